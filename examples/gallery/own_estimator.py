"""
Your own estimator
==================

A tank leaks more than its controller believes, and its level sensor is noisy. Without feedback on the model's error the level stays
below its set-point. An estimator is a class with four methods, written in CasADi expressions, so that it runs in the compiled episode:
here an observer with constant gains, whose second entry is the inflow that the model lacks.
"""

from dataclasses import dataclass

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct


@dataclass(frozen=True)
class Observer:
    """x_hat+ = f(x_hat, u) + L (y - level), for a model with the states (level, missing inflow)."""

    gain: tuple[float, float] = (0.4, 0.1)

    def signals(self, model):
        """Outputs of the plant that are read."""
        return ("level",)

    def initial(self, model, state):
        """The memory before the first measurement: the state that the model predicts."""
        return np.array(state, dtype=float)

    def correct(self, model, memory, y, u, p):
        """(estimate, memory) from a measurement; one that is not finite is left out."""
        error = y["level"] - memory[0]
        estimate = memory + ca.if_else(ca.fabs(error) < 1e9, error, 0) * ca.DM(self.gain)
        return estimate, memory

    def predict(self, model, x_hat, memory, u, p):
        """The memory at the end of the interval in which u is applied."""
        return model.f(x_hat, u, p)


# %%
# The same equations twice: the plant leaks 10 % a step, the controller believes 4 %. Its model has the missing inflow as a state.
LEVEL, MISSING, INFLOW = ct.Signal("level", "m"), ct.Signal("missing", "m"), ct.Signal("inflow", "m")


def tank(leak, states):
    def equations(x, u, p):
        missing = x["missing"] if MISSING in states else 0
        following = {"level": (1 - p["leak"]) * x["level"] + u["inflow"] + missing, "missing": missing}
        return {signal.name: following[signal.name] for signal in states}, x

    how = {"parameters": {"leak": leak}, "sampling_time_s": 1.0, "equations": equations}
    return ct.Model.build("tank", states=states, inputs=[INFLOW], outputs=states, **how)


plant = ct.SimulatedPlant(tank(0.1, [LEVEL]), {}, ct.Sensors(noise_sd={"level": 0.02}))
plt.figure(figsize=(7, 4), layout="constrained")
for name, estimator in {"the sensor is believed": ct.Propagated(("level",)), "own observer": Observer()}.items():
    controller = ct.Controller.build(
        tank(0.04, [LEVEL, MISSING]), ct.ParameterSpace(()), horizon=10, estimator=estimator,
        stage_cost=lambda s: (s.x["level"] - 1.5) ** 2 + 0.1 * (s.u["inflow"] - s.u_last["inflow"]) ** 2,
        input_lower={"inflow": 0.0}, input_upper={"inflow": 0.4})  # fmt: skip
    episode = ct.simulate(controller, plant, steps=60).noise_free()
    level = episode.signal("level")[1]
    plt.plot(episode.time_s + 1, level, label=name)
    print(f"{name}: mean level of the last half {level[30:].mean():.3f} m, sd of the inflow there {episode.input[30:].std():.3f} m")
plt.axhline(1.5, color="black", linestyle=":", label="set-point")
plt.gca().set(xlabel="time (s)", ylabel="true level (m)")
plt.legend(loc="lower right")
