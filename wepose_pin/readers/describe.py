"""What a file is, for `wepose info`. For data a session is proposed, and read: what is said of it was seen in it."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ..diagnostics import ERROR, WARNING, Diagnostic
from ..documents import is_number, parse_toml, read_toml, toml_key, toml_string, toml_strings
from ..errors import BadData, MissingFile, MissingRate, WeposeError, WrongUnit, one_of
from ..model import BodyTable, load_table
from ..recording import (
    AXES,
    CONFIGURATION,
    ImuSensor,
    Intervals,
    OrientationSensor,
    Recording,
    format_span,
    format_time,
)
from ..recording.clocks import TIME_UNITS, guess_time_unit
from ..recording.gaps import find_runs
from ..recording.limits import LONGEST_STEP_S, STANDARD_GRAVITY
from ..recording.sensors import compute_rate
from .arrays import ArrayFile, is_array_file
from .device import GYRO_UNITS, Device, read_first_lines
from .guess import Guess, guess_arrays, guess_columns
from .live_log import read_live_log
from .reference import read_reference
from .registry import detect_format, find_title, is_whole, may_be_folder, read_device
from .session import SessionReader
from .tables import FORMATS as TABLES
from .tables import read_columns, read_names, read_table

# A line of a file that says its rate.
_STATED_RATE = re.compile(r"(sampl\w*|frame|data)[ _]*(frequency|rate)[^0-9]{0,12}(?P<rate>\d+(\.\d+)?)", re.IGNORECASE)
# A sensor is static where its rate [rad/s] and specific force [m/s²] vary by less over `BLOCK_S`; the sway of a
# standing person is below.
BLOCK_S, STATIC_GYRO, STATIC_ACCEL = 0.25, np.deg2rad(3.0), 0.4
SHORTEST_STATIC_S = 1.0
SHORTEST_EXAMPLE_S = 2.0  # a shorter recording has no room for a phase
JOINED_S = 0.5  # static intervals nearer than this are one: a person twitches
MOST_SIBLINGS = 20
CHECK = "   # CHECK: "
GUESSED_GYRO_UNIT = f'gyro_unit = "rad/s"{CHECK}neither the file nor the motion says so'
# Gravity turns in a sensor as its rates say, to a factor of 7: other accelerations disturb it. Radians and degrees are
# 57 apart. Where the two correlate by less, or in fewer places, the motion does not show the unit.
TURN_FACTOR, TURN_CORRELATION, FEWEST_TURNS = 7.0, 0.4, 10
_YEAR_2000, _YEAR_2100 = 946_684_800.0, 4_102_444_800.0  # [s] since 1970


class Description(NamedTuple):
    """The description of a file for `wepose info`."""

    what: str  # one line
    facts: tuple[str, ...]  # one line each
    sensors: tuple[tuple[str, ...], ...]  # segment, its name in the file, signals, rate, time, gaps
    session: str | None  # the proposed session file, for data
    then: str = ""  # advice on that session
    diagnostics: tuple[Diagnostic, ...] = ()


@dataclass(frozen=True)
class _Proposal:
    """The contents of a proposed session for a data file.

    Parameters
    ----------
    title : kind of file
    head : lines of [data]
    phases : lines of [phases] where the file states them
    tables : segment, or "?" and a name of the file → lines of its [sensors.…]
    labels : segment → its name in the file
    facts : other facts from the file, one line each
    """

    title: str
    head: list[str] = field(default_factory=list)
    tables: Mapping[str, list[str]] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    facts: Sequence[str] = ()
    diagnostics: Sequence[Diagnostic] = ()
    phases: list[str] = field(default_factory=list)


class Wearer(NamedTuple):
    """The body that bears the sensors."""

    table: BodyTable
    model: Path | None = None  # its file, or its name in the package; None: the upper body's

    def name_model(self, folder: Path) -> str:
        """The line of a session in `folder` that names it."""
        if self.model is None:
            return ""
        return f"model = {_relative(self.model, folder) if self.model.is_file() else toml_string(str(self.model))}"


def find_file(path: Path, wearer: Wearer | None = None) -> Path:
    """Find what is described of a path: the session or subject in a folder, or the first recording in it.

    A file, a result, and a folder that is one recording are returned as they are.

    Raises
    ------
    MissingFile
        The folder holds nothing that is known.
    """
    if not path.is_dir() or (path / "pose.parquet").is_file():
        return path
    named = next((path / name for name in ("session.toml", "subject.toml") if (path / name).is_file()), None)
    if named is not None or detect_format(path) is not None:
        return named or path
    files = [file for file in sorted(path.iterdir()) if file.is_file()]
    data = [file for file in files if file.suffix.lower() in TABLES or is_array_file(file) or detect_format(file)]
    if not data:
        raise MissingFile(
            f"{path}: a folder without session.toml, subject.toml or pose.parquet, none of an x-IMU3, a phone or a ROS "
            f"bag, and without recordings in it; name a file"
        )
    table = (wearer or Wearer(load_table())).table
    return next((file for file in data if table.guess_segment(file.stem)), data[0])


def describe_file(path: Path, folder: Path | None = None, wearer: Wearer | None = None) -> Description:
    """Describe a file or folder, as `find_file` returns it.

    Parameters
    ----------
    folder : for which a session is proposed; None: that of the file
    wearer : of the sensors; None: the upper body

    Raises
    ------
    WeposeError
        The file is missing, damaged, or of an unknown kind.
    """
    if not path.exists():
        raise MissingFile(f"{path}: no such file or folder")
    if path.is_dir() and (path / "pose.parquet").is_file():
        return _describe_result(path)
    if path.suffix.lower() == ".toml":
        return _describe_toml(path)
    if path.suffix.lower() in (".c3d", ".trc"):
        return _describe_reference(path)
    folder, wearer = folder or path.absolute().parent, wearer or Wearer(load_table())
    table = wearer.table
    format = detect_format(path)
    if format:
        return _propose_session(path, folder, _propose_from_device(path, folder, format, table), wearer)
    if is_array_file(path):
        arrays = ArrayFile(path)
        guess = guess_arrays(arrays.shapes, table)
        proposal = _propose_from_names(path, folder, guess, list(arrays.shapes), arrays, table)
        return _propose_session(path, folder, proposal, wearer)
    names, units = read_names(path) if path.suffix.lower() in TABLES else ([], {})
    if len(names) > (path.suffix.lower() == ".txt"):  # a text that is no table has one column
        if any(f"{point}_x" in names for point in table.points):
            return Description(f"{path}: a pose, as `wepose track` writes it: {len(names)} columns", (), (), None)
        proposal = _propose_from_names(path, folder, guess_columns(names, table, units), names, None, table)
        return _propose_session(path, folder, proposal, wearer)
    known = (
        ".toml, .csv, .parquet, .tsv and .txt (tables with tabs, semicolons or commas; MT Manager), .mvnx, .sto, .h5, "
        ".hdf5, .mat, .xdf, .db3, .mcap, .bag, .c3d, .trc, .zip and .json of phones; folders of a result, an "
        "x-IMU3, a phone, a ROS bag"
    )
    raise BadData(f"{path}: is nothing that is known here; there is: {known}")


# Files that hold no data -------------------------------------------------------------------------------------------


def _describe_result(path: Path) -> Description:
    try:
        summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        summary = None
    if not isinstance(summary, dict):
        return Description(f"{path}: a result of `wepose track`, without a summary.json that can be read", (), (), None)
    run = {key: summary.get(key) for key in ("recording", "method", "rate_hz", "duration_s", "samples")}
    facts = [
        f"of {run['recording']}, by {run['method']}: {run['samples']} samples, {run['duration_s']} s at "
        f"{run['rate_hz']} Hz",
        *_read_diagnostics(summary.get("diagnostics")),
    ]
    facts[1:1] = [
        f"{name}: {', '.join(_texts(summary.get(name)))}" for name in ("sensors", "points", "joints") if name in summary
    ]
    facts.append(f"look at it: wepose view {path}")
    return Description(f"{path}: a result of `wepose track`", tuple(facts), (), None)


def _read_diagnostics(value: object) -> list[str]:
    """Read the texts of a summary's diagnostics, which another version may have written."""
    texts = []
    for each in value if isinstance(value, list) else []:
        text = each.get("text") if isinstance(each, dict) else None
        if isinstance(text, dict):
            texts.append(f"{each.get('severity')}: {text.get('what')}")
    return texts


