"""A session for data that have none: what files say, what names and motion suggest, and what the user has to check."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..body import BodyTable
from ..data_tables import read_columns, read_names, read_table
from ..errors import BadData, MissingRate, WeposeError, WrongUnit, one_of
from ..recording import AXES, CONFIGURATION, ImuSensor, Intervals, Recording
from ..recording.clocks import TIME_UNITS, guess_time_unit
from ..recording.gaps import find_runs
from ..recording.limits import LONGEST_STEP_S
from ..recording.sensors import compute_rate
from .arrays import ArrayFile
from .device import Device, read_first_lines
from .guess import Guess, guess_arrays, guess_columns
from .live_log import read_live_log
from .registry import detect_format, look_up_format, read_device
from .session import read_session
from .session_file import format_keys

# A line of a file that says its rate.
_STATED_RATE = re.compile(r"(sampl\w*|frame|data)[ _]*(frequency|rate)[^0-9]{0,12}(?P<rate>\d+(\.\d+)?)", re.IGNORECASE)
ASSUMED_RATE_HZ = 100.0
# A sensor is static where its rate [rad/s] and specific force [m/s²] vary by less over `BLOCK_S`; the sway of a
# standing person is below.
BLOCK_S, STATIC_GYRO, STATIC_ACCEL = 0.25, np.deg2rad(3.0), 0.4
SHORTEST_STATIC_S = 1.0
MOST_SIBLINGS = 20


@dataclass
class Proposal:
    """The contents of a proposed session."""

    path: Path  # of the data
    folder: Path  # of the session
    body: BodyTable  # whose segments carry the sensors
    title: str  # kind of file
    data: dict[str, Any] = field(default_factory=dict)  # keys of [data]
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)  # segment, or "?" and a name of the file → keys
    checks: dict[str, str] = field(default_factory=dict)  # key → what the user has to check there
    facts: list[str] = field(default_factory=list)  # from the file, one line each
    phases: Mapping[str, Intervals] = field(default_factory=dict)  # that the file states

    def relative(self, path: Path) -> str:
        """Return a path as the session names it."""
        return Path(os.path.relpath(path.absolute(), self.folder.absolute())).as_posix()

    def read(self) -> Recording | None:
        """Read the recording as a session file would, and settle units; None: the data cannot be read.

        All sensors are read, also those on unknown segments.
        """
        for _ in range(3):
            values = {"start_pose": CONFIGURATION, "data": self.data, "sensors": self.sensors}
            try:
                return read_session(self.folder / "session.toml", True, values)
            except WrongUnit as error:  # the reader's check of units is better than a guess from names
                self.data[error.key] = error.unit
                self.checks.pop(error.key, None)
            except WeposeError as error:
                self.facts.append(f"as the session proposes it, it cannot be read: {error}")
                break
        return None


# From files of a known format ----------------------------------------------------------------------------------------


def propose_from_device(path: Path, folder: Path, name: str, body: BodyTable) -> Proposal:
    """Propose a session for a file of a known format, with the files beside it where each sensor has one."""
    format = look_up_format(name)
    device, lacks_rate = _read(path, name)
    signals = "gyroscope and accelerometer" if device.kind == "raw" else "orientations, no raw data"
    proposal = Proposal(path, folder, body, f"{format.title}, {signals}")
    whole = len(device.sensors) > 1 or format.whole
    if whole:
        proposal.data["file"] = proposal.relative(path)
    else:
        proposal.data["format"] = proposal.relative(Path(name)) if name.endswith(".toml") else name
    for file in [path] if whole else _list_siblings(path, name):
        try:
            device, lacks = _read(file, name)
        except WeposeError as error:
            proposal.facts.append(f"{file.name} is left out, as it cannot be read: {error}")
            continue
        lacks_rate |= lacks
        for label, sensor in device.sensors.items():
            guesses = map(body.guess_segment, (label, file.stem) if len(device.sensors) == 1 else (label,))
            segment: str | None = (
                sensor.segment if sensor.segment in body.segments else next(filter(None, guesses), None)
            )
            where = segment if segment and segment not in proposal.sensors else f"?{label if whole else file.name}"
            proposal.sensors[where] = {"label": label} if whole else {"file": proposal.relative(file)}
    if lacks_rate:
        proposal.data["rate_hz"] = ASSUMED_RATE_HZ
        proposal.checks["rate_hz"] = "the file does not say its rate"
    if not whole and len(proposal.sensors) > 1:
        proposal.title += f", {len(proposal.sensors)} files"
    if name == "wepose_live":
        log = read_live_log(path)
        proposal.facts.append(f"of {log.header['name']}, live by {log.header['method']}: {len(log.quat_WL)} poses")
        proposal.facts.append(f"track it as it was: wepose track {path} -o result; to change its phases: --write")
        proposal.phases = log.recording.phases
    return proposal


def _read(path: Path, format: str) -> tuple[Device, bool]:
    """Read a device's file; and whether it does not state its rate."""
    try:
        return read_device(path, format), False
    except MissingRate:
        return read_device(path, format, None, ASSUMED_RATE_HZ), True


