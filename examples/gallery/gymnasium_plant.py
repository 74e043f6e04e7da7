"""
Your own plant, through Gymnasium
=================================

Any environment of Gymnasium with continuous actions is a plant, and so is your simulator with the methods `reset`, `step` and `close`.
Here it is `Pendulum-v1` (extra `gym`), which should stand upright and not turn faster than 5 rad/s; 2 N m are too weak to lift it at once.
The length in the controller's model is wrong by half; Bayesian optimisation corrects it in a few swings.
"""

import tempfile
from pathlib import Path

import casadi as ca
import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct

# %%
# The plant: signals, sampling time, and what the observation (cos, sin, speed) means. Angle 0 is upright.
STATES, TORQUE = (ct.Signal("angle", "rad"), ct.Signal("speed", "rad/s")), (ct.Signal("torque", "N m"),)


def pendulum():
    return ct.GymnasiumPlant(gymnasium.make("Pendulum-v1"), TORQUE, STATES, 0.05, observe=lambda o: [np.arctan2(o[1], o[0]), o[2]])


# %%
# The controller: a rod turned at its end, angle'' = 1.5 g sin(angle) / l + 3 torque / (m l^2), g = 10 m/s2, m = 1 kg; its length is theta.
def equations(x, u, p):
    speed = x["speed"] + 0.05 * (15 * ca.sin(x["angle"]) / p["length"] + 3 * u["torque"] / p["length"] ** 2)
    return {"angle": x["angle"] + 0.05 * speed, "speed": speed}, x


how = {"inputs": TORQUE, "outputs": STATES, "parameters": {"length": 1.5}, "sampling_time_s": 0.05, "equations": equations}
rod = ct.Model.build("rod", states=STATES, **how)
space = ct.ParameterSpace((ct.Parameter("length", 0.5, 2.0, default=1.5, unit="m"),))
controller = ct.Controller.build(
    rod, space, horizon=25, parameters=lambda s: {"length": s.theta["length"]}, input_lower={"torque": -2.0}, input_upper={"torque": 2.0},
    stage_cost=lambda s: 1 - ca.cos(s.x["angle"]) + 0.05 * s.x["speed"] ** 2 + 0.01 * s.u["torque"] ** 2,
    terminal_cost=lambda s: 10 * (1 - ca.cos(s.x["angle"])) + 0.5 * s.x["speed"] ** 2,
    limits=[ct.SoftLimit("speed", lower=-5.0, upper=5.0, at="end", penalty=10.0, scale=0.1)])  # fmt: skip
limit = ct.ScoredLimit("speed", lower=-5.0, upper=5.0, tolerance=0.25)  # so much a torque so weak cannot prevent


def evaluate(theta, _):
    episode = ct.run_episode(controller, pendulum(), steps=80, theta=theta, seed=0)  # always the same start
    return ct.score_limits(episode, [limit], objective=lambda e: float(np.cos(e.signal("angle")[1]).mean()))


how = {"config": {}, "space": space, "tuner": ct.ConstrainedLogEI(seed=0)}
with ct.Store(Path(tempfile.mkdtemp()) / "rod.sqlite") as store, ct.Study.create_or_resume(store, "rod", **how) as study:
    best = study.run(evaluate, 10)
for name, theta in {"untuned": space.default, "tuned": best.theta}.items():
    score, episode, _ = evaluate(theta, 0)
    label = f"{name}, l = {theta[0]:.2f} m: {score.excess['speed']:+.2f} rad/s beyond the limit"
    plt.plot(episode.time_s, np.cos(episode.signal("angle")[1]), label=label)
plt.gca().set(xlabel="time (s)", ylabel="height of the tip (lengths)")
plt.legend(loc="lower center", bbox_to_anchor=(0.5, 1))