def _texts(value: object) -> list[str]:
    return [str(item) for item in value] if isinstance(value, list | dict) else []


def _describe_reference(path: Path) -> Description:
    reference = read_reference(path)
    rate_hz = (len(reference.time) - 1) / float(reference.time[-1] - reference.time[0])
    facts = [f"{len(reference.time)} samples at {rate_hz:.6g} Hz, {format_span(reference.time[[0, -1]])}"]
    for name, known in (("joints", reference.points), ("segments", reference.quat_VT)):
        facts.append(f"{name}: {', '.join(known) or 'none'}")
    facts.append(f"compare a result with it: wepose evaluate RESULT {path}")
    what = "rotations" if reference.own_frames else "markers"
    return Description(f"{path}: {what}, a reference for `wepose evaluate`", tuple(facts), (), None)


def _describe_toml(path: Path) -> Description:
    values = read_toml(path, "a session or a subject")
    if "data" in values or "sensors" in values:
        whole = SessionReader(path, gaps=True).recording()
        what = f"{path}: a session, '{whole.name}'"
        return Description(what, _facts(whole), _rows(whole, {}), None, diagnostics=whole.diagnostics)
    if isinstance(values.get("lengths"), dict):
        lengths = {name: length for name, length in values["lengths"].items() if is_number(length)}
        facts = ["lengths [mm]: " + ", ".join(f"{name} {1e3 * length:.0f}" for name, length in lengths.items())]
        mounts = ", ".join(_texts(values.get("mounts")))
        facts.append(f"mounts: {mounts}" if mounts else "no calibrated mounts")
        return Description(f"{path}: a subject, '{values.get('name', '')}'", tuple(facts), (), None)
    raise BadData(f"{path}: TOML, but neither a session ([data], [sensors.…]) nor a subject ([lengths])")


