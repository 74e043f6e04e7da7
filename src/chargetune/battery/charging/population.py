"""The cells of one make, from measured ones of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from chargetune.battery.cell.cell import Cell
from chargetune.plants.variation import StudentT, Variation
from chargetune.runtime.counted import counted

__all__ = ["CELLS_MIN", "check_population", "population"]

# A spread, and how sure it is, need three.
CELLS_MIN = 3
# Number of the circuit that has no table.
CAPACITY = "capacity_Ah"


def population(cell: Cell, cells: Sequence[Cell]) -> tuple[Cell, Variation]:
    """The mean of ``cells``, and how another cell of their make differs from it; all else is that of ``cell``.

    The logarithms x of all R and C at the SOC nodes of ``cell`` and of the capacity are taken as normal. From n cells with mean m and
    covariance S, another one has

        x_i = m_i + sqrt(S_ii (1 + 1/n)) t_i,   t_i Student's t with n - 1 degrees of freedom,

    the predictive distribution of each x_i, and the x_i are correlated as S says (Gelman et al., Bayesian Data Analysis, 3rd ed., 2013,
    section 3.2). So three cells say little, and what no two of them differ in does not differ.
    """
    names = (*cell.tables, CAPACITY)
    logs = np.array([_logs(cell, one) for one in cells])
    mean, off = logs.mean(axis=0), logs - logs.mean(axis=0)
    covariance = off.T @ off / (len(cells) - 1)
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    sizes = [1 if name == CAPACITY else len(cell.soc) for name in names]
    parts = np.split(np.arange(mean.size), np.cumsum(sizes)[:-1])
    spread = sd * np.sqrt(1 + 1 / len(cells))
    values = {name: np.exp(mean[part]) for name, part in zip(names, parts, strict=True)}
    middle = replace(
        cell,
        capacity_Ah=float(values[CAPACITY][0]),
        **{name: tuple(map(float, values[name])) for name in cell.tables},  # type: ignore[arg-type]
    )
    return middle, Variation(
        "cells",
        StudentT(len(cells) - 1.0),
        parameters={name: tuple(map(float, spread[part])) for name, part in zip(names, parts, strict=True)},
        by_entry=True,
        log=True,
        correlation=tuple(tuple(map(float, row)) for row in correlation),
    )


def check_population(cell: Cell, cells: Sequence[Cell], where: str) -> None:
    """Raises ValueError where these cells have another circuit than ``cell``, or are too few."""
    if len(cells) < CELLS_MIN:
        raise ValueError(f"range: cells = {where!r} has {counted(len(cells), 'cell file')}, allowed are at least {CELLS_MIN}")
    for one in cells:
        if one.pairs != cell.pairs:
            found = f"range: cells = {where!r}: {one.name!r} has {counted(len(one.pairs), 'R-C pair')}"
            raise ValueError(f"{found}, allowed are {len(cell.pairs)}, as the study's cell has")


def _logs(cell: Cell, other: Cell) -> list[float]:
    """Logarithms of the other's tables at the nodes of ``cell``, linear in between and held beyond its own, and of its capacity."""
    tables = [np.interp(cell.soc, other.soc, np.log(getattr(other, name))) for name in cell.tables]
    return [*np.concatenate(tables).tolist(), float(np.log(other.capacity_Ah))]
