"""How every figure looks, and the only place that imports matplotlib.

The object-oriented interface is used throughout, so that no window system, global figure or user's matplotlibrc plays a part.
"""

from __future__ import annotations

import io
import os
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chargetune.study.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = [
    "BLUE", "COLUMN_IN", "FORMATS", "GREEN", "GREY", "ORANGE", "PAGE_IN", "RED",
    "cell_note", "check_format", "journal_style", "legend_above", "letter", "new_figure", "plain_symlog", "save", "words",
]  # fmt: skip

# Okabe and Ito's palette, told apart with every kind of colour vision; the red is darker, to differ from the orange in lightness too.
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#B8000B", "#8C8C8C"
# Widths of one column and of a page's text block, inches.
COLUMN_IN, PAGE_IN = 3.5, 7.0
FORMATS = ("png", "pdf", "svg")
DPI = 300

RC: dict[str, Any] = {
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "legend.handletextpad": 0.5,
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.03,
    "savefig.dpi": DPI,
    # TrueType fonts, which journals ask for; and identifiers that do not change from run to run.
    "pdf.fonttype": 42,
    "svg.hashsalt": "chargetune",
}
# Dates and versions in a file would make the same figure differ.
METADATA: dict[str, dict[str, Any]] = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}


@contextmanager
def journal_style() -> Iterator[None]:
    """The settings under which a figure is made and saved. They are matplotlib's global ones meanwhile: one thread at a time."""
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcdefaults()
        settings: Any = mpl.rcParams
        settings.update(RC)
        yield


def new_figure(width_in: float, height_in: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, list[Axes]]:
    """A figure and its axes, row by row; ``options`` go to `Figure.subplots`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).flat)


def letter(axes: Sequence[Axes]) -> None:
    """(a), (b), ... at the upper left, outside the data."""
    for axis, name in zip(axes, "abcdefghijklmnopqrstuvwxyz", strict=False):
        axis.set_title(f"({name})", loc="left", pad=3)


def plain_symlog(axis: Axes, within: float = 1.0) -> None:
    """A y axis for an excess: linear ``within`` so much on either side of the limit, logarithmic beyond, with plain numbers."""
    from matplotlib.ticker import StrMethodFormatter

    axis.set_yscale("symlog", linthresh=within, linscale=0.5)
    axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


def words(text: str) -> Line2D:
    """An entry of a legend that is only text."""
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="none", label=text)


def legend_above(figure: Figure, handles: Sequence[Any], columns: int | None = None) -> None:
    """One legend for all axes, above them."""
    figure.legend(handles=list(handles), loc="outside upper center", ncols=columns or len(handles), columnspacing=1.1)


def cell_note(figure: Figure, name: str, remark: str) -> None:
    """What must be said of the cell wherever it is shown, below the axes; nothing when there is no remark."""
    if remark:
        characters = int(figure.get_figwidth() * 21)
        note = figure.supxlabel(textwrap.fill(f"{name}: {remark}", characters), fontsize=6.5, color="0.35", x=0.01, ha="left")
        # A dollar sign in a user's cell file is no formula.
        note.set_parse_math(False)


def check_format(path: str | os.PathLike[str], what: str = "figure") -> str:
    """The format that the path's ending names. Raises ValueError, so that nobody waits for a figure that cannot be written.

    ``what`` is how the message begins: the option that the path came from, for instance.
    """
    kind = Path(path).suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise ValueError(f"{what} {path}: format {kind!r}, allowed are {', '.join(FORMATS)}")
    return kind


def save(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure in the format of the path's ending; the same figure gives the same bytes. Raises ValueError."""
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    target, kind = Path(path), check_format(path)
    with journal_style():
        # The layout depends on the resolution and on the layout before, so it is settled once, at the same one for every format.
        if isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine):
            figure.set_dpi(DPI)
            figure.draw_without_rendering()
            figure.set_layout_engine("none")
        content = io.BytesIO()
        figure.savefig(content, format=kind, metadata=METADATA[kind])
    return write_whole(target, content.getvalue())
