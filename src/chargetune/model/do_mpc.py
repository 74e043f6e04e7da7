"""A model that was written for do-mpc."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from chargetune.model.model import Model

__all__ = ["from_do_mpc"]


def from_do_mpc(
    model: Any, *, sampling_time_s: float, parameters: Mapping[str, ArrayLike], name: str = "do_mpc", substeps: int = 1
) -> Model:
    """The `Model` of a ``do_mpc.model.Model`` after its ``setup()``.

    Its states keep their names, those of a vector with a number behind: ``x_0``, ``x_1``. Outputs are all states, and the measurements
    (``set_meas``) whose names are others. ``parameters`` has the values of its parameters (``_p``) and of its time-varying ones
    (``_tvp``), which become parameters that a given signal may change. Process and measurement noise (``_w``, ``_v``) are left to the
    plant. A continuous model is integrated by `rk4` in ``substeps``. Raises ValueError for a model that is not set up, one with
    algebraic states, and missing or unknown parameters.
    Source of the attributes: Fiedler et al., do-mpc: Towards FAIR nonlinear and robust MPC, Control Engineering Practice 140, 2023.
    """
    if not getattr(model, "flags", {}).get("setup", False):
        raise ValueError(f"do-mpc model {name}: setup() was not called, allowed is a model that is set up")
    if model.n_z:
        raise ValueError(
            f"do-mpc model {name}: algebraic states {_names(model.z)}, allowed are models of differential or difference equations"
        )
    states, inputs, measured = _names(model.x), _names(model.u), _names(model.y)
    needed = [key for of in (model.p, model.tvp) for key in of.keys() if key != "default" and np.prod(of[key].shape)]  # noqa: SIM118 - do-mpc's own
    told = dict(parameters)
    if set(told) != set(needed):
        missing, unknown = sorted(set(needed) - set(told)), sorted(set(told) - set(needed))
        said = [f"{word} {', '.join(found)}" for word, found in (("missing", missing), ("unknown", unknown)) if found]
        raise ValueError(f"do-mpc model {name}: parameters {', '.join(said)}; expected exactly {', '.join(needed) or '(none)'}")
    x, u, p = (ca.SX.sym(label, size) for label, size in (("x", model.n_x), ("u", model.n_u), ("p", model.n_p + model.n_tvp)))
    of_p, of_tvp = ca.vertsplit(p, [0, model.n_p, model.n_p + model.n_tvp])
    noise = {of: ca.DM.zeros(getattr(model, f"n_{of}"), 1) for of in "wv"}
    after = model._rhs_fun(x, u, ca.DM.zeros(0, 1), of_tvp, of_p, noise["w"])  # noqa: SLF001 - the public ones are expressions
    seen = model._meas_fun(x, u, ca.DM.zeros(0, 1), of_tvp, of_p, noise["v"])  # noqa: SLF001
    others = [i for i, label in enumerate(measured) if label not in states]
    return Model.from_casadi(
        name,
        ca.Function("f", [x, u, p], [after]),
        ca.Function("h", [x, u, p], [ca.vertcat(x, *(seen[i] for i in others))]),
        states=states,
        inputs=inputs,
        outputs=[*states, *(measured[i] for i in others)],
        parameters={key: told[key] for key in needed},
        sampling_time_s=sampling_time_s,
        continuous=model.model_type == "continuous",
        substeps=substeps,
    )


def _names(struct: Any) -> list[str]:
    """Names of the entries of a do-mpc structure: ``name`` of a scalar, ``name_0``, ``name_1`` of a vector."""
    out: list[str] = []
    for key in struct.keys():  # noqa: SIM118 - a structure of CasADi's iterates over its numbers
        size = int(np.prod(struct[key].shape)) if key != "default" else 0
        out += [key] if size == 1 else [f"{key}_{i}" for i in range(size)]
    return out
