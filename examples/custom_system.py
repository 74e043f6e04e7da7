"""Tune an MPC for a system that is no battery: an overhead crane moves its load 2 m without letting it swing too far.

The controller believes in a rope of 0.6 m, the crane has 1.0 m, so the load swings beyond its limit. theta has one entry in
the cost (weight of the swing) and one in the model (rope length). Run: python examples/custom_system.py [TRIALS]
"""

import sys
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np

from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.estimators import ExactState
from chargetune.episode.compiled import simulate
from chargetune.episode.score import Score
from chargetune.learning import ConstrainedLogEI
from chargetune.model.integrators import rk4
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.simulated import SimulatedPlant
from chargetune.study.store.store import Store
from chargetune.study.study import Study

TS, STEPS, SWING_MAX_RAD = 0.1, 80, 0.10


def crane(rope_m):
    """Trolley acceleration a moves position and, through the rope, the angle: angle'' = -(g sin(angle) + a cos(angle)) / rope."""

    def equations(x, u, p):
        def rate(state):
            _, speed, angle, turn = ca.vertsplit(state)
            swing = -(9.81 * ca.sin(angle) + u["acceleration"] * ca.cos(angle)) / p["rope_m"]
            return ca.vertcat(speed, u["acceleration"], turn, swing - 0.05 * turn)

        after = rk4(rate, x.vector, TS, substeps=2)
        names = ("position", "speed", "angle", "turn")
        return dict(zip(names, ca.vertsplit(after), strict=True)), {name: x[name] for name in names}

    signals = (Signal("position", "m"), Signal("speed", "m/s"), Signal("angle", "rad"), Signal("turn", "rad/s"))
    return Model.build(
        "crane", states=signals, inputs=(Signal("acceleration", "m/s2"),), outputs=signals,
        parameters={"rope_m": rope_m}, sampling_time_s=TS, equations=equations,
    )  # fmt: skip


SPACE = ParameterSpace((
    Parameter("swing_weight", 1e-2, 1e2, default=0.1, scale="log"),
    Parameter("rope_m", 0.5, 2.0, default=0.6, unit="m"),
))  # fmt: skip


def cost(s):
    """Distance from the set-point, a little speed and effort, and the swing by a tuned weight."""
    away = (s.x["position"] - s.x_d["position"]) ** 2
    return away + 0.1 * s.x["speed"] ** 2 + s.theta["swing_weight"] * s.x["angle"] ** 2 + 0.01 * s.u["acceleration"] ** 2


CONTROLLER = Controller.build(
    crane(0.6), SPACE, horizon=20, stage_cost=cost,
    terminal_cost=lambda s: 10 * ((s.x["position"] - s.x_d["position"]) ** 2 + s.x["speed"] ** 2),
    parameters=lambda s: {"rope_m": s.theta["rope_m"]},
    input_lower={"acceleration": -1.0}, input_upper={"acceleration": 1.0}, fallback={"acceleration": 0.0},
    limits=[SoftLimit("angle", lower=-SWING_MAX_RAD, upper=SWING_MAX_RAD, at="end", penalty=1e4, scale=0.1)],
    setpoint={"position": 2.0}, estimator=ExactState(),
)  # fmt: skip


def evaluate(theta, seed):
    """One move of the real crane: the distance still to go, integrated, and how far the load swung."""
    episode = simulate(CONTROLLER, SimulatedPlant(crane(1.0), {}), steps=STEPS, theta=theta, seed=seed)
    position, angle = episode.signal("position")[1], episode.signal("angle")[1]
    distance = float(np.sum(np.abs(2.0 - position)) * TS)
    excess = float(np.max(np.abs(angle)) - SWING_MAX_RAD)
    score = Score(
        objective=-distance,
        performance=-distance - 100 * max(0.0, excess),
        excess={"swing_rad": excess},
        tolerance={"swing_rad": 1e-3},
        metrics={"distance_ms": distance, "swing_rad": excess + SWING_MAX_RAD},
    )
    return score, episode, episode.ending.value


def main(trials):
    """Tune, and print the untuned and the tuned run."""
    with tempfile.TemporaryDirectory() as folder, Store(Path(folder) / "crane.sqlite") as store:
        setup = {"system": "crane", "steps": STEPS, "swing_max_rad": SWING_MAX_RAD}
        with Study.create_or_resume(store, "crane", config=setup, space=SPACE, tuner=ConstrainedLogEI(seed=0)) as study:
            best = study.run(evaluate, trials, progress=lambda *_: print(".", end="", flush=True))
            untuned = study.trials()[0]
    print()
    for name, trial in (("untuned", untuned), ("tuned", best)):
        if trial is None or trial.score is None:
            print(f"{name}: no trial kept the limit")
            continue
        m = trial.score.metrics
        values = ", ".join(f"{n} = {v:.3g}" for n, v in zip(SPACE.entries, trial.theta, strict=True))
        print(f"{name:8}: swing {m['swing_rad']:.3f} rad (limit {SWING_MAX_RAD}), distance integral {m['distance_ms']:.3f} m s, {values}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 25)
