"""A session for data that have none: what files say, what names and motion suggest, and what the user has to check."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ..body import BodyTable
from ..data_tables import read_columns, read_names, read_table
from ..diagnostics import ERROR, WARNING, Diagnostic
from ..documents import parse_toml, toml_key, toml_string, toml_strings
from ..errors import BadData, MissingRate, WeposeError, WrongUnit, one_of
from ..recording import AXES, CONFIGURATION, ImuSensor, Intervals, Recording
from ..recording.clocks import TIME_UNITS, guess_time_unit
from ..recording.gaps import find_runs
from ..recording.limits import LONGEST_STEP_S, STANDARD_GRAVITY
from ..recording.sensors import compute_rate
from .arrays import ArrayFile
from .device import GYRO_UNITS, Device, read_first_lines
from .guess import Guess
from .live_log import read_live_log
from .registry import detect_format, look_up_format, read_device
from .session import read_session

# A line of a file that says its rate.
_STATED_RATE = re.compile(r"(sampl\w*|frame|data)[ _]*(frequency|rate)[^0-9]{0,12}(?P<rate>\d+(\.\d+)?)", re.IGNORECASE)
ASSUMED_RATE_HZ = 100.0
# A sensor is static where its rate [rad/s] and specific force [m/s²] vary by less over `BLOCK_S`; the sway of a
# standing person is below.
BLOCK_S, STATIC_GYRO, STATIC_ACCEL = 0.25, np.deg2rad(3.0), 0.4
SHORTEST_STATIC_S = 1.0
SHORTEST_EXAMPLE_S = 2.0  # a shorter recording has no room for a phase
JOINED_S = 0.5  # static intervals nearer than this are one: a person twitches
MOST_SIBLINGS = 20
# Gravity turns in a sensor as its rates say, to a factor of 7: other accelerations disturb it. Radians and degrees are
# 57 apart. Where the two correlate by less, or in fewer places, the motion does not show the unit.
TURN_FACTOR, TURN_CORRELATION, FEWEST_TURNS = 7.0, 0.4, 10
_YEAR_2000, _YEAR_2100 = 946_684_800.0, 4_102_444_800.0  # [s] since 1970


class Wearer(NamedTuple):
    """The body that bears the sensors."""

    table: BodyTable
    model: Path | None = None  # its file, or its name in the package; None: the upper body's


@dataclass
class Proposal:
    """The contents of a proposed session.

    Parameters
    ----------
    title : kind of file
    data : keys of [data]
    sensors : segment, or "?" and a name of the file → keys of its [sensors.…]
    checks : (table, key) → what the user has to check there
    labels : segment → its name in the file
    facts : other facts from the file, one line each
    phases : that the file states, and why
    """

    title: str
    data: dict[str, Any] = field(default_factory=dict)
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)
    checks: dict[tuple[str, str], str] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    facts: list[str] = field(default_factory=list)
    diagnostics: list[Diagnostic] = field(default_factory=list)
    phases: dict[str, tuple[Intervals, str]] = field(default_factory=dict)

    def warn_of_unknown(self, place: str, sensors: Sequence[str]) -> None:
        """Say which sensors are on segments that are not known."""
        if sensors:
            facts: dict[str, float | str] = {"variant": "unnamed", "devices": ", ".join(sensors)}
            self.diagnostics.append(Diagnostic("sensors-left-out", WARNING, place, len(sensors), facts=facts))

    def read(self, session: Path, name: str) -> Recording | None:
        """Read the recording as a session file would, and settle units; None: the data `name` cannot be read.

        All sensors are read, also those on unknown segments.
        """
        recording: Recording | None = None
        for _ in range(3):
            values = {"start_pose": CONFIGURATION, "data": self.data, "sensors": self.sensors}
            try:
                recording = read_session(session, True, values)
                if ("data", "gyro_unit") not in self.checks or (unit := guess_gyro_unit(recording)) is None:
                    break
                key = "gyro_unit"
            except WrongUnit as error:  # the reader's check of units is better than a guess from names
                key, unit = error.key, error.unit
            except WeposeError as error:
                facts = {"reason": str(error)}
                self.diagnostics.append(Diagnostic("session-unreadable", ERROR, name, facts=facts))
                break
            self.data[key] = unit
            self.checks.pop(("data", key), None)
        return recording


# From files of a known format ----------------------------------------------------------------------------------------


def propose_from_device(path: Path, folder: Path, name: str, table: BodyTable) -> Proposal:
    """Propose a session for a file of a known format, with the files beside it where each sensor has one."""
    format = look_up_format(name)
    device, segments, lacks_rate = _read(path, name, table)
    signals = "gyroscope and accelerometer" if device.kind == "raw" else "orientations, no raw data"
    proposal = Proposal(f"{format.title}, {signals}")
    if name == "wepose_live":
        proposal.data["file"] = relative(path, folder)
        proposal.sensors = {label: {} for label in device.sensors}
        _describe_live(path, proposal)
        return proposal
    if len(segments) > 1 or format.whole:
        proposal.data["file"] = relative(path, folder)
        if lacks_rate:
            proposal.data["rate_hz"] = ASSUMED_RATE_HZ
            proposal.checks["data", "rate_hz"] = "the file does not say its rate"
        for label, segment in segments.items():
            where = segment if segment and segment not in proposal.sensors else f"?{label}"
            proposal.sensors[where] = {"label": label}
        proposal.labels = {segment: label for label, segment in segments.items() if segment}
        proposal.warn_of_unknown(path.name, [label for label, segment in segments.items() if segment is None])
        return proposal
    own = name.endswith(".toml")
    proposal.data["format"] = relative(Path(name), folder) if own else name
    without_rate = []
    for file in _list_siblings(path, name):
        try:
            _, segments, lacks_rate = _read(file, name, table)
        except WeposeError as error:
            facts: dict[str, float | str] = {"variant": "unreadable", "reason": str(error)}
            proposal.diagnostics.append(Diagnostic("sensors-left-out", WARNING, file.name, facts=facts))
            continue
        (label, segment), *_ = segments.items()
        where = segment if segment and segment not in proposal.sensors else f"?{file.name}"
        proposal.sensors[where] = {"file": relative(file, folder)}
        proposal.labels[where] = label
        without_rate += [where] if lacks_rate else []
    if len(without_rate) == len(proposal.sensors):  # one line holds for all
        proposal.data["rate_hz"] = ASSUMED_RATE_HZ
        proposal.checks["data", "rate_hz"] = "the file does not say its rate"
        without_rate = []
    for where in without_rate:
        proposal.sensors[where]["rate_hz"] = ASSUMED_RATE_HZ
        proposal.checks[where, "rate_hz"] = "the file does not say its rate"
    unknown = [where.removeprefix("?") for where in proposal.sensors if where.startswith("?")]
    if len(proposal.sensors) - len(unknown) > 1:
        proposal.title += f", {len(proposal.sensors) - len(unknown)} files"
    proposal.warn_of_unknown(path.parent.name, unknown)
    return proposal


def _read(path: Path, format: str, table: BodyTable) -> tuple[Device, dict[str, str | None], bool]:
    """Read a device's file, with label → segment; and whether it does not state its rate."""
    try:
        device, lacks_rate = read_device(path, format), False
    except MissingRate:
        device, lacks_rate = read_device(path, format, None, ASSUMED_RATE_HZ), True
    names = (path.stem,) if len(device.sensors) == 1 else ()
    segments: dict[str, str | None] = {}
    for label, sensor in device.sensors.items():
        guesses = (table.guess_segment(text) for text in (label, *names))
        segments[label] = sensor.segment if sensor.segment in table.segments else next(filter(None, guesses), None)
    return device, segments, lacks_rate


