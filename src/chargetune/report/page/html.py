"""HTML from Python: every text is escaped on its way into the page."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from html import escape
from importlib import resources

__all__ = ["Cell", "beside", "packed", "paragraph", "plotly_js", "section", "static", "table"]

# A number or text, or a text with the class of its cell.
Cell = str | float | None | tuple[str, str]


def table(headings: Sequence[str | tuple[str, str]], rows: Sequence[Sequence[Cell]], caption: str = "", kind: str = "") -> str:
    """A table that scrolls sideways where the screen is narrow. The first column is text; numbers have 5 significant digits.

    A heading may be a pair of its text and the class of its cell. ``kind`` is the class of the table.
    """
    pairs = [h if isinstance(h, tuple) else (h, "" if i else "text") for i, h in enumerate(headings)]
    cells = "".join(f'<th scope="col"{f" class={chr(34)}{c}{chr(34)}" if c else ""}>{escape(h)}</th>' for h, c in pairs)
    head = f"<thead><tr>{cells}</tr></thead>" if any(h for h, _ in pairs) else ""
    body = "".join(f"<tr>{''.join(_cell(c, first=i == 0) for i, c in enumerate(row))}</tr>" for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    opened = f'<table class="{kind}">' if kind else "<table>"
    return f'<div class="wide">{opened}{title}{head}<tbody>{body}</tbody></table></div>\n'


def beside(*parts: str) -> str:
    """Parts side by side where the screen is wide enough."""
    return f'<div class="beside">\n{"".join(parts)}</div>\n'


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    opened = f'<p class="{kind}">' if kind else "<p>"
    return f"{opened}{escape(text)}</p>\n"


def section(title: str, *parts: str) -> str:
    """A heading and what belongs to it."""
    return f"<section>\n<h2>{escape(title)}</h2>\n{''.join(parts)}</section>\n"


def packed(text: str | bytes) -> str:
    """gzip in base64: what a page carries along, and unpacks itself. The same text gives the same bytes."""
    data = text.encode() if isinstance(text, str) else text
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode()


def static(name: str) -> str:
    """A file of this package that goes into the page."""
    return resources.files("chargetune.report").joinpath("static", name).read_text("utf-8")


def plotly_js() -> bytes:
    """The plotly.js that the wheel of plotly brings; nothing of plotly is imported."""
    return resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()


def _cell(value: Cell, *, first: bool) -> str:
    if isinstance(value, tuple):
        text, kind = value
        return f'<td class="{kind}">{escape(text)}</td>'
    if isinstance(value, float):
        value = f"{value:.5g}"
    text = "-" if value is None else escape(str(value))
    return f'<td class="text">{text}</td>' if first else f"<td>{text}</td>"
