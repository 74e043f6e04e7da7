"""The file of a short study, for the tests that read one."""

import json
from typing import Any


def study_text(**tables: dict[str, Any]) -> str:
    """TOML of a study of 60 steps by Sobol points in three backoffs; ``tables`` add to it or replace what stands there."""
    usual = {
        "study": {"tuner": "sobol"},
        "controller": {},
        "episode": {"steps": 60},
        "theta.backoff": {"nodes": 3, "lower_V": 0.0, "upper_V": 0.2},
    }
    lines = []
    for name in {**usual, **tables}:
        keys = usual.get(name, {}) | tables.get(name, {})
        if keys:
            # Strings, numbers, switches and lists are written in TOML as in JSON.
            lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items())]
    return "\n".join(lines) + "\n"