# Data: a session is proposed ---------------------------------------------------------------------------------------


def _propose_session(path: Path, folder: Path, proposal: _Proposal, wearer: Wearer) -> Description:
    """Describe data and propose a session; the description has what this session reads."""
    what, diagnostics = f"{path}: {proposal.title}", tuple(proposal.diagnostics)
    if not proposal.tables:
        return Description(what, tuple(proposal.facts), (), None, diagnostics=diagnostics)
    model = wearer.name_model(folder)
    title = [f"name = {toml_string(path.stem)}", *([model] if model else [])]
    phases, head = proposal.phases, proposal.head
    recording: Recording | None = None
    for _ in range(3):
        try:
            # All sensors are read, also those on unknown segments.
            values = parse_toml("\n".join(["[data]", *head]))
            values["start_pose"] = CONFIGURATION
            values["sensors"] = {segment: parse_toml("\n".join(table)) for segment, table in proposal.tables.items()}
            reader = SessionReader(folder / "session.toml", gaps=True, values=values)
            recording = reader.recording()
            unit = guess_gyro_unit(recording) if GUESSED_GYRO_UNIT in head else None
            if unit is None:
                break
            head = [f"gyro_unit = {toml_string(unit)}" if line == GUESSED_GYRO_UNIT else line for line in head]
        except WeposeError as error:
            # The reader's check of units is better than a guess from names.
            if not isinstance(error, WrongUnit):
                unread = Diagnostic("session-unreadable", ERROR, path.name, facts={"reason": str(error)})
                diagnostics = (*diagnostics, unread)
                break
            fitting = f"{error.key} = {toml_string(error.unit)}"
            head = [fitting if line.startswith(error.key) else line for line in head]
    if recording is None:
        text = _session_text(title, head, phases, proposal.tables, {}, wearer.table)
        return Description(what, tuple(proposal.facts), (), text, "mend what cannot be read", diagnostics)
    static = find_static_intervals(recording)
    comments = {segment: _mount_comment(recording, segment, static) for segment in proposal.tables}
    ends = float(recording.time[0]), float(recording.time[-1])
    phases = phases or _start_lines(static, ends)
    text = _session_text(title, head, phases, proposal.tables, comments, wearer.table, ends)
    facts, rows = (*proposal.facts, *_facts(recording)), _rows(recording, proposal.labels)
    # A sensor on an unknown segment has its name in the file.
    read = (replace(each, place=each.place.removeprefix("?")) for each in recording.diagnostics)
    return Description(what, facts, rows, text, _advise(recording, wearer.table), (*diagnostics, *read))


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
    if len(by_rates) < FEWEST_TURNS or product <= TURN_CORRELATION * np.linalg.norm(by_rates) * np.linalg.norm(
        by_gravity
    ):
        return None
    ratio = product / float(np.sum(by_rates**2))
    return next((unit for unit, factor in GYRO_UNITS.items() if 1.0 / TURN_FACTOR < ratio / factor < TURN_FACTOR), None)


