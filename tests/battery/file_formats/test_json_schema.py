"""The schemas accept every example and refuse what the readers refuse."""

import json
import tomllib
from pathlib import Path

import pytest

from chargetune.battery.file_formats.formats import FORMATS
from chargetune.battery.file_formats.json_schema import json_schema

EXAMPLES = Path(__file__).parents[3] / "examples"
KINDS = {"number": (int, float), "integer": int, "boolean": bool, "string": str, "array": list, "object": dict}


def faults(schema, value, where=""):
    """Where a value breaks a schema, after the words of JSON Schema draft 7 that the schemas use."""
    if "anyOf" in schema:
        found = [faults(part, value, where) for part in schema["anyOf"]]
        return [] if [] in found else found[0]
    if "enum" in schema:
        return [] if value in schema["enum"] else [where]
    kind = schema["type"]
    if not isinstance(value, KINDS[kind]) or (isinstance(value, bool) and kind != "boolean"):
        return [where]
    if kind == "array":
        wrong = not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value))
        return [where] * wrong + [fault for k, part in enumerate(value) for fault in faults(schema["items"], part, f"{where}[{k}]")]
    if kind == "object":
        known, rest = schema.get("properties", {}), schema["additionalProperties"]
        out = [f"{where}.{name}" for name in schema.get("required", ()) if name not in value]
        for name, part in value.items():
            inner = known.get(name, rest)
            out += [f"{where}.{name}"] if inner is False else faults(inner, part, f"{where}.{name}")
        return out
    if kind not in ("number", "integer"):
        return []
    low, high = schema.get("minimum", value), schema.get("maximum", value)
    inside = low <= value <= high and schema.get("exclusiveMinimum", value - 1) < value < schema.get("exclusiveMaximum", value + 1)
    return [] if inside else [where]


def kind_of(data):
    return "campaign" if "campaign" in data else "cell" if "ecm" in data else "study"


FILES = {path.name: tomllib.loads(path.read_text(encoding="utf-8")) for path in sorted(EXAMPLES.glob("*.toml"))}


@pytest.mark.parametrize("name", FILES)
def test_examples_are_accepted(name):
    data = FILES[name]
    assert faults(json_schema(FORMATS[kind_of(data)]), data) == []


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("[controller]\nhorizon = 51", ".controller.horizon"),
        ("[controller]\nhorizont = 5", ".controller.horizont"),
        ("[controller]\nhorizon = true", ".controller.horizon"),
        ('[study]\ntuner = "best"', ".study.tuner"),
        ("[range]\nsoc_start = [0.1]", ".range.soc_start"),
        ("[[study.earlier]]\nstore = 'a'", ".study.earlier[0].study"),
        ("[safety]\nprobability = 1.0", ".safety.probability"),
        ("[theta.values]\nbackoff_V = ['a']", ".theta.values.backoff_V"),
    ],
)
def test_what_is_wrong_is_refused(text, where):
    assert faults(json_schema(FORMATS["study"]), tomllib.loads(text)) == [where]


@pytest.mark.parametrize("name", FORMATS)
def test_a_schema_is_json_and_explains_every_key(name):
    schema = json.loads(json.dumps(json_schema(FORMATS[name])))
    count = 0

    def walk(part):
        nonlocal count
        for inner in part.get("properties", {}).values():
            count += 1
            assert inner["description"]
            walk(inner.get("items", inner))

    walk(schema)
    assert count > len(schema["properties"])
