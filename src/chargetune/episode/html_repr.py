"""How results show themselves in a notebook: small HTML without scripts and style sheets, in the colours of the notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

__all__ = ["Cell", "curves", "facts", "table", "text"]

Cell = str | float | bool | None

WIDTH, HEIGHT = 260.0, 90.0
# More points than this cannot be told apart on such a width.
POINTS = 400


def text(value: Cell) -> str:
    """A cell as escaped text: numbers with five significant digits, None as a dash."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, (int, float)) else escape(value)


def table(headings: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """Rows under headings."""
    head = "".join(f"<th>{escape(h)}</th>" for h in headings)
    body = "".join(f"<tr>{''.join(f'<td>{text(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def facts(title: str, pairs: Mapping[str, Cell]) -> str:
    """A title and what there is to say, one row each."""
    body = "".join(f"<tr><th>{escape(name)}</th><td>{text(value)}</td></tr>" for name, value in pairs.items())
    return f"<b>{escape(title)}</b><table><tbody>{body}</tbody></table>"


def curves(time_min: NDArray[np.float64], signals: Mapping[str, NDArray[np.float64]]) -> str:
    """One small graph a signal over the same time in minutes; what is not finite is left out."""
    return "".join(_curve(name, time_min, np.asarray(values, dtype=float)) for name, values in signals.items())


def _curve(name: str, time_min: NDArray[np.float64], values: NDArray[np.float64]) -> str:
    known = np.isfinite(values) & np.isfinite(time_min)
    x, y = time_min[known], values[known]
    label = escape(name)
    if not len(x):
        return f"<div>{label}: no finite sample</div>"
    keep = np.unique(np.linspace(0, len(x) - 1, min(len(x), POINTS)).astype(int))
    low, high = float(y.min()), float(y.max())
    across = WIDTH * (x[keep] - x[0]) / (float(x[-1] - x[0]) or 1.0)
    down = HEIGHT - HEIGHT * (y[keep] - low) / ((high - low) or 1.0)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, down, strict=True))
    return (
        '<figure style="display:inline-block;margin:4px 12px 4px 0">'
        f"<figcaption>{label}: {low:.4g} to {high:.4g} in {x[-1]:.4g} min</figcaption>"
        f'<svg width="{WIDTH:g}" height="{HEIGHT + 4:g}" viewBox="0 -2 {WIDTH:g} {HEIGHT + 4:g}" role="img" aria-label="{label}">'
        f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.2"/></svg></figure>'
    )
