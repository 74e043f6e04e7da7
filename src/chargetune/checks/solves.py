"""How the control problem is solved along a closed loop: steps without a solution, and costs of which a solution is only a local one."""

from __future__ import annotations

import numpy as np

from chargetune.checks.finding import Evidence, Finding
from chargetune.control.controller import Controller
from chargetune.control.sqp import KKT_TOLERANCE
from chargetune.episode.episode import Episode

__all__ = ["check_costs", "check_solves"]

# Shares of steps not solved from which on it is told, and from which on what is scored is hardly the controller's.
NOTICED, TOO_MANY = 0.01, 0.2


def check_solves(run: Episode) -> list[Finding]:
    """Steps of a closed loop whose solve is not within the tolerance: the input applied is bounded, but not the problem's solution."""
    share = run.unsolved_share
    if not len(run) or share < NOTICED:
        return []
    minutes, residual = run.time_s / 60, np.where(np.isfinite(run.kkt), run.kkt, np.nan)
    return [
        Finding(
            "steps-not-solved",
            "error" if share >= TOO_MANY else "warning",
            f"{100 * share:.0f} % of the control steps are not solved to tolerance ({run.failures} of {len(run)}): what is tuned then is "
            "where the solver stops, as well as the controller",
            'hessian = "exact", first_guess = "ipopt", more iterations_max, a shorter horizon, or costs and limits of similar size; '
            'solver = "ipopt" solves each step, slowly',
            {"share": share, "steps": float(len(run)), "not_solved": float(run.failures), "kkt_median": float(np.nanmedian(residual))},
            Evidence("time (min)", "optimality residual", {"closed loop": (minutes, residual)}, {"tolerance": KKT_TOLERANCE}),
        )
    ]


def check_costs(controller: Controller) -> list[Finding]:
    """Costs that are bent downwards in the inputs or in what they reach: the solver finds one of several local solutions."""
    out = []
    for label, found in controller.curvatures.items():
        if not found.convex:
            out.append(
                Finding(
                    "non-convex",
                    "warning",
                    f"{label} has curvature {found.least:.3g} along {', '.join(found.along)}: what the solver finds is a local solution, "
                    "which depends on where it starts",
                    f'a function that is convex in {", ".join(found.of)}; or first_guess = "ipopt", and a look at what it changes',
                    {"curvature_least": found.least, "curvature_largest": found.largest},
                )
            )
    return out
