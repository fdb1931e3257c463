"""The commands: each is one function, whose signature is its options and whose docstring is its help.

A command does the whole job, prints what came of it, and returns it; the exit code is 0, or the `exit_code` of what it
returns. `main` runs the one that the command line names; `wepose_pin.batch` runs some of them for many recordings.
Heavy rooms load inside the functions, so that help and mistakes in options are answered at once.

Ctrl-C and SIGTERM end a command; its output is whole, or there is none.
"""

import contextlib
import gc
import io
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

from ..errors import WeposeError

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_stopped: list[int] = []


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``wepose``; ends by `SystemExit`: a command's exit code, or 2 after one line on what is wrong."""
    is_process = argv is None
    if argv is None:
        argv = sys.argv[1:]
        # Before numpy loads: BLAS's last bits depend on its number of threads.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # It warns of a home where it cannot keep its list of fonts, which changes nothing but its time.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        # Most of what a command makes is code that it loads, which stays: Python would search it for garbage too often.
        gc.set_threshold(20_000, 100)
        _catch_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that knows no ± still shows the rest
    try:
        from .options import parse

        command, bound = parse(argv)
        code = getattr(command(*bound.args, **bound.kwargs), "exit_code", 0)
    except BrokenPipeError:
        # Whoever read our output has seen enough; Python would complain once more on its way out.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except (KeyboardInterrupt, Exception) as error:
        if is_process:
            _catch_signals(signal.SIG_IGN)  # a second one would end in a traceback
        if _stopped or isinstance(error, KeyboardInterrupt):
            code, line = 130, "stopped"
        elif isinstance(error, WeposeError):
            code, line = 2, re.sub(r"`(\w+)(=True)?`", lambda name: f"--{name[1].replace('_', '-')}", str(error))
        elif isinstance(error, OSError):
            code, line = 2, f"{error.filename or 'output'}: {error.strerror or error}"
        else:
            raise
        print(f"wepose: {line}", file=sys.stderr)
    finally:
        if is_process:
            _catch_signals(signal.SIG_IGN)
            gc.freeze()  # else Python searches all of it once more on its way out
    sys.exit(code)


def _stop(number: int, _frame: Any) -> None:
    _stopped.append(number)
    raise KeyboardInterrupt


def _catch_signals(handler: Any = _stop) -> None:
    """From here on both raise `KeyboardInterrupt` and are remembered, or are treated as by another handler."""
    for number in _SIGNALS:
        signal.signal(number, handler)


def check_stopped() -> None:
    """Raise `KeyboardInterrupt` where a signal came and a library has swallowed what it raised."""
    if _stopped:
        raise KeyboardInterrupt


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Whether a signal asked to stop. It interrupts nothing, unless nobody has looked yet or it comes twice."""
    requests: list[int] = []
    looked = False

    def ask(number: int, frame: Any) -> None:
        if requests or not looked:
            _stop(number, frame)
        requests.append(number)

    def is_asked() -> bool:
        nonlocal looked
        looked = True
        return bool(requests or _stopped)

    before = {number: signal.signal(number, ask) for number in _SIGNALS}
    try:
        yield is_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
