"""What counted violations say about the probability of one."""

from __future__ import annotations

import math

__all__ = ["violation_bound"]


def violation_bound(violations: int, episodes: int, confidence: float = 0.95) -> float:
    """Upper Clopper-Pearson bound on the probability of a violation, from ``violations`` in ``episodes`` independent ones.

    The p at which so few violations or fewer have the probability 1 - confidence: the quantile ``confidence`` of
    Beta(k + 1, n - k), 1 - (1 - confidence)^(1/n) for k = 0, and 1 for k = n. Whatever the true probability is, the
    bound lies below it in at most a share 1 - confidence of all repetitions. Raises ValueError.
    Source: Clopper and Pearson, Biometrika 26 (1934) 404.
    """
    if isinstance(episodes, bool) or not isinstance(episodes, int) or episodes < 1:
        raise ValueError(f"episodes = {episodes!r}, allowed is an integer >= 1")
    if isinstance(violations, bool) or not isinstance(violations, int) or not 0 <= violations <= episodes:
        raise ValueError(f"violations = {violations!r}, allowed is an integer in [0, {episodes}]")
    if not isinstance(confidence, (int, float)) or not math.isfinite(confidence) or not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence = {confidence!r}, allowed is (0, 1)")
    if violations == episodes:
        return 1.0
    from scipy.stats import beta

    return float(beta.ppf(confidence, violations + 1, episodes - violations))
