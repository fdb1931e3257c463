"""What a file is, for `wepose info`, and a session for data that have none.

The session is proposed from what files say, and from what names and motion suggest; what the user has to check is
marked. Data are described by what it reads.
"""

import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..body import BodyTable, load_table
from ..data_tables import FORMATS as TABLES
from ..data_tables import read_first_lines, read_names, read_table, read_times
from ..diagnostics import Diagnostic
from ..documents import is_number, read_toml
from ..errors import BadData, MissingFile, MissingRate, WeposeError, WrongUnit, one_of
from ..recording import AXES, CONFIGURATION, ImuSensor, Recording, compute_rate
from ..recording.clocks import TIME_UNITS, guess_time_unit
from ..recording.intervals import Intervals, find_runs, format_span, format_time
from ..recording.limits import LONGEST_STEP_S
from . import format_keys, read_session
from .arrays import ArrayFile, is_array_file
from .device import Device
from .guess import Guess, guess_arrays, guess_columns
from .live_log import read_live_log
from .reference import read_reference
from .registry import detect_format, look_up_format, read_device

# A line of a file that says its rate.
_STATED_RATE = re.compile(r"(sampl\w*|frame|data)[ _]*(frequency|rate)[^0-9]{0,12}(?P<rate>\d+(\.\d+)?)", re.IGNORECASE)
ASSUMED_RATE_HZ = 100.0
# A sensor is static where its rate [rad/s] and specific force [m/s²] vary by less over `BLOCK_S`; the sway of a
# standing person is below.
BLOCK_S, STATIC_GYRO, STATIC_ACCEL = 0.25, np.deg2rad(3.0), 0.4
SHORTEST_STATIC_S = 1.0
MOST_SIBLINGS = 50


@dataclass
class Description:
    """What a file is; of data the session that is proposed for them."""

    path: Path
    title: str  # kind of file
    facts: list[str] = field(default_factory=list)  # one line each
    recording: Recording | None = None  # by the session, also by the proposed one; None: it cannot be read
    data: dict[str, Any] = field(default_factory=dict)  # proposed keys of [data]
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)  # segment, or "?" and a name of the file → keys
    checks: dict[str, str] = field(default_factory=dict)  # key → what the user has to check there
    phases: Mapping[str, Intervals] = field(default_factory=dict)  # that the file states
    session: str | None = None  # the text of the proposed session
    then: str = ""  # advice on it

    @property
    def diagnostics(self) -> list[Diagnostic]:
        """Those of the recording; a sensor on an unknown segment has its name in the file."""
        listed = () if self.recording is None else self.recording.diagnostics
        return [replace(each, place=each.place.removeprefix("?")) for each in listed]

    def list_sensors(self) -> Iterator[tuple[str, ...]]:
        """List segment, name in the file, signals, peak rate, median specific force and gaps of each sensor."""
        if self.recording is None:
            return
        rate_hz = self.recording.rate_hz
        for segment, sensor in self.recording.sensors.items():
            fastest = np.degrees(np.linalg.norm(compute_rate(sensor, rate_hz), axis=1).max())
            holds, gravity = "segment's orientation" if sensor.aligned else "orientation", ""
            if isinstance(sensor, ImuSensor):
                holds, gravity = "gyro, accel", f"{np.median(np.linalg.norm(sensor.accel_S, axis=1)):.2f} m/s²"
            lost = [b - a for a, b in find_runs(sensor.gap)] if sensor.gap is not None else []
            gaps = f"{len(lost)}, up to {max(lost) / rate_hz:.2f} s" if lost else "none"
            unknown, own = segment.startswith("?"), self.sensors.get(segment, {})
            label = own.get("label") or own.get("file") or (segment[1:] if unknown else "")
            yield "?" if unknown else segment, label, holds, f"{fastest:.0f} deg/s", gravity, gaps


def find_file(path: Path, body: BodyTable | None = None) -> tuple[Path, list[Path]]:
    """Find what is described of a path: the session or subject in a folder, or the first recording of those in it.

    A file, a result, and a folder that is one recording are returned as they are.
    """
    if not path.is_dir() or (path / "pose.parquet").is_file():
        return path, []
    named = next((path / name for name in ("session.toml", "subject.toml") if (path / name).is_file()), None)
    if named is not None or detect_format(path) is not None:
        return named or (path if path.name else path.absolute()), []  # beside "." nothing is found
    files = [file for file in sorted(path.iterdir()) if file.is_file()]
    data = [file for file in files if file.suffix.lower() in TABLES or is_array_file(file) or detect_format(file)]
    if not data:
        raise MissingFile(f"{path}: a folder without session.toml, and without a recording in it; name a file")
    body = body or load_table()
    return next((file for file in data if body.guess_segment(file.stem)), data[0]), data


