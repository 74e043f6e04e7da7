"""Machine code for generated C, cached by content in the user's cache folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import casadi as ca
from platformdirs import user_cache_path

__all__ = ["cache_folder", "compile_library", "compiler_flags", "find_compiler"]

# -O3 makes an episode 15 % quicker than -O2.
_SPEED = "-O3 -march=native"
# No -ffast-math: the checks for NaN and infinity must survive. Loops are not vectorised: GCC 12 with AVX-512 then wrote a
# local array as if it were aligned, and the process died.
_ALWAYS = (
    *("-fno-trapping-math", "-fno-signed-zeros", "-fno-math-errno", "-fno-tree-loop-vectorize"),
    *("-fPIC", "-shared", "-fno-semantic-interposition", "-Wl,-Bsymbolic"),
)


def find_compiler() -> str | None:
    """The C compiler: environment variable CHARGETUNE_CC ("none" for no compiler), else CC, cc, gcc or clang on the PATH."""
    asked = os.environ.get("CHARGETUNE_CC")
    if asked is not None:
        return None if asked.lower() in ("", "none") else shutil.which(asked)
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        found = shutil.which(name) if name else None
        if found:
            return found
    return None


def compiler_flags() -> tuple[str, ...]:
    """Words of the environment variable CHARGETUNE_CFLAGS, else "-O3 -march=native"; then the flags that are always needed."""
    return (*os.environ.get("CHARGETUNE_CFLAGS", _SPEED).split(), *_ALWAYS)


def cache_folder() -> Path:
    """Where compiled episodes are kept: CHARGETUNE_CACHE, else the user's cache folder of this system."""
    asked = os.environ.get("CHARGETUNE_CACHE")
    return Path(asked) if asked else user_cache_path("chargetune")


@lru_cache(maxsize=1)
def _processor() -> str:
    # -march=native code must not be taken up by another processor that shares the cache folder.
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), "") + platform.machine()
    return platform.machine() + platform.processor()


def compile_library(name: str, sources: tuple[str, ...], defines: tuple[str, ...] = ()) -> Path:
    """Compile C sources, together with DAQP from CasADi's own folder, to a shared library; answer its path.

    The file's name holds a hash of sources, flags, CasADi version and processor, so it is compiled once a content.
    Raises RuntimeError with the compiler's message when it fails.
    """
    compiler = find_compiler()
    if compiler is None:
        raise RuntimeError("no C compiler found; set CHARGETUNE_CC or use the virtual machine (compiled=False)")
    base = Path(ca.__file__).parent
    options = [*compiler_flags(), *(f"-D{d}" for d in defines), f"-I{base / 'include'}", f"-L{base}", f"-Wl,-rpath,{base}"]
    content = "\0".join([*sources, *options, compiler, ca.CasadiMeta.version(), _processor()])
    target = cache_folder() / f"{name}-{hashlib.sha256(content.encode()).hexdigest()[:24]}.so"
    if target.exists():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        files = [Path(folder) / f"source{i}.c" for i in range(len(sources))]
        for file, source in zip(files, sources, strict=True):
            file.write_text(source)
        built = Path(folder) / "built.so"
        command = [compiler, *options, *map(str, files), "-o", str(built), "-ldaqp", "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"the C compiler failed: {shlex.join(command)}\n{done.stderr.strip()}")
        # Two processes may build the same content: the last rename wins and both are right.
        built.replace(target)
    return target
