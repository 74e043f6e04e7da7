"""The keys of a file, read from the classes that the file is read into: type, default, unit, and the sentence beside the field."""

from __future__ import annotations

import ast
import inspect
import sys
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from pydantic.fields import FieldInfo

__all__ = ["REQUIRED", "UNITS", "Key", "Table", "in_words", "part_of", "table_of", "without_none"]

# Where a name ends so, its number has this unit; the longest ending counts.
UNITS = {
    "V": "V",
    "A": "A",
    "s": "s",
    "K": "K",
    "Ah": "Ah",
    "ohm": "ohm",
    "F": "F",
    "A_s": "A/s",
    "mVs": "mV s",
    "W_K": "W/K",
    "V_K": "V/K",
    "J_K": "J/K",
    "J_mol": "J/mol",
    "W_m2K": "W/(m² K)",
    "per_V": "1/V",
}
REQUIRED = MISSING
# Sentence by field.
Sentences = Mapping[str, str]
SIMPLE = {float: "number", int: "integer", bool: "true or false", str: "text", Path: "text"}
PLURAL = {"number": "numbers", "integer": "integers", "text": "texts"}


@dataclass(frozen=True)
class Key:
    """One key: its type as an annotation, its default (`REQUIRED`: there is none), what it means in one sentence, its unit."""

    name: str
    type: Any
    default: Any
    sentence: str
    unit: str

    @property
    def is_number(self) -> bool:
        """Whether it is a number, or a list of numbers."""
        kinds = {self.type, *get_args(self.type)}
        return bool(kinds & {float, int}) and not kinds & {str}


@dataclass(frozen=True)
class Table:
    """A table of the file: its path, whether there may be many ([[a.b]]), what it is in one sentence, its keys, the tables in it."""

    path: tuple[str, ...]
    many: bool
    sentence: str
    keys: tuple[Key, ...]
    tables: tuple[Table, ...] = ()

    @property
    def heading(self) -> str:
        """As a file writes it, [a.b] or [[a.b]]; of the whole file without brackets."""
        name = ".".join(self.path)
        return f"[[{name}]]" if self.many else f"[{name}]" if name else "Top of the file"

    def walk(self) -> list[Table]:
        """This table and all in it, in the order of the file."""
        return [self, *(found for table in self.tables for found in table.walk())]


def table_of(
    model: type,
    path: tuple[str, ...] = (),
    *,
    sentence: str = "",
    many: bool = False,
    texts: Mapping[type, Sentences] | None = None,
) -> Table:
    """The keys of a table that is read into this class, a pydantic model or a dataclass.

    A sentence is the string below the field, or, where a class has them elsewhere, what ``texts`` says of it. Raises TypeError for
    a type that a file cannot have.
    """
    beside = {name: _sentence(text) for name, text in {**(texts or {}).get(model, {}), **_sentences(model)}.items()}
    keys, tables = [], []
    for name, kind, default in _fields(model):
        plain = without_none(kind)
        inner = _inner(plain)
        if inner:
            # What may be one of several tables is told by each of them.
            told = beside.get(name, "") if len(inner) == 1 else ""
            several = get_origin(plain) in (list, tuple)
            tables += [table_of(one, (*path, name), sentence=told, many=several, texts=texts) for one in inner]
        else:
            in_words(plain)
            keys.append(Key(name, plain, default, beside.get(name, ""), _unit(name, plain)))
    return Table(path, many, sentence or _first_sentence(model), tuple(keys), tuple(tables))


def part_of(keys: Sequence[Key], name: str) -> Key:
    """The key of this name. Raises KeyError."""
    return {key.name: key for key in keys}[name]


