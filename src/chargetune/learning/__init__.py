"""Tuners: pure functions that propose theta from the trials so far. Only this folder imports torch."""

from chargetune.learning.composite import Composite
from chargetune.learning.constrained import ConstrainedLogEI
from chargetune.learning.envelope import Envelope
from chargetune.learning.expected_improvement import ExpectedImprovement
from chargetune.learning.posterior import Posterior
from chargetune.learning.safety import NoSafeThetaError, Safety
from chargetune.learning.sobol import Sobol
from chargetune.learning.surrogate import GaussianProcess
from chargetune.learning.tuner import TrialLike, Tuner
from chargetune.learning.twin import Twin, Uncertain
from chargetune.learning.twin_tuner import TwinTuner

__all__ = [
    "Composite", "ConstrainedLogEI", "Envelope", "ExpectedImprovement", "GaussianProcess", "NoSafeThetaError", "Posterior", "Safety",
    "Sobol", "TrialLike", "Tuner", "Twin", "TwinTuner", "Uncertain",
]  # fmt: skip
