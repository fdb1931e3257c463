"""The commands: each is one function, whose signature is its options and whose docstring is its help.

A command does the whole job, prints what came of it, and returns it; the exit code is 0, or the `exit_code` of what it
returns. `main` runs the one that the command line names; `wepose_pin.batch` runs some of them for many recordings.
`results` is the Python API's `track`, whose result prints, draws, shows and saves itself.

Heavy rooms load inside the functions, so that help and mistakes in options are answered at once.
"""

from __future__ import annotations

import io
import logging
import os
import signal
import sys

from ..errors import WeposeError
from .stopping import catch_signals, describe_written, is_stopped


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``wepose``; ends by `SystemExit`: a command's exit code, or 2 after one line on what is wrong."""
    is_process = argv is None
    if argv is None:
        argv = sys.argv[1:]
        # Before numpy loads: BLAS's last bits depend on its number of threads.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # It warns of a home where it cannot keep its list of fonts, which changes nothing but its time.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        catch_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that knows no ± still shows the rest
    try:
        from .command_line import parse

        command, bound = parse(argv)
        code = getattr(command(*bound.args, **bound.kwargs), "exit_code", 0)
    except BrokenPipeError:
        # Whoever read our output has seen enough; Python would complain once more on its way out.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except (KeyboardInterrupt, Exception) as error:
        if is_process:
            catch_signals(signal.SIG_IGN)  # a second one would end in a traceback
        if is_stopped() or isinstance(error, KeyboardInterrupt):
            code, line = 130, f"stopped; {describe_written()}"
        elif isinstance(error, WeposeError):
            code, line = 2, str(error)
        elif isinstance(error, OSError):
            code, line = 2, f"{error.filename or 'output'}: {error.strerror or error}; {describe_written()}"
        else:
            raise
        print(f"wepose: {line}", file=sys.stderr)
    finally:
        if is_process:
            catch_signals(signal.SIG_IGN)
    sys.exit(code)
