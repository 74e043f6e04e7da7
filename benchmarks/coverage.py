"""How many new samples of the voltage lie in the 90 % intervals that the twin states after one, two and three trials.

python benchmarks/coverage.py --plant ecm|unknown|structural --study r0 --seeds 0:10

The ensemble is the one by which safe mode chooses the next trial. Two trials are predicted by it, noise of the sensor included: that
next one, and one whose theta is midway between theta_0 and the upper bounds. Printed are the means over the seeds, the lowest seed
in brackets.
"""

from __future__ import annotations

import argparse
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from learning_plants import PLANTS, STUDIES, make_problem
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from chargetune.battery.charging.evaluate import evaluate
from chargetune.episode.episode import Episode
from chargetune.learning.twin.ensemble import Ensemble, condition
from chargetune.learning.twin.settings import TwinSettings
from learning import METHODS

TRIALS, PLANTS_DRAWN, NOISE_V, STATED = 3, 96, 2e-3, 0.9


def share(ensemble: Ensemble, episode: Episode, seed: int) -> float:
    """Of the noisy samples of the voltage, the share within the stated intervals."""
    replayed = ensemble.replayed(episode, seed).episodes
    drawn = np.array([np.stack(e.signal("voltage_V"), axis=1) for e in replayed if e is not None])
    drawn = drawn + NOISE_V * np.random.default_rng(seed).standard_normal(drawn.shape)
    low, high = np.quantile(drawn, [(1 - STATED) / 2, (1 + STATED) / 2], axis=0)
    measured = np.stack(episode.signal("voltage_V"), axis=1)
    return float(np.mean((measured >= low) & (measured <= high)))


def study(plant: str, name: str, seed: int) -> list[list[float]]:
    """By number of trials: (coverage of the next trial, of one further away)."""
    warnings.simplefilter("ignore", RuntimeWarning)
    problem = make_problem(plant, name, seed, NOISE_V)
    tuner: Any = METHODS["safe"](problem, seed)
    afar = (problem.space.upper + problem.space.default) / 2
    told: list[SimpleNamespace] = []
    out = []
    with threadpool_limits(1):
        for k in range(TRIALS + 1):
            theta = tuner.ask(problem.space, told, 1)[0]
            score, episode, ending = evaluate(problem, theta, 1000 * seed + k)
            if told:
                ensemble = condition(tuner.loop, told, TwinSettings(plants=PLANTS_DRAWN))
                other = evaluate(problem, afar, 1000 * seed + 500 + k)[1]
                out.append([share(ensemble, e, seed) for e in (episode, other)])
            status = "done" if score else "failed"
            told.append(
                SimpleNamespace(number=k, theta=tuple(theta), status=status, score=score, ending=ending, episode=lambda e=episode: e)
            )
    return out


def text(values: NDArray[np.float64]) -> str:
    """By number of trials, from shares of shape (seeds, trials)."""
    return ", ".join(f"{100 * m:.0f} ({100 * low:.0f})" for m, low in zip(values.mean(axis=0), values.min(axis=0), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plant", choices=[p for p in PLANTS if not p.startswith("dfn")], default="structural")
    parser.add_argument("--study", choices=list(STUDIES), default="r0")
    parser.add_argument("--seeds", default="0:10")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    first, _, last = args.seeds.partition(":")
    with ProcessPoolExecutor(args.workers) as pool:
        found = np.array(list(pool.map(partial(study, args.plant, args.study), range(int(first), int(last)))))
    print(f"{args.plant}, {args.study}, seeds {args.seeds}: % of new samples in {100 * STATED:.0f} % intervals after 1, 2, 3 trials")
    print(f"next trial: {text(found[..., 0])}; far from what was tried: {text(found[..., 1])}")


if __name__ == "__main__":
    main()
