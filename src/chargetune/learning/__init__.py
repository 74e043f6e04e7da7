"""Tuners: pure functions that propose theta from the trials so far. Only this folder imports torch.

Each name is imported when it is first asked for: torch takes two thirds of the time in which a command starts, and Sobol's points,
an envelope and what safety refuses need none of it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from chargetune.learning.black_box.composite import Composite
    from chargetune.learning.black_box.constrained_ei import ConstrainedLogEI
    from chargetune.learning.black_box.expected_improvement import ExpectedImprovement
    from chargetune.learning.black_box.gaussian_process import GaussianProcess
    from chargetune.learning.closed_loop.iterative_learning import IterativeLearning
    from chargetune.learning.initial_design import Sobol
    from chargetune.learning.range_of_use.range_loop import SimulatedRange
    from chargetune.learning.range_of_use.range_tuner import RangeSettings, RangeTuner
    from chargetune.learning.range_of_use.range_twin import SimulatedRangeTwin
    from chargetune.learning.range_of_use.range_verdict import RangeEvaluation
    from chargetune.learning.range_twin_tuner import RangeTwinSettings, RangeTwinTuner
    from chargetune.learning.safety import NoSafeThetaError, Safety
    from chargetune.learning.tuner import TrialLike, Tuner
    from chargetune.learning.twin.posterior import Posterior
    from chargetune.learning.twin.settings import TwinSettings
    from chargetune.learning.twin.simulated_twin import SimulatedTwin
    from chargetune.learning.twin.twin import Twin, Uncertain
    from chargetune.learning.twin_tuner import TwinTuner

__all__ = [
    "Composite",
    "ConstrainedLogEI",
    "ExpectedImprovement",
    "GaussianProcess",
    "IterativeLearning",
    "NoSafeThetaError",
    "Posterior",
    "RangeEvaluation",
    "RangeSettings",
    "RangeTuner",
    "RangeTwinSettings",
    "RangeTwinTuner",
    "Safety",
    "SimulatedRange",
    "SimulatedRangeTwin",
    "SimulatedTwin",
    "Sobol",
    "TrialLike",
    "Tuner",
    "Twin",
    "TwinSettings",
    "TwinTuner",
    "Uncertain",
]

_MODULES = {
    "Composite": "black_box.composite",
    "ConstrainedLogEI": "black_box.constrained_ei",
    "ExpectedImprovement": "black_box.expected_improvement",
    "GaussianProcess": "black_box.gaussian_process",
    "IterativeLearning": "closed_loop.iterative_learning",
    "NoSafeThetaError": "safety",
    "Posterior": "twin.posterior",
    "RangeEvaluation": "range_of_use.range_verdict",
    "RangeSettings": "range_of_use.range_tuner",
    "RangeTuner": "range_of_use.range_tuner",
    "RangeTwinSettings": "range_twin_tuner",
    "RangeTwinTuner": "range_twin_tuner",
    "Safety": "safety",
    "SimulatedRange": "range_of_use.range_loop",
    "SimulatedRangeTwin": "range_of_use.range_twin",
    "SimulatedTwin": "twin.simulated_twin",
    "Sobol": "initial_design",
    "TrialLike": "tuner",
    "Tuner": "tuner",
    "Twin": "twin.twin",
    "TwinSettings": "twin.settings",
    "TwinTuner": "twin_tuner",
    "Uncertain": "twin.twin",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