def _advise(recording: Recording, table: BodyTable) -> str:
    """Advise on the use of a session with these sensors, once its lines marked CHECK are right."""
    name = "take the # off the lines of each sensor with ? and write its segment in place of SEGMENT"
    then = (
        "add the seconds of clasp to [phases] and wepose calibrate SESSION -o subject; "
        "or state the mounts and wepose track SESSION -o result"
    )
    worn = {segment: sensor for segment, sensor in recording.sensors.items() if segment in table.segments}
    if not worn:
        return name
    if len(worn) < len(recording.sensors):
        return f"{name}; then {then}"
    without = [segment for segment, sensor in worn.items() if not sensor.aligned and sensor.stated_quat_LS is None]
    if not without:
        return "wepose track SESSION -o result"
    if set(worn) >= set(table.needed) >= set(without):
        return then
    return f"state the mounts of {', '.join(without)}, then wepose track SESSION -o result"


def _start_lines(static: list[tuple[float, float]], ends: tuple[float, float]) -> list[str]:
    """Propose the start pose: the first static interval, else an example between the recording's `ends` [s]."""
    if static and static[0][1] - static[0][0] >= SHORTEST_STATIC_S:
        first, last = static[0]
        return [f"start = [[{first:.2f}, {last:.2f}]]{CHECK}all sensors are static there; is it the start pose?"]
    begin, end = ends
    if end - begin < SHORTEST_EXAMPLE_S:
        return []
    example = _write_example(begin + 0.5, min(begin + 4.5, end))
    return [f"# start = {example}   # name the seconds in which the person stands still in the start pose"]


def _session_text(
    title: list[str],
    head: list[str],
    phases: list[str],
    tables: Mapping[str, list[str]],
    comments: Mapping[str, list[str]],
    body: BodyTable,
    ends: tuple[float, float] = (0.0, 80.0),
) -> str:
    """The text of a session; examples of phases lie between the `ends` [s] of the recording."""
    lines = [
        *title,
        'start_pose = "n_pose"',
        "",
        "[data]",
        *head,
        "",
        "[phases]   # seconds",
    ]
    lines += phases
    # A sensor on an unknown segment may be one that is lacking.
    named = bool(tables) and set(tables) <= set(body.segments)
    lacking = [segment for segment in body.needed if segment not in tables] if named else []
    clasped = any(line.startswith("clasp = ") for line in phases)
    begin, end = ends
    paired = body.paths and all(body.counterpart(tip) in body.paths for tip in body.paths)
    if not clasped and not lacking and paired and end - begin > SHORTEST_EXAMPLE_S:
        tips = " and ".join(dict.fromkeys(f"{body.shared_name(tip).replace('_', ' ')}s" for tip in body.paths))
        example = _write_example(begin + min(10.0, (end - begin) / 4.0), begin + min(70.0, 0.75 * (end - begin)))
        lines.append(f"# clasp = {example}   # for wepose calibrate: the seconds in which the {tips} are held together")
    if lacking:
        lines += ["", f"# without a sensor here, and not known without one: {', '.join(lacking)}"]
    segments = list(body.segments)
    for segment in sorted(tables, key=lambda name: segments.index(name) if name in segments else len(segments)):
        commented = segment not in segments
        place = body.sensors[segment].place if segment in body.sensors else ""
        first = f"[sensors.{'SEGMENT' if commented else segment}]{f'   # usually {place}' if place else ''}"
        table = [first, *tables[segment], *comments.get(segment, [])]
        lines += ["", *(f"# {line}" if commented else line for line in table)]
    return "\n".join(lines) + "\n"


