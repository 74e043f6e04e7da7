"""The tables in a file as rows of text, whatever the file is: text with any separator, Excel, Parquet."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Any

__all__ = ["Table", "tables"]

SEPARATORS = ";\t,|"
EXCEL = {".xlsx", ".xlsm", ".xlsb", ".xls", ".ods"}
# First bytes of a zip archive, which xlsx is, and of old Excel's compound files.
EXCEL_MARKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")


@dataclass(frozen=True)
class Table:
    """Rows of cells as text, where they stand ("" or "sheet Channel_1"), and whether they may be one by chance."""

    rows: list[list[str]]
    where: str = ""
    likely: bool = True


def tables(path: Path) -> Iterator[list[Table]]:
    """Every way to read the file as tables, the likeliest first: each sheet of a workbook, each separator of a text.

    Raises FileNotFoundError, and ValueError for what is none of them or with what has to be installed to read it.
    """
    with path.open("rb") as file:
        mark = file.read(4)
    if mark == b"PAR1":
        yield [_parquet(path)]
    elif mark in EXCEL_MARKS or path.suffix.lower() in EXCEL:
        yield _sheets(path)
    else:
        yield from ([table] for table in _texts(path))


def _texts(path: Path) -> Iterator[Table]:
    lines = _text(path).splitlines()
    if not any(line.strip() for line in lines):
        raise ValueError(f"{path.name} is empty")
    for separator in SEPARATORS:
        try:
            yield Table(list(csv.reader(lines, delimiter=separator)))
        except csv.Error as error:
            raise ValueError(f"{path.name} is no table of text: {error}") from error
    for spaces in (r"\s{2,}", r"\s+"):
        yield Table([re.split(spaces, line.strip()) for line in lines], likely=False)


def _text(path: Path) -> str:
    content = path.read_bytes()
    wide = content[:2] in {b"\xff\xfe", b"\xfe\xff"}
    # Without its mark UTF-16 shows by the zeros in every second byte of what is mostly ASCII.
    bare = next((name for at, name in ((1, "utf-16-le"), (0, "utf-16-be")) if content[at:200:2].count(0) > 60), None)
    for encoding in ("utf-8-sig", "utf-16") if wide else (bare,) if bare else ("utf-8-sig", "cp1252"):
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\x00" in text:
            continue
        if encoding == "cp1252":
            return _chinese(content) or text
        return text
    raise ValueError(
        f"{path.name} is not text; allowed are text (CSV), Excel and Parquet. Export it from the cycler's program as one of these"
    )


def _chinese(content: bytes) -> str | None:
    """The text in GB 18030, where it then has the word for voltage or current; any bytes are some text in cp1252."""
    try:
        text = content.decode("gb18030")
    except UnicodeDecodeError:
        return None
    return text if "电压" in text or "电流" in text else None


def _parquet(path: Path) -> Table:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError as error:
        raise ValueError(f"to read {path.name} chargetune needs pyarrow: pip install 'chargetune[export]'") from error
    try:
        whole = parquet.read_table(path)
    except (ArrowException, OSError) as error:
        raise ValueError(f"{path.name} is no Parquet file that can be read: {error}") from error
    columns = [[_cell(value) for value in column.to_pylist()] for column in whole.columns]
    return Table([list(whole.column_names), *(list(row) for row in zip(*columns, strict=True))])


def _sheets(path: Path) -> list[Table]:
    try:
        import python_calamine as calamine
    except ImportError as error:
        raise ValueError(f"to read {path.name} chargetune needs python-calamine: pip install 'chargetune[excel]'") from error
    try:
        book = calamine.CalamineWorkbook.from_path(str(path))
        sheets = [(name, book.get_sheet_by_name(name).to_python(skip_empty_area=False)) for name in book.sheet_names]
    except (calamine.CalamineError, OSError) as error:
        raise ValueError(f"{path.name} is no workbook that can be read: {error}") from error
    return [Table([[_cell(value) for value in row] for row in rows], f"sheet {name}") for name, rows in sheets]


def _cell(value: Any) -> str:
    """A cell as a text file would have it; a time of day or a duration is a clock."""
    if value is None:
        return ""
    if isinstance(value, datetime):
        return value.isoformat(sep=" ")
    if isinstance(value, time):
        value = timedelta(hours=value.hour, minutes=value.minute, seconds=value.second, microseconds=value.microsecond)
    if isinstance(value, timedelta):
        seconds = value.total_seconds()
        return f"{int(seconds // 3600)}:{int(seconds % 3600 // 60):02d}:{seconds % 60:09.6f}"
    if isinstance(value, date):
        return value.isoformat()
    return repr(value) if isinstance(value, float) else str(value)
