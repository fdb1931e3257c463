"""What a file is, for `wepose info`. For data a session is proposed, and read: what is said of it was seen in it."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadData, MissingFile, WeposeError, one_of
from ..recording import AXES, SEGMENTS, Recording, Sensor, format_time, span_text
from .arrays import ArrayFile, is_array_file
from .clocks import SLOWEST_STEP_S, TIME_UNITS, runs
from .device import Device
from .formats import TITLES, format_of, read_device
from .guess import Guess, guess_arrays, guess_columns
from .keys import is_number, read_toml
from .session import SessionReader
from .tables import FORMATS as TABLES
from .tables import Rows, columns, read_table

# A sensor rests where over `BLOCK_S` its rate varies by less [rad/s] and its specific force [m/s²]: a person who stands
# sways below.
BLOCK_S, REST_GYRO, REST_ACCEL = 0.25, np.deg2rad(3.0), 0.4
SHORTEST_REST_S = 1.0
MOST_SIBLINGS = 20
CHECK = "   # CHECK: "


class Description(NamedTuple):
    """What `wepose info` says of a file."""

    what: str  # in a line
    facts: tuple[str, ...]  # a line each
    sensors: tuple[tuple[str, ...], ...]  # segment, its name in the file, what it holds, rate, time, gaps
    session: str | None  # a ready session file, for data


def describe(path: Path, folder: Path | None = None) -> Description:
    """What a file or folder is; a session that is proposed is to stand in `folder`, the file's own by default.

    Raises
    ------
    WeposeError
        Not there, damaged, or of no kind that is known here.
    """
    if not path.exists():
        raise MissingFile(f"{path}: no such file or folder")
    if path.is_dir() and (path / "pose.parquet").is_file():
        return _result(path)
    if path.is_dir() and format_of(path) is None:
        named = next((path / name for name in ("session.toml", "subject.toml") if (path / name).is_file()), None)
        if named is None:
            raise MissingFile(
                f"{path}: a folder without session.toml, subject.toml, pose.parquet or an x-IMU3's Inertial.csv; name "
                f"a file"
            )
        path = named
    if path.suffix.lower() == ".toml":
        return _toml(path)
    folder = folder or path.absolute().parent
    format = format_of(path)
    if format:
        return _described(path, folder, *_of_devices(path, folder, format))
    if is_array_file(path):
        arrays = ArrayFile(path)
        return _described(
            path, folder, *_of_columns(path, folder, guess_arrays(arrays.shapes), list(arrays.shapes), arrays)
        )
    if path.suffix.lower() in TABLES:
        names = Rows(path).names
        if any(re.fullmatch(r"(left|right)_(elbow|wrist|hand)_x", name) for name in names):
            return Description(f"{path}: a pose, as `wepose track` writes it: {len(names)} columns", (), (), None)
        return _described(path, folder, *_of_columns(path, folder, guess_columns(names), names, None))
    known = (
        ".toml, .csv, .parquet, .mvnx, .txt (MT Manager), .sto, .h5, .hdf5, .mat; a result's folder, an x-IMU3's folder"
    )
    raise BadData(f"{path}: is nothing that is known here; there is: {known}")


# Files that hold no data -------------------------------------------------------------------------------------------


def _result(path: Path) -> Description:
    try:
        summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        summary = None
    if not isinstance(summary, dict):
        return Description(f"{path}: a result of `wepose track`, without a summary.json that can be read", (), (), None)
    said = {key: summary.get(key) for key in ("recording", "method", "rate_hz", "duration_s", "samples")}
    facts = [
        f"of {said['recording']}, by {said['method']}: {said['samples']} samples, {said['duration_s']} s at "
        f"{said['rate_hz']} Hz",
        *(f"note: {warning}" for warning in _texts(summary.get("warnings"))),
    ]
    if (path / "joints.parquet").is_file():
        facts[1:1] = [f"of a chain, sensors on: {', '.join(_texts(summary.get('not_followed_rms_deg')))}"]
        return Description(f"{path}: a result of `wepose track`", (*facts, "its motion: joints.parquet"), (), None)
    facts[1:1] = [
        f"sensors: {', '.join(_texts(summary.get('sensors')))}",
        f"points: {', '.join(_texts(summary.get('points')))}",
    ]
    facts.append(f"look at it: wepose view {path}")
    return Description(f"{path}: a result of `wepose track`", tuple(facts), (), None)


def _texts(value: object) -> list[str]:
    return [str(item) for item in value] if isinstance(value, list | dict) else []


def _toml(path: Path) -> Description:
    values = read_toml(path, "a session or a subject")
    if "data" in values or "sensors" in values:
        recording = SessionReader(path, gaps=True)
        whole = recording.recording(0, len(recording.time))
        what = f"{path}: a session, '{whole.name}'"
        return Description(what, _facts(whole), _rows(whole, {}), None)
    if isinstance(values.get("lengths"), dict):
        lengths = {name: length for name, length in values["lengths"].items() if is_number(length)}
        facts = ["lengths [mm]: " + ", ".join(f"{name} {1e3 * length:.0f}" for name, length in lengths.items())]
        mounts = ", ".join(_texts(values.get("mounts")))
        facts.append(f"mounts: {mounts}" if mounts else "no calibrated mounts")
        return Description(f"{path}: a subject, '{values.get('name', '')}'", tuple(facts), (), None)
    raise BadData(f"{path}: TOML, but neither a session ([data], [sensors.…]) nor a subject ([lengths])")


# Data: a session is proposed ---------------------------------------------------------------------------------------


def _described(
    path: Path,
    folder: Path,
    what: str,
    notes: list[str],
    head: list[str],
    tables: dict[str, list[str]],
    labels: Mapping[str, str],
) -> Description:
    """The description of data for which `head` ([data] of a session) and `tables` ([sensors.…]) are proposed."""
    notes = list(notes)
    if not tables:
        return Description(f"{path}: {what}", tuple(notes), (), None)
    text = _session_text(path, head, [], tables, {})
    recording: Recording | None = None
    for _ in range(3):
        try:
            reader = SessionReader(folder / "session.toml", gaps=True, values=tomllib.loads(text))
            recording = reader.recording(0, len(reader.time))
            break
        except WeposeError as error:
            # What is wrong with a unit the reader knows better than any guess from names.
            fits = re.search(r'data\.(gyro_unit|accel_unit) = ("[^"]+") would fit', str(error))
            if not fits:
                notes.append(f"cannot be read so: {str(error).removeprefix(str(folder / 'session.toml') + ': ')}")
                break
            head = [f"{fits[1]} = {fits[2]}" if line.startswith(fits[1]) else line for line in head]
            text = _session_text(path, head, [], tables, {})
    if recording is None:
        return Description(f"{path}: {what}", tuple(notes), (), text)
    still = rests(recording)
    comments = {segment: _mount_comment(recording, segment, still) for segment in tables}
    text = _session_text(path, head, still, tables, comments)
    return Description(f"{path}: {what}", (*notes, *_facts(recording)), _rows(recording, labels), text)


def _session_text(
    path: Path,
    head: list[str],
    still: list[tuple[float, float]],
    tables: Mapping[str, list[str]],
    comments: Mapping[str, list[str]],
) -> str:
    lines = [f"name = {_quoted(path.stem)}", 'start_pose = "n_pose"', "", "[data]", *head, "", "[phases]   # seconds"]
    if still and still[0][1] - still[0][0] >= SHORTEST_REST_S:
        first, last = still[0]
        lines.append(f"start = [[{first:.2f}, {last:.2f}]]{CHECK}all sensors rest there; is it the start pose?")
    else:
        lines.append("# start = [[0.5, 4.5]]   # name the seconds in which the person stands still in the start pose")
    for segment in sorted(tables, key=lambda name: SEGMENTS.index(name) if name in SEGMENTS else 99):
        commented = segment not in SEGMENTS
        table = [f"[sensors.{'SEGMENT' if commented else segment}]", *tables[segment], *comments.get(segment, [])]
        lines += ["", *(f"# {line}" if commented else line for line in table)]
    return "\n".join(lines) + "\n"


def _of_devices(
    path: Path, folder: Path, format: str
) -> tuple[str, list[str], list[str], dict[str, list[str]], dict[str, str]]:
    """What a known format's file holds; with those beside it where the device wrote one a sensor."""
    device = read_device(path, format)
    title = (
        f"{TITLES[format]}, {'gyroscope and accelerometer' if device.kind == 'raw' else 'orientations, no raw data'}"
    )
    if len(device.labels) > 1 or format in ("mvnx", "opensim"):
        tables: dict[str, list[str]] = {}
        for label, segment in device.labels.items():
            where = segment if segment and segment not in tables else f"?{label}"
            tables[where] = [f"label = {_quoted(label)}"]
        labels = {segment: str(device_label) for device_label, segment in device.labels.items() if segment}
        unknown = [label for label, segment in device.labels.items() if segment is None]
        notes = [f"segments of these are not known by their names: {', '.join(unknown)}"] if unknown else []
        return title, notes, [f"file = {_relative(path, folder)}"], tables, labels
    tables, labels, notes = {}, {}, []
    for file in _siblings(path, format):
        its = device if file == path else _try(file, format, notes)
        if its is None:
            continue
        (label, segment), *_ = its.labels.items()
        where = segment if segment and segment not in tables else f"?{file.name}"
        tables[where] = [f"file = {_relative(file, folder)}"]
        labels[where] = label
    if not any(name in SEGMENTS for name in tables):
        # Nothing names a segment: the file that was asked about stands for the torso until somebody says better.
        key = f"?{path.name}"
        tables["torso"] = [tables.pop(key)[0] + f"{CHECK}which segment?"]
        labels["torso"] = labels.pop(key)
    unknown = [name.removeprefix("?") for name in tables if name.startswith("?")]
    if unknown:
        notes.append(f"which segment is not said by the names of: {', '.join(unknown)}")
    if format not in ("mvnx", "opensim") and len(tables) - len(unknown) > 1:
        title += f", {len(tables) - len(unknown)} files"
    return title, notes, [f'format = "{format}"'], tables, labels


def _siblings(path: Path, format: str) -> list[Path]:
    """The file, and those beside it of the same format: one recording's files lie together."""
    if path.is_dir() or path.name in ("Inertial.csv", "Quaternion.csv"):
        own = path if path.is_dir() else path.parent
        beside = [folder for folder in sorted(own.absolute().parent.iterdir()) if folder.is_dir()]
        same = [own if folder == own.absolute() else folder for folder in beside]
    else:
        same = [file for file in sorted(path.parent.iterdir()) if file.suffix == path.suffix and file.is_file()]
    found = [file for file in same[: 10 * MOST_SIBLINGS] if file == path or format_of(file) == format]
    return found[:MOST_SIBLINGS] if path in found[:MOST_SIBLINGS] else [path]


def _try(file: Path, format: str, notes: list[str]) -> Device | None:
    try:
        return read_device(file, format)
    except WeposeError as error:
        notes.append(f"left out: {error}")
        return None


def _of_columns(
    path: Path, folder: Path, guess: Guess, names: list[str], arrays: ArrayFile | None
) -> tuple[str, list[str], list[str], dict[str, list[str]], dict[str, str]]:
    """A table whose columns, or arrays, are told by their names."""
    kind = {".parquet": "Parquet table", ".csv": "CSV table", ".mat": "MATLAB file"}.get(
        path.suffix.lower(), "HDF5 file"
    )
    title = f"{kind}, {len(names)} {'arrays' if arrays else 'columns'}"
    if not guess.sensors:
        listed = one_of(names).removeprefix("there is: ")
        return title, [f"no gyroscope and accelerometer, and no quaternions, by their names: {listed}"], [], {}, {}
    time, note = _time(path, guess.time, arrays)
    raw = any("gyro" in signals for signals in guess.sensors.values())
    head = [f"file = {_relative(path, folder)}", time]
    if raw:
        head += [
            f'gyro_unit = "{"deg/s" if guess.degrees else "rad/s"}"',
            f'accel_unit = "{"g" if guess.g else "m/s^2"}"',
        ]
    check = "" if guess.sure else f"{CHECK}which segment?"
    tables = {}
    for segment, signals in guess.sensors.items():
        lines = [f"{key} = {_listed(columns)}" for key, columns in signals.items()]
        if arrays and "orientation" in signals:
            path_ = signals["orientation"][0]
            lines[-1] += (
                f'{CHECK}x, y, z, w? if w comes first: ["{path_}[1]", "{path_}[2]", "{path_}[3]", "{path_}[0]"]'
            )
        lines[0] += check if segment == "torso" else ""
        tables[segment] = lines
    unknown = [name.removeprefix("?") for name in tables if name.startswith("?")]
    if unknown:
        note = [*note, f"which segment is not said by the names of: {', '.join(unknown)}"]
    return title, note, head, tables, {}


