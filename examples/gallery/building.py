"""
A building with prices
======================

Floor heating of a house, every quarter of an hour for two days. Electricity is dear in the morning and in the evening, and at night it
may be cooler. Floor and walls store heat: a controller that sees price and weather ahead heats before it is dear.
"""

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct

HOURS, STEPS, AHEAD = 0.25, 192, 32
START = {"air": 20.0, "walls": 19.0, "floor": 22.0}


def equations(x, u, p):
    """Heat balances; kW, kWh/K and h."""

    def rate(t):
        air, walls, floor = ca.vertsplit(t)
        warmer = 0.1 * (p["ambient"] - air) + 0.8 * (walls - air) + 1.0 * (floor - air)
        return ca.vertcat(warmer, (0.8 * (air - walls) + 0.05 * (p["ambient"] - walls)) / 8, (1.0 * (air - floor) + u["heat"]) / 3)

    return dict(zip(START, ca.vertsplit(ct.rk4(rate, x.vector, HOURS)), strict=True)), x


states, heat = [ct.Signal(name, "degC") for name in START], [ct.Signal("heat", "kW")]
how = {"parameters": {"ambient": 0.0}, "sampling_time_s": 3600 * HOURS, "equations": equations}
house = ct.Model.build("house", states=states, inputs=heat, outputs=states, **how)

# %%
# The cost is the bill, and a little for changes of the heat. Price, weather and the least temperature are given signals: their values
# come at run time, over the horizon of eight hours as well.
controller = ct.Controller.build(
    house, ct.ParameterSpace(()), horizon=AHEAD, given=[ct.Signal(name) for name in ("price", "ambient", "least")], start=START,
    stage_cost=lambda s: s.given["price"] * s.u["heat"] + 0.005 * (s.u["heat"] - s.u_last["heat"]) ** 2,
    parameters=lambda s: {"ambient": s.given["ambient"]}, input_lower={"heat": 0.0}, input_upper={"heat": 8.0},
    limits=[ct.SoftLimit("air", lower=lambda s: s.given["least"], at="end", penalty=50.0, scale=0.1)])  # fmt: skip
hour = HOURS * np.arange(STEPS + AHEAD + 1)
price = 0.2 + 0.25 * np.isin(hour % 24 // 1, (6, 7, 8, 17, 18, 19))
given = {"price": price, "ambient": 2 + 5 * np.sin(2 * np.pi * (hour - 9) / 24), "least": np.where((hour + 2) % 24 < 8, 17.0, 20.0)}
unseen = given | {"price": np.full(len(hour), price[:96].mean())}

figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
for name, told in {"price seen ahead": given, "price not known": unseen}.items():
    episode = ct.run_episode(controller, ct.SimulatedPlant(house, START, given=("ambient",)), steps=STEPS, given=told)
    bill = HOURS * price[:STEPS] @ episode.input[:, 0]
    top.plot(hour[1 : STEPS + 1], episode.signal("air")[1], label=f"{name}: {bill:.1f} EUR")
    bottom.step(hour[:STEPS], episode.input[:, 0], where="post")
    print(f"{name}: {bill:.2f} EUR for {HOURS * episode.input.sum():.0f} kWh")
top.step(hour[:STEPS], given["least"][:STEPS], "k:", where="post", label="least")
for axes in (top, bottom):
    axes.fill_between(hour[:STEPS], 0, 1, where=price[:STEPS] > 0.3, transform=axes.get_xaxis_transform(), color="0.9", step="post")
top.set(ylabel="air (°C)")
bottom.set(xlabel="time (h); grey: electricity is dear", ylabel="heat (kW)")
figure.legend(loc="outside upper center", ncols=3)