def _list_siblings(path: Path, format: str) -> list[Path]:
    """List the file and those of the same format beside it: the files of one recording are in one folder."""
    if path.is_dir() or (look_up_format(format).folder and path.suffix.lower() == ".csv"):
        own = path if path.is_dir() else path.parent
        beside = [folder for folder in sorted(own.absolute().parent.iterdir()) if folder.is_dir()]
        same = [own if folder == own.absolute() else folder for folder in beside]
    else:
        same = [file for file in sorted(path.parent.iterdir()) if file.suffix == path.suffix and file.is_file()]
    siblings = [file for file in same[: 10 * MOST_SIBLINGS] if file == path or detect_format(file) == format]
    return siblings[:MOST_SIBLINGS] if path in siblings[:MOST_SIBLINGS] else [path]


def _describe_live(path: Path, proposal: Proposal) -> None:
    """Add the facts and the phases of a recording of `wepose live`."""
    log = read_live_log(path)
    recording, header = log.recording, log.header
    about: dict[str, Any] = {}
    with contextlib.suppress(ValueError):  # another program may have written the file
        about = parse_toml(header["subject"] or "")
    names = {segment: "stated" for segment, sensor in recording.sensors.items() if sensor.stated_quat_LS is not None}
    names |= {segment: "calibrated" for segment in recording.sensors if segment in about.get("mounts", ())}
    mounts = ", ".join(f"{segment} {origin}" for segment, origin in names.items())
    first, last = recording.phases["start"][0]
    proposal.facts = [
        f"of {header['name']}, live by {header['method']}: {len(log.quat_WL)} poses were shown",
        f"subject: {about.get('name') or 'without a name'}" if header["subject"] else "no subject",
        f"mounts: {mounts}" if mounts else "no mounts",
        f"start pose held [s]: {first:.2f} to {last:.2f}",
    ]
    if recording.resets:
        times = ", ".join(f"{recording.time[tick]:.1f}" for tick in recording.resets)
        proposal.facts.append(f"headings reset at [s]: {times}")
    for name, spans in recording.phases.items():
        proposal.phases[name] = spans, "as it was held live" if name == "start" else "as it was marked"
        if name != "start":
            listed = ", ".join(f"{begin:.2f} to {end:.2f}" for begin, end in spans)
            proposal.facts.append(f"phase {name} [s]: {listed}")
    proposal.facts += [f"marked at {mark.time:.2f} s: {mark.text}" for mark in recording.marks]
    if len(log.quat_WL):
        proposal.facts.append(f"track it as it was: wepose track {path} -o result")
    proposal.facts.append("to change its phases: --write")


