"""What is wrong with a file that a person wrote: the key as it stands there, its value, and what is allowed."""

from __future__ import annotations

import re
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel

__all__ = ["keys_of", "plain_errors"]

# A place among alternatives, which the file does not name: a type, or a kind of table in angle brackets.
ALTERNATIVE = re.compile(r"<.*>|(str|int|float|bool|list|tuple|dict)(\[.*\])?")
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
BOUND = {"greater_than": ("gt", "more than"), "greater_than_equal": ("ge", "at least"), "less_than": ("lt", "less than")}
BOUND |= {"less_than_equal": ("le", "at most")}
TYPES = {
    "int": "a whole number",
    "float": "a number",
    "string": "text in quotes",
    "bool": "true or false",
    "list": "a list [...]",
    "tuple": "a list [...]",
}


def keys_of(model: Any) -> dict[str, list[str]]:
    """The keys of each table of a file of this form, by the table's name ("controller", "theta.R1"); "" is the top."""
    found: dict[str, list[str]] = {}

    def look(kind: Any, place: str) -> None:
        for table in _tables(kind):
            hints = _keys(table)
            found[place] = list(dict.fromkeys([*found.get(place, []), *hints]))
            for name, inner in hints.items():
                look(inner, f"{place}.{name}" if place else name)

    look(model, "")
    return found


def plain_errors(problems: Iterable[Mapping[str, Any]], model: Any) -> list[str]:
    """The errors of pydantic in the words of the file, one line each; what is allowed in one place stands in one line."""
    lines: list[str] = []
    for line in (plain_error(problem, model) for problem in problems):
        place, allowed, form = line.partition(", allowed is ")
        if allowed and lines and lines[-1].startswith(place + allowed):
            lines[-1] += f" or {form}"
        else:
            lines.append(line)
    return lines


def plain_error(problem: Mapping[str, Any], model: Any) -> str:
    """One error of pydantic in the words of the file."""
    place = [part for part in problem["loc"] if not (isinstance(part, str) and ALTERNATIVE.fullmatch(part))]
    field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).removeprefix(".")
    kind, given, context = str(problem["type"]), problem["input"], problem.get("ctx", {})
    if kind in UNKNOWN:
        return _unknown(field, keys_of(model))
    if kind in ("missing", "missing_argument"):
        keys = keys_of(model).get(field)
        return f"{field} is not given, and is needed" + (f": a table [{field}] with {', '.join(keys)}" if keys else "")
    if kind == "value_error":
        # What a table says of its own entries names field, value and what is allowed.
        return f"{field}: {context['error']}"
    shown = f"{field} = {_value(given)}"
    if kind == "literal_error":
        allowed = str(context["expected"])
        names = allowed.replace(" or ", ", ").replace("'", "").split(", ")
        near = next((name for name in names if isinstance(given, str) and name.lower() == given.lower()), None)
        near = near or next(iter(get_close_matches(str(given), names, 1)), None)
        return f"{shown}, allowed is {allowed}" + (f" (did you mean '{near}'?)" if near else "")
    if kind in BOUND:
        bound, words = BOUND[kind]
        return f"{shown}, allowed is {words} {context[bound]:g}"
    table = keys_of(model).get(field)
    if table is not None and (kind.startswith("list") or not isinstance(given, Mapping)):
        form = f"tables [[{field}]]" if kind.startswith("list") else f"a table [{field}]"
        return f"{shown}, allowed is {form} with {', '.join(table)}"
    if kind == "string_too_short":
        return f"{shown}, allowed is a text that is not empty"
    allowed = TYPES.get(kind.partition("_")[0], "")
    if allowed and kind.endswith(("_type", "_parsing", "_from_float")):
        return f"{shown}, allowed is {allowed}"
    message = str(problem["msg"])
    return f"{shown}: {message[0].lower()}{message[1:]}"


def _value(given: object) -> str:
    if isinstance(given, Mapping):
        # A date in TOML comes as a table of this one key.
        return "a date" if given.keys() == {"date"} else "a table"
    if isinstance(given, bool):
        return str(given).lower()
    text = repr(given)
    return text if len(text) <= 60 else text[:57] + "..."


def _unknown(field: str, keys: Mapping[str, list[str]]) -> str:
    table, _, key = field.rpartition(".")
    # A table in a list [[study.earlier]] has a number in its place.
    home = table.partition("[")[0]
    said = f"{field} is not a known key"
    mine = keys.get(home, [])
    if near := get_close_matches(key, mine, 1, 0.75):
        return f"{said}; did you mean {near[0]}?"
    elsewhere = [place for place, names in keys.items() if key in names and place != home]
    if elsewhere:
        return f"{said}; {key} belongs in {' or '.join(f'[{place}]' if place else 'no table, at the top' for place in elsewhere)}"
    far = {name: place for place, names in keys.items() for name in names}
    if near := get_close_matches(key, far, 1, 0.8):
        place = far[near[0]]
        return f"{said}; did you mean {near[0]}" + (f" in [{place}]?" if place else "?")
    return f"{said}; known {f'in [{home}]' if home else 'at the top'} are {', '.join(mine)}" if mine else said


def _tables(kind: Any) -> Iterator[Any]:
    """The classes of tables in a type, through unions, lists and annotations."""
    origin = get_origin(kind)
    if origin is Annotated:
        yield from _tables(get_args(kind)[0])
    elif origin in (Union, types.UnionType, list, tuple):
        for part in get_args(kind):
            yield from _tables(part)
    elif isinstance(kind, type) and (is_dataclass(kind) or issubclass(kind, BaseModel)):
        yield kind


def _keys(table: Any) -> dict[str, Any]:
    if issubclass(table, BaseModel):
        return {name: field.annotation for name, field in table.model_fields.items()}
    hints = get_type_hints(table, include_extras=True)
    return {field.name: hints[field.name] for field in fields(table) if field.init}
