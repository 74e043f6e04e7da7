"""
Your own system, safely: a crane
================================

An overhead crane moves its load 2 m; the load must not swing by more than 0.1 rad, not even while we tune. A twin, the same equations
with a guess of the rope, learns from the trace of each move, and a theta is tried only if the limit is kept on 95 % of the cranes that are
still possible. The first move is the most cautious one that theta allows.
"""

import tempfile
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt

import chargetune as ct


def crane(rope_m):
    def equations(x, u, p):
        def rate(state):
            _, speed, angle, turn = ca.vertsplit(state)
            swing = -(9.81 * ca.sin(angle) + u["acceleration"] * ca.cos(angle)) / p["rope_m"] - 0.05 * turn
            return ca.vertcat(speed, u["acceleration"], turn, swing)

        return dict(zip(x, ca.vertsplit(ct.rk4(rate, x.vector, 0.1, substeps=2)), strict=True)), x

    states = [ct.Signal("position", "m"), ct.Signal("speed", "m/s"), ct.Signal("angle", "rad"), ct.Signal("turn", "rad/s")]
    how = {"outputs": states, "parameters": {"rope_m": rope_m}, "sampling_time_s": 0.1, "equations": equations}
    return ct.Model.build("crane", states=states, inputs=[ct.Signal("acceleration", "m/s2")], **how)


# %%
# Theta: the length of the rope in the controller's model, and a weight of the swing in its cost.
space = ct.ParameterSpace((ct.Parameter("rope_m", 0.5, 2.0, default=0.6), ct.Parameter("weight", 0.01, 100.0, default=0.1, scale="log")))
controller = ct.Controller.build(
    crane(0.6), space, horizon=20, parameters=lambda s: {"rope_m": s.theta["rope_m"]},
    stage_cost=lambda s: (s.x["position"] - 2) ** 2 + 0.1 * s.x["speed"] ** 2 + s.theta["weight"] * s.x["angle"] ** 2,
    input_lower={"acceleration": -1.0}, input_upper={"acceleration": 1.0}, fallback={"acceleration": 0.0},
    limits=[ct.SoftLimit("angle", lower=-0.1, upper=0.1, penalty=1e4, scale=0.1)])  # fmt: skip
noise = {"position": 1e-3, "speed": 1e-3, "angle": 1e-4, "turn": 1e-3}
score = {"limits": [ct.ScoredLimit("angle", -0.1, 0.1, 1e-3)], "objective": lambda e: -0.1 * abs(2 - e.signal("position")[1]).sum()}
twin = ct.SimulatedTwin.build(controller, crane(0.8), [ct.Uncertain("rope_m", sd=0.3)], noise_sd=noise, steps=60, **score)


def evaluate(theta, seed):
    plant = ct.SimulatedPlant(crane(1.0), {}, ct.Sensors(noise_sd=noise))
    return ct.score_limits(ct.run_episode(controller, plant, steps=60, theta=theta, seed=seed), **score)


tuner = ct.TwinTuner(twin, safety=ct.Safety(0.95), settings=ct.TwinSettings(plants=32, judges=64, rounds=2))  # a short search
how = {"config": {}, "space": space, "tuner": tuner}
with ct.Store(Path(tempfile.mkdtemp()) / "crane.sqlite") as store, ct.Study.create_or_resume(store, "crane", **how) as study:
    study.run(evaluate, 4)
    for number, (result, episode, _) in enumerate(evaluate(theta, 0) for theta in [space.default, *(t.theta for t in study.trials())]):
        plt.plot(episode.time_s, episode.signal("angle")[1], "" if number else "k--", label=f"move {number}" if number else "untuned")
        print(f"{number}: {1e3 * result.excess['angle']:+.1f} mrad beyond the limit, objective {result.objective:.2f}")
plt.axhspan(-0.1, 0.1, alpha=0.1, label="allowed")
plt.gca().set(xlabel="time (s)", ylabel="swing (rad)")
plt.legend()