# From names of columns or arrays -----------------------------------------------------------------------------------


def propose_from_names(
    path: Path, folder: Path, guess: Guess, names: list[str], arrays: ArrayFile | None, body: BodyTable
) -> Proposal:
    """Propose a session for a table or arrays by their names."""
    kinds = {".parquet": "Parquet table", ".mat": "MATLAB file"}
    kind = kinds.get(path.suffix.lower(), "HDF5 file" if arrays else "CSV table")
    proposal = Proposal(f"{kind}, {len(names)} {'arrays' if arrays else 'columns'}")
    if not guess.sensors:
        listed = one_of(names).removeprefix("there is: ")
        proposal.facts.append(f"no gyroscope and accelerometer, and no quaternions, by their names: {listed}")
        return proposal
    beside = _find_tables_beside(path, folder, guess, names, body) if arrays is None else {}
    if not beside:
        proposal.data["file"] = relative(path, folder)
    _propose_time(path, guess, arrays, proposal)
    if any("gyro" in signals for signals in guess.sensors.values()):
        proposal.data["gyro_unit"] = guess.units.get("gyro", "rad/s")
        if "gyro" not in guess.units:
            proposal.checks["data", "gyro_unit"] = "neither the file nor the motion says so"
        proposal.data["accel_unit"] = guess.units.get("accel", "m/s^2")
    for segment, signals in guess.sensors.items():
        keys = {signal: columns if len(columns) > 1 else columns[0] for signal, columns in signals.items()}
        proposal.sensors[segment] = keys
        if arrays and "orientation" in keys:
            w_first = toml_strings(f"{keys['orientation']}[{k}]" for k in (1, 2, 3, 0))
            proposal.checks[segment, "orientation"] = f"x, y, z, w? if w comes first: {w_first}"
    if beside:
        ((_, keys),) = proposal.sensors.items()
        proposal.sensors = {segment: {"file": file, **keys} for segment, file in beside.items()}
        proposal.title += f", {len(beside)} files" if len(beside) > 1 else ""
        return proposal
    columns_of = {name: next(iter(signals.values()))[0] for name, signals in guess.sensors.items()}
    unknown = [name.removeprefix("?") or f"{columns_of[name]}, …" for name in guess.sensors if name.startswith("?")]
    proposal.warn_of_unknown(path.name, unknown)
    return proposal


