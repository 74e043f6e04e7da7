import json
import struct
import time
from contextlib import suppress

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from chargetune.study.store.trace import MAGIC, TraceFacts, content_sha256, decode, encode, facts

DTYPES = st.sampled_from(["<f8", ">f8", "<f4", "<i8", "<i4", "u1", "?", "<u8", "<f2"])
ARRAYS = DTYPES.flatmap(lambda d: hnp.arrays(d, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=7)))


@given(st.dictionaries(st.text(max_size=5), ARRAYS, max_size=4))
def test_round_trip_is_bit_exact(arrays):
    meta = {"units": {"V": "V"}, "list": [1, 2.5, None, True], "µ": "Ω"}
    found, found_meta = decode(encode(arrays, meta))
    assert list(found) == list(arrays)
    assert found_meta == meta
    for name, array in arrays.items():
        little = array.astype(array.dtype.newbyteorder("<"))
        assert found[name].dtype == little.dtype
        assert found[name].shape == little.shape
        assert found[name].tobytes() == little.tobytes()
        assert found[name].flags.writeable


def test_not_contiguous_and_not_finite():
    a = np.arange(24.0).reshape(4, 6)
    a[1, 2], a[2, 3], a[3, 4] = np.nan, np.inf, -0.0
    for view in (a.T, a[::2, ::-1], np.asfortranarray(a)):
        assert decode(encode({"a": view}, {}))[0]["a"].tobytes() == np.ascontiguousarray(view).tobytes()


def test_equal_content_gives_equal_bytes():
    a = np.linspace(0, 1, 50).reshape(10, 5)
    assert encode({"a": a}, {"x": 1, "y": [2]}) == encode({"a": np.asfortranarray(a)}, {"y": (2,), "x": np.int64(1)})
    assert encode({"a": a}, {"x": 1}) != encode({"a": a}, {"x": 2})


@pytest.mark.parametrize(
    "array", [np.array([object()]), np.array(["a"]), np.zeros(2, complex), np.zeros(2, "f8,i4"), np.zeros(2, np.longdouble)]
)
def test_refuses_what_would_need_pickle(array):
    with pytest.raises(ValueError, match="array 'bad' has dtype"):
        encode({"bad": array}, {})


@pytest.mark.parametrize("meta", [{"x": float("nan")}, {"x": {1: 2}}, {"x": object()}])
def test_refuses_metadata_that_is_not_json(meta):
    with pytest.raises(ValueError, match=r"trace\.meta\.x"):
        encode({}, meta)


@given(st.integers(0, 10_000), st.integers(0, 255))
def test_damage_is_a_value_error_or_another_valid_trace(position, byte):
    data = bytearray(encode({"a": np.arange(12.0).reshape(3, 4), "n": np.arange(3)}, {"unit": "V"}))
    data[position % len(data)] = byte
    with suppress(ValueError):
        decode(bytes(data))


def forged(header, content=b""):
    text = json.dumps(header).encode()
    return MAGIC + zstandard.compress(struct.pack("<I", len(text)) + text + content)


@pytest.mark.parametrize("dtype", ["O", "<f8,<f8", "<U8", "(", "f8", "<c16", "<M8", "__import__('os')"])
def test_dtypes_that_are_never_written_are_not_read(dtype):
    entry = {"name": "a", "dtype": "<f8", "shape": [3], "filter": "raw"}
    assert decode(forged({"arrays": [entry], "meta": {}}, bytes(24)))[0]["a"].tolist() == [0.0] * 3
    with pytest.raises(ValueError, match=r"dtype .* is not allowed"):
        decode(forged({"arrays": [entry | {"dtype": dtype}], "meta": {}}, bytes(24)))


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (zstandard.compress(bytes(1 << 20)).replace(struct.pack("<I", 1 << 20), struct.pack("<I", 1 << 31)), "allowed is at most"),
        (zstandard.ZstdCompressor(write_content_size=False).compress(bytes(100)), "allowed is at most"),
        (zstandard.compress(struct.pack("<I", 0)) + b"x", "damaged"),
        (zstandard.compress(struct.pack("<I", 1 << 31)), "damaged"),
        (zstandard.compress(b""), "damaged"),
    ],
)
def test_lengths_that_lie_are_refused(frame, message):
    with pytest.raises(ValueError, match=message):
        decode(MAGIC + frame)


def test_facts_are_those_of_the_content_not_of_its_compression():
    meta = {"sampling_time_s": 10, "input_names": ["i"], "input_units": ["A"], "output_names": ["v"], "output_units": ["V"]}
    data = encode({"v": np.arange(3.0)}, meta)
    known = facts(data)
    assert (known.units, known.sampling_time_s) == ({"i": "A", "v": "V"}, 10.0)
    other = MAGIC + zstandard.ZstdCompressor(level=19, write_checksum=True).compress(zstandard.decompress(data[len(MAGIC) :]))
    assert other != data
    assert facts(other) == known
    for arrays, changed in (
        ({"v": np.array([0.0, 1.0, -0.0])}, meta),
        ({"w": np.arange(3.0)}, meta),
        ({"v": np.arange(3.0)}, meta | {"a": 1}),
    ):
        assert facts(encode(arrays, changed)).sha256 != known.sha256
    assert facts(encode({}, {"units": {"v": "mV"}})) == TraceFacts(content_sha256({}, {"units": {"v": "mV"}}), {"v": "mV"}, None)


@pytest.mark.parametrize("cut", [0, 5, 20, 60, -1])
def test_truncated(cut):
    data = encode({"a": np.arange(1000.0)}, {})
    with pytest.raises(ValueError, match="trace"):
        decode(data[:cut])
    with pytest.raises(ValueError, match="trace"):
        decode(data + b"x")


def test_size_and_time_of_an_hour_at_one_second():
    rng = np.random.default_rng(0)
    t = np.arange(3600.0)
    current = 6 * np.exp(-t / 1800)
    soc = 0.05 + np.cumsum(current) / 7200
    voltage = 3.3 + 0.8 * soc + 0.03 * current
    noisy = [t, current, soc, 298 + rng.normal(0, 0.05, 3600), *(voltage + rng.normal(0, 1e-3, (2, 3600)))]
    array = np.column_stack(noisy)
    start = time.process_time()
    data = encode({"trace": array}, {})
    assert time.process_time() - start < 0.1  # 4 ms here; a slow machine may take longer
    assert len(data) < 100_000
    assert len(encode({"trace": np.round(array, 4)}, {})) < 50_000
