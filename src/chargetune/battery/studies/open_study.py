"""From a study file to a study in a store."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING

from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.range_twin import ChargingRangeTwin, RangeCharge
from chargetune.battery.charging.soc_windows import ChargingWindows
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.battery.studies.carry_over import ChargingCarry
from chargetune.battery.studies.study_file import Config, TunerName, TwinTable
from chargetune.study.evaluation import Evaluate
from chargetune.study.store.store import Store
from chargetune.study.study import Proposer, Study

if TYPE_CHECKING:
    from chargetune.learning.range_of_use.range_tuner import RangeSettings
    from chargetune.learning.range_of_use.range_verdict import RangeEvaluation

__all__ = ["evaluation_of", "make_tuner", "open_study"]


def evaluation_of(name: TunerName, problem: ChargingProblem, executor: Executor | None = None) -> Evaluate:
    """What a trial of this tuner is, as `Study.run` takes it: ``study.run(evaluation_of(config.study.tuner, config.problem()), 4)``.

    One charge; with "range" a theta on fresh draws of the range of use (`RangeEvaluation`); with "twin" over a range one charge under a
    condition that the trial's seed draws. Raises ValueError for "range" without a range of use. ``executor`` charges the
    plants of a trial of "range" where they are electrochemical; None: this process, one after the other.
    """
    if name == "twin" and problem.range is not None:
        return RangeCharge(problem)
    return _over_range(problem, executor) if name == "range" else Evaluation(problem)


def _over_range(problem: ChargingProblem, executor: Executor | None) -> RangeEvaluation:
    if problem.range is None:
        raise ValueError("tuner = 'range' is given without a table [range], which says what differs between the charges")
    from chargetune import learning

    return learning.RangeEvaluation(ChargingRange(problem, executor), problem.range.draws, problem.range.objective_quantile)


def make_tuner(
    name: TunerName,
    seed: int,
    problem: ChargingProblem,
    unknown: TwinTable | None = None,
    executor: Executor | None = None,
) -> Proposer:
    """The tuner that a configuration names; the twin simulates the problem's controller, and is safe where the problem says how.

    ``executor``: as in `evaluation_of`, for the charges with which "range" chooses theta.
    Raises ValueError when it is to be safe and cannot.
    """
    safety = problem.safety
    if safety and name != "twin":
        raise ValueError(f"[safety] is given with tuner = {name!r}, allowed is tuner = 'twin': it alone predicts what it has not tried")
    if unknown and name != "twin":
        raise ValueError(f"[twin] is given with tuner = {name!r}, allowed is tuner = 'twin': the others have no model of the plant")
    if problem.theta.schedule and name != "range":
        raise ValueError(
            f"[theta.schedule] is given with tuner = {name!r}, allowed is tuner = 'range': the others charge in one context, in which "
            "most of the table has no say"
        )
    # torch is needed from here on only.
    from chargetune import learning

    start = problem.safe_start
    first = None if start is None else tuple(float(v) for v in start)
    safe = learning.Safety(safety.probability, first, safety.budget_mVs) if safety else None
    if name == "twin" and problem.range is not None:
        of_range = ChargingRangeTwin(problem, _model_spread(problem, unknown))
        if of_range.unpredicted:
            raise ValueError(_unpredicted("tuner = 'twin' is given with a table [range]", of_range.unpredicted))
        quantile = problem.range.objective_quantile
        settings = learning.RangeTwinSettings(objective_quantile=quantile)
        return learning.RangeTwinTuner(of_range, seed=seed, safety=safe or learning.Safety(), settings=settings)
    known = unknown or TwinTable()
    twin = ChargingTwin(
        problem,
        spread=known.resistance_spread,
        capacity_spread=known.capacity_spread,
        soc_spread=known.soc_spread,
        ocv_spread_V=known.ocv_spread_V,
    )
    if safety and twin.unpredicted:
        raise ValueError(_unpredicted("[safety] is given", twin.unpredicted))
    makers: dict[str, Callable[[int], Proposer]] = {
        "default": lambda s: learning.ConstrainedLogEI(seed=s),
        "ei": lambda s: learning.ExpectedImprovement(seed=s),
        "sobol": lambda s: learning.Sobol(seed=s),
        "composite": lambda s: learning.Composite(ChargingWindows(problem), seed=s),
        "iterative_learning": lambda _: learning.IterativeLearning(twin),
        "range": lambda s: learning.RangeTuner(_over_range(problem, executor), seed=s, settings=_search_of(problem)),
        "twin": lambda s: learning.TwinTuner(twin, seed=s, safety=safe),
    }
    return makers[name](seed)


def _search_of(problem: ChargingProblem) -> RangeSettings:
    """A charge of an electrochemical plant takes as long as a thousand of a circuit: fewer plants, and one start of the search.

    So few say less of those that were not drawn: all of the tolerance is left for these.
    """
    from chargetune import learning

    drop_idle = problem.range is not None and problem.range.drop_idle
    if problem.plant_cell is not None:
        return learning.RangeSettings(drop_idle=drop_idle)
    return learning.RangeSettings(plants=12, added=6, first=4, pool=0, corners=8, iterations=6, aim=0.0, drop_idle=drop_idle)


def _model_spread(problem: ChargingProblem, unknown: TwinTable | None) -> float:
    """What the circuit is unsure of beside the range: nothing where the plant is that circuit."""
    if problem.plant is None and unknown:
        raise ValueError(
            "[twin] is given with a table [range] and without [plant], allowed is one of them: the range says what is unknown of the cell"
        )
    for name in ("capacity_spread", "soc_spread", "ocv_spread_V"):
        if unknown and getattr(unknown, name):
            raise ValueError(f"twin: {name} = {getattr(unknown, name):g}, allowed is 0 with a table [range], which says that")
    return 0.0 if problem.plant is None else (unknown or TwinTable()).resistance_spread


def _unpredicted(what: str, limits: Sequence[str]) -> str:
    return (
        f"{what} with the limits {', '.join(limits)}, which the cell's circuit does not predict: "
        "allowed are limits whose table ([thermal], [anode]) the cell file has"
    )


def open_study(
    store: Store, config: Config, folder: Path | None = None, *, accept_changed: bool = False, executor: Executor | None = None
) -> Study:
    """The study of a configuration, begun or resumed; see `Study.create_or_resume`. ``executor``: as in `make_tuner`."""
    if config.safety and config.study.earlier:
        raise ValueError(
            "[safety] is given with [[study.earlier]]: the trials of an earlier study may be of another cell, and what that one allowed "
            "is not known to be safe for this one; allowed is one of the two"
        )
    problem = config.problem(folder)
    with config.named():
        tuner = make_tuner(config.study.tuner, config.study.seed, problem, config.twin, executor)
    return Study.create_or_resume(
        store,
        config.study.name,
        config=config.document(folder),
        space=problem.space,
        tuner=tuner,
        seed=config.study.seed,
        batch=config.study.batch,
        earlier=config.earlier(folder),
        accept_changed=accept_changed,
        carry=ChargingCarry(problem),
    )