def describe_file(
    path: Path, folder: Path | None = None, body: BodyTable | None = None, model: Path | None = None
) -> Description:
    """Describe a file or folder, as `find_file` returns it.

    Parameters
    ----------
    folder : for which a session is proposed; None: that of the file
    body : that carries the sensors; None: the upper body
    model : its file, or its name in the package, as the session is to name it
    """
    if not path.exists():
        raise MissingFile(f"{path}: no such file or folder")
    suffix = path.suffix.lower()
    if path.is_dir() and (path / "pose.parquet").is_file():
        return Description(path, "a result of `wepose track`", [f"look at it: wepose view {path}"])
    if suffix == ".toml":
        return _describe_toml(path)
    if suffix in (".c3d", ".trc"):
        return _describe_reference(path)
    folder, body = folder or path.absolute().parent, body or load_table()
    if format := detect_format(path):
        about = _propose_from_device(path, folder, format, body)
    elif is_array_file(path):
        about = _propose_from_names(path, folder, body, ArrayFile(path))
    else:
        names = read_names(path)[0] if suffix in TABLES else []
        if len(names) <= (suffix == ".txt"):  # a text that is no table has one column
            raise BadData(f"{path}: is nothing that is known here; docs/formats.md lists the files that are read")
        if any(f"{point}_x" in names for point in body.points):
            return Description(path, f"a pose, as `wepose track` writes it: {len(names)} columns")
        about = _propose_from_names(path, folder, body, None)
    if about.sensors:
        _read_proposed(about, folder)
        about.session, about.then = _format_session(about, folder, body, model), _advise(about, body)
        if about.recording is not None:
            about.facts += _list_facts(about.recording)
    return about


def _read_proposed(about: Description, folder: Path) -> None:
    """Read the recording as the session would, also sensors on unknown segments, and settle units."""
    for _ in range(3):
        values = {"start_pose": CONFIGURATION, "data": about.data, "sensors": about.sensors}
        try:
            about.recording = read_session(folder / "session.toml", True, values)
            break
        except WrongUnit as error:  # the reader's check of units is better than a guess from names
            about.data[error.key] = error.unit
            about.checks.pop(error.key, None)
        except WeposeError as error:
            about.facts.append(f"as the session proposes it, it cannot be read: {error}")
            break


def _advise(about: Description, body: BodyTable) -> str:
    if about.recording is None:
        return "mend what cannot be read"
    sensors, then = about.recording.sensors, "run wepose track SESSION -o result"
    if not all(sensor.aligned or sensor.stated_quat_LS is not None for sensor in sensors.values()):
        calibrate = "add the seconds of clasp to [phases] and run wepose calibrate SESSION -o subject"
        then = f"{calibrate}; or state the mounts and {then}"
    if not set(sensors) <= set(body.segments):
        then = f"remove the # from the lines of each sensor with ? and replace SEGMENT by its segment; then {then}"
    return then


def _describe_reference(path: Path) -> Description:
    reference = read_reference(path)
    rate_hz = (len(reference.time) - 1) / float(reference.time[-1] - reference.time[0])
    facts = [f"{len(reference.time)} samples at {rate_hz:.6g} Hz, {format_span(reference.time[[0, -1]])}"]
    for name, known in (("joints", reference.points), ("segments", reference.quat_VT)):
        facts.append(f"{name}: {', '.join(known) or 'none'}")
    facts.append(f"compare a result with it: wepose evaluate RESULT {path}")
    what = "rotations" if reference.own_frames else "markers"
    return Description(path, f"{what}, a reference for `wepose evaluate`", facts)