def _find_tables_beside(
    path: Path, folder: Path, guess: Guess, names: Sequence[str], body: BodyTable
) -> dict[str, str]:
    """Find segment → file, of a table with one sensor whose name is the file's, and those beside it with its columns.

    Empty where the table's own names say the segment, or its file's name does not.
    """
    (owner, *others) = guess.sensors
    own = body.guess_segment(path.stem)
    if others or own is None or not owner.startswith("?"):
        return {}
    same = [file for file in sorted(path.parent.iterdir()) if file.suffix == path.suffix and file.is_file()]
    files = {own: relative(path, folder)}
    for file in same[:MOST_SIBLINGS]:
        segment = body.guess_segment(file.stem)
        if segment is not None and segment not in files:
            with contextlib.suppress(WeposeError):
                if read_names(file)[0] == list(names):
                    files[segment] = relative(file, folder)
    return files


def _propose_time(path: Path, guess: Guess, arrays: ArrayFile | None, proposal: Proposal) -> None:
    """Propose `time` and its unit, or `rate_hz`; with facts about it."""

    def assume_rate(check: str, fact: str) -> None:
        proposal.data["rate_hz"] = ASSUMED_RATE_HZ
        proposal.checks["data", "rate_hz"] = check
        proposal.facts.append(fact)

    if not guess.times:
        stated = next(filter(None, map(_STATED_RATE.search, read_first_lines(path) if not arrays else ())), None)
        if not stated:
            return assume_rate("no column looks like time", "no column looks like time: state the rate")
        proposal.data["rate_hz"] = float(stated["rate"])
        proposal.facts.append(f"no column looks like time; the file says '{stated[0]}'")
        return None
    table = arrays.table({name: str(path) for name in guess.times}) if arrays else read_table(path)
    for name in guess.times:
        try:
            time = read_columns(table, [name], str(path), "time")[:, 0]
            break
        except BadData as error:  # dates, or another column of this name
            refused = error
    else:
        for name in guess.times:
            if rate_hz := _measure_rate_of_dates(table[name].cast(pl.String).str.strip_chars()):
                proposal.data["rate_hz"] = rate_hz
                proposal.facts.append(f"'{name}' holds dates; by the first and the last of them: {rate_hz:g} Hz")
                return None
        return assume_rate(f"'{name}' holds no numbers", f"state the rate: {refused}")
    steps = np.diff(time)
    step = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    named = guess.units.get(name)
    unit = named if named is not None and 0.0 < step * TIME_UNITS[named] < LONGEST_STEP_S else guess_time_unit(step)
    proposal.data["time"] = name
    if unit not in (None, "s"):
        reason = "its name says" if unit == named else f"it grows by {step:g} from row to row"
        rate_hz = 1.0 / (step * TIME_UNITS[unit])
        proposal.facts.append(f"'{name}' is in {unit}, as {reason}: {rate_hz:.4g} Hz")
        proposal.data["time_unit"] = unit
        if unit != named:
            proposal.checks["data", "time_unit"] = reason
    first = float(np.nanmin(time)) * TIME_UNITS[unit or "s"] if np.isfinite(time).any() else 0.0
    if _YEAR_2000 < first < _YEAR_2100:
        begin = f"{datetime.fromtimestamp(first, UTC):%F %T} UTC"
        proposal.facts.append(f"'{name}' counts from 1970: the recording begins at {begin}")
    return None


def _measure_rate_of_dates(column: pl.Series) -> float:
    """Measure the rate [Hz] by the first and the last date, or time of day, of a column; 0.0 where there are none."""
    for kind, form, tick_s in ((pl.Datetime("us"), None, 1e-6), (pl.Time, "%T%.f", 1e-9)):
        with contextlib.suppress(pl.exceptions.PolarsError):  # in no form that is known
            ticks = column.str.strptime(kind, form, strict=False).cast(pl.Int64).drop_nulls().to_numpy()
            if len(ticks) and (span := float(np.ptp(ticks)) * tick_s):
                return float(f"{(len(ticks) - 1) / span:.6g}")
    return 0.0


# What the motion shows -----------------------------------------------------------------------------------------------


