"""The memory of a controller before the first measurement, with the plan that the first solve begins from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chargetune.control.control_step import Act, Memory, act, begin
from chargetune.control.controller import Controller
from chargetune.control.ipopt_reference import ipopt_act, ipopt_plan

__all__ = ["act_of", "first_memory"]


def first_memory(controller: Controller, theta: NDArray[np.float64], given: NDArray[np.float64] | None = None) -> Memory:
    """`begin`, and where the controller's ``first_guess`` is "ipopt" the plan that IPOPT finds from its ``start``.

    A local solver finds the local solution that is downhill of its first guess. IPOPT's multiple shooting has the states as variables
    and often comes to a better one; from there on each solve begins at the plan of the one before. A plan that IPOPT does not find
    leaves the guess as it is.
    """
    memory = begin(controller)
    if controller.first_guess != "ipopt":
        return memory
    plan, found = ipopt_plan(controller, np.array(controller.start), theta, memory, given)
    return replace(memory, warm=np.concatenate([plan, memory.warm[plan.size :]])) if found else memory


def act_of(controller: Controller) -> Act:
    """The control step of the controller's ``solver``."""
    return ipopt_act if controller.solver == "ipopt" else act