def _describe_toml(path: Path) -> Description:
    values = read_toml(path, "a session or a subject")
    if "data" in values or "sensors" in values:
        recording = read_session(path, gaps=True)
        return Description(path, f"a session, '{recording.name}'", _list_facts(recording), recording)
    if isinstance(values.get("lengths"), dict):
        lengths = {name: length for name, length in values["lengths"].items() if is_number(length)}
        facts = ["lengths [mm]: " + ", ".join(f"{name} {1e3 * length:.0f}" for name, length in lengths.items())]
        mounts = ", ".join(values.get("mounts") or ())
        facts.append(f"mounts: {mounts}" if mounts else "no calibrated mounts")
        facts += [f"quality of the calibration: {quality}"] if (quality := values.get("quality")) else []
        return Description(path, f"a subject, '{values.get('name', '')}'", facts)
    raise BadData(f"{path}: TOML, but neither a session ([data], [sensors.…]) nor a subject ([lengths])")


def _list_facts(recording: Recording) -> list[str]:
    facts = [f"{len(recording)} samples at {recording.rate_hz:g} Hz, {format_span(recording.time[[0, -1]])}"]
    static = _find_static_intervals(recording)
    listed = ", ".join(f"{a:.1f} to {b:.1f}" for a, b in static[:8]) + (" …" if len(static) > 8 else "")
    facts.append(
        f"all sensors static [s]: {listed}" if static else "there is no second in which all sensors are static"
    )
    for name, spans in recording.phases.items():
        listed = ", ".join(f"{format_time(a)} to {format_time(b)}" for a, b in spans)
        facts.append(f"phase {name} [s]: {listed or 'none'}")
    return facts


