"""Small real studies in stores: a charging problem, a tuner without learning, ten trials."""

from dataclasses import dataclass
from itertools import count

import numpy as np

from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.charging.limits import LimitSettings
from chargetune.battery.charging.settings import ControllerSettings, EpisodeSettings
from chargetune.battery.charging.tunables import Backoff, ResistanceRatio, Tunables
from chargetune.battery.studies.study_file import Config, StudyTable
from chargetune.episode.episode import Ending
from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.study.serialization import space_to_json
from chargetune.study.store.store import Store
from chargetune.study.study import Study
from chargetune.study.trial import Trial

TRIALS = 10
CUT = 20


@dataclass(frozen=True)
class LocalSobol:
    """theta_0, then scrambled Sobol points in the part of the unit cube within ``reach`` of theta_0."""

    reach: float = 1.0
    seed: int = 2

    def ask(self, space, trials, n=1):
        # Who reads a store alone needs none of it, and it takes a second.
        from scipy.stats import qmc

        points = qmc.Sobol(space.dimension, rng=self.seed).random(128)
        start = space.to_unit(space.default)
        thetas = space.from_unit(start + self.reach * (points - start))
        thetas[0] = space.default
        return thetas[len(trials) : len(trials) + n]


@dataclass(frozen=True)
class Given:
    """The thetas that a test wants tried."""

    thetas: tuple[tuple[float, ...], ...]

    def ask(self, space, trials, n=1):
        return np.array(self.thetas[len(trials) : len(trials) + n])


def charging(tuner="sobol", *, tolerance_V=0.0005):
    """A configuration that tunes a backoff, R0 and R1; all have one structure, so that one compilation serves every test."""
    return Config(
        study=StudyTable(name="charge", tuner=tuner),
        controller=ControllerSettings(mismatch_seed=0, horizon=3),
        limits=LimitSettings(tolerance_V=tolerance_V),
        episode=EpisodeSettings(steps=150),
        theta=Tunables(backoff=Backoff(nodes=5), R0=ResistanceRatio(), R1=ResistanceRatio()),
    )


def run_charging(path, config, *, reach=0.7, cut=(), raising=(), trials=TRIALS):
    """Run the study; trials in ``cut`` fail and leave the start of their trace, those in ``raising`` fail without any."""
    problem, numbers = config.problem(), count()

    def evaluate(theta, seed):
        number = next(numbers)
        if number in raising:
            raise RuntimeError(f"the cycler lost its connection at trial {number}")
        score, episode, ending = Evaluation(problem)(theta, seed)
        if number in cut:
            return None, episode.cut(CUT, Ending.LIMIT, "too hot"), "limit trip: too hot"
        return score, episode, ending

    with (
        Store(path) as store,
        Study.create_or_resume(store, config.study.name, config=config.document(), space=problem.space, tuner=LocalSobol(reach)) as study,
    ):
        study.run(evaluate, trials)
    return path


HOSTILE = '<script>alert("x")</script>&amp;"\'</title>'


def other_study(path, name=HOSTILE):
    """A study that is not about a battery, with a name that wants to be markup."""
    space = ParameterSpace((Parameter("gain", 0.1, 10.0, 1.0, scale="log"), Parameter("shift", -1.0, 1.0, 0.0)))
    with Store(path) as store:
        record = store.add_study(name, {"config": {"what": HOSTILE}, "space": space_to_json(space), "tuner": {}, "seed": 0, "batch": 1})
        for n in range(12):
            x = (1.0, 0.0) if n == 0 else (0.1 + 0.5 * n, np.sin(n))
            store.add_trials(record.id, [Trial(n, x)])
            score = Score(-float(n), -1.0 - n, {HOSTILE: 0.5 - n}, {HOSTILE: 0.0}, {"cost": 1.0 * n})
            if n == 11:
                store.finish_trial(record.id, n, score=None, ending=HOSTILE, trace=None, provenance={})
            else:
                store.finish_trial(record.id, n, score=score, ending="done", trace=None, provenance={"versions": {HOSTILE: HOSTILE}})
    return path


def lines(axis, color):
    """Lines with data of one colour on an axis, in the order in which they were drawn."""
    return [line for line in axis.lines if line.get_color() == color]


def segments(axis):
    """The grey curves."""
    return [np.asarray(s) for collection in axis.collections for s in getattr(collection, "get_segments", list)()]


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]
