"""HTML from Python: every text is escaped on its way into the page."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from html import escape
from importlib import resources

__all__ = ["Cell", "packed", "paragraph", "plotly_js", "section", "static", "table"]

# A number or text, or a text with the class of its cell.
Cell = str | float | None | tuple[str, str]


def table(headings: Sequence[str], rows: Sequence[Sequence[Cell]], caption: str = "") -> str:
    """A table that scrolls sideways where the screen is narrow. The first column is text; numbers have 5 significant digits."""
    first = ' class="text"'
    head = "".join(f'<th scope="col"{"" if i else first}>{escape(h)}</th>' for i, h in enumerate(headings))
    body = "".join(f"<tr>{''.join(_cell(c, first=i == 0) for i, c in enumerate(row))}</tr>" for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f'<div class="wide"><table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>\n'


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