def _propose_from_device(path: Path, folder: Path, format: str, table: BodyTable) -> _Proposal:
    """Propose a session for a file of a known format, with the files beside it where each sensor has one."""
    device, rate = _read(path, format, table)
    signals = "gyroscope and accelerometer" if device.kind == "raw" else "orientations, no raw data"
    title = f"{find_title(format)}, {signals}"
    if format == "wepose_live":
        facts, phases = _describe_live(path)
        worn = {str(segment): list[str]() for segment in device.labels.values()}
        return _Proposal(title, [f"file = {_relative(path, folder)}"], worn, facts=facts, phases=phases)
    if len(device.labels) > 1 or is_whole(format):
        tables: dict[str, list[str]] = {}
        for label, segment in device.labels.items():
            where = segment if segment and segment not in tables else f"?{label}"
            tables[where] = [f"label = {toml_string(label)}"]
        labels = {segment: str(device_label) for device_label, segment in device.labels.items() if segment}
        unknown = [label for label, segment in device.labels.items() if segment is None]
        head = [f"file = {_relative(path, folder)}", *rate]
        return _Proposal(title, head, tables, labels, diagnostics=_unknown_segments(path, unknown))
    tables, labels, diagnostics = {}, {}, list[Diagnostic]()
    rates: list[list[str]] = []
    for file in _siblings(path, format):
        try:
            its, its_rate = (device, rate) if file == path else _read(file, format, table)
        except WeposeError as error:
            diagnostics.append(Diagnostic("device-file-left-out", WARNING, file.name, facts={"reason": str(error)}))
            continue
        (label, segment), *_ = its.labels.items()
        where = segment if segment and segment not in tables else f"?{file.name}"
        tables[where] = [f"file = {_relative(file, folder)}", *its_rate]
        labels[where] = label
        rates.append(its_rate)
    if all(rates):  # one line holds for all
        tables = {where: lines[:1] for where, lines in tables.items()}
    else:
        rate = []
    unknown = [name.removeprefix("?") for name in tables if name.startswith("?")]
    if len(tables) - len(unknown) > 1:
        title += f", {len(tables) - len(unknown)} files"
    diagnostics += _unknown_segments(path.parent, unknown)
    stated = _relative(Path(format), folder) if format.endswith(".toml") else toml_string(format)
    return _Proposal(title, [f"format = {stated}", *rate], tables, labels, diagnostics=diagnostics)


def _unknown_segments(path: Path, sensors: Sequence[str]) -> list[Diagnostic]:
    facts = {"sensors": ", ".join(sensors)}
    return [Diagnostic("sensor-segments-unknown", WARNING, path.name, len(sensors), facts=facts)] if sensors else []


def _describe_live(path: Path) -> tuple[list[str], list[str]]:
    """Describe a recording of `wepose live`: facts, and the phases of a session for it."""
    log = read_live_log(path)
    recording, header = log.recording, log.header
    subject = header["subject"]
    first, last = recording.phases["start"][0]
    names = {segment: "stated" for segment, sensor in recording.sensors.items() if sensor.stated_quat_LS is not None}
    about: dict[str, Any] = {}
    if subject:
        with contextlib.suppress(ValueError):  # another program may have written the file
            about = parse_toml(subject)
        calibrated = _texts(about.get("mounts"))
        names |= {segment: "calibrated" for segment in recording.sensors if segment in calibrated}
    mounts = ", ".join(f"{segment} {origin}" for segment, origin in names.items())
    facts = [
        f"of {header['name']}, live by {header['method']}: {len(log.quat_WL)} poses were shown",
        f"subject: {about.get('name') or 'without a name'}" if subject else "no subject",
        f"mounts: {mounts}" if mounts else "no mounts",
        f"start pose held [s]: {first:.2f} to {last:.2f}",
    ]
    if recording.resets:
        times = ", ".join(f"{recording.time[tick]:.1f}" for tick in recording.resets)
        facts.append(f"headings reset at [s]: {times}")
    marked = {name: spans for name, spans in recording.phases.items() if name != "start"}
    for name, spans in marked.items():
        facts.append(f"phase {name} [s]: {', '.join(f'{begin:.2f} to {end:.2f}' for begin, end in spans)}")
    facts += [f"marked at {mark.time:.2f} s: {mark.text}" for mark in recording.marks]
    if len(log.quat_WL):
        facts.append(f"track it as it was: wepose track {path} -o result")
    facts.append("to change its phases: --write")
    lines = [f"start = {_write_spans(recording.phases['start'])}   # as it was held live"]
    return facts, lines + [
        f"{toml_key(name)} = {_write_spans(spans)}   # as it was marked" for name, spans in marked.items()
    ]


