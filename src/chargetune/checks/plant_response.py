"""Whether a plant moves the way its controller thinks it does."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from chargetune.checks.finding import Evidence, Finding
from chargetune.checks.static import model_at, titled, unit_of
from chargetune.control.controller import Controller
from chargetune.episode.episode import Episode

__all__ = ["check_response"]

# Plant and model agree in sign unless their changes are correlated by less than this.
OPPOSITE = -0.3


def check_response(controller: Controller, run: Episode, theta: ArrayLike | None = None) -> list[Finding]:
    """Outputs of the plant that move against what the controller's model predicts from the same states and inputs.

    Compared are changes within intervals, y(x_{k+1}, u_k) - y(x_k, u_k), and across the jumps of the input; the plant is
    reversed when their correlation is clearly negative.
    """
    model, u = model_at(controller, theta), run.input
    if len(run) < 2:
        return []
    count = len(run)
    p = ca.repmat(ca.DM(model.nominal), 1, count)
    h, f = model.h.map(count), model.f.map(count)
    before = np.vstack([np.zeros_like(u[:1]), u[:-1]])
    x = run.estimate.T
    at_start, at_rest, at_end = (np.array(v).T for v in (h(x, u.T, p), h(x, before.T, p), h(f(x, u.T, p), u.T, p)))
    out = []
    for name in (n for n in model.output_names if n in run.output_names):
        start, end = run.signal(name)
        i = model.output_names.index(name)
        plant = np.concatenate([end - start, start[1:] - end[:-1]])
        predicted = np.concatenate([at_end[:, i] - at_start[:, i], (at_start - at_rest)[1:, i]])
        known = np.isfinite(plant) & np.isfinite(predicted)
        size = np.linalg.norm(plant[known]) * np.linalg.norm(predicted[known])
        likeness = float(plant[known] @ predicted[known] / size) if size > 0 else 0.0
        if likeness < OPPOSITE:
            out.append(
                Finding(
                    "wrong-sign",
                    "error",
                    f"{name} of the plant moves against what the model predicts (correlation {likeness:.2f})",
                    f"the sign of the input or of {name} is reversed between plant and controller: current is positive when it charges",
                    {"correlation": likeness},
                    Evidence(
                        "time (s)",
                        titled(f"change of {name} in an interval", unit_of(controller, name)),
                        {"plant": (run.time_s, end - start), "model": (run.time_s, at_end[:, i] - at_start[:, i])},
                        {"zero": 0.0},
                    ),
                )
            )
    return out
