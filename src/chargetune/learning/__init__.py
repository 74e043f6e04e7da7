"""Tuners: pure functions that propose theta from the trials so far. Only this folder imports torch."""

from chargetune.learning.constrained import ConstrainedLogEI
from chargetune.learning.expected_improvement import ExpectedImprovement
from chargetune.learning.sobol import Sobol
from chargetune.learning.surrogate import GaussianProcess
from chargetune.learning.tuner import TrialLike, Tuner
from chargetune.learning.twin import Posterior, Twin, Uncertain
from chargetune.learning.twin_tuner import TwinTuner

__all__ = [
    "ConstrainedLogEI", "ExpectedImprovement", "GaussianProcess", "Posterior", "Sobol",
    "TrialLike", "Tuner", "Twin", "TwinTuner", "Uncertain",
]  # fmt: skip