def _write_spans(spans: Intervals) -> str:
    """Intervals [s] in TOML, to the millisecond within them."""
    return f"[{', '.join(f'[{np.ceil(1e3 * a) / 1e3:.3f}, {np.floor(1e3 * b) / 1e3:.3f}]' for a, b in spans)}]"


def _write_example(begin: float, end: float) -> str:
    """An interval [s] in TOML that is to be replaced, to a tenth of a second within it."""
    return f"[[{np.ceil(10.0 * begin) / 10.0:.1f}, {np.floor(10.0 * end) / 10.0:.1f}]]"


def _siblings(path: Path, format: str) -> list[Path]:
    """List the file and those of the same format beside it: the files of one recording are in one folder."""
    if path.is_dir() or (may_be_folder(format) and path.suffix.lower() == ".csv"):
        own = path if path.is_dir() else path.parent
        beside = [folder for folder in sorted(own.absolute().parent.iterdir()) if folder.is_dir()]
        same = [own if folder == own.absolute() else folder for folder in beside]
    else:
        same = [file for file in sorted(path.parent.iterdir()) if file.suffix == path.suffix and file.is_file()]
    siblings = [file for file in same[: 10 * MOST_SIBLINGS] if file == path or detect_format(file) == format]
    return siblings[:MOST_SIBLINGS] if path in siblings[:MOST_SIBLINGS] else [path]


def _read(path: Path, format: str, table: BodyTable) -> tuple[Device, list[str]]:
    """Read a device's file; with the line that states a rate, where the file has none."""
    try:
        device, rate = read_device(path, format), list[str]()
    except MissingRate:
        device = read_device(path, format, None, 100.0)
        rate = [f"rate_hz = 100.0{CHECK}the file does not say its rate"]
    return replace(device, labels=_find_segments(device.labels, path, table)), rate


def _find_segments(labels: Mapping[str, str | None], path: Path, table: BodyTable) -> dict[str, str | None]:
    """Find the segment of each label: what the reader says, where the body has it, else by the body's own labels."""
    names = (path.stem,) if len(labels) == 1 else ()
    guesses = {
        label: next((own for text in (label, *names) if (own := table.guess_segment(text)) is not None), None)
        for label in labels
    }
    return {label: segment if segment in table.segments else guesses[label] for label, segment in labels.items()}


def _propose_from_names(
    path: Path, folder: Path, guess: Guess, names: list[str], arrays: ArrayFile | None, body: BodyTable
) -> _Proposal:
    """Propose a session for a table or arrays by their names."""
    kinds = {".parquet": "Parquet table", ".mat": "MATLAB file"}
    kind = kinds.get(path.suffix.lower(), "HDF5 file" if arrays else "CSV table")
    title = f"{kind}, {len(names)} {'arrays' if arrays else 'columns'}"
    if not guess.sensors:
        listed = one_of(names).removeprefix("there is: ")
        fact = f"no gyroscope and accelerometer, and no quaternions, by their names: {listed}"
        return _Proposal(title, facts=[fact])
    time, facts = _propose_time(path, guess, arrays)
    raw = any("gyro" in signals for signals in guess.sensors.values())
    beside = _find_tables_beside(path, folder, guess, names, body) if arrays is None else {}
    head = [*([] if beside else [f"file = {_relative(path, folder)}"]), *time]
    if raw:
        head += [
            f"gyro_unit = {toml_string(guess.units['gyro'])}" if "gyro" in guess.units else GUESSED_GYRO_UNIT,
            f"accel_unit = {toml_string(guess.units.get('accel', 'm/s^2'))}",
        ]
    tables = {}
    for segment, signals in guess.sensors.items():
        lines = [f"{key} = {_listed(columns)}" for key, columns in signals.items()]
        if arrays and "orientation" in signals:
            path_ = signals["orientation"][0]
            lines[-1] += (
                f'{CHECK}x, y, z, w? if w comes first: ["{path_}[1]", "{path_}[2]", "{path_}[3]", "{path_}[0]"]'
            )
        tables[segment] = lines
    if beside:
        ((_, lines),) = tables.items()
        tables = {segment: [f"file = {file}", *lines] for segment, file in beside.items()}
        title += f", {len(beside)} files" if len(beside) > 1 else ""
        return _Proposal(title, head, tables, facts=facts)
    columns_of = {name: next(iter(signals.values()))[0] for name, signals in guess.sensors.items()}
    unknown = [name.removeprefix("?") or f"{columns_of[name]}, …" for name in tables if name.startswith("?")]
    return _Proposal(title, head, tables, facts=facts, diagnostics=_unknown_segments(path, unknown))


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
    files = {own: _relative(path, folder)}
    for file in same[:MOST_SIBLINGS]:
        segment = body.guess_segment(file.stem)
        if segment is not None and segment not in files:
            with contextlib.suppress(WeposeError):
                if read_names(file)[0] == list(names):
                    files[segment] = _relative(file, folder)
    return files


