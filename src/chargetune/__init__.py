"""Tuning of model predictive charging controllers in closed loop.

cell -> model -> controller(theta) -> plant -> episode -> score -> tuner -> trial -> study -> report, web

Signs and units everywhere: current is positive when it charges; volts, amperes, seconds, ohm, farad, kelvin; state of
charge from 0 to 1; capacity in ampere-hours. Where a person types a number its name carries the unit (``voltage_max_V``).

``import chargetune as ct`` offers what a study needs, ``ct.Model`` to ``ct.TwinTuner``. Each name is imported when it is first
asked for: the import itself takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from chargetune.battery.case_study.configurations import case_study
    from chargetune.battery.cell.cell import Cell, default_cell, load_cell
    from chargetune.battery.charging.evaluate import evaluate, run_charge
    from chargetune.battery.charging.problem import ChargingProblem
    from chargetune.battery.charging.settings import EstimatorSettings
    from chargetune.battery.identification.cycler_files import read_record
    from chargetune.battery.identification.pulse_fit import cell_toml, identify
    from chargetune.battery.plants.electrochemical import Electrochemical
    from chargetune.battery.studies.open_study import evaluation_of, open_study
    from chargetune.battery.studies.study_file import load_config
    from chargetune.control.controller import Controller, SoftLimit, Stage
    from chargetune.control.estimators import ExactState, Propagated
    from chargetune.control.kalman import ExtendedKalman
    from chargetune.episode.compiled import simulate
    from chargetune.episode.episode import Ending, Episode, Trip
    from chargetune.episode.recorded import recorded_episode
    from chargetune.episode.score import Score
    from chargetune.episode.score_limits import Evaluation, ScoredLimit, Windows, score_limits
    from chargetune.episode.stepwise import run_episode
    from chargetune.learning.black_box.composite import Composite
    from chargetune.learning.black_box.constrained_ei import ConstrainedLogEI
    from chargetune.learning.black_box.expected_improvement import ExpectedImprovement
    from chargetune.learning.closed_loop.iterative_learning import IterativeLearning
    from chargetune.learning.initial_design import Sobol
    from chargetune.learning.range_of_use.range_loop import SimulatedRange
    from chargetune.learning.range_of_use.range_tuner import RangeSettings, RangeTuner
    from chargetune.learning.range_of_use.range_twin import SimulatedRangeTwin
    from chargetune.learning.range_of_use.range_verdict import RangeEvaluation
    from chargetune.learning.range_twin_tuner import RangeTwinSettings, RangeTwinTuner
    from chargetune.learning.safety import NoSafeThetaError, Safety
    from chargetune.learning.twin.settings import TwinSettings
    from chargetune.learning.twin.simulated_twin import SimulatedTwin
    from chargetune.learning.twin.twin import Twin, Uncertain
    from chargetune.learning.twin_tuner import TwinTuner
    from chargetune.model.disturbances import with_disturbances
    from chargetune.model.do_mpc import from_do_mpc
    from chargetune.model.integrators import rk4
    from chargetune.model.model import Model, Signal
    from chargetune.model.parameter_space import Parameter, ParameterSpace
    from chargetune.plants.gymnasium import GymnasiumPlant
    from chargetune.plants.plant import Measurement, PlantError
    from chargetune.plants.range_of_use import OwnDraws, RangeOfUse
    from chargetune.plants.sensors import Sensors
    from chargetune.plants.simulated import SimulatedPlant
    from chargetune.plants.variation import Choice, LogNormal, Normal, StudentT, Uniform, Variation
    from chargetune.study.recompute import recompute
    from chargetune.study.store.store import Store
    from chargetune.study.study import Study
    from chargetune.study.warm_start import Earlier

__all__ = [
    "Cell",
    "ChargingProblem",
    "Choice",
    "Composite",
    "ConstrainedLogEI",
    "Controller",
    "Earlier",
    "Electrochemical",
    "Ending",
    "Episode",
    "EstimatorSettings",
    "Evaluation",
    "ExactState",
    "ExpectedImprovement",
    "ExtendedKalman",
    "GymnasiumPlant",
    "IterativeLearning",
    "LogNormal",
    "Measurement",
    "Model",
    "NoSafeThetaError",
    "Normal",
    "OwnDraws",
    "Parameter",
    "ParameterSpace",
    "PlantError",
    "Propagated",
    "RangeEvaluation",
    "RangeOfUse",
    "RangeSettings",
    "RangeTuner",
    "RangeTwinSettings",
    "RangeTwinTuner",
    "Safety",
    "Score",
    "ScoredLimit",
    "Sensors",
    "Signal",
    "SimulatedPlant",
    "SimulatedRange",
    "SimulatedRangeTwin",
    "SimulatedTwin",
    "Sobol",
    "SoftLimit",
    "Stage",
    "Store",
    "StudentT",
    "Study",
    "Trip",
    "Twin",
    "TwinSettings",
    "TwinTuner",
    "Uncertain",
    "Uniform",
    "Variation",
    "Windows",
    "__version__",
    "case_study",
    "cell_toml",
    "default_cell",
    "evaluate",
    "evaluation_of",
    "from_do_mpc",
    "identify",
    "load_cell",
    "load_config",
    "open_study",
    "read_record",
    "recompute",
    "recorded_episode",
    "rk4",
    "run_charge",
    "run_episode",
    "score_limits",
    "simulate",
    "with_disturbances",
]

# A literal, not importlib.metadata: reading the metadata costs a tenth of the time that ``chargetune --help`` may take.
__version__ = "0.1.0"

_MODULES = {
    "Cell": "battery.cell.cell",
    "ChargingProblem": "battery.charging.problem",
    "Choice": "plants.variation",
    "Composite": "learning.black_box.composite",
    "ConstrainedLogEI": "learning.black_box.constrained_ei",
    "Controller": "control.controller",
    "Earlier": "study.warm_start",
    "Electrochemical": "battery.plants.electrochemical",
    "Ending": "episode.episode",
    "Episode": "episode.episode",
    "EstimatorSettings": "battery.charging.settings",
    "Evaluation": "episode.score_limits",
    "ExactState": "control.estimators",
    "ExpectedImprovement": "learning.black_box.expected_improvement",
    "ExtendedKalman": "control.kalman",
    "GymnasiumPlant": "plants.gymnasium",
    "IterativeLearning": "learning.closed_loop.iterative_learning",
    "LogNormal": "plants.variation",
    "Measurement": "plants.plant",
    "Model": "model.model",
    "NoSafeThetaError": "learning.safety",
    "Normal": "plants.variation",
    "OwnDraws": "plants.range_of_use",
    "Parameter": "model.parameter_space",
    "ParameterSpace": "model.parameter_space",
    "PlantError": "plants.plant",
    "Propagated": "control.estimators",
    "RangeEvaluation": "learning.range_of_use.range_verdict",
    "RangeOfUse": "plants.range_of_use",
    "RangeSettings": "learning.range_of_use.range_tuner",
    "RangeTuner": "learning.range_of_use.range_tuner",
    "RangeTwinSettings": "learning.range_twin_tuner",
    "RangeTwinTuner": "learning.range_twin_tuner",
    "Safety": "learning.safety",
    "Score": "episode.score",
    "ScoredLimit": "episode.score_limits",
    "Sensors": "plants.sensors",
    "Signal": "model.model",
    "SimulatedPlant": "plants.simulated",
    "SimulatedRange": "learning.range_of_use.range_loop",
    "SimulatedRangeTwin": "learning.range_of_use.range_twin",
    "SimulatedTwin": "learning.twin.simulated_twin",
    "Sobol": "learning.initial_design",
    "SoftLimit": "control.controller",
    "Stage": "control.controller",
    "Store": "study.store.store",
    "StudentT": "plants.variation",
    "Study": "study.study",
    "Trip": "episode.episode",
    "Twin": "learning.twin.twin",
    "TwinSettings": "learning.twin.settings",
    "TwinTuner": "learning.twin_tuner",
    "Uncertain": "learning.twin.twin",
    "Uniform": "plants.variation",
    "Variation": "plants.variation",
    "Windows": "episode.score_limits",
    "case_study": "battery.case_study.configurations",
    "cell_toml": "battery.identification.pulse_fit",
    "default_cell": "battery.cell.cell",
    "evaluate": "battery.charging.evaluate",
    "evaluation_of": "battery.studies.open_study",
    "from_do_mpc": "model.do_mpc",
    "identify": "battery.identification.pulse_fit",
    "load_cell": "battery.cell.cell",
    "load_config": "battery.studies.study_file",
    "open_study": "battery.studies.open_study",
    "read_record": "battery.identification.cycler_files",
    "recompute": "study.recompute",
    "recorded_episode": "episode.recorded",
    "rk4": "model.integrators",
    "run_charge": "battery.charging.evaluate",
    "run_episode": "episode.stepwise",
    "score_limits": "episode.score_limits",
    "simulate": "episode.compiled",
    "with_disturbances": "model.disturbances",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    # The next time it is found at once.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
