"""Identity of a study: everything that decides which trials it gets, compared when it is resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from chargetune.model.parameter_space import ParameterSpace
from chargetune.study.names import check_name
from chargetune.study.serialization import canonical_json, describe, differences, space_to_json
from chargetune.study.store.rows import StudyRecord

__all__ = ["StudyError", "check_change", "parameters_of", "study_identity"]

SHOWN = 12


class StudyError(Exception):
    """A study cannot begin, resume or go on; the message says why and what can be done."""


def study_identity(
    name: str,
    *,
    config: Mapping[str, Any],
    space: ParameterSpace,
    tuner: object,
    seed: int,
    batch: int,
    hardware: bool = False,
    earlier: Sequence[str] = (),
) -> dict[str, Any]:
    """The identity as JSON data. Raises ValueError naming the argument, its value and what is allowed."""
    check_name(name)
    for field, value, least in (("seed", seed, 0), ("batch", batch, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{field} = {value!r}, allowed is an integer >= {least}")
    if space.dimension == 0:
        raise ValueError("space: no parameters, allowed is at least one")
    identity = {"config": config, "space": space_to_json(space), "tuner": describe(tuner), "seed": seed, "batch": batch}
    # Only where they are so, that studies of before these entries resume.
    identity |= {"hardware": True} if hardware else {}
    identity |= {"earlier": list(earlier)} if earlier else {}
    plain: dict[str, Any] = json.loads(canonical_json(identity, "study"))
    return plain


def check_change(record: StudyRecord, identity: Mapping[str, Any], *, accept_changed: bool) -> bool:
    """Whether ``identity`` differs from the stored one; StudyError that lists what differs unless that is accepted.

    Other names, sizes or units of the parameters are never accepted: the stored thetas would mean something else. Nor are other
    earlier studies: their trials are in the store since the study was begun.
    """
    old, new = parameters_of(record.identity["space"]), parameters_of(identity["space"])
    if old != new:
        raise StudyError(
            f"study {record.name!r} tunes other parameters: {', '.join(old)} -> {', '.join(new)};"
            " its trials do not fit, begin a study with another name"
        )
    begun, now = record.identity.get("earlier", []), identity.get("earlier", [])
    if begun != now:
        raise StudyError(
            f"study {record.name!r} began with other earlier studies: {', '.join(begun) or '(none)'} -> {', '.join(now) or '(none)'};"
            " their trials were taken over once, begin a study with another name"
        )
    lines = differences(dict(record.identity), dict(identity))
    if accept_changed or not lines:
        return bool(lines)
    shown = "".join(f"\n  {line}" for line in lines[:SHOWN]) + (f"\n  and {len(lines) - SHOWN} more" if len(lines) > SHOWN else "")
    raise StudyError(
        f"study {record.name!r} was begun with something else:{shown}\n"
        "Undo the change, begin a study with another name, or resume with accept_changed=True (tune --accept-changed)"
    )


def parameters_of(parameters: Sequence[Mapping[str, Any]]) -> list[str]:
    """Name, size and unit of each parameter, as text; two studies with the same ones mean the same by theta."""
    return [f"{p['name']} ({p['size']} x {p['unit']})" for p in parameters]
