"""
Your own system: a crane
========================

An overhead crane moves its load 2 m; the load must not swing by more than 0.1 rad. The controller believes in a rope of 0.6 m, the
crane has 1 m. A system is its equations; everything else is the same as for a battery.
"""

import tempfile
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt

import chargetune as ct


def crane(rope_m):
    """The trolley's acceleration moves the angle: angle'' = -(g sin(angle) + a cos(angle)) / rope."""

    def equations(x, u, p):
        def rate(state):
            _, speed, angle, turn = ca.vertsplit(state)
            swing = -(9.81 * ca.sin(angle) + u["acceleration"] * ca.cos(angle)) / p["rope_m"]
            return ca.vertcat(speed, u["acceleration"], turn, swing - 0.05 * turn)

        return dict(zip(x, ca.vertsplit(ct.rk4(rate, x.vector, 0.1, substeps=2)), strict=True)), x

    states = [ct.Signal("position", "m"), ct.Signal("speed", "m/s"), ct.Signal("angle", "rad"), ct.Signal("turn", "rad/s")]
    how = {"parameters": {"rope_m": rope_m}, "sampling_time_s": 0.1, "equations": equations}
    return ct.Model.build("crane", states=states, inputs=[ct.Signal("acceleration", "m/s2")], outputs=states, **how)


# %%
# Two entries of theta: a weight in the cost, and the length of the rope in the model.
rope, weight = ct.Parameter("rope_m", 0.5, 2.0, default=0.6), ct.Parameter("weight", 0.01, 100.0, default=0.1, scale="log")
space = ct.ParameterSpace((rope, weight))
controller = ct.Controller.build(
    crane(0.6), space, horizon=20, parameters=lambda s: {"rope_m": s.theta["rope_m"]},
    stage_cost=lambda s: (s.x["position"] - 2) ** 2 + 0.1 * s.x["speed"] ** 2 + s.theta["weight"] * s.x["angle"] ** 2,
    input_lower={"acceleration": -1.0}, input_upper={"acceleration": 1.0}, fallback={"acceleration": 0.0},
    limits=[ct.SoftLimit("angle", lower=-0.1, upper=0.1, penalty=1e4, scale=0.1)])  # fmt: skip
limits = [ct.ScoredLimit("angle", lower=-0.1, upper=0.1, tolerance=1e-3)]


def evaluate(theta, seed):
    episode = ct.simulate(controller, ct.SimulatedPlant(crane(1.0), {}), steps=80, theta=theta, seed=seed)
    return ct.score_limits(episode, limits, objective=lambda e: -0.1 * abs(2 - e.signal("position")[1]).sum(), penalty=0.1)


with ct.Store(Path(tempfile.mkdtemp()) / "crane.sqlite") as store:
    tuner = ct.ConstrainedLogEI(seed=0)
    with ct.Study.create_or_resume(store, "crane", config={}, space=space, tuner=tuner) as study:
        best = study.run(evaluate, 10)
for name, theta in {"untuned": space.default, "tuned": best.theta}.items():
    score, episode, _ = evaluate(theta, 0)
    plt.plot(episode.time_s, episode.signal("angle")[1], label=f"{name}: {score.excess['angle']:+.3f} rad beyond the limit")
plt.hlines([-0.1, 0.1], 0, 8, colors="black", linestyles=":")
plt.gca().set(xlabel="time (s)", ylabel="swing (rad)")
plt.legend(loc="upper center", bbox_to_anchor=(0.5, 1.18))
