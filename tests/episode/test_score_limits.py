"""The verdict by limits: by hand, with samples lost, and of episodes that ended early."""

import numpy as np
import pytest

from chargetune.episode.score_limits import moving_mean


def test_moving_mean_by_hand():
    np.testing.assert_allclose(moving_mean(np.array([0.0, 3.0, 6.0, 0.0]), 3), [1.5, 3.0, 3.0, 3.0])
    np.testing.assert_allclose(moving_mean(np.array([1.0, 2.0]), 9), [1.5, 1.5])
    assert moving_mean(np.zeros(0), 3).size == 0


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 9])
def test_a_lost_sample_is_left_out_of_the_mean_and_spoils_no_other(samples):
    draw = np.random.default_rng(4)
    values = draw.normal(size=40)
    values[[0, 7, 8, 9, 10, 11, 20]] = [np.nan, np.nan, np.inf, np.nan, np.nan, -np.inf, np.nan]
    found = moving_mean(values, samples)
    for k in range(values.size):
        part = values[max(0, k - samples // 2) : k + (samples - 1) // 2 + 1]
        known = part[np.isfinite(part)]
        if samples > 1:
            assert found[k] == pytest.approx(np.mean(known)) if known.size else np.isnan(found[k]), k
