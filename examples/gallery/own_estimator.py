"""
Your own estimator
==================

A tank leaks more than its controller believes: the level stays below its set-point. An estimator is a class with four methods, in CasADi
expressions, so that it can be compiled: here an observer with constant gains, whose second state is the inflow that the model lacks.
"""

from dataclasses import dataclass

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct


@dataclass(frozen=True)
class Observer:
    """x_hat = prediction + L (y - predicted level), for a model with the states (level, missing inflow)."""

    gain: tuple[float, float] = (0.4, 0.1)

    def signals(self, model):
        return ("level",)  # outputs of the plant that are read

    def initial(self, model, state):
        return np.array(state, dtype=float)  # the memory, here a prediction, before the first measurement

    def correct(self, model, memory, y, u, p):
        return memory + ca.DM(self.gain) * (y["level"] - memory[0]), memory  # the estimate, and the memory

    def predict(self, model, x_hat, memory, u, p):
        return model.f(x_hat, u, p)  # the memory at the end of the interval in which u is applied


# %%
# The plant leaks 10 % in each step, the controller believes 4 %. Both have the same equations; a missing inflow is a state that stays.
states, inflow = [ct.Signal("level", "m"), ct.Signal("missing", "m")], [ct.Signal("inflow", "m")]


def tank(leak):
    def equations(x, u, p):
        return {"level": (1 - p["leak"]) * x["level"] + u["inflow"] + x["missing"], "missing": x["missing"]}, x

    how = {"parameters": {"leak": leak}, "sampling_time_s": 1.0, "equations": equations, "outputs": states}
    return ct.Model.build("tank", states=states, inputs=inflow, **how)


plant = ct.SimulatedPlant(tank(0.1), {}, ct.Sensors(noise_sd={"level": 0.02}))
plt.figure(figsize=(7, 4), layout="constrained")
for name, estimator in {"the sensor is believed": ct.Propagated(("level",)), "own observer": Observer()}.items():
    controller = ct.Controller.build(
        tank(0.04), ct.ParameterSpace(()), horizon=10, input_lower={"inflow": 0.0}, input_upper={"inflow": 0.4}, estimator=estimator,
        stage_cost=lambda s: (s.x["level"] - 1.5) ** 2 + 0.1 * (s.u["inflow"] - s.u_last["inflow"]) ** 2)  # fmt: skip
    episode = ct.run_episode(controller, plant, steps=60).noise_free()
    plt.plot(episode.time_s + 1, episode.signal("level")[1], label=name)
plt.axhline(1.5, color="black", linestyle=":", label="set-point")
plt.gca().set(xlabel="time (s)", ylabel="true level (m)")
plt.legend(loc="lower right")
