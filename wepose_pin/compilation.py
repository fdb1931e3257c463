"""Functions compiled by numba, with bit-identical results for all callers, and cached for the next start."""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit, types
from numba.core.event import Event, Listener, register
from numba.core.options import DefaultOptions
from numba.extending import intrinsic

# No fastmath: the same bits from a batch, from a sample at a time and from a bank of sensors need strict IEEE steps.
# What it would merge, a kernel merges itself where it counts (`fma`).
# The numpy error model spares each division a branch; nogil lets page and robot go on in their threads.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# A function that allocates nothing needs no reference counts, but numba leaves some atomic ones in, several a sample.
# Its option has no public name: without it kernels are slower, with the same results.
_BARE = _OPTIONS | ({"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {})


class _CompilationNotice(Listener):  # type: ignore[misc]
    """Prints a line on a terminal when the first of our functions is compiled."""

    printed = False

    def on_start(self, event: Event) -> None:
        if self.printed or not event.data["dispatcher"].py_func.__module__.startswith("wepose_pin."):
            return
        self.printed = True
        if sys.stderr.isatty():
            print("compiling the filters for this machine, once: 10 to 30 seconds …", file=sys.stderr, flush=True)

    def on_end(self, event: Event) -> None:
        pass


register("numba:compile", _CompilationNotice())


def _compile_cached(options: dict[str, Any], function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function by numba and cache it for the next start, where a folder is writable."""
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor a home is writable
        return njit(**options)(function)


compiled = partial(_compile_cached, _OPTIONS)
# For a function that allocates no array: without reference counts.
kernel = partial(_compile_cached, _BARE | {"forceinline": True})
# For a part of kernels, which is always inlined in its caller and allocates no array.
inlined: Callable[[Callable[..., Any]], Any] = njit(
    forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **_BARE
)


@intrinsic
def fma(typingcontext, a, b, c):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """``a * b + c`` of three floats in a compiled function, rounded once: one instruction, the same bits everywhere."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]  # noqa: ARG001
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate
