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
from ..documents import toml_key, toml_string, toml_strings
from ..errors import BadData, MissingRate, WeposeError, WrongUnit, one_of
from ..recording import AXES, CONFIGURATION, ImuSensor, Intervals, Recording
from ..recording.clocks import TIME_UNITS, guess_time_unit
from ..recording.gaps import find_runs
from ..recording.limits import LONGEST_STEP_S
from ..recording.sensors import compute_rate
from .arrays import ArrayFile
from .device import read_first_lines
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
MOST_SIBLINGS = 20
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
    phases : that the file states
    """

    title: str
    data: dict[str, Any] = field(default_factory=dict)
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)
    checks: dict[tuple[str, str], str] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    facts: list[str] = field(default_factory=list)
    diagnostics: list[Diagnostic] = field(default_factory=list)
    phases: Mapping[str, Intervals] = field(default_factory=dict)

    def warn_of_unknown(self, place: str, sensors: Sequence[str]) -> None:
        """Say which sensors are on segments that are not known."""
        if sensors:
            facts: dict[str, float | str] = {"variant": "unnamed", "devices": ", ".join(sensors)}
            self.diagnostics.append(Diagnostic("sensors-left-out", WARNING, place, len(sensors), facts=facts))

    def read(self, session: Path, name: str) -> Recording | None:
        """Read the recording as a session file would, and settle units; None: the data `name` cannot be read.

        All sensors are read, also those on unknown segments.
        """
        for _ in range(3):
            values = {"start_pose": CONFIGURATION, "data": self.data, "sensors": self.sensors}
            try:
                return read_session(session, True, values)
            except WrongUnit as error:  # the reader's check of units is better than a guess from names
                self.data[error.key] = error.unit
                self.checks.pop(("data", error.key), None)
            except WeposeError as error:
                facts = {"reason": str(error)}
                self.diagnostics.append(Diagnostic("session-unreadable", ERROR, name, facts=facts))
                break
        return None


def relative(path: Path, folder: Path) -> str:
    """Return a path as a session in a folder names it."""
    return Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix()


# From files of a known format ----------------------------------------------------------------------------------------


def propose_from_device(path: Path, folder: Path, name: str, body: BodyTable) -> Proposal:
    """Propose a session for a file of a known format, with the files beside it where each sensor has one."""
    format = look_up_format(name)
    device, lacks_rate = _read(path, name)
    signals = "gyroscope and accelerometer" if device.kind == "raw" else "orientations, no raw data"
    proposal = Proposal(f"{format.title}, {signals}")
    whole = len(device.sensors) > 1 or format.whole
    if whole:
        proposal.data["file"] = relative(path, folder)
    else:
        proposal.data["format"] = relative(Path(name), folder) if name.endswith(".toml") else name
    without_rate = []
    for file in [path] if whole else _list_siblings(path, name):
        try:
            device, lacks_rate = _read(file, name)
        except WeposeError as error:
            facts: dict[str, float | str] = {"variant": "unreadable", "reason": str(error)}
            proposal.diagnostics.append(Diagnostic("sensors-left-out", WARNING, file.name, facts=facts))
            continue
        for label, sensor in device.sensors.items():
            texts = (label, file.stem) if len(device.sensors) == 1 else (label,)
            guesses = filter(None, map(body.guess_segment, texts))
            segment: str | None = sensor.segment if sensor.segment in body.segments else next(guesses, None)
            where = segment if segment and segment not in proposal.sensors else f"?{label if whole else file.name}"
            proposal.sensors[where] = {"label": label} if whole else {"file": relative(file, folder)}
            proposal.labels[where] = label
            without_rate += [where] if lacks_rate else []
    for_all = len(without_rate) == len(proposal.sensors)  # one line holds for all
    for where in ["data"] if for_all and without_rate else without_rate:
        (proposal.data if where == "data" else proposal.sensors[where])["rate_hz"] = ASSUMED_RATE_HZ
        proposal.checks[where, "rate_hz"] = "the file does not say its rate"
    unknown = [where.removeprefix("?") for where in proposal.sensors if where.startswith("?")]
    proposal.warn_of_unknown(path.name if whole else path.parent.name, unknown)
    if not whole and len(proposal.sensors) - len(unknown) > 1:
        proposal.title += f", {len(proposal.sensors) - len(unknown)} files"
    if name == "wepose_live":
        log = read_live_log(path)
        poses = f"{len(log.quat_WL)} poses were shown"
        proposal.facts.append(f"of {log.header['name']}, live by {log.header['method']}: {poses}")
        proposal.facts.append(f"track it as it was: wepose track {path} -o result; to change its phases: --write")
        proposal.phases = log.recording.phases
    return proposal


def _read(path: Path, format: str) -> tuple[Any, bool]:
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
        same = [file for file in sorted(path.parent.iterdir()) if file.suffix == path.suffix and file.is_file()]
    siblings = [file for file in same[: 10 * MOST_SIBLINGS] if file == path or detect_format(file) == format]
    return siblings[:MOST_SIBLINGS] if path in siblings[:MOST_SIBLINGS] else [path]


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
    # A table with one sensor, whose segment is that of the file's name, has others beside it with the same columns.
    own = body.guess_segment(path.stem) if arrays is None and len(guess.sensors) == 1 else None
    if own and next(iter(guess.sensors)).startswith("?"):
        same = [file for file in sorted(path.parent.iterdir()) if file.suffix == path.suffix and file.is_file()]
        files = {own: path}
        for file in same[:MOST_SIBLINGS]:
            other = body.guess_segment(file.stem)
            with contextlib.suppress(WeposeError):
                if other and other not in files and read_names(file)[0] == names:
                    files[other] = file
        ((_, keys),) = proposal.sensors.items()
        proposal.sensors = {segment: {"file": relative(file, folder), **keys} for segment, file in files.items()}
        proposal.title += f", {len(files)} files" if len(files) > 1 else ""
        return proposal
    proposal.data = {"file": relative(path, folder), **proposal.data}
    columns_of = {name: next(iter(signals.values()))[0] for name, signals in guess.sensors.items()}
    unknown = [name.removeprefix("?") or f"{columns_of[name]}, …" for name in guess.sensors if name.startswith("?")]
    proposal.warn_of_unknown(path.name, unknown)
    return proposal


def _propose_time(path: Path, guess: Guess, arrays: ArrayFile | None, proposal: Proposal) -> None:
    """Propose `time` and its unit, or `rate_hz`; with facts about it."""
    table = arrays.table({name: str(path) for name in guess.times}) if arrays else read_table(path)
    for name in guess.times:
        with contextlib.suppress(BadData):  # dates, or another column of this name
            time = read_columns(table, [name], str(path), "time")[:, 0]
            break
    else:
        dates = {name: _measure_rate_of_dates(table[name].cast(pl.String).str.strip_chars()) for name in guess.times}
        dated = next((name for name, rate_hz in dates.items() if rate_hz), None)
        stated = next(filter(None, map(_STATED_RATE.search, read_first_lines(path) if not arrays else ())), None)
        proposal.data["rate_hz"] = dates[dated] if dated else float(stated["rate"]) if stated else ASSUMED_RATE_HZ
        if dated:
            fact = f"'{dated}' holds dates; by the first and the last of them: {dates[dated]:g} Hz"
        elif stated:
            fact = f"no column looks like time; the file says '{stated[0]}'"
        else:
            fact = "no column of times in numbers: state the rate"
            proposal.checks["data", "rate_hz"] = "no column looks like time"
        proposal.facts.append(fact)
        return
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


def _measure_rate_of_dates(column: pl.Series) -> float:
    """Measure the rate [Hz] by the first and the last date, or time of day, of a column; 0.0 where there are none."""
    for kind, form, tick_s in ((pl.Datetime("us"), None, 1e-6), (pl.Time, "%T%.f", 1e-9)):
        with contextlib.suppress(pl.exceptions.PolarsError):  # in no form that is known
            ticks = column.str.strptime(kind, form, strict=False).cast(pl.Int64).drop_nulls().to_numpy()
            if len(ticks) and (span := float(np.ptp(ticks)) * tick_s):
                return float(f"{(len(ticks) - 1) / span:.6g}")
    return 0.0


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
        about = rate - rate.mean(axis=1, keepdims=True) if isinstance(sensor, ImuSensor) else rate
        static &= np.sqrt((about**2).sum(axis=2).mean(axis=1)) < STATIC_GYRO
        # A bias is below the rate of a person who rotates evenly.
        static &= np.linalg.norm(rate.mean(axis=1), axis=1) < 3.0 * STATIC_GYRO
        if isinstance(sensor, ImuSensor):
            static &= np.sqrt(split(sensor.accel_S).var(axis=1).sum(axis=1)) < STATIC_ACCEL
        if sensor.gap is not None:
            static &= ~split(sensor.gap).any(axis=1)
    spans = [(float(recording.time[a * size]), float(recording.time[b * size - 1])) for a, b in find_runs(static)]
    return [(first, last) for first, last in spans if last - first >= SHORTEST_STATIC_S - BLOCK_S]


def format_session(proposal: Proposal, path: Path, folder: Path, wearer: Wearer, recording: Recording | None) -> str:
    """Format the session of the data in `path` as TOML; sensors on unknown segments are in comments."""
    body, segments = wearer.table, list(wearer.table.segments)
    static = find_static_intervals(recording) if recording is not None else []
    lines = [f"name = {toml_string(path.stem)}"]
    if wearer.model is not None:
        model = relative(wearer.model, folder) if wearer.model.is_file() else str(wearer.model)
        lines.append(f"model = {toml_string(model)}")
    lines += ['start_pose = "n_pose"', "", "[data]", *_format_keys(proposal, "data", proposal.data)]
    lines += ["", "[phases]   # seconds"]
    for name, spans in proposal.phases.items():
        listed = ", ".join(f"[{np.ceil(1e3 * a) / 1e3:.3f}, {np.floor(1e3 * b) / 1e3:.3f}]" for a, b in spans)
        lines.append(f"{toml_key(name)} = [{listed}]   # as it was marked live")
    known = set(proposal.sensors) <= set(segments)  # else an unknown one may be lacking
    lacking = [segment for segment in body.needed if segment not in proposal.sensors] if known else []
    if not proposal.phases and recording is not None:
        begin, end = float(recording.time[0]), float(recording.time[-1])
        if static:
            first, last = static[0]
            lines.append(
                f"start = [[{first:.2f}, {last:.2f}]]   # CHECK: all sensors are static there; is it the start pose?"
            )
        elif end - begin > 2.0:
            example = _format_example(begin + 0.5, min(begin + 4.5, end))
            lines.append(f"# start = {example}   # name the seconds in which the person stands still in the start pose")
        if not lacking and end - begin > 2.0 and body.draw.paths:
            example = _format_example(begin + min(10.0, (end - begin) / 4.0), begin + min(70.0, 0.75 * (end - begin)))
            lines.append(
                f"# clasp = {example}   # for wepose calibrate: the seconds in which the palms are held together"
            )
    for segment in sorted(proposal.sensors, key=lambda name: segments.index(name) if name in segments else 99):
        place = body.sensors[segment].place if segment in body.sensors else ""
        name = segment if segment in segments else "SEGMENT"
        table = [f"[sensors.{name}]{f'   # usually {place}' if place else ''}"]
        table += _format_keys(proposal, segment, proposal.sensors[segment])
        if recording is not None and not recording.sensors[segment].aligned:
            table.append(_propose_mount(recording, segment, static))
        lines += ["", *(line if segment in segments else f"# {line}" for line in table)]
    return "\n".join(lines) + "\n"


def _format_keys(proposal: Proposal, table: str, values: Mapping[str, Any]) -> Iterator[str]:
    for key, value in values.items():
        text = toml_string(value) if isinstance(value, str) else str(value)
        check = proposal.checks.get((table, key))
        yield f"{key} = {toml_strings(value) if isinstance(value, list) else text}" + (
            f"   # CHECK: {check}" if check else ""
        )


def _format_example(begin: float, end: float) -> str:
    """Format an interval [s] that is to be replaced, to a tenth of a second within it."""
    return f"[[{np.ceil(10.0 * begin) / 10.0:.1f}, {np.floor(10.0 * end) / 10.0:.1f}]]"


def _propose_mount(recording: Recording, segment: str, static: Sequence[tuple[float, float]]) -> str:
    """Propose a comment with a mount to complete; gravity shows the axis that points up."""
    sensor = recording.sensors[segment]
    if not isinstance(sensor, ImuSensor):
        hint = "which sensor axis is up, which forward, in the start pose? none: the segment's own orientation"
        return f'# mount = {{ up = "+x", forward = "?" }}   # {hint}'
    span = recording.span(static[0]) if static else slice(max(1, round(recording.rate_hz)))
    force = sensor.accel_S[span].mean(axis=0)
    up = max(AXES, key=lambda axis: float(AXES[axis] @ force))
    where = "where it is static" if static else "in the first second"
    hint = f"up as gravity says {where}; write the axis ahead for ?, without the #"
    return f'# mount = {{ up = "{up}", forward = "?" }}   # {hint}'


def advise(recording: Recording, table: BodyTable) -> str:
    """Advise on the use of a session with these sensors, once its lines marked CHECK are right."""
    advice = (
        "add the seconds of clasp to [phases] and wepose calibrate SESSION -o subject; "
        "or state the mounts and wepose track SESSION -o result"
    )
    if all(sensor.aligned or sensor.stated_quat_LS is not None for sensor in recording.sensors.values()):
        advice = "wepose track SESSION -o result"
    name = "take the # off the lines of each sensor with ? and write its segment in place of SEGMENT; then "
    return advice if set(recording.sensors) <= set(table.segments) else name + advice
