"""The trace of an episode as bytes: named arrays and JSON metadata, lossless, without pickle.

Layout: a magic line, the length of the header as 4 bytes (little endian), the header as JSON
(``{"arrays": [{name, dtype, shape, filter, length}], "meta": {...}}``), then one zlib block for each array in the order of
the header. Equal arrays and metadata give equal bytes, so that the SHA-256 of a trace identifies its content.

Filters of a block, all exactly invertible:
``raw``
    the array in C order.
``delta``
    8-byte entries read as integers, time (axis 0) running fastest, each replaced by its zigzag-coded difference from the one before.
``delta+shuffle``
    the same, then all first bytes, all second bytes and so on. Measured noise then sits in few byte planes.
"""

from __future__ import annotations

import json
import math
import re
import struct
import zlib
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.study.document import canonical_json

__all__ = ["Traceable", "decode", "encode"]

MAGIC = b"chargetune trace 1\n"
# Level 1: level 6 takes up to three times as long and saves 2-8 %.
LEVEL = 1
DTYPE = re.compile(r"[<|][biuf][1248]")


class Traceable(Protocol):
    """What can be stored with a trial: an episode."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """The named arrays."""
        ...

    def meta(self) -> Mapping[str, Any]:
        """Everything else as JSON: names, units, sampling time, ending."""
        ...


def encode(arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> bytes:
    """Bytes of the named arrays (bool, integer or float of any shape, NaN allowed) and of JSON metadata.

    Raises ValueError for another kind of array, naming it, and for metadata that is not JSON.
    """
    entries: list[dict[str, Any]] = []
    blocks: list[bytes] = []
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
            raise ValueError(f"trace: array {name!r} has dtype {array.dtype}, allowed are bool, integers and floats of at most 8 bytes")
        array = array.astype(array.dtype.newbyteorder("<"))
        name_of_filter, block = _compress(array)
        entries.append({"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "filter": name_of_filter, "length": len(block)})
        blocks.append(block)
    header = canonical_json({"arrays": entries, "meta": dict(meta)}, "trace").encode()
    return b"".join((MAGIC, struct.pack("<I", len(header)), header, *blocks))


def decode(data: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays and the metadata of `encode`, bit for bit. Raises ValueError for anything else."""
    if not data.startswith(MAGIC):
        raise ValueError("trace: these bytes do not begin as a trace does")
    try:
        start = len(MAGIC) + 4
        (length,) = struct.unpack_from("<I", data, len(MAGIC))
        header = json.loads(data[start : start + length])
        position = start + length
        arrays = {}
        for entry in header["arrays"]:
            block = data[position : position + entry["length"]]
            arrays[str(entry["name"])] = _expand(block, entry["dtype"], tuple(entry["shape"]), entry["filter"])
            position += entry["length"]
        meta = dict(header["meta"])
    except (struct.error, zlib.error, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"trace: damaged ({error})") from error
    if position != len(data):
        raise ValueError(f"trace: damaged ({len(data)} bytes, its header says {position})")
    return arrays, meta


def _compress(array: NDArray[Any]) -> tuple[str, bytes]:
    if array.dtype.itemsize != 8 or array.size == 0:
        return "raw", zlib.compress(array.tobytes(), LEVEL)
    coded = _delta(array)
    plain = zlib.compress(coded.tobytes(), LEVEL)
    shuffled = zlib.compress(coded.view(np.uint8).reshape(-1, 8).T.tobytes(), LEVEL)
    # Quantised readings repeat whole words, noise only repeats its upper bytes: neither way is the shorter for both.
    return ("delta", plain) if len(plain) <= len(shuffled) else ("delta+shuffle", shuffled)


def _expand(block: bytes, dtype_name: str, shape: tuple[int, ...], name_of_filter: str) -> NDArray[Any]:
    # NumPy reads far more as a dtype than `encode` writes, and evaluates part of it as Python.
    if not DTYPE.fullmatch(dtype_name):
        raise ValueError(f"dtype {dtype_name!r} is not allowed")
    dtype = np.dtype(dtype_name)
    plain = zlib.decompress(block)
    if len(plain) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{len(plain)} bytes for shape {shape} of {dtype}")
    if name_of_filter == "raw":
        return np.frombuffer(plain, dtype).reshape(shape).copy()
    if name_of_filter == "delta+shuffle":
        plain = np.frombuffer(plain, np.uint8).reshape(8, -1).T.tobytes()
    elif name_of_filter != "delta":
        raise ValueError(f"unknown filter {name_of_filter!r}")
    return _undelta(np.frombuffer(plain, "<u8"), dtype, shape)


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
