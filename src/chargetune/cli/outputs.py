"""What a command may write: never a file that it reads, nothing of another kind, and what exists only with ``--overwrite``.

All of it is asked and tried before the long work, so that nobody waits an hour for a message that a folder is not writable.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from chargetune.study.files import try_whole

__all__ = ["Kind", "Output", "claim", "figure_kind", "kind_of", "read_by"]

# What SQLite and the lock of a study keep beside a store.
COMPANIONS = ("-wal", "-shm", "-journal", "-lock")
# A certificate of ten thousand episodes is smaller.
READ_MAX = 64 * 2**20


class Kind(StrEnum):
    """What a file is, by its content."""

    STORE = "store or other SQLite database"
    PAGE = "HTML page"
    PNG = "PNG figure"
    PDF = "PDF figure"
    SVG = "SVG figure"
    CERTIFICATE = "certificate"
    JSON = "JSON file"
    CELL = "cell file"
    STUDY = "study file"
    CAMPAIGN = "campaign file"
    TRACES = "zip archive (npz)"
    PARQUET = "Parquet table"
    CSV = "text file"
    OTHER = "file of an unknown kind"
    EMPTY = "empty file"


BEGINNINGS = (
    (b"SQLite format 3\0", Kind.STORE),
    (b"\x89PNG\r\n\x1a\n", Kind.PNG),
    (b"%PDF-", Kind.PDF),
    (b"PK\x03\x04", Kind.TRACES),
    (b"PAR1", Kind.PARQUET),
)
FIGURES = {".png": Kind.PNG, ".pdf": Kind.PDF, ".svg": Kind.SVG}


@dataclass(frozen=True)
class Output:
    """A file that a command is going to write.

    ``what`` is how a message begins: the option that names the file, also where it has its default, so that one knows how to choose
    another. ``renewed``: it is this command's own from an earlier run,
    which the same command continues.
    """

    what: str
    path: Path
    kind: Kind
    renewed: bool = False


def figure_kind(path: Path) -> Kind:
    """The kind of figure that a path's ending names."""
    return FIGURES.get(path.suffix.lower(), Kind.OTHER)


def kind_of(path: Path) -> Kind:
    """What a file is by its content, whatever its name says. Raises OSError."""
    size = path.stat().st_size
    if not size:
        return Kind.EMPTY
    with path.open("rb") as file:
        head = file.read(1024)
        for beginning, kind in BEGINNINGS:
            if head.startswith(beginning):
                return kind
        content = head + file.read(READ_MAX)
    if b"\0" in head:
        return Kind.OTHER
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return Kind.CSV if size else Kind.OTHER
    start = text[:1024].lstrip().lower()
    if start.startswith(("<!doctype html", "<html")):
        return Kind.PAGE
    if "<svg" in start:
        return Kind.SVG
    return _of_data(text)


def _of_data(text: str) -> Kind:
    if text.lstrip().startswith(("{", "[")):
        try:
            found = json.loads(text)
        except ValueError:
            pass
        else:
            certificate = isinstance(found, dict) and {"figures", "traces", "confidence"} <= found.keys()
            return Kind.CERTIFICATE if certificate else Kind.JSON
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return Kind.CSV
    return Kind.CELL if "capacity_Ah" in table else Kind.CAMPAIGN if "campaign" in table else Kind.STUDY


def read_by(path: Path, document: Mapping[str, Any] | None = None) -> list[Path]:
    """A study or campaign file, the files that it names and those of cells in folders that it names; ``document`` is its content."""
    named = [path.parent / text for text in _texts(document)]
    return [path, *(found for one in named for found in ([one] if one.is_file() else one.glob("*.toml")))]


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        if value and "\0" not in value and "\n" not in value and "://" not in value:
            yield value
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from _texts(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _texts(part)


def claim(outputs: Iterable[Output], *, inputs: Iterable[str | Path], overwrite: bool, folders: bool = True) -> None:
    """Raise ValueError or OSError, naming the path, unless each output may be written and can be.

    inputs
        What the command reads: files, and stores, of which those on a server are no files.
    overwrite
        Existing files of the same kind are replaced.
    folders
        Whether who writes makes folders that are missing.
    """
    read = [path for one in inputs if "://" not in str(one) for path in _with_companions(Path(one))]
    claimed: list[Output] = []
    for output in outputs:
        for path in read:
            if _same(output.path, path):
                raise ValueError(f"{output.what} {output.path}: the command reads {path}, allowed is another file")
        for other in claimed:
            if _same(output.path, other.path):
                raise ValueError(f"{output.what} {output.path}: {other.what} is written to the same file, allowed is another one")
        claimed.append(output)
    for output in claimed:
        _may(output, overwrite=overwrite)
    for output in claimed:
        _can(output, folders=folders)


def _with_companions(path: Path) -> list[Path]:
    # Where the path is a link, they lie beside what it leads to.
    place = path.resolve()
    return [path, *(place.with_name(place.name + end) for end in COMPANIONS)]


def _same(one: Path, other: Path) -> bool:
    try:
        # Through links of both kinds.
        return one.samefile(other)
    except OSError:
        return one.resolve() == other.resolve()


def _may(output: Output, *, overwrite: bool) -> None:
    path = output.path
    if path.is_dir():
        raise ValueError(f"{output.what} {path}: is a folder, allowed is the name of a file")
    # A terminal or a pipe keeps nothing that could be lost.
    if not path.is_file():
        return
    found = kind_of(path)
    if found not in (output.kind, Kind.EMPTY):
        raise ValueError(
            f"{output.what} {path}: there is {_article(found)} of this name, which {_article(output.kind)} does not replace; "
            "choose another name"
        )
    if not overwrite and not output.renewed:
        raise ValueError(f"{output.what} {path}: exists; --overwrite replaces it")


def _article(kind: Kind) -> str:
    """The kind with its article: an HTML page, a cell file."""
    return f"{'an' if kind in (Kind.PAGE, Kind.SVG, Kind.EMPTY) else 'a'} {kind}"


def _can(output: Output, *, folders: bool) -> None:
    path = output.path
    if path.exists() and not path.is_file():
        return
    place = path.resolve()
    if not place.parent.exists() and not folders:
        raise ValueError(f"{output.what} {path}: there is no folder {path.parent}")
    try:
        try_whole(place)
    except OSError as error:
        raise OSError(error.errno, error.strerror, f"{output.what} {path}") from error
