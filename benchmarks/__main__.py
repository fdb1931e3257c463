"""`python -m benchmarks`: speed and accuracy on this machine, as tables."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `wepose` has it; a busy machine loses a multiple. Before numpy.

import argparse
import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from wepose_pin.errors import BadOption, ExistingOutput, WeposeError

from .tables import Section, document, print_table, read_document

KINDS = (
    "filters",
    "calibration",
    "live",
    "batch",
    "long",
    "headings",
    "harm",
    "protocols",
    "robots",
    "bodies",
    "diagnostics",
    "kinematics",
    "validation",
)
DEFAULT = ("filters", "calibration")


def parse(argv: list[str] | None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Times belong to the machine and the moment; what counts are the ratios to VQF, timed in turn in "
        "the same run.",
        epilog="example: python -m benchmarks filters --quick --save before.json",
    )
    add = parser.add_argument
    add(
        "kinds",
        nargs="*",
        metavar="KIND",
        help="filters: speed and accuracy beside VQF and imufusion, two minutes; calibration: nlpsol beside "
        "others; live: five sensors at 1 kHz for five minutes, and again with the page; batch: a study of 50 "
        "sessions on one process and on two; "
        "long: recordings of up to 24 hours in chunks; headings: relative headings of simulated people with and "
        "without their correction, half an hour; with --live an hour of one person who clasps the hands every ten "
        "minutes; harm: headings with and without their correction, of people who walk, run, throw and more, with "
        "good and poor sensors, hours, --quick ten minutes; protocols: what each "
        "calibration protocol is worth on simulated people, an hour for eight; robots: "
        "the upper-body recording of --data on every robot, offline and live, half an hour; bodies: chains, other "
        "bodies and legs by the commands, on the recordings of --data and simulated, three minutes; diagnostics: "
        "the share of 50 ordinary recordings in which each appears, ten minutes; kinematics: beside "
        "a bare loop of Pinocchio; validation: the paper's experiments and real recordings, hours, into its page. "
        f"Without any: {' and '.join(DEFAULT)}",
    )
    add("--quick", action="store_true", help="less of each: shorter data, fewer rounds, 8 sessions, up to one hour")
    add("--live", action="store_true", help="with headings: live, over a long time, with and without correction")
    add("--minutes", type=float, metavar="MIN", help="with headings --live: minutes of motion; without it 60")
    add("--sessions", type=int, metavar="N", help="number of sessions of batch")
    add("--robot", action="append", default=[], metavar="NAME", help="with robots: only this one; may be repeated")
    add("--persons", type=int, default=8, metavar="N", help="number of simulated people of protocols")
    add("--results", type=Path, metavar="FILE", help="where protocols and validation keep what they have measured")
    add("--page", type=Path, metavar="FILE", help="write the page of protocols or validation there, in Markdown")
    add("--only", metavar="NAME", help="with validation: only the experiments whose names begin so")
    add(
        "--data",
        type=Path,
        help="real recordings (broad/, wepose_hr/) for filters and validation, upper_body/ "
        "for robots, ring/, ur5/ and mvnx/ for bodies; or WEPOSE_DATA",
    )
    add("--save", type=Path, metavar="FILE", help="write the figures there with versions, machine and date, as JSON")
    add("--compare", type=Path, metavar="FILE", help="show each ratio of a file that --save wrote by that of this run")
    options = parser.parse_args(argv)
    options.kinds = options.kinds or list(DEFAULT)
    for kind in options.kinds:
        if kind not in KINDS:
            parser.error(f"'{kind}' is not measured; choose from {', '.join(KINDS)}")
    return options


def chosen_sections(options: argparse.Namespace) -> dict[str, Section]:
    """Name → a function that measures it."""
    if options.sessions is not None and ("batch" not in options.kinds or options.sessions < 2):
        raise BadOption(f"--sessions {options.sessions}: a number of sessions of batch, at least 2")
    if (options.live or options.minutes is not None) and "headings" not in options.kinds:
        raise BadOption("--live, --minutes: go with headings, which is not asked for")
    if options.minutes is not None and not (options.live and 5.0 <= options.minutes <= 600.0):
        raise BadOption(f"--minutes {options.minutes:g}: goes with --live, from 5 to 600")
    chosen: dict[str, Section] = {}
    for kind in options.kinds:
        module = "live_headings" if kind == "headings" and options.live else {"long": "long_recordings"}.get(kind, kind)
        sections = import_module(f".{module}", __package__).sections
        chosen |= sections(*_choose_arguments(module, options))
    return chosen


def _choose_arguments(module: str, options: argparse.Namespace) -> tuple[Any, ...]:
    """The arguments of a module's `sections`."""
    named, quick = options.data or os.environ.get("WEPOSE_DATA"), options.quick
    data = Path(named) if named else None
    if module == "filters":
        from .filters import FULL, QUICK

        return (QUICK if quick else FULL, data)
    if module == "live_headings":
        from .live_headings import MINUTES

        return (options.minutes or (10.0 if quick else MINUTES),)
    return {
        "batch": (quick, options.sessions),
        "protocols": (options.persons, options.results, options.page),
        "robots": (quick, data, options.robot),
        "bodies": (quick, data),
        "validation": (quick, data, options.only, options.results, options.page),
    }.get(module, (quick,))


def main(argv: list[str] | None = None) -> int:
    """The exit code: 0, or 2 after one line on what was wrong."""
    options = parse(argv)
    try:
        before = None if options.compare is None else read_document(options.compare)
        if options.save is not None and (options.save.exists() or not options.save.absolute().parent.is_dir()):
            raise ExistingOutput(f"--save {options.save}: exists, or has no folder; name a new file in one")
        tables = {}
        for name, measure in chosen_sections(options).items():
            tables[name] = measure()
            print_table(name, tables[name], before)
    except WeposeError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    if before is not None:
        print(f"before: {options.compare}, {before.get('date', 'undated')}; over 1: it was slower beside VQF then")
    if options.save is not None:
        text = json.dumps(document(tables, options.quick), indent=1, allow_nan=False) + "\n"
        options.save.write_text(text, encoding="utf-8")
        print(f"Figures: {options.save}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