def _find_static_intervals(recording: Recording) -> list[tuple[float, float]]:
    """Find the intervals [s], of at least `SHORTEST_STATIC_S`, in which all sensors are static."""
    size = max(2, round(BLOCK_S * recording.rate_hz))
    static = np.ones(len(recording) // size, dtype=bool)

    def split(values: np.ndarray) -> np.ndarray:
        return values[: len(static) * size].reshape(len(static), size, *values.shape[1:])

    for sensor in recording.sensors.values():
        rate = split(compute_rate(sensor, recording.rate_hz))
        mean = rate.mean(axis=1, keepdims=True)
        # A bias is below the rate of a person who rotates evenly.
        static &= np.linalg.norm(mean[:, 0], axis=1) < 3.0 * STATIC_GYRO
        if isinstance(sensor, ImuSensor):
            static &= split(sensor.accel_S).var(axis=1).sum(axis=1) < STATIC_ACCEL**2
            rate = rate - mean
        static &= (rate**2).mean(axis=1).sum(axis=1) < STATIC_GYRO**2
        if sensor.gap is not None:
            static &= ~split(sensor.gap).any(axis=1)
    spans = [(float(recording.time[a * size]), float(recording.time[b * size - 1])) for a, b in find_runs(static)]
    return [(first, last) for first, last in spans if last - first >= SHORTEST_STATIC_S - BLOCK_S]


def _relative(path: Path, folder: Path) -> str:
    """Return a path as a session in a folder names it."""
    return Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix()


# From files of a known format ----------------------------------------------------------------------------------------


def _propose_from_device(path: Path, folder: Path, name: str, body: BodyTable) -> Description:
    """Propose a session for a file of a known format, with the files beside it where each sensor has one."""
    format = look_up_format(name)
    device = _read(path, name)[0]
    signals = "gyroscope and accelerometer" if device.kind == "raw" else "orientations, no raw data"
    about = Description(path, f"{format.title}, {signals}")
    files = [path]
    if whole := len(device.sensors) > 1 or format.whole:
        about.data["file"] = _relative(path, folder)
    else:  # those of one recording are in one folder
        about.data["format"] = _relative(Path(name), folder) if name.endswith(".toml") else name
        own = path.parent if path.is_file() and format.folder and path.suffix.lower() == ".csv" else path
        siblings = [file for file in _list_files_like(own) if file == own or detect_format(file) == name]
        files = siblings if path in siblings else [path]
    for file in files:
        try:
            device, lacks_rate = _read(file, name)
        except WeposeError as error:
            about.facts.append(f"{file.name} is left out, as it cannot be read: {error}")
            continue
        if lacks_rate:
            about.data["rate_hz"], about.checks["rate_hz"] = ASSUMED_RATE_HZ, "the file does not say its rate"
        for label, sensor in device.sensors.items():
            names = (label, file.stem) if len(device.sensors) == 1 else (label,)
            guesses = (sensor.segment, *map(body.guess_segment, names))
            segment = next((each for each in guesses if each in body.segments), None)
            known = segment is not None and segment not in about.sensors
            where = str(segment) if known else f"?{label if whole else file.name}"
            about.sensors[where] = {"label": label} if whole else {"file": _relative(file, folder)}
    if not whole and len(about.sensors) > 1:
        about.title += f", {len(about.sensors)} files"
    if name == "wepose_live":
        log = read_live_log(path)
        about.facts.append(f"of {log.header['name']}, live by {log.header['method']}: {len(log.quat_WL)} poses")
        about.facts.append(f"to track it as it was live: wepose track {path} -o result; to change its phases: --write")
        about.phases = log.recording.phases
    return about


def _read(path: Path, format: str) -> tuple[Device, bool]:
    """Read a device's file; and whether it does not state its rate."""
    try:
        return read_device(path, format), False
    except MissingRate:
        return read_device(path, format, None, ASSUMED_RATE_HZ), True


def _list_files_like(path: Path) -> list[Path]:
    siblings = [path.parent / file.name for file in sorted(path.absolute().parent.iterdir())]
    if path.is_dir():
        return [each for each in siblings if each.is_dir()][:MOST_SIBLINGS]
    return [each for each in siblings if each.is_file() and each.suffix == path.suffix][:MOST_SIBLINGS]


# From names of columns or arrays -----------------------------------------------------------------------------------


def _propose_from_names(path: Path, folder: Path, body: BodyTable, content: ArrayFile | None) -> Description:
    """Propose a session for a table, or for the arrays of a file, by their names."""
    if content is None:
        names, units = read_names(path)
        guess, kind = guess_columns(names, body, units), "Parquet" if path.suffix.lower() == ".parquet" else "CSV"
        about = Description(path, f"{kind} table, {len(names)} columns")
    else:
        names = list(content.shapes)
        guess, kind = guess_arrays(content.shapes, body), "MATLAB" if path.suffix.lower() == ".mat" else "HDF5"
        about = Description(path, f"{kind} file, {len(names)} arrays")
    if not guess.sensors:
        if content is None and all(re.fullmatch(r"[-+.,\deE\s]*", name) for name in names):
            needed = "write the names of the columns above it; commas, semicolons or tabs separate them"
            raise BadData(f"{path}: the first line holds numbers; {needed}")
        listed = one_of(names).removeprefix("there is: ")
        about.facts.append(f"no gyroscope and accelerometer, and no quaternions, by their names: {listed}")
        return about
    _propose_time(about, guess, content)
    if any("gyro" in signals for signals in guess.sensors.values()):
        about.data["gyro_unit"] = guess.units.get("gyro", "rad/s")
        if "gyro" not in guess.units:
            about.checks["gyro_unit"] = "assumed, as the file states no unit; the motion does not contradict it"
        about.data["accel_unit"] = guess.units.get("accel", "m/s^2")
    for segment, signals in guess.sensors.items():
        about.sensors[segment] = {name: own if len(own) > 1 else own[0] for name, own in signals.items()}
        if content and "orientation" in signals:
            about.checks["orientation"] = "x, y, z, w? if w comes first, name its columns [1], [2], [3], [0]"
    # A table with one sensor, whose columns name no segment, has others beside it with the same columns.
    name, keys = next(iter(about.sensors.items()))
    if content is None and len(guess.sensors) == 1 and name.startswith("?"):
        files: dict[str, Path] = {}
        for file in (path, *_list_files_like(path)):
            with contextlib.suppress(WeposeError):
                if file == path or read_names(file)[0] == names:
                    files.setdefault(body.guess_segment(file.stem) or f"?{file.name}", file)
        about.sensors = {segment: {"file": _relative(file, folder), **keys} for segment, file in files.items()}
        about.title += f", {len(files)} files" if len(files) > 1 else ""
    else:
        about.data = {"file": _relative(path, folder), **about.data}
    return about


def _propose_time(about: Description, guess: Guess, arrays: ArrayFile | None) -> None:
    """Propose `time` and its unit, or `rate_hz`; with facts about it."""
    place, data = str(about.path), about.data
    table = arrays.table(dict.fromkeys(guess.times, place)) if arrays else read_table(about.path)
    for name in guess.times:
        with contextlib.suppress(BadData):  # text, or another column of this name
            time = read_times(table, name, place, "time")
            break
    else:
        lines = () if arrays else read_first_lines(about.path)
        missing = f"'{guess.times[0]}' holds no times" if guess.times else "no column looks like time"
        if stated := next(filter(None, map(_STATED_RATE.search, lines)), None):
            data["rate_hz"] = float(stated["rate"])
            about.facts.append(f"{missing}; the file says '{stated[0]}'")
        else:
            data["rate_hz"], about.checks["rate_hz"] = ASSUMED_RATE_HZ, f"a guess, as {missing}"
            about.facts.append(f"{ASSUMED_RATE_HZ:g} Hz is a guess, as {missing}")
        return
    steps = np.diff(time)
    if len(guess.sensors) == 1 and (steps <= 0.0).any():
        for other in (column for column in table.drop(name) if 1 < column.n_unique() <= MOST_SIBLINGS):
            rows = pl.DataFrame([pl.Series("time", time), other.alias("sensor")])
            if rows.select((pl.col("time").diff().over("sensor") > 0.0).all()).item():
                needed = "write a file for each sensor, named as its segment (torso.csv)"
                raise BadData(f"{place}: rows of several sensors, told apart by '{other.name}'; {needed}")
    step = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    named = guess.units.get(name)
    unit = named if named is not None and 0.0 < step * TIME_UNITS[named] < LONGEST_STEP_S else guess_time_unit(step)
    data["time"] = name
    if unit not in (None, "s"):
        reason = "its name says" if unit == named else f"it grows by {step:g} from row to row"
        about.facts.append(f"'{name}' is in {unit}, as {reason}: {1.0 / (step * TIME_UNITS[unit]):.4g} Hz")
        data["time_unit"] = unit
        if unit != named:
            about.checks["time_unit"] = reason


# Text of the session ---------------------------------------------------------------------------------------------


def _format_session(about: Description, folder: Path, body: BodyTable, model: Path | None) -> str:
    """Format the session as TOML; sensors on unknown segments are in comments.

    `model` is the body's file, or its name in the package; None: the upper body's.
    """
    recording, segments = about.recording, list(body.segments)
    static = _find_static_intervals(recording) if recording is not None else []
    in_files = len(about.sensors) > 1 and "file" not in about.data  # one file a sensor: the folder is the recording
    head = {"name": about.path.parent.resolve().name if in_files else about.path.stem}
    if model is not None:
        head["model"] = _relative(model, folder) if model.is_file() else str(model)
    lines = [*format_keys({**head, "start_pose": "n_pose"}), "", "[data]", *format_keys(about.data, about.checks)]
    lines += ["", "[phases]   # seconds", *format_keys(about.phases)]  # as they were marked live
    if not about.phases:
        if static:
            spans = f"[[{static[0][0]:.2f}, {static[0][1]:.2f}]]"
            lines.append(f"start = {spans}   # CHECK: all sensors are static there; is it the start pose?")
        else:
            lines.append('# start = [["FROM", "TO"]]   # the seconds of standing still in the start pose')
        # A sensor on an unknown segment may be one that is needed.
        if body.draw.paths and not (set(about.sensors) <= set(segments) and set(body.needed) - set(about.sensors)):
            lines.append('# clasp = [["FROM", "TO"]]   # for wepose calibrate: the seconds with the palms together')
            lines.append('# t_pose = [["FROM", "TO"]]   # the same, if there was one: arms held sideways, five seconds')
    for segment in sorted(about.sensors, key=lambda name: segments.index(name) if name in segments else 99):
        known = segment in segments
        table = [f"[sensors.{segment if known else 'SEGMENT'}]"]
        table += format_keys(about.sensors[segment], about.checks)
        if recording is not None and not recording.sensors[segment].aligned:
            table.append(_propose_mount(recording, segment, static))
        lines += ["", *(line if known else f"# {line}" for line in table)]
    return "\n".join(lines) + "\n"


def _propose_mount(recording: Recording, segment: str, static: Sequence[tuple[float, float]]) -> str:
    sensor = recording.sensors[segment]
    up, hint = "+x", "which sensor axis is up, which forward, in the start pose? none: the segment's own orientation"
    if isinstance(sensor, ImuSensor):
        force = sensor.accel_S[recording.span(static[0]) if static else slice(max(1, round(recording.rate_hz)))]
        up = max(AXES, key=lambda axis: float(AXES[axis] @ force.mean(axis=0)))
        where = "where it is static" if static else "in the first second"
        hint = f"gravity shows up {where}; replace ? by the axis that points forward, and remove the #"
    return f'# mount = {{ up = "{up}", forward = "?" }}   # {hint}'
