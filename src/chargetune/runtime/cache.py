"""What takes long to build is built once and kept, by one thread at a time.

CasADi lets any number of threads evaluate a function, but promises nothing about threads that make expressions: its objects count their
references, and the count is safe only in a build with WITH_THREADSAFE_SYMBOLICS, which the wheels of PyPI have and others need not. Its
Python interface gives up the interpreter lock while it works, so that lock does not help. Source: casadi issues 1355, 2955, 3518.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

__all__ = ["Built", "built_once", "cached"]

P = ParamSpec("P")
T = TypeVar("T")

# One for all that is built: what two threads build may share symbols. It is entered again where building one thing needs another.
_building = threading.RLock()


def _unlock() -> None:
    global _building  # noqa: PLW0603 - a fork has none of its parent's threads, so the one that holds its copy would never let it go
    _building = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unlock)


class Built:
    """Keeps what was built under its key; of more than ``most`` the one that was not asked for the longest goes first.

    With ``casadi`` what is built makes CasADi expressions, and one thread at a time does. What is built by several threads must not wait
    for that lock, which they need themselves.
    """

    def __init__(self, most: int, *, casadi: bool = True) -> None:
        self._most, self._casadi = most, casadi
        self._kept: OrderedDict[Hashable, tuple[Any]] = OrderedDict()

    def get(self, key: Hashable, build: Callable[[], T]) -> T:
        """What ``build`` makes. Other threads that build wait; one that asks for what is kept does not."""
        found = self._kept.get(key)
        if found is None:
            with _building if self._casadi else contextlib.nullcontext():
                found = self._kept.get(key)
                if found is None:
                    found = self._kept[key] = (build(),)
                    while len(self._kept) > self._most:
                        self._kept.popitem(last=False)
        with contextlib.suppress(KeyError):
            # Another thread may have just let it go.
            self._kept.move_to_end(key)
        built: T = found[0]
        return built


def built_once(most: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """A decorator like functools.lru_cache(most) for functions of positional arguments, with the lock of `Built`."""

    def decorate(build: Callable[P, T]) -> Callable[P, T]:
        built = Built(most)

        @wraps(build)
        def get(*arguments: P.args, **named: P.kwargs) -> T:
            return built.get((arguments, tuple(named.items())), partial(build, *arguments, **named))

        return get

    return decorate


_BUILT = Built(32)


def cached(key: str, build: Callable[[], T]) -> T:
    """What ``build`` makes, kept under ``key``; see `Built`."""
    return _BUILT.get(key, build)
