"""`python -m benchmarks`: speed and accuracy on this machine, as tables."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `wepose` has it; a busy machine loses a multiple. Before numpy.

import argparse
import sys
from importlib import import_module
from pathlib import Path

from wepose_pin.errors import WeposeError

from .tables import print_table

KINDS = {
    "filters": "the filters beside VQF, two minutes",
    "live": "five sensors at 1 kHz for five minutes, and again with the page and a robot",
    "long": "recordings of up to 24 hours in chunks",
    "headings": "relative headings of simulated people with and without their correction, half an hour; with --live an "
    "hour of one person who clasps the hands every ten minutes",
    "harm": "headings with and without their correction, of people who walk, run, throw and more, with good and poor "
    "sensors, hours, --quick ten minutes",
    "robots": "the upper-body recording of --data on every robot, offline and live, half an hour",
    "bodies": "chains and other bodies by the commands, on the recordings of --data, two minutes",
    "diagnostics": "the share of 50 ordinary recordings in which each appears, ten minutes",
    "validation": "the paper's experiments and real recordings, hours, into its page",
}


def parse(argv: list[str] | None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Times belong to the machine and the moment; what counts are the ratios to VQF, timed in turn in "
        "the same run. " + "; ".join(f"{kind}: {text}" for kind, text in KINDS.items()),
        epilog="example: python -m benchmarks filters --quick",
    )
    add = parser.add_argument
    add("kinds", nargs="*", metavar="KIND", help=f"one or more of {', '.join(KINDS)}; without any: filters")
    add("--quick", action="store_true", help="less of each: shorter data, fewer rounds and people")
    add("--live", action="store_true", help="with headings: live, over an hour (--quick: ten minutes)")
    add("--robot", action="append", default=[], metavar="NAME", help="with robots: only this one; may be repeated")
    add("--only", metavar="NAME", help="with validation: only the experiments whose names begin so")
    add(
        "--data",
        type=Path,
        default=os.environ.get("WEPOSE_DATA"),
        help="real recordings (broad/, wepose_hr/, ring/, ur5/, upper_body/, mvnx/); or WEPOSE_DATA",
    )
    options = parser.parse_args(argv)
    options.kinds = options.kinds or ["filters"]
    options.data = options.data and Path(options.data)
    for kind in options.kinds:
        if kind not in KINDS:
            parser.error(f"'{kind}' is not measured; choose from {', '.join(KINDS)}")
    return options


def main(argv: list[str] | None = None) -> int:
    """The exit code: 0, or 2 after one line on what was wrong."""
    options = parse(argv)
    arguments = {
        "filters": (options.data,),
        "headings": (options.live,),
        "robots": (options.data, options.robot),
        "bodies": (options.data,),
        "validation": (options.data, options.only),
    }
    try:
        for kind in options.kinds:
            module = import_module(f".{'long_recordings' if kind == 'long' else kind}", __package__)
            for measure in module.sections(options.quick, *arguments.get(kind, ())):
                print_table(measure())
    except WeposeError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