def _time(path: Path, name: str | None, arrays: ArrayFile | None) -> tuple[str, list[str]]:
    """The line that says the time, `time` or `rate_hz`, and what to tell of it."""
    if name is None:
        return f"rate_hz = 100.0{CHECK}no column looks like time", ["no column looks like time: state the rate"]
    table = arrays.table({name: str(path)}) if arrays else read_table(path)
    time = columns(table, [name], str(path), "time")[:, 0]
    steps = np.diff(time)
    step = float(np.nanmedian(steps)) if len(steps) else 0.0
    if not step > SLOWEST_STEP_S:
        return f"time = {_quoted(name)}", []
    for unit, seconds in TIME_UNITS:
        if 1e-4 < step * seconds < SLOWEST_STEP_S:
            rate = round(1.0 / (step * seconds), 3)
            note = f"'{name}' is in {unit}, a session wants seconds: a rate stands for it, and lost rows go unseen"
            return f"rate_hz = {rate:g}{CHECK}'{name}' is in {unit}; divide it and name it as time", [note]
    return f"time = {_quoted(name)}", []


# What a recording holds --------------------------------------------------------------------------------------------


def rests(recording: Recording) -> list[tuple[float, float]]:
    """Intervals [s] of at least `SHORTEST_REST_S` in which all sensors keep still."""
    size = max(2, round(BLOCK_S * recording.rate_hz))
    blocks = len(recording) // size
    still = np.ones(blocks, dtype=bool)
    for sensor in recording.sensors.values():
        rate, force = _rate(sensor, recording.rate_hz)[: blocks * size].reshape(blocks, size, 3), sensor.accel_S
        about = rate if sensor.ready else rate - rate.mean(axis=1, keepdims=True)
        still &= np.sqrt((about**2).sum(axis=2).mean(axis=1)) < REST_GYRO
        # A bias is below the rate of whoever turns evenly.
        still &= np.linalg.norm(rate.mean(axis=1), axis=1) < 3.0 * REST_GYRO
        if force is not None:
            still &= np.sqrt(force[: blocks * size].reshape(blocks, size, 3).var(axis=1).sum(axis=1)) < REST_ACCEL
        if sensor.gap is not None:
            still &= ~sensor.gap[: blocks * size].reshape(blocks, size).any(axis=1)
    spans = [(float(recording.time[a * size]), float(recording.time[b * size - 1])) for a, b in runs(still)]
    return [(first, last) for first, last in spans if last - first >= SHORTEST_REST_S - BLOCK_S]