def _list_siblings(path: Path, format: str) -> list[Path]:
    """List the file and those of the same format beside it: the files of one recording are in one folder."""
    if path.is_dir() or (look_up_format(format).folder and path.suffix.lower() == ".csv"):
        own = path if path.is_dir() else path.parent
        beside = [folder for folder in sorted(own.absolute().parent.iterdir()) if folder.is_dir()]
        same = [own if folder == own.absolute() else folder for folder in beside]
    else:
        same = _list_files_like(path)
    siblings = [file for file in same[: 10 * MOST_SIBLINGS] if file == path or detect_format(file) == format]
    return siblings[:MOST_SIBLINGS] if path in siblings[:MOST_SIBLINGS] else [path]


def _list_files_like(path: Path) -> list[Path]:
    return [file for file in sorted(path.parent.iterdir()) if file.suffix == path.suffix and file.is_file()]


# From names of columns or arrays -----------------------------------------------------------------------------------


def propose_from_names(path: Path, folder: Path, body: BodyTable, content: ArrayFile | None) -> Proposal:
    """Propose a session for a table, or for the arrays of a file, by their names."""
    if content is None:
        names, units = read_names(path)
        guess, kind = guess_columns(names, body, units), "Parquet" if path.suffix.lower() == ".parquet" else "CSV"
        proposal = Proposal(path, folder, body, f"{kind} table, {len(names)} columns")
    else:
        names = list(content.shapes)
        guess, kind = guess_arrays(content.shapes, body), "MATLAB" if path.suffix.lower() == ".mat" else "HDF5"
        proposal = Proposal(path, folder, body, f"{kind} file, {len(names)} arrays")
    if not guess.sensors:
        listed = one_of(names).removeprefix("there is: ")
        proposal.facts.append(f"no gyroscope and accelerometer, and no quaternions, by their names: {listed}")
        return proposal
    _propose_time(proposal, guess, content)
    if any("gyro" in signals for signals in guess.sensors.values()):
        proposal.data["gyro_unit"] = guess.units.get("gyro", "rad/s")
        if "gyro" not in guess.units:
            proposal.checks["gyro_unit"] = "neither the file nor the motion says so"
        proposal.data["accel_unit"] = guess.units.get("accel", "m/s^2")
    for segment, signals in guess.sensors.items():
        keys = {signal: columns if len(columns) > 1 else columns[0] for signal, columns in signals.items()}
        proposal.sensors[segment] = keys
        if content and "orientation" in keys:
            proposal.checks["orientation"] = "x, y, z, w? if w comes first, name its columns [1], [2], [3], [0]"
    # A table with one sensor, whose segment is that of the file's name, has others beside it with the same columns.
    own = body.guess_segment(path.stem) if content is None and len(guess.sensors) == 1 else None
    if own and next(iter(guess.sensors)).startswith("?"):
        files = {own: path}
        for file in _list_files_like(path)[:MOST_SIBLINGS]:
            other = body.guess_segment(file.stem)
            with contextlib.suppress(WeposeError):
                if other and other not in files and read_names(file)[0] == names:
                    files[other] = file
        proposal.sensors = {segment: {"file": proposal.relative(file), **keys} for segment, file in files.items()}
        proposal.title += f", {len(files)} files" if len(files) > 1 else ""
    else:
        proposal.data = {"file": proposal.relative(path), **proposal.data}
    return proposal


