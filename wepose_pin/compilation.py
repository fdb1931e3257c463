"""Functions compiled by numba: bit-identical wherever they are called from, and kept for the next start."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.event import Event, Listener, register
from numba.core.options import DefaultOptions

# No fastmath: the same bits from a batch, from a sample at a time and from a bank of sensors need strict IEEE steps.
# The numpy error model spares each division a branch; nogil lets several sensors run in threads.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# What allocates nothing needs no reference counts; numba leaves some in, atomic ones, several a sample. Its option has
# no public name: where it is gone, kernels are slower and as right.
_BARE = _OPTIONS | ({"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {})


class _SayOnce(Listener):  # type: ignore[misc]
    """One line on a terminal when the first of our functions is compiled, since that takes seconds; never again."""

    said = False

    def on_start(self, event: Event) -> None:
        if self.said or not event.data["dispatcher"].py_func.__module__.startswith("wepose_pin."):
            return
        self.said = True
        if sys.stderr.isatty():
            print("compiling for this machine: some ten seconds, kept for the next time …", file=sys.stderr, flush=True)

    def on_end(self, event: Event) -> None:
        pass


register("numba:compile", _SayOnce())


def _cached(function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    try:
        dispatcher = njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor a home can be written to
        return njit(**options)(function)
    cache = getattr(dispatcher, "_cache", None)
    if cache is not None:  # a full disk is no reason to fail: it compiles again the next time
        cache.save_overload = _unless_full(cache.save_overload)
    return dispatcher


def _unless_full(save: Callable[..., None]) -> Callable[..., None]:
    def try_to_save(*args: Any) -> None:
        with contextlib.suppress(OSError):
            save(*args)

    return try_to_save


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled by numba, and kept for the next start where there is a place to keep it."""
    return _cached(function, _OPTIONS)


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """`compiled` for a function that makes no array, only fills those it is given: no reference counting in it."""
    return _cached(function, _BARE | {"forceinline": True})


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """A piece of kernels and of nothing else, always a part of its caller's code; it makes no array."""
    return njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **_BARE)(function)