def _rate(sensor: Sensor, rate_hz: float) -> np.ndarray:
    if sensor.gyro_S is not None:
        return sensor.gyro_S
    R = Rotation.from_quat(sensor.quat_WS)
    turned = (R[:-1].inv() * R[1:]).as_rotvec() * rate_hz
    return np.concatenate([turned[:1], turned])


def _mount_comment(recording: Recording, segment: str, still: list[tuple[float, float]]) -> list[str]:
    """A mount to be filled in; which axis is up, gravity says."""
    sensor = recording.sensors.get(segment)
    if sensor is None or sensor.aligned:
        return []
    up = "+x"
    if sensor.accel_S is not None:
        rest = sensor.accel_S[recording.span(still[0])] if still else sensor.accel_S[: max(1, round(recording.rate_hz))]
        up = max(AXES, key=lambda axis: float(AXES[axis] @ rest.mean(axis=0)))
    forward = "-z" if up[1] != "z" else "+x"
    said = f"up as gravity says {'at rest' if still else 'in the first second'}; which axis is forward?"
    if sensor.accel_S is None:
        said = "which sensor axis is up, which forward, in the start pose? none: the segment's own orientation"
    return [f'# mount = {{ up = "{up}", forward = "{forward}" }}   # {said}']


def _facts(recording: Recording) -> tuple[str, ...]:
    first, last = float(recording.time[0]), float(recording.time[-1])
    facts = [f"{len(recording)} samples at {recording.rate_hz:g} Hz, {span_text((first, last))}"]
    still = rests(recording)
    listed = ", ".join(f"{a:.1f} to {b:.1f}" for a, b in still[:8]) + (" …" if len(still) > 8 else "")
    facts.append(f"all sensors at rest [s]: {listed}" if still else "never are all sensors at rest for a second")
    for name, spans in recording.phases.items():
        listed = ", ".join(f"{format_time(a)} to {format_time(b)}" for a, b in spans)
        facts.append(f"phase {name} [s]: {listed or 'none'}")
    facts += [f"note: {note}" for note in recording.notes]
    return tuple(facts)


def _rows(recording: Recording, labels: Mapping[str, str]) -> tuple[tuple[str, ...], ...]:
    rows = []
    for segment, sensor in recording.sensors.items():
        if sensor.accel_S is not None:
            assert sensor.gyro_S is not None
            fast = f"{np.degrees(np.linalg.norm(sensor.gyro_S, axis=1).max()):.0f} deg/s"
            gravity = f"{np.median(np.linalg.norm(sensor.accel_S, axis=1)):.2f} m/s²"
            holds = "gyro, accel"
        else:
            fast = f"{np.degrees(np.linalg.norm(_rate(sensor, recording.rate_hz), axis=1).max()):.0f} deg/s"
            holds, gravity = "segment's orientation" if sensor.aligned else "orientation", ""
        lost = runs(sensor.gap) if sensor.gap is not None else []
        longest = max((b - a for a, b in lost), default=0) / recording.rate_hz
        gaps = f"{len(lost)}, up to {longest:.2f} s" if lost else "none"
        rows.append((segment, labels.get(segment, ""), holds, fast, gravity, gaps))
    return tuple(rows)


def _relative(path: Path, folder: Path) -> str:
    return _quoted(Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix())


def _listed(names: list[str]) -> str:
    return _quoted(names[0]) if len(names) == 1 else f"[{', '.join(_quoted(name) for name in names)}]"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
