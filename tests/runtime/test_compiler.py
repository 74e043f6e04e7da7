"""Flags of the C compiler: the user's, in the place of the default ones, and part of what a library is found by."""

import ctypes

import pytest

from chargetune.runtime.compiler import compile_library, compiler_flags

SOURCE = "int answer(void) { return ANSWER; }\n"


@pytest.mark.compiled_code
def test_other_flags_are_another_library(monkeypatch, tmp_path):
    monkeypatch.setenv("CHARGETUNE_CACHE", str(tmp_path))
    built = []
    for answer in (3, 4, 3):
        monkeypatch.setenv("CHARGETUNE_CFLAGS", f"-O1  -DANSWER={answer}")
        built.append(compile_library("answer", (SOURCE,)))
        assert ctypes.CDLL(str(built[-1])).answer() == answer
    assert built[0] == built[2] != built[1]
    assert sorted(tmp_path.glob("*.so")) == sorted(set(built))


def test_what_is_needed_always_stays(monkeypatch):
    monkeypatch.delenv("CHARGETUNE_CFLAGS", raising=False)
    usual = compiler_flags()
    monkeypatch.setenv("CHARGETUNE_CFLAGS", "-Os")
    assert usual[:2] == ("-O3", "-march=native")
    assert compiler_flags() == ("-Os", *usual[2:])