def guess_gyro_unit(recording: Recording) -> str | None:
    """Guess the unit of rates that were read as rad/s from how gravity turns in the sensors; None: it does not show."""
    size = max(2, round(BLOCK_S * recording.rate_hz))
    blocks = len(recording) // size
    predicted, measured = [np.empty((0, 3))], [np.empty((0, 3))]
    for sensor in recording.imus.values():
        # A vector that is fixed in the world turns by -gyro x vector in the sensor.
        turns = -np.cross(sensor.gyro_S, sensor.accel_S)[: blocks * size] / recording.rate_hz
        turn = turns.reshape(blocks, size, 3).sum(axis=1)
        force = sensor.accel_S[: blocks * size].reshape(blocks, size, 3).mean(axis=1)
        upright = np.abs(np.linalg.norm(force, axis=1) - STANDARD_GRAVITY) < STATIC_ACCEL
        known = np.flatnonzero(upright[:-2] & upright[2:])
        predicted.append((0.5 * turn[:-2] + turn[1:-1] + 0.5 * turn[2:])[known])
        measured.append((force[2:] - force[:-2])[known])
    by_rates, by_gravity = np.concatenate(predicted), np.concatenate(measured)
    product = float(np.sum(by_rates * by_gravity))
    norms = float(np.linalg.norm(by_rates) * np.linalg.norm(by_gravity))
    if len(by_rates) < FEWEST_TURNS or product <= TURN_CORRELATION * norms:
        return None
    ratio = product / float(np.sum(by_rates**2))
    return next((unit for unit, factor in GYRO_UNITS.items() if 1.0 / TURN_FACTOR < ratio / factor < TURN_FACTOR), None)


def find_static_intervals(recording: Recording) -> list[tuple[float, float]]:
    """Find the intervals [s], of at least `SHORTEST_STATIC_S`, in which all sensors are static but for `JOINED_S`."""
    size = max(2, round(BLOCK_S * recording.rate_hz))
    blocks = len(recording) // size

    def split(values: np.ndarray) -> np.ndarray:
        return values[: blocks * size].reshape(blocks, size, *values.shape[1:])

    static = np.ones(blocks, dtype=bool)
    for sensor in recording.sensors.values():
        rate = split(compute_rate(sensor, recording.rate_hz))
        about = rate - rate.mean(axis=1, keepdims=True) if isinstance(sensor, ImuSensor) else rate
        static &= np.sqrt((about**2).sum(axis=2).mean(axis=1)) < STATIC_GYRO
        # A bias is below the rate of a person who rotates evenly.
        static &= np.linalg.norm(rate.mean(axis=1), axis=1) < 3.0 * STATIC_GYRO
        if isinstance(sensor, ImuSensor):
            static &= np.sqrt(split(sensor.accel_S).var(axis=1).sum(axis=1)) < STATIC_ACCEL
        if sensor.gap is not None:
            static &= ~split(sensor.gap).any(axis=1)
    spans: list[tuple[float, float]] = []
    for a, b in find_runs(static):
        begin, end = float(recording.time[a * size]), float(recording.time[b * size - 1])
        spans.append((spans.pop()[0] if spans and begin - spans[-1][1] < JOINED_S else begin, end))
    return [(first, last) for first, last in spans if last - first >= SHORTEST_STATIC_S - BLOCK_S]


# The file ----------------------------------------------------------------------------------------------------------


def format_session(proposal: Proposal, path: Path, folder: Path, wearer: Wearer, recording: Recording | None) -> str:
    """Format the session of the data in `path` as TOML; sensors on unknown segments are in comments."""
    body = wearer.table
    static = find_static_intervals(recording) if recording is not None else []
    ends = (float(recording.time[0]), float(recording.time[-1])) if recording is not None else (0.0, 80.0)
    lines = [f"name = {toml_string(path.stem)}"]
    if wearer.model is not None:
        model = relative(wearer.model, folder) if wearer.model.is_file() else str(wearer.model)
        lines.append(f"model = {toml_string(model)}")
    lines += ['start_pose = "n_pose"', "", "[data]", *_format_keys(proposal, "data", proposal.data)]
    lines += ["", "[phases]   # seconds", *_format_phases(proposal, body, static, ends, recording is not None)]
    lacking = [segment for segment in body.needed if segment not in proposal.sensors]
    if lacking and set(proposal.sensors) <= set(body.segments):  # else an unknown one may be lacking
        lines += ["", f"# without a sensor here, and not known without one: {', '.join(lacking)}"]
    segments = list(body.segments)
    for segment in sorted(
        proposal.sensors, key=lambda name: segments.index(name) if name in segments else len(segments)
    ):
        known = segment in segments
        place = body.sensors[segment].place if segment in body.sensors else ""
        table = [f"[sensors.{segment if known else 'SEGMENT'}]{f'   # usually {place}' if place else ''}"]
        table += _format_keys(proposal, segment, proposal.sensors[segment])
        table += _propose_mount(recording, segment, static) if recording is not None else []
        lines += ["", *(line if known else f"# {line}" for line in table)]
    return "\n".join(lines) + "\n"


