"""The diagnostics that ordinary recordings show: of random recordings of `tests/`, and of simulated people."""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wepose_pin.calibration import calibrate
from wepose_pin.diagnostics import INFO, Diagnostic, render_all
from wepose_pin.errors import BadOption, WeposeError
from wepose_pin.readers import load_session
from wepose_pin.recording import Recording
from wepose_pin.simulation import ACTIVITIES, PEOPLE_PRESET, simulate, simulate_activity, simulate_person
from wepose_pin.tracking import track

from .tables import Column, Section, Table

RECORDINGS, FEW_RECORDINGS = 50, 6
CLASP_S, ACTIVITY_S, CIRCLES = 60.0, 60.0, 4
NAMES = ("walk", "tasks", "sit")
GOOD_START_S = 2.0  # of the start pose, at least


class Shown(NamedTuple):
    """The diagnostics of a command on one recording."""

    command: str
    diagnostics: tuple[Diagnostic, ...]
    good: bool  # recorded as the guide says, with a calibration that passes where there is one


def sections(quick: bool) -> list[Section]:
    """List the functions that measure."""
    return [partial(measure_diagnostics, FEW_RECORDINGS if quick else RECORDINGS)]


def measure_diagnostics(recordings: int) -> Table:
    """Measure the share of recordings in which each diagnostic appears."""
    half = recordings // 2
    shown = [*_show_random(recordings - half), *_show_people(half)]
    table = Table(
        f"Diagnostics of {recordings} ordinary recordings, by command",
        (Column("ordinary", "in ordinary recordings [%]", 0), Column("good", "in good ones [%]", 0)),
        notes=[
            "Random recordings of tests/random_recordings without faults, and people of the preset `people` who "
            "calibrate with joined hands or walk, sit and work. A good recording begins with a start pose of "
            f"{GOOD_START_S:g} s or longer, has all five sensors, and its calibration passes."
        ],
    )
    for command in ("calibrate", "track"):
        results = [each for each in shown if each.command == command]
        good = [each for each in results if each.good]
        counts, counts_good = _count(results), _count(good)
        for code in sorted(counts, key=lambda code: -counts[code]):
            table.rows[f"{command}: {code}"] = {
                "ordinary": 100.0 * counts[code] / len(results),
                "good": 100.0 * counts_good[code] / max(len(good), 1),
            }
        sizes = [len(render_all(each.diagnostics)) for each in good]
        warnings = [sum(severity != INFO for severity, _ in render_all(each.diagnostics)) for each in good]
        table.notes.append(
            f"{command}: {len(results)} recordings, {len(good)} of them good, which show {np.median(sizes):g} "
            f"diagnostics (median; at most {max(sizes, default=0)}), {np.median(warnings):g} of them warnings."
        )
    return table


def _count(results: Iterable[Shown]) -> Counter[str]:
    return Counter(code for each in results for code in {diagnostic.code for diagnostic in each.diagnostics})


def _show_random(recordings: int) -> Iterator[Shown]:
    """Diagnostics of random recordings, which are read from files as a user has them."""
    tests = str(Path(__file__).parents[1] / "tests")
    sys.path[:0] = [] if tests in sys.path else [tests]
    from random_recordings import adapter
    from random_recordings.cases import draw_case
    from random_recordings.people import CORE
    from random_recordings.recordings import record

    for seed in range(recordings):
        case = draw_case(seed, ordinary=True)
        with tempfile.TemporaryDirectory() as folder:
            recording = load_session(adapter.write_session(Path(folder), record(case), case.layout, case.clock.unit))
        begin, end = case.stood
        is_good = not case.begins_in_motion and end - begin >= GOOD_START_S and set(case.worn) >= set(CORE)
        yield from _show(recording, is_good, (case.measured, case.person.sex) if case.clasp else None)


def _show_people(recordings: int) -> Iterator[Shown]:
    """Diagnostics of simulated people: every second one calibrates, the others walk, work or sit with stated mounts."""
    for seed in range(1, recordings + 1):
        calibrates = bool(seed % 2)
        person = simulate_person(seed)
        sizes = replace(PEOPLE_PRESET, mount="any") if calibrates else PEOPLE_PRESET
        try:
            if calibrates:
                simulation = simulate(person.lengths, seed=seed, imperfections=sizes, clasp_s=CLASP_S, circles=CIRCLES)
            else:
                activity = NAMES[seed // 2 % len(NAMES)]
                simulation = simulate_activity(activity, seed=seed, imperfections=sizes, seconds=ACTIVITY_S)
        except BadOption:  # arms that do not reach through the motion that was drawn
            continue
        size = {**person.measured, "stature": person.stature}, person.sex
        recording = replace(simulation.recording(), model="" if calibrates else ACTIVITIES[activity].body)
        yield from _show(recording, True, size if calibrates else None)


def _show(recording: Recording, is_good: bool, size: tuple[Mapping[str, float], Any] | None) -> Iterator[Shown]:
    """Calibrate where the person's measured lengths [m], with the stature if it is known, and sex are given; track."""
    calibration = None
    try:
        if size is not None:
            measured, sex = dict(size[0]), size[1]
            stature = measured.pop("stature", None)
            calibration = calibrate(recording, measured=measured, stature=stature, sex=sex if stature else None)
            is_good = is_good and calibration.quality.quality == "pass"
            yield Shown("calibrate", calibration.diagnostics, is_good)
        yield Shown("track", track(recording, calibration, accept_failed=True).diagnostics, is_good)
    except WeposeError as error:  # such as: no mount is stated, and the motion calibrates none
        print(f"left out: {error}", file=sys.stderr)