def _propose_time(path: Path, guess: Guess, arrays: ArrayFile | None) -> tuple[list[str], list[str]]:
    """Propose the lines of the time, `time` and its unit or `rate_hz`; with facts about it."""
    if not guess.times:
        stated = next(filter(None, map(_STATED_RATE.search, read_first_lines(path) if not arrays else ())), None)
        if stated:
            return [f"rate_hz = {float(stated['rate'])}"], [f"no column looks like time; the file says '{stated[0]}'"]
        return [f"rate_hz = 100.0{CHECK}no column looks like time"], ["no column looks like time: state the rate"]
    table = arrays.table({name: str(path) for name in guess.times}) if arrays else read_table(path)
    for name in guess.times:
        try:
            time = read_columns(table, [name], str(path), "time")[:, 0]
            break
        except BadData as error:  # dates, or another column of this name
            refused = error
    else:
        for name in guess.times:
            rate_hz = _rate_of_dates(table[name].cast(pl.String).str.strip_chars())
            if rate_hz:
                fact = f"'{name}' holds dates; by the first and the last of them: {rate_hz:g} Hz"
                return [f"rate_hz = {rate_hz}"], [fact]
        return [f"rate_hz = 100.0{CHECK}'{name}' holds no numbers"], [f"state the rate: {refused}"]
    steps = np.diff(time)
    step = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    named = guess.units.get(name)
    unit = named if named is not None and 0.0 < step * TIME_UNITS[named] < LONGEST_STEP_S else guess_time_unit(step)
    line, facts = f"time = {toml_string(name)}", []
    if unit not in (None, "s"):
        reason = "its name says" if unit == named else f"it grows by {step:g} from row to row"
        facts = [f"'{name}' is in {unit}, as {reason}: {1.0 / (step * TIME_UNITS[unit]):.4g} Hz"]
    first = float(np.nanmin(time)) * TIME_UNITS[unit or "s"] if np.isfinite(time).any() else 0.0
    if _YEAR_2000 < first < _YEAR_2100:
        facts.append(
            f"'{name}' counts from 1970: the recording begins at {datetime.fromtimestamp(first, UTC):%F %T} UTC"
        )
    unit_line = [] if unit in (None, "s") else [f'time_unit = "{unit}"' + ("" if unit == named else f"{CHECK}{reason}")]
    return [line, *unit_line], facts


def _rate_of_dates(column: pl.Series) -> float:
    """The rate [Hz] by the first and the last date, or time of day, of a column; 0.0 where there are none."""
    span, count = 0.0, 0
    for kind, form in ((pl.Datetime("us"), None), (pl.Time, "%T%.f")):
        with contextlib.suppress(pl.exceptions.PolarsError):  # in no form that is known
            ticks = column.str.strptime(kind, form, strict=False).cast(pl.Int64).drop_nulls().to_numpy()
            span, count = float(np.ptp(ticks)) * (1e-6 if form is None else 1e-9) if len(ticks) else 0.0, len(ticks)
        if span:
            return float(f"{(count - 1) / span:.6g}")
    return 0.0


# Contents of a recording -------------------------------------------------------------------------------------------


