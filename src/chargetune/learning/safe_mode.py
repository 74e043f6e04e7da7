"""Safe mode: of the candidates only what fresh plants of the ensemble call safe."""

from __future__ import annotations

import warnings
from itertools import islice, product

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.candidates import Proposal
from chargetune.learning.safety import NoSafeThetaError, Safety
from chargetune.learning.twin.ensemble import episodes_of
from chargetune.runtime.counted import counted

__all__ = ["safe_thetas"]

# Parameters of theta whose corners are all tried for a start: eight ensembles.
CORNERS_OF = 3


def safe_thetas(proposal: Proposal, safety: Safety, count: int = 1) -> list[NDArray[np.float64]]:
    """At most ``count`` thetas that are safe for the next trial, the best first.

    1. Without a trace: the declared start, or the corner of the space that plants of the prior call the safest.
    2. Candidates of the search that keep every limit on the stated share of the ensemble, judged again on fresh plants.
    3. Else the longest part of the way from the best safe theta that was tried that fresh plants call safe.
    4. Else that theta itself, with a warning.

    Raises NoSafeThetaError where there is none, or the budget of violation is spent.
    """
    if proposal.ensemble.discrepancy is None:
        return [_start(proposal, safety)]
    _check_budget(proposal, safety)
    if proposal.ensemble.rejected:
        return [_repeated(proposal)]
    accepted, last = proposal.search()
    safe = list(islice((theta for theta, _ in accepted if proposal.holds(theta)), count))
    if safe:
        return safe
    tried = next((theta for theta in proposal.kept if proposal.holds(theta)), None)
    if tried is None:
        what = f"no theta keeps every limit with probability {safety.probability:g}"
        raise NoSafeThetaError(f"{what} as far as {counted(len(proposal.trials), 'trial')} can show; nothing was proposed")
    aim = (accepted[0] if accepted else last)[0]
    part = proposal.backtrack(tried, aim, proposal.holds)
    if part is None:
        warnings.warn("no safe improvement is known: a theta that was tried is proposed again", RuntimeWarning, stacklevel=2)
    return [tried if part is None else part]


def _repeated(proposal: Proposal) -> NDArray[np.float64]:
    """The best theta that kept every limit as measured: a twin that was wrong says nothing of another one."""
    what = f"the twin is no model of this plant: {proposal.ensemble.rejected}"
    if not proposal.kept:
        raise NoSafeThetaError(f"{what}, and no trial kept every limit; nothing was proposed")
    warnings.warn(f"{what}; the best theta that kept every limit is proposed again", RuntimeWarning, stacklevel=2)
    return proposal.kept[0]


def _check_budget(proposal: Proposal, safety: Safety) -> None:
    if safety.budget is None:
        return
    spent = sum(proposal.ensemble.loop.violation(e) for e in episodes_of(proposal.trials))
    if spent > safety.budget:
        raise NoSafeThetaError(f"the budget of violation is spent: {spent:.4g} of {safety.budget:g}; nothing was proposed")


def _start(proposal: Proposal, safety: Safety) -> NDArray[np.float64]:
    """The declared start, or the corner that is the likeliest to keep every limit on plants of the prior, which has to be safe there.

    Of few parameters all corners are tried. Of more than `CORNERS_OF` one parameter after the other is put to the side that is
    surer, from all lower bounds on: one ensemble each instead of twice as many for each. Where a side of a parameter is the surer one
    wherever the others are, as with backoffs and resistances, it is the same corner.
    """
    space = proposal.space
    if safety.start is not None:
        return space.validate(np.array(safety.start))
    sizes = [p.size for p in space.parameters]
    known: dict[tuple[float, ...], tuple[float, float]] = {}

    def surer(sides: tuple[float, ...]) -> tuple[float, float]:
        """The probability, and among equal ones how far it is from breaking a limit."""
        if sides not in known:
            predicted = proposal.candidate(space.from_unit(np.repeat(sides, sizes)))[1]
            worst = np.nanquantile(np.nanmax(predicted.excess, axis=1), safety.probability) if predicted.scores else np.inf
            known[sides] = predicted.probability(), -float(worst)
        return known[sides]

    if len(sizes) <= CORNERS_OF:
        sides = max(product((0.0, 1.0), repeat=len(sizes)), key=surer)
    else:
        sides = (0.0,) * len(sizes)
        for i in range(len(sizes)):
            sides = max(sides, (*sides[:i], 1.0, *sides[i + 1 :]), key=surer)
    theta, chance = space.from_unit(np.repeat(sides, sizes)), known[sides][0]
    if chance < safety.probability or not proposal.holds(theta):
        raise NoSafeThetaError(
            f"no corner of theta keeps every limit with probability {safety.probability:g} on plants of the prior "
            f"(the most cautious one: {chance:.2f}); declare a start that does"
        )
    return theta
