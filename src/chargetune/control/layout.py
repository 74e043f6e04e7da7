"""Which numbers of a plan belong together: inputs by block, rows by interval and by limit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import casadi as ca

from chargetune.runtime.split import split

__all__ = ["Layout", "greatest", "largest", "least"]


def least(a: Any, b: Any) -> Any:
    """The smaller of each pair; b where one of them is NaN."""
    return ca.if_else(a < b, a, b)


def greatest(a: Any, b: Any) -> Any:
    """The larger of each pair; b where one of them is NaN."""
    return ca.if_else(a > b, a, b)


def largest(matrix: Any) -> Any:
    """The largest of each row, shape (rows, 1), of a matrix with at least one column. It may drop a NaN."""
    while (columns := matrix.shape[1]) > 1:
        half = columns // 2
        left, right, rest = ca.horzsplit(matrix, [0, half, 2 * half, columns])
        matrix = ca.horzcat(greatest(left, right), rest)
    return matrix


@dataclass(frozen=True)
class Layout:
    """The shape of a plan: U holds an input a block, c the rows of each interval and then those of the end of the horizon.

    blocks
        For how many intervals each input is held; they add up to the horizon.
    stage_groups, final_groups
        For each row of an interval, and of the end, the index of its limit; -1 for a row that is hard: the rate of an input.
    prices
        Penalty times scale of each limit.
    """

    nu: int
    blocks: tuple[int, ...]
    stage_groups: tuple[int, ...]
    final_groups: tuple[int, ...]
    prices: tuple[float, ...]

    @property
    def horizon(self) -> int:
        return sum(self.blocks)

    @property
    def size(self) -> int:
        """Number of decision variables."""
        return len(self.blocks) * self.nu

    @property
    def groups(self) -> tuple[int, ...]:
        """For each row of c the index of its limit, -1 for a hard one."""
        return (*self.stage_groups * self.horizon, *self.final_groups)

    def inputs(self, vector: Any) -> list[Any]:
        """The input of each interval, shape (nu,), from that of each block."""
        held = split(vector, [self.nu] * len(self.blocks))
        return [u for u, length in zip(held, self.blocks, strict=True) for _ in range(length)]

    def together(self, intervals: list[Any]) -> list[list[Any]]:
        """What stands for the intervals, a list a block."""
        return [intervals[a:b] for a, b in pairwise((0, *accumulate(self.blocks)))]

    def later(self, blocks: Sequence[Any]) -> list[Any]:
        """The input of each block of the same plan an interval later: the mean over the intervals that a block then covers."""
        ahead = (*blocks[1:], blocks[-1])
        return [b if length == 1 else (a * (length - 1) + b) / length for a, b, length in zip(blocks, ahead, self.blocks, strict=True)]

    def rows(self, vector: Any) -> tuple[list[Any], Any]:
        """(rows of each interval, those of the end) of a vector like c."""
        *stages, last = split(vector, (*[len(self.stage_groups)] * self.horizon, len(self.final_groups)))
        return stages, last

    def violations(self, rows: Any) -> Any:
        """s_j / scale_j, the largest violation of each limit over the horizon, at least 0."""
        worst = self._of_limits(rows, largest)
        return greatest(worst, type(rows)(ca.DM.zeros(*worst.shape)))

    def sums(self, rows: Any) -> Any:
        """The sum of the rows of each limit."""
        return self._of_limits(rows, ca.sum2)

    def spread(self, values: Any) -> Any:
        """The value of its limit for each row, 0 for a hard one."""
        own = [*split(values, [1] * len(self.prices)), type(values)(ca.DM.zeros(1, 1))]
        stage, last = (ca.vertcat(type(values)(0, 1), *(own[j] for j in groups)) for groups in (self.stage_groups, self.final_groups))
        return ca.vertcat(ca.repmat(stage, self.horizon, 1), last)

    def _of_limits(self, rows: Any, reduce: Callable[[Any], Any]) -> Any:
        stages, last = self.rows(rows)
        each = reduce(ca.horzcat(*stages)) if self.stage_groups else last[:0]
        entries = [*split(each, [1] * len(self.stage_groups)), *split(last, [1] * len(self.final_groups))]
        of = (*self.stage_groups, *self.final_groups)
        own = [[entry for entry, j in zip(entries, of, strict=True) if j == limit] for limit in range(len(self.prices))]
        return ca.vertcat(*(reduce(ca.horzcat(*one)) for one in own))
