"""Tuners: pure functions that propose theta from the trials so far. Only this folder imports torch.

Each name is imported when it is first asked for: torch takes two thirds of the time in which a command starts, and Sobol's points,
an envelope and what safety refuses need none of it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_MODULES = {
    "Composite": "composite", "ConstrainedLogEI": "constrained", "Envelope": "envelope", "ExpectedImprovement": "expected_improvement",
    "GaussianProcess": "surrogate", "NoSafeThetaError": "safety", "Posterior": "posterior", "Safety": "safety", "Sobol": "sobol",
    "TrialLike": "tuner", "Tuner": "tuner", "Twin": "twin", "TwinTuner": "twin_tuner", "Uncertain": "twin",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
