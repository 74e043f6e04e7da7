"""The trace of an episode as one compressed blob: named arrays and JSON metadata, lossless, without pickle.

Layout: a magic line, then one zstd frame that holds the length of the header as 4 bytes (little endian), the header as JSON
(``{"arrays": [{name, dtype, shape, filter}], "meta": {...}}``) and the filtered bytes of each array in the order of the header.

Filters, all exactly invertible:
``raw``
    the array in C order.
``delta``
    8-byte entries read as integers, time (axis 0) running fastest, each replaced by its zigzag-coded difference from the one before.
``delta+shuffle``
    the same, then all first bytes, all second bytes and so on. Measured noise then sits in few byte planes.

The SHA-256 of a trace is that of its content (`content_sha256`), not of the blob: another version of the compressor writes other bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import zstandard
from numpy.typing import NDArray

from chargetune.runtime.counted import counted
from chargetune.study.serialization import canonical_json

__all__ = ["TraceFacts", "Traceable", "content_sha256", "decode", "encode", "expand", "facts"]

MAGIC = b"chargetune trace 2\n"
# Levels above 3 take up to six times as long and save less than 2 %.
LEVEL = 3
DTYPE = re.compile(r"[<|][biuf][1248]")
# An hour of 6 signals at 1 s is 0.2 MB; a damaged length must not ask for all memory.
LARGEST = 1 << 30


class Traceable(Protocol):
    """What can be stored with a trial: an episode."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """The named arrays."""
        ...

    def meta(self) -> Mapping[str, Any]:
        """Everything else as JSON: names, units, sampling time, ending."""
        ...


@dataclass(frozen=True)
class TraceFacts:
    """What a store writes beside a trace: SHA-256 of the content, unit by signal, sampling time in s (None: the metadata has none)."""

    sha256: str
    units: Mapping[str, str]
    sampling_time_s: float | None


def encode(arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> bytes:
    """Bytes of the named arrays (bool, integer or float of any shape, NaN allowed) and of JSON metadata.

    Raises ValueError for another kind of array, naming it, and for metadata that is not JSON.
    """
    entries: list[dict[str, Any]] = []
    blocks: list[bytes] = []
    for name, value in arrays.items():
        array = _plain(name, value)
        name_of_filter, block = _filtered(array)
        entries.append({"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "filter": name_of_filter})
        blocks.append(block)
    header = canonical_json({"arrays": entries, "meta": dict(meta)}, "trace").encode()
    return MAGIC + _compress(b"".join((struct.pack("<I", len(header)), header, *blocks)))


def decode(data: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays and the metadata of `encode`, bit for bit. Raises ValueError for anything else."""
    if not data.startswith(MAGIC):
        raise ValueError("trace: these bytes do not begin as a trace does")
    try:
        content = _decompress(data[len(MAGIC) :])
        (length,) = struct.unpack_from("<I", content)
        header = json.loads(content[4 : 4 + length])
        position = 4 + length
        arrays = {}
        for entry in header["arrays"]:
            dtype, shape = _dtype(entry["dtype"]), tuple(entry["shape"])
            size = math.prod(shape) * dtype.itemsize
            arrays[str(entry["name"])] = expand(content[position : position + size], dtype, shape, entry["filter"])
            position += size
        meta = dict(header["meta"])
    except (struct.error, zstandard.ZstdError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"trace: damaged ({error})") from error
    if position != len(content):
        raise ValueError(f"trace: damaged ({counted(len(content), 'byte')}, its header says {position})")
    return arrays, meta


def content_sha256(arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> str:
    """SHA-256 of names, types, shapes and metadata as JSON followed by the arrays in C order, little endian."""
    plain = {name: _plain(name, value) for name, value in arrays.items()}
    entries = [{"name": name, "dtype": array.dtype.str, "shape": list(array.shape)} for name, array in plain.items()]
    digest = hashlib.sha256(canonical_json({"arrays": entries, "meta": dict(meta)}, "trace").encode())
    for array in plain.values():
        digest.update(array.tobytes())
    return digest.hexdigest()


def facts(data: bytes) -> TraceFacts:
    """Hash, units and sampling time of an encoded trace. Raises ValueError for bytes that are none."""
    arrays, meta = decode(data)
    units = {str(name): str(unit) for name, unit in dict(meta.get("units") or {}).items()}
    for kind in ("input", "output"):
        units.update(zip(meta.get(f"{kind}_names", ()), meta.get(f"{kind}_units", ()), strict=False))
    sampling_time = meta.get("sampling_time_s")
    return TraceFacts(content_sha256(arrays, meta), units, None if sampling_time is None else float(sampling_time))


def expand(block: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], name_of_filter: str) -> NDArray[Any]:
    """The array of a filtered block. Raises ValueError when they do not fit together."""
    if len(block) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{counted(len(block), 'byte')} for shape {shape} of {dtype}")
    if name_of_filter == "raw":
        return np.frombuffer(block, dtype).reshape(shape).copy()
    if name_of_filter == "delta+shuffle":
        block = np.frombuffer(block, np.uint8).reshape(8, -1).T.tobytes()
    elif name_of_filter != "delta":
        raise ValueError(f"unknown filter {name_of_filter!r}")
    return _undelta(np.frombuffer(block, "<u8"), dtype, shape)


def _plain(name: str, value: NDArray[Any]) -> NDArray[Any]:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
        raise ValueError(f"trace: array {name!r} has dtype {array.dtype}, allowed are bool, integers and floats of at most 8 bytes")
    return array.astype(array.dtype.newbyteorder("<"), copy=False)


def _dtype(name: str) -> np.dtype[Any]:
    # NumPy reads far more as a dtype than `encode` writes, and evaluates part of it as Python.
    if not DTYPE.fullmatch(name):
        raise ValueError(f"dtype {name!r} is not allowed")
    return np.dtype(name)


def _compress(content: bytes) -> bytes:
    return zstandard.ZstdCompressor(level=LEVEL).compress(content)


def _decompress(frame: bytes) -> bytes:
    size = zstandard.get_frame_parameters(frame).content_size
    if size > LARGEST:
        raise ValueError(f"its length is {size} bytes, allowed is at most {LARGEST}")
    return zstandard.ZstdDecompressor().decompress(frame, allow_extra_data=False)


def _filtered(array: NDArray[Any]) -> tuple[str, bytes]:
    if array.dtype.itemsize != 8 or array.size == 0:
        return "raw", array.tobytes()
    coded = _delta(array)
    plain, shuffled = coded.tobytes(), coded.view(np.uint8).reshape(-1, 8).T.tobytes()
    # Quantised readings repeat whole words, noise only repeats its upper bytes: neither way is the shorter for both.
    return ("delta", plain) if len(_compress(plain)) <= len(_compress(shuffled)) else ("delta+shuffle", shuffled)


def _delta(array: NDArray[Any]) -> NDArray[np.uint64]:
    words = np.ascontiguousarray(array.reshape(len(array) if array.ndim else 1, -1).T).ravel().view("<u8")
    difference = words.copy()
    difference[1:] -= words[:-1]
    signed = difference.view("<i8")
    return ((signed << 1) ^ (signed >> 63)).view("<u8")


def _undelta(coded: NDArray[np.uint64], dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    one = np.uint64(1)
    difference = (coded >> one) ^ (~(coded & one) + one)
    words = np.cumsum(difference, dtype="<u8")
    rows = shape[0] if shape else 1
    return np.ascontiguousarray(words.view(dtype).reshape(-1, rows).T).reshape(shape)
