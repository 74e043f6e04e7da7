"""The Clopper-Pearson bound: closed forms, its defining equation, and exact coverage."""

import numpy as np
import pytest
from scipy.stats import binom

from chargetune.battery.certification.clopper_pearson import violation_bound


@pytest.mark.parametrize("episodes", [1, 10, 300, 5000])
@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.999])
def test_closed_forms(episodes, confidence):
    alpha = 1 - confidence
    assert violation_bound(0, episodes, confidence) == pytest.approx(1 - alpha ** (1 / episodes), rel=1e-9)
    assert violation_bound(episodes, episodes, confidence) == 1.0
    if episodes > 1:
        # All but one: 1 - p^n = 1 - confidence.
        assert violation_bound(episodes - 1, episodes, confidence) == pytest.approx(confidence ** (1 / episodes), rel=1e-9)


@pytest.mark.parametrize(("violations", "episodes"), [(1, 10), (7, 50), (30, 300), (299, 300)])
def test_at_the_bound_so_few_violations_have_the_remaining_probability(violations, episodes):
    bound = violation_bound(violations, episodes, 0.95)
    assert binom.cdf(violations, episodes, bound) == pytest.approx(0.05, rel=1e-9)


@pytest.mark.parametrize("p", [0.001, 0.02, 0.1, 0.5, 0.93])
@pytest.mark.parametrize("episodes", [10, 60, 300])
def test_the_bound_covers_every_rate_with_its_confidence(p, episodes):
    """Summed over all outcomes instead of drawn; below by what counting in whole numbers costs, never by more than that."""
    counts = np.arange(episodes + 1)
    covered = np.array([violation_bound(int(k), episodes, 0.9) >= p for k in counts])
    coverage = float(np.sum(binom.pmf(counts, episodes, p)[covered]))
    assert coverage >= 0.9 - 1e-12
    first = int(np.argmax(covered))
    assert coverage - float(binom.pmf(first, episodes, p)) < 0.9


@pytest.mark.parametrize(
    ("arguments", "words"),
    [((1, 0), "episodes = 0"), ((5, 4), "violations = 5"), ((-1, 4), "violations = -1"), ((True, 4), "violations = True"),
     ((1, 4, 1.0), "confidence = 1.0"), ((1, 4, float("nan")), "confidence = nan")],
)  # fmt: skip
def test_nonsense_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        violation_bound(*arguments)
