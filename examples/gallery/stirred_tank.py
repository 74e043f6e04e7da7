"""
A stirred tank that earns money
===============================

The reaction A -> B in a stirred tank. The cost is no distance to a set-point but the profit: B is sold, the feed is paid. At the
price of 2 the best steady state is a feed of 4 l/min with half of A converted (Diehl, Amrit and Rawlings, IEEE Trans. Autom.
Control 56 (2011) 703). When the price changes, a controller that sees it coming stores B before.
"""

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct

VOLUME_L, RATE_1_MIN, TS_MIN = 10.0, 0.4, 0.5


def equations(x, u, _):
    """Balances of A and B, mol/l, over half a minute."""

    def rate(c):
        a, b = ca.vertsplit(c)
        return ca.vertcat(u["feed"] / VOLUME_L * (1 - a) - RATE_1_MIN * a, -u["feed"] / VOLUME_L * b + RATE_1_MIN * a)

    return dict(zip(x, ca.vertsplit(ct.rk4(rate, x.vector, TS_MIN)), strict=True)), x


states = [ct.Signal("A", "mol/l"), ct.Signal("B", "mol/l")]
feed_in = [ct.Signal("feed", "l/min")]
how = {"parameters": {}, "sampling_time_s": 60 * TS_MIN, "equations": equations}
tank = ct.Model.build("tank", states=states, inputs=feed_in, outputs=states, **how)

# %%
# The price is a given signal: its values come at run time, over the horizon as well.
controller = ct.Controller.build(
    tank, ct.ParameterSpace(()), horizon=30, given=[ct.Signal("price")],
    stage_cost=lambda s: 0.5 * s.u["feed"] - s.given["price"] * s.u["feed"] * s.x["B"] + 0.1 * (s.u["feed"] - s.u_last["feed"]) ** 2,
    input_lower={"feed": 0.0}, input_upper={"feed": 20.0}, input_before={"feed": 4.0}, start={"A": 0.5, "B": 0.5})  # fmt: skip

# %%
# The price doubles for five minutes. A forecast has a row for each interval: what is believed of the horizon.
steps, ahead = 60, 31
price = np.where((np.arange(steps + ahead) >= 25) & (np.arange(steps + ahead) < 35), 4.0, 2.0)
seen = np.array([price[k : k + ahead] for k in range(steps)])
unseen = np.repeat(price[:steps, None], ahead, axis=1)

figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
for name, forecast in {"price seen ahead": seen, "price as it is now": unseen}.items():
    plant = ct.SimulatedPlant(tank, {"A": 0.5, "B": 0.5}, input_before={"feed": 4.0})
    episode = ct.run_episode(controller, plant, steps=steps, given={"price": forecast})
    feed, product = episode.input[:, 0], episode.signal("B")[0]
    profit = TS_MIN * np.sum(price[:steps] * feed * product - 0.5 * feed)
    top.plot(episode.time_s[:steps] / 60, feed, label=name)
    bottom.plot(episode.time_s[:steps] / 60, product, label=name)
    print(f"{name}: feed at the start {feed[5]:.2f} l/min, profit {profit:.1f}")
top.set(ylabel="feed (l/min)")
bottom.set(xlabel="time (min)", ylabel="B (mol/l)")
top.legend()