def _format_keys(proposal: Proposal, table: str, values: Mapping[str, Any]) -> Iterator[str]:
    for key, value in values.items():
        text = toml_string(value) if isinstance(value, str) else str(value)
        check = proposal.checks.get((table, key))
        yield f"{key} = {toml_strings(value) if isinstance(value, list) else text}" + (
            f"   # CHECK: {check}" if check else ""
        )


def _format_phases(
    proposal: Proposal, body: BodyTable, static: Sequence[tuple[float, float]], ends: tuple[float, float], is_read: bool
) -> Iterator[str]:
    """Format the phases that the file states, or propose the first static interval; with examples between the ends."""
    begin, end = ends
    has_room = end - begin >= SHORTEST_EXAMPLE_S
    for name, (spans, reason) in proposal.phases.items():
        listed = ", ".join(f"[{np.ceil(1e3 * a) / 1e3:.3f}, {np.floor(1e3 * b) / 1e3:.3f}]" for a, b in spans)
        yield f"{toml_key(name)} = [{listed}]   # {reason}"
    if not proposal.phases and static and static[0][1] - static[0][0] >= SHORTEST_STATIC_S:
        first, last = static[0]
        yield f"start = [[{first:.2f}, {last:.2f}]]   # CHECK: all sensors are static there; is it the start pose?"
    elif not proposal.phases and has_room and is_read:
        example = _format_example(begin + 0.5, min(begin + 4.5, end))
        yield f"# start = {example}   # name the seconds in which the person stands still in the start pose"
    known = set(proposal.sensors) <= set(body.segments)
    lacking = known and not set(body.needed) <= set(proposal.sensors)
    paired = body.paths and all(body.counterpart(tip) in body.paths for tip in body.paths)
    if "clasp" not in proposal.phases and not lacking and paired and has_room:
        tips = " and ".join(dict.fromkeys(f"{body.shared_name(tip).replace('_', ' ')}s" for tip in body.paths))
        example = _format_example(begin + min(10.0, (end - begin) / 4.0), begin + min(70.0, 0.75 * (end - begin)))
        yield f"# clasp = {example}   # for wepose calibrate: the seconds in which the {tips} are held together"


def _format_example(begin: float, end: float) -> str:
    """Format an interval [s] that is to be replaced, to a tenth of a second within it."""
    return f"[[{np.ceil(10.0 * begin) / 10.0:.1f}, {np.floor(10.0 * end) / 10.0:.1f}]]"


def _propose_mount(recording: Recording, segment: str, static: Sequence[tuple[float, float]]) -> list[str]:
    """Propose a comment with a mount to complete; gravity shows the axis that points up."""
    sensor = recording.sensors[segment]
    if sensor.aligned:
        return []
    up = "+x"
    hint = "which sensor axis is up, which forward, in the start pose? none: the segment's own orientation"
    if isinstance(sensor, ImuSensor):
        span = recording.span(static[0]) if static else slice(max(1, round(recording.rate_hz)))
        force = sensor.accel_S[span].mean(axis=0)
        up = max(AXES, key=lambda axis: float(AXES[axis] @ force))
        where = "where it is static" if static else "in the first second"
        hint = f"up as gravity says {where}; write the axis ahead for ?, without the #"
    return [f'# mount = {{ up = "{up}", forward = "?" }}   # {hint}']


def advise(recording: Recording, table: BodyTable) -> str:
    """Advise on the use of a session with these sensors, once its lines marked CHECK are right."""
    name = "take the # off the lines of each sensor with ? and write its segment in place of SEGMENT"
    then = (
        "add the seconds of clasp to [phases] and wepose calibrate SESSION -o subject; "
        "or state the mounts and wepose track SESSION -o result"
    )
    worn = {segment: sensor for segment, sensor in recording.sensors.items() if segment in table.segments}
    if len(worn) < len(recording.sensors):
        return f"{name}; then {then}" if worn else name
    without = [segment for segment, sensor in worn.items() if not sensor.aligned and sensor.stated_quat_LS is None]
    if not without:
        return "wepose track SESSION -o result"
    if set(worn) >= set(table.needed) >= set(without):
        return then
    return f"state the mounts of {', '.join(without)}, then wepose track SESSION -o result"


def relative(path: Path, folder: Path) -> str:
    """Return a path as a session in a folder names it."""
    return Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix()
