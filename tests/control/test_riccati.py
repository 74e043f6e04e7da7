"""The steady filter against SciPy's solution of the Riccati equation."""

import numpy as np
from scipy.linalg import solve_discrete_are
from test_estimators import A, C, linear

from chargetune.control.kalman import ExtendedKalman
from chargetune.control.riccati import steady_filter

SD, PROCESS = (0.1, 0.2), (0.02, 0.03)


def test_it_is_the_solution_of_the_riccati_equation():
    found = steady_filter(linear(), ExtendedKalman(("y", "w"), SD, PROCESS, (1.0, 2.0)), np.zeros(2), np.zeros(1))
    noise = np.diag(np.square(SD))
    ahead = solve_discrete_are(A.T, C.T, np.diag(np.square(PROCESS)), noise)
    np.testing.assert_allclose(found.gain, ahead @ C.T @ np.linalg.inv(C @ ahead @ C.T + noise), atol=1e-12)
    np.testing.assert_allclose(found.prediction_sd, np.sqrt(np.diag(C @ ahead @ C.T)), atol=1e-12)
    np.testing.assert_allclose(found.transition, A)
    np.testing.assert_allclose(found.output, C)
