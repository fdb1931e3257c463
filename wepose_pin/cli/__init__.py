"""The command line: ``wepose COMMAND``, one thin file a command."""

from __future__ import annotations

import io
import logging
import os
import sys
import textwrap
from importlib import import_module

from ..errors import BadOption, WeposeError, one_of
from .output import WIDTH
from .parser import Command, parse
from .stopping import catch_signals, ignore_signals, is_stopped, whats_written

# In the order of `wepose --help`; each is a module here.
COMMANDS = (
    *("demo", "info", "simulate", "calibrate", "track", "view", "evaluate", "angles", "export", "retarget"),
    *("live", "batch"),
)

REMOVED = {
    "reproduce": "run the command that `provenance` in the result's summary.json names again, with the same versions",
    "validate": "in a clone of the project, run make validation DATA=DIR",
}


def find_command(name: str) -> Command:
    """The command of a name in `COMMANDS`."""
    command: Command = import_module(f".{name}", __name__).COMMAND
    return command


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
        code = _run(argv)
    except BrokenPipeError:
        # Whoever read our output has seen enough; Python would complain once more on its way out.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except (KeyboardInterrupt, Exception) as error:
        # A library may turn the interrupt into an error of its own.
        if is_stopped() or isinstance(error, KeyboardInterrupt):
            code, line = 130, f"stopped; {whats_written()}"
        elif isinstance(error, WeposeError):
            code, line = 2, str(error)
        elif isinstance(error, OSError):
            code, line = 2, f"{error.filename or 'output'}: {error.strerror or error}; {whats_written()}"
        else:
            raise
        print(f"wepose: {line}", file=sys.stderr)
    finally:
        if is_process:
            ignore_signals()
    sys.exit(code)


def _run(argv: list[str]) -> int:
    first = argv[0] if argv else "--help"
    if first in ("--help", "-h"):
        print(_help())
        return 0
    if first in ("--version", "-V"):
        from .. import __version__

        print(f"wepose-pin {__version__}")
        return 0
    if first in REMOVED:
        raise BadOption(f"'{first}' is no command any more: {REMOVED[first]}")
    if first not in COMMANDS:
        raise BadOption(f"'{first}' is not a command; {one_of(COMMANDS, first)}")
    command = find_command(first)
    return command.run(parse(first, command, argv[1:]))


def _help() -> str:
    """The list of commands."""
    commands = [
        textwrap.fill(find_command(name).summary(), WIDTH, initial_indent=f"  {name:<12}", subsequent_indent=" " * 14)
        for name in COMMANDS
    ]
    return _HELP.format(commands="\n".join(commands))


_HELP = """usage: wepose COMMAND [options]

Upper-body pose from wearable IMUs without magnetometers. `wepose demo` shows all of it.

commands:
{commands}

wepose COMMAND --help says what a command does, with all its options and an example.
wepose --version prints the version. Exit code: 0 success, 2 invalid options or input. Terms: docs/glossary.md."""
