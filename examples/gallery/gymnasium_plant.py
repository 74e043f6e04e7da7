"""
Your own plant, through Gymnasium
=================================

Any environment of Gymnasium with continuous actions is a plant, and so is your simulator with the methods `reset`, `step` and `close`.
Here it is the pendulum `Pendulum-v1`, which should stand upright and not turn faster than 5 rad/s; 2 N m are too weak to hold it or lift
it at once. The length in the controller's model is wrong by half; Bayesian optimisation corrects it from a few swings. It needs the
extra `gym`.
"""

import tempfile
from pathlib import Path

import casadi as ca
import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct

STEPS, TORQUE = 80, (ct.Signal("torque", "N m"),)
STATES = (ct.Signal("angle", "rad"), ct.Signal("speed", "rad/s"))


# %%
# The plant: signals, sampling time, and what the observation (cos, sin, speed) means. Angle 0 is upright.
def pendulum():
    return ct.GymnasiumPlant(gymnasium.make("Pendulum-v1"), TORQUE, STATES, 0.05, observe=lambda o: [np.arctan2(o[1], o[0]), o[2]])


# %%
# The controller: a rod that is pushed at its pivot, angle'' = 1.5 g sin(angle) / l + 3 torque / (m l^2), with a length l that is theta.
def equations(x, u, p):
    speed = x["speed"] + 0.05 * (15 * ca.sin(x["angle"]) / p["length_m"] + 3 * u["torque"] / p["length_m"] ** 2)
    return {"angle": x["angle"] + 0.05 * speed, "speed": speed}, x


rod = ct.Model.build(
    "rod", states=STATES, inputs=TORQUE, outputs=STATES, parameters={"length_m": 1.5}, sampling_time_s=0.05, equations=equations)  # fmt: skip
space = ct.ParameterSpace((ct.Parameter("length_m", 0.5, 2.0, default=1.5, unit="m"),))


def away(s):
    return 1 - ca.cos(s.x["angle"]) + 0.05 * s.x["speed"] ** 2


controller = ct.Controller.build(
    rod, space, horizon=25, parameters=lambda s: {"length_m": s.theta["length_m"]},
    stage_cost=lambda s: away(s) + 0.01 * s.u["torque"] ** 2, terminal_cost=lambda s: 10 * away(s),
    limits=[ct.SoftLimit("speed", lower=-5.0, upper=5.0, at="end", penalty=10.0, scale=0.1)],
    input_lower={"torque": -2.0}, input_upper={"torque": 2.0})  # fmt: skip
# A score forgives what a torque so weak cannot prevent.
limits = [ct.ScoredLimit("speed", lower=-5.0, upper=5.0, tolerance=0.25)]


def evaluate(theta, seed):
    """One swing: the environment is stepped from the same start (seed 0), whatever the seed of the trial."""
    episode = ct.run_episode(controller, pendulum(), steps=STEPS, theta=theta, seed=0)
    return ct.score_limits(episode, limits, objective=lambda e: float(np.cos(e.signal("angle")[1]).mean()))


with ct.Store(Path(tempfile.mkdtemp()) / "rod.sqlite") as store:
    with ct.Study.create_or_resume(store, "rod", config={}, space=space, tuner=ct.ConstrainedLogEI(seed=0)) as study:
        best = study.run(evaluate, 12)
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
for name, theta in {"untuned": space.default, "tuned": best.theta}.items():
    score, episode, _ = evaluate(theta, 0)
    height = np.cos(episode.signal("angle")[1])
    axes.plot(episode.time_s, height, label=f"{name}, l = {theta[0]:.2f} m: {score.excess['speed']:+.2f} rad/s beyond the limit")
axes.set(xlabel="time (s)", ylabel="height of the tip (lengths)", ylim=(-1.1, 1.6), yticks=(-1, 0, 1))
axes.legend(loc="upper left")