def find_static_intervals(recording: Recording) -> list[tuple[float, float]]:
    """Find the intervals [s], of at least `SHORTEST_STATIC_S`, in which all sensors are static but for `JOINED_S`."""
    size = max(2, round(BLOCK_S * recording.rate_hz))
    blocks = len(recording) // size
    static = np.ones(blocks, dtype=bool)
    for sensor in recording.sensors.values():
        rate = compute_rate(sensor, recording.rate_hz)[: blocks * size].reshape(blocks, size, 3)
        about = rate - rate.mean(axis=1, keepdims=True) if isinstance(sensor, ImuSensor) else rate
        static &= np.sqrt((about**2).sum(axis=2).mean(axis=1)) < STATIC_GYRO
        # A bias is below the rate of a person who rotates evenly.
        static &= np.linalg.norm(rate.mean(axis=1), axis=1) < 3.0 * STATIC_GYRO
        if isinstance(sensor, ImuSensor):
            static &= (
                np.sqrt(sensor.accel_S[: blocks * size].reshape(blocks, size, 3).var(axis=1).sum(axis=1)) < STATIC_ACCEL
            )
        if sensor.gap is not None:
            static &= ~sensor.gap[: blocks * size].reshape(blocks, size).any(axis=1)
    spans: list[tuple[float, float]] = []
    for a, b in find_runs(static):
        begin, end = float(recording.time[a * size]), float(recording.time[b * size - 1])
        spans.append((spans.pop()[0] if spans and begin - spans[-1][1] < JOINED_S else begin, end))
    return [(first, last) for first, last in spans if last - first >= SHORTEST_STATIC_S - BLOCK_S]


def _mount_comment(recording: Recording, segment: str, static: list[tuple[float, float]]) -> list[str]:
    """Write a comment with a mount to complete; gravity shows the axis that points up."""
    sensor = recording.sensors.get(segment)
    if sensor is None or sensor.aligned:
        return []
    up = "+x"
    if isinstance(sensor, ImuSensor):
        force = (
            sensor.accel_S[recording.span(static[0])] if static else sensor.accel_S[: max(1, round(recording.rate_hz))]
        )
        up = max(AXES, key=lambda axis: float(AXES[axis] @ force.mean(axis=0)))
    where = "where it is static" if static else "in the first second"
    hint = f"up as gravity says {where}; write the axis ahead for ?, without the #"
    if isinstance(sensor, OrientationSensor):
        hint = "which sensor axis is up, which forward, in the start pose? none: the segment's own orientation"
    return [f'# mount = {{ up = "{up}", forward = "?" }}   # {hint}']


def _facts(recording: Recording) -> tuple[str, ...]:
    first, last = float(recording.time[0]), float(recording.time[-1])
    facts = [f"{len(recording)} samples at {recording.rate_hz:g} Hz, {format_span((first, last))}"]
    static = find_static_intervals(recording)
    listed = ", ".join(f"{a:.1f} to {b:.1f}" for a, b in static[:8]) + (" …" if len(static) > 8 else "")
    facts.append(f"all sensors static [s]: {listed}" if static else "all sensors are never static for a second")
    for name, spans in recording.phases.items():
        listed = ", ".join(f"{format_time(a)} to {format_time(b)}" for a, b in spans)
        facts.append(f"phase {name} [s]: {listed or 'none'}")
    return tuple(facts)


def _rows(recording: Recording, labels: Mapping[str, str]) -> tuple[tuple[str, ...], ...]:
    rows = []
    for segment, sensor in recording.sensors.items():
        if isinstance(sensor, ImuSensor):
            fast = f"{np.degrees(np.linalg.norm(sensor.gyro_S, axis=1).max()):.0f} deg/s"
            gravity = f"{np.median(np.linalg.norm(sensor.accel_S, axis=1)):.2f} m/s²"
            holds = "gyro, accel"
        else:
            fast = f"{np.degrees(np.linalg.norm(compute_rate(sensor, recording.rate_hz), axis=1).max()):.0f} deg/s"
            holds, gravity = "segment's orientation" if sensor.aligned else "orientation", ""
        lost = find_runs(sensor.gap) if sensor.gap is not None else []
        longest = max((b - a for a, b in lost), default=0) / recording.rate_hz
        gaps = f"{len(lost)}, up to {longest:.2f} s" if lost else "none"
        named = (
            ("?", labels.get(segment, segment[1:])) if segment.startswith("?") else (segment, labels.get(segment, ""))
        )
        rows.append((*named, holds, fast, gravity, gaps))
    return tuple(rows)


def _relative(path: Path, folder: Path) -> str:
    return toml_string(Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix())


def _listed(names: list[str]) -> str:
    return toml_string(names[0]) if len(names) == 1 else toml_strings(names)