def _propose_time(proposal: Proposal, guess: Guess, arrays: ArrayFile | None) -> None:
    """Propose `time` and its unit, or `rate_hz`; with facts about it."""
    place = str(proposal.path)
    table = arrays.table(dict.fromkeys(guess.times, place)) if arrays else read_table(proposal.path)
    for name in guess.times:
        with contextlib.suppress(BadData):  # dates, or another column of this name
            time = read_columns(table, [name], place, "time")[:, 0]
            break
    else:
        dates = table.select(*dict.fromkeys(guess.times))
        _propose_rate(proposal, dates, () if arrays else read_first_lines(proposal.path))
        return
    steps = np.diff(time)
    step = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    named = guess.units.get(name)
    unit = named if named is not None and 0.0 < step * TIME_UNITS[named] < LONGEST_STEP_S else guess_time_unit(step)
    proposal.data["time"] = name
    if unit not in (None, "s"):
        reason = "its name says" if unit == named else f"it grows by {step:g} from row to row"
        proposal.facts.append(f"'{name}' is in {unit}, as {reason}: {1.0 / (step * TIME_UNITS[unit]):.4g} Hz")
        proposal.data["time_unit"] = unit
        if unit != named:
            proposal.checks["time_unit"] = reason


def _propose_rate(proposal: Proposal, dates: pl.DataFrame, lines: Sequence[str]) -> None:
    """Propose the rate of a file without times in numbers: by its dates or times of day, or as a line states it."""
    for name in dates.columns:
        texts = dates[name].cast(pl.String).str.strip_chars()
        for kind, form, tick_s in ((pl.Datetime("us"), None, 1e-6), (pl.Time, "%T%.f", 1e-9)):
            with contextlib.suppress(pl.exceptions.PolarsError):  # in no form that is known
                ticks = texts.str.strptime(kind, form, strict=False).cast(pl.Int64).drop_nulls().to_numpy()
                if len(ticks) and (span := float(np.ptp(ticks)) * tick_s):
                    rate_hz = proposal.data["rate_hz"] = float(f"{(len(ticks) - 1) / span:.6g}")
                    fact = f"'{name}' holds dates; by the first and the last of them: {rate_hz:g} Hz"
                    proposal.facts.append(fact)
                    return
    stated = next(filter(None, map(_STATED_RATE.search, lines)), None)
    proposal.data["rate_hz"] = float(stated["rate"]) if stated else ASSUMED_RATE_HZ
    if stated:
        proposal.facts.append(f"no column looks like time; the file says '{stated[0]}'")
    else:
        proposal.checks["rate_hz"] = "no column looks like time"


# The file ----------------------------------------------------------------------------------------------------------


def find_static_intervals(recording: Recording) -> list[tuple[float, float]]:
    """Find the intervals [s], of at least `SHORTEST_STATIC_S`, in which all sensors are static."""
    size = max(2, round(BLOCK_S * recording.rate_hz))
    blocks = len(recording) // size

    def split(values: np.ndarray) -> np.ndarray:
        return values[: blocks * size].reshape(blocks, size, *values.shape[1:])

    static = np.ones(blocks, dtype=bool)
    for sensor in recording.sensors.values():
        rate = split(compute_rate(sensor, recording.rate_hz))
        mean = rate.mean(axis=1, keepdims=True)
        # A bias is below the rate of a person who rotates evenly.
        static &= np.linalg.norm(mean[:, 0], axis=1) < 3.0 * STATIC_GYRO
        if isinstance(sensor, ImuSensor):
            rate = rate - mean
            static &= np.sqrt(split(sensor.accel_S).var(axis=1).sum(axis=1)) < STATIC_ACCEL
        static &= np.sqrt((rate**2).sum(axis=2).mean(axis=1)) < STATIC_GYRO
        if sensor.gap is not None:
            static &= ~split(sensor.gap).any(axis=1)
    spans = [(float(recording.time[a * size]), float(recording.time[b * size - 1])) for a, b in find_runs(static)]
    return [(first, last) for first, last in spans if last - first >= SHORTEST_STATIC_S - BLOCK_S]