def in_words(kind: Any) -> str:
    """A type in words: "number", "list of 2 numbers", '"soft" or "hard"'. Raises TypeError."""
    if kind in SIMPLE:
        return SIMPLE[kind]
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(f'"{part}"' for part in parts)
    if origin in (Union, types.UnionType):
        return " or ".join(in_words(part) for part in parts if part is not type(None))
    if origin is tuple and Ellipsis not in parts:
        return f"list of {len(parts)} {_plural(parts[0])}"
    if origin in (list, tuple):
        return f"list of {_plural(parts[0])}"
    if origin is Mapping:
        return f"table of {in_words(parts[1])}, by name"
    raise TypeError(f"{kind} has no words, allowed are {', '.join(SIMPLE.values())}, Literal, list, tuple, Mapping and a union of these")


def without_none(kind: Any) -> Any:
    """The type without what says how it is checked, and without None: a key that is not given is left out."""
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) in (Union, types.UnionType):
        parts = [part for part in get_args(kind) if part is not type(None)]
        return without_none(parts[0]) if len(parts) == 1 else Union[tuple(parts)]  # noqa: UP007 - the parts are known at run time only
    return kind


def _plural(kind: Any) -> str:
    word = in_words(kind)
    return PLURAL.get(word, word)


def _inner(kind: Any) -> list[type]:
    """The class of a table, of each table of a list, or the classes of which it is one."""
    if get_origin(kind) in (Union, types.UnionType):
        return [one for part in get_args(kind) for one in _inner(without_none(part))]
    part = get_args(kind)[0] if get_origin(kind) in (list, tuple) else kind
    return [part] if isinstance(part, type) and (is_dataclass(part) or issubclass(part, BaseModel)) else []


def _fields(model: type) -> list[tuple[str, Any, Any]]:
    """(name, annotation, default) of each field."""
    hints = get_type_hints(model)
    if issubclass(model, BaseModel):
        found = model.model_fields.items()
        return [(name, hints[name], REQUIRED if f.is_required() else f.get_default(call_default_factory=True)) for name, f in found]
    parts = fields(cast("Any", model))
    return [(f.name, hints[f.name], f.default_factory() if f.default_factory is not MISSING else f.default) for f in parts]


def _unit(name: str, kind: Any) -> str:
    """By the end of the name; "1" for a number without one, "" for what is no number."""
    if not Key(name, kind, None, "", "").is_number:
        return ""
    endings = [end for end in UNITS if name.endswith(f"_{end}") or name == end]
    return UNITS[max(endings, key=len)] if endings else "1"


def _sentence(text: str) -> str:
    """With a capital and a full stop, and in the words of a file, which has no null."""
    text = text.replace("null:", "not given:").strip()
    return text if not text else f"{text[0].upper()}{text[1:]}{'' if text[-1] in '.!?' else '.'}"


def _first_sentence(model: type) -> str:
    return (inspect.getdoc(model) or "").split("\n\n", maxsplit=1)[0].replace("\n", " ")


def _sentences(model: type) -> dict[str, str]:
    """Descriptions of fields (pydantic's `Field`), and the strings below the fields of a class: Python keeps those in the source alone."""
    below = {name: text for cls in reversed(model.__mro__) for name, text in _of_module(cls.__module__).get(cls.__name__, {}).items()}
    if issubclass(model, BaseModel):
        below |= {name: part.description for name, part in model.model_fields.items() if part.description}
    for name, kind in get_type_hints(model, include_extras=True).items():
        told = [part.description for part in getattr(kind, "__metadata__", ()) if isinstance(part, FieldInfo) and part.description]
        if told:
            below[name] = told[0]
    return below


@cache
def _of_module(name: str) -> dict[str, dict[str, str]]:
    if not name.startswith("chargetune."):
        return {}
    found: dict[str, dict[str, str]] = {}
    for node in ast.parse(inspect.getsource(sys.modules[name])).body:
        if isinstance(node, ast.ClassDef):
            own = found.setdefault(node.name, {})
            for part, after in zip(node.body, node.body[1:], strict=False):
                if (
                    isinstance(part, ast.AnnAssign)
                    and isinstance(part.target, ast.Name)
                    and isinstance(after, ast.Expr)
                    and isinstance(after.value, ast.Constant)
                ):
                    own[part.target.id] = inspect.cleandoc(str(after.value.value)).replace("\n", " ").strip()
    return found
