"""A terminal of any kind: characters that it does not have, and warnings as one line each."""

from __future__ import annotations

import codecs
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from chargetune.runtime.notes import say_warnings_as_notes

__all__ = ["any_terminal"]

PLAIN = str.maketrans(
    {"Ω": "Ohm", "±": "+-", "²": "2", "°": "deg ", "µ": "u", "μ": "u", "→": "->", "—": "-", "…": "...", "━": "-", "╸": "-"}
)


def _in_plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end].translate(PLAIN)
    return "".join(c if c.isascii() else "?" for c in text), error.end


codecs.register_error("chargetune.plain", _in_plain)


@contextmanager
def any_terminal() -> Iterator[None]:
    """Within it no character fails to be printed, and each warning is said once, as one line on stderr."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="chargetune.plain")
    with warnings.catch_warnings():
        say_warnings_as_notes()
        yield