def format_session(proposal: Proposal, model: Path | None, recording: Recording | None) -> str:
    """Format the session as TOML; sensors on unknown segments are in comments.

    `model` is the body's file, or its name in the package; None: the upper body's. `recording`: the data, if readable.
    """
    body, segments = proposal.body, list(proposal.body.segments)
    static = find_static_intervals(recording) if recording is not None else []
    head = {"name": proposal.path.stem}
    if model is not None:
        head["model"] = proposal.relative(model) if model.is_file() else str(model)
    lines = [*format_keys({**head, "start_pose": "n_pose"}), "", "[data]", *format_keys(proposal.data, proposal.checks)]
    lines += ["", "[phases]   # seconds"]
    if proposal.phases:  # as they were marked live
        inside = {
            name: [(np.ceil(1e3 * a) / 1e3, np.floor(1e3 * b) / 1e3) for a, b in spans]
            for name, spans in proposal.phases.items()
        }
        lines += format_keys(inside)
    elif recording is not None:
        lines += _propose_phases(proposal, recording, static)
    for segment in sorted(proposal.sensors, key=lambda name: segments.index(name) if name in segments else 99):
        known = segment in segments
        place = body.sensors[segment].place if segment in body.sensors else ""
        table = [f"[sensors.{segment if known else 'SEGMENT'}]{f'   # usually {place}' if place else ''}"]
        table += format_keys(proposal.sensors[segment], proposal.checks)
        if recording is not None and not recording.sensors[segment].aligned:
            table.append(_propose_mount(recording, segment, static))
        lines += ["", *(line if known else f"# {line}" for line in table)]
    return "\n".join(lines) + "\n"


def _propose_phases(proposal: Proposal, recording: Recording, static: Sequence[tuple[float, float]]) -> Iterator[str]:
    """Propose the start phase where all sensors are static, else an example; and an example of a clasp."""
    begin, end = float(recording.time[0]), float(recording.time[-1])
    if static:
        spans = f"[[{static[0][0]:.2f}, {static[0][1]:.2f}]]"
        yield f"start = {spans}   # CHECK: all sensors are static there; is it the start pose?"
    if end - begin < 2.0:
        return

    def example(first: float, last: float) -> str:
        return f"[[{np.ceil(10.0 * first) / 10.0:.1f}, {np.floor(10.0 * last) / 10.0:.1f}]]"

    if not static:
        spans = example(begin + 0.5, min(begin + 4.5, end))
        yield f"# start = {spans}   # name the seconds in which the person stands still in the start pose"
    body, sensors = proposal.body, set(proposal.sensors)
    lacking = sensors <= set(body.segments) and set(body.needed) - sensors  # else an unknown one may be a needed one
    if body.draw.paths and not lacking:
        spans = example(begin + min(10.0, (end - begin) / 4.0), begin + min(70.0, 0.75 * (end - begin)))
        yield f"# clasp = {spans}   # for wepose calibrate: the seconds in which the palms are held together"


def _propose_mount(recording: Recording, segment: str, static: Sequence[tuple[float, float]]) -> str:
    """Propose a comment with a mount to complete; gravity shows the axis that points up."""
    sensor = recording.sensors[segment]
    if not isinstance(sensor, ImuSensor):
        hint = "which sensor axis is up, which forward, in the start pose? none: the segment's own orientation"
        return f'# mount = {{ up = "+x", forward = "?" }}   # {hint}'
    span = recording.span(static[0]) if static else slice(max(1, round(recording.rate_hz)))
    force = sensor.accel_S[span].mean(axis=0)
    up = max(AXES, key=lambda axis: float(AXES[axis] @ force))
    hint = f"up as gravity says {'where it is static' if static else 'in the first second'}"
    return f'# mount = {{ up = "{up}", forward = "?" }}   # {hint}; write the axis ahead for ?, without the #'
