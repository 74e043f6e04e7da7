"""A file's keys as a JSON schema (draft 7), by which an editor completes, explains and checks a TOML file."""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Any, Literal, Union, get_args, get_origin

from chargetune.battery.file_formats.bounds import Bounds
from chargetune.battery.file_formats.formats import Format
from chargetune.battery.file_formats.keys import REQUIRED, Key, Table, in_words

__all__ = ["json_schema"]

NAMES = {float: "number", int: "integer", bool: "boolean", str: "string"}


def json_schema(file: Format) -> dict[str, Any]:
    """The schema of a kind of file.

    Bounds that are another key's or the cell's are left to the reader of the file. Source of the form: Wright et al., JSON Schema
    draft 7 (2018).
    """
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": f"chargetune: {file.title.lower()}"}
    return head | _of_table(file, file.table())


def _of_table(file: Format, table: Table) -> dict[str, Any]:
    inner: dict[str, Any] = {}
    for part in table.tables:
        name, one = part.path[-1], _of_table(file, part)
        inner[name] = {"description": "One of several tables.", "anyOf": [inner[name], one]} if name in inner else one
    properties = {key.name: _of_key(key, file.bounds(table, key)) for key in table.keys} | inner
    required = [key.name for key in table.keys if key.default is REQUIRED] + [
        part.path[-1] for part in table.tables if part.path[-1] in file.required
    ]
    schema = {
        "type": "object",
        "description": table.sentence,
        "properties": properties,
        "required": required,
        "additionalProperties": False,
    }
    if not table.many:
        return schema
    return {"type": "array", "description": table.sentence, "items": schema}


def _of_key(key: Key, bounds: Bounds) -> dict[str, Any]:
    unit = f" In {key.unit}." if key.unit not in ("", "1") else ""
    allowed = f" Allowed: {in_words(key.type)} {bounds}".rstrip() + "."
    schema = {"description": f"{key.sentence}{unit}{allowed}"} | _of_type(key.type, bounds)
    if key.default is not REQUIRED and key.default is not None and key.default not in ((), {}):
        schema["default"] = list(key.default) if isinstance(key.default, tuple) else key.default
    return schema


def _of_type(kind: Any, bounds: Bounds) -> dict[str, Any]:
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return {"enum": list(parts)}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_of_type(part, bounds) for part in parts if part is not type(None)]}
    if origin is tuple and Ellipsis not in parts:
        return {"type": "array", "items": _of_type(parts[0], bounds), "minItems": len(parts), "maxItems": len(parts)}
    if origin in (list, tuple):
        return {"type": "array", "items": _of_type(parts[0], bounds)}
    if origin is Mapping:
        return {"type": "object", "additionalProperties": _of_type(parts[1], bounds)}
    schema: dict[str, Any] = {"type": NAMES.get(kind, "string")}
    if kind in (float, int):
        for name, end, is_open in (("Minimum", bounds.low, bounds.low_open), ("Maximum", bounds.high, bounds.high_open)):
            if isinstance(end, (int, float)):
                schema[f"exclusive{name}" if is_open else name.lower()] = int(end) if kind is int else end
    return schema
