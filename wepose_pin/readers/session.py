"""The session file, in which the user describes a recording (TOML), and the data files that it names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..body.table import NEUTRAL_POSE
from ..data_tables import read_columns, read_table
from ..diagnostics import INFO, WARNING, Diagnostic
from ..documents import TomlTable
from ..errors import BadData, BadSession, MissingFile, printable
from ..recording import (
    ImuSensor,
    OrientationSensor,
    Recording,
    Sensor,
    check_phases,
    check_recording,
    format_span,
)
from ..recording.clocks import LONGEST_GAP_S, TIME_UNITS, Clock, build_clock, find_common_time, measure_rate
from ..recording.faults import SensorCheck, check_sensors
from ..recording.gaps import BRIDGED, GOOD, LONG, bridge, bridge_quat, find_runs, mark_lost_samples
from ..recording.limits import LARGEST_NUMBER
from ..recording.plausibility import check_signals
from ..recording.resampling import resample
from .arrays import ArrayFile, is_array_file
from .device import ACCEL_UNITS, GYRO_UNITS, Device
from .registry import USES, detect_format, find_format, read_device
from .session_file import (
    WIDTHS,
    SensorKeys,
    check_session_keys,
    choose_label,
    find_model,
    find_truth,
    read_joints,
    read_phases,
    read_sensor_keys,
    read_session_file,
)

# Allowed error of a quaternion's norm, from rounded decimals.
NORM_ERROR = 1e-2
MOST_LOST = 0.01  # share of samples lost in short gaps, above which it is a diagnostic
# Optional keys of [data] → why one has no effect; a key that no sensor uses is an error.
_UNUSED = {
    "file": "every sensor names a file of its own",
    **dict.fromkeys(
        ("time", "time_unit"), "no sensor here has times in a column: the format has its own, or rate_hz replaces them"
    ),
    "rate_hz": "every sensor has a time of its own",
    **dict.fromkeys(("gyro_unit", "accel_unit"), "the format of every sensor here has its own units"),
    "format": "no sensor here is read by it: they state columns, or a format of their own",
    "use": "no sensor here has a format with both; state the columns to read",
}


def read_session(path: Path, gaps: bool = False, values: Mapping[str, Any] | None = None) -> Recording:
    """Read a session file and the data it names.

    Parameters
    ----------
    path : the session file, or its folder
    gaps : accept gaps longer than 50 ms: they are bridged, and marked in the sensor's `gap`
    values : the contents of the session file, where it does not exist yet

    Raises
    ------
    WeposeError
        One line that names the file, the key or column, its value and what would be right.
    """
    path = path / "session.toml" if path.is_dir() else path
    top = read_session_file(path) if values is None else check_session_keys(values, path)
    data, stated = top.table("data"), top.table("sensors", {})
    data.allow(*_UNUSED, "truth")
    start_pose = top.text("start_pose", NEUTRAL_POSE) or NEUTRAL_POSE
    # Whether the names are segments, and the start pose one of theirs, is checked where the body is known.
    tables = {name: table for name in stated.values if not (table := stated.table(name)).flag("ignore")}
    if not tables:
        raise BadSession(f"{path}: no sensors; one [sensors.<segment>] table each, without # before its lines")
    head = Recording(
        name=printable(top.text("name", None) or path.absolute().parent.name or path.stem),
        time=np.empty(0),
        rate_hz=0.0,
        sensors={},
        phases=read_phases(top.table("phases", {})),
        start_pose=start_pose,
        joints=read_joints(top, start_pose),
        model=find_model(path, top),
        remounted=top.flag("remounted"),
        source=path,
        truth=find_truth(path, data),
    )
    files = _Files(path, data, gaps)
    measured = files.read_sensors(tables)
    time, resampled = find_common_time(str(path), {segment: each.clock for segment, each in measured.items()})
    check_phases(str(path), time, head.phases)
    _refuse_shared_columns(path, measured)
    start = next(iter(head.phases.get("start", ())), None)
    check = check_sensors(str(path), {segment: each.list_samples() for segment, each in measured.items()}, start)
    sensors: dict[str, Sensor] = {}
    diagnostics = [*resampled, *files.list_diagnostics(), *check.diagnostics]
    for segment, each in measured.items():
        sensor, marks = each.bridge_gaps(segment, check, gaps)
        sensors[segment] = resample(sensor, each.clock.time, time) if resampled else sensor
        diagnostics += _report_bridged_gaps(segment, marks, each.clock.step)
    recording = replace(head, time=time, rate_hz=measure_rate(time), sensors=sensors, diagnostics=tuple(diagnostics))
    check_recording(recording)
    return replace(recording, diagnostics=(*recording.diagnostics, *check_signals(recording)))


# Files -------------------------------------------------------------------------------------------------------------


class _Files:
    """The files that a session names, each read once, and the keys of [data] that its sensors use."""

    def __init__(self, path: Path, data: TomlTable, gaps: bool) -> None:
        self._path, self._data, self._gaps = path, data, gaps
        self._used: set[str] = set()
        self._devices: dict[Path, Device] = {}
        self._rates: dict[Path, float | None] = {}  # of devices, where the session states one
        self._begins: dict[Path, float] = {}  # [s] when the clock of a device began, on one clock for all
        self._tables: dict[Path, pl.DataFrame] = {}
        self._arrays: dict[Path, ArrayFile] = {}
        self._clocks: dict[tuple[object, ...], Clock] = {}
        self._packets: dict[str, int] = {}  # file → rows in a packet

    def read_sensors(self, tables: Mapping[str, TomlTable]) -> dict[str, _Measured]:
        """Read the samples of the sensors in these tables of the session."""
        stated = {segment: read_sensor_keys(table) for segment, table in tables.items()}
        columns = {segment: keys for segment, keys in stated.items() if keys.signals}
        units = {"gyro": 1.0, "accel": 1.0}
        if columns:
            for signal, known in (("gyro", GYRO_UNITS), ("accel", ACCEL_UNITS)):
                key = f"{signal}_unit"
                if key in self._data or any("gyro" in keys.signals for keys in columns.values()):
                    units[signal] = known[self._data.choice(key, known)]
                self._used.add(key)
        for segment, table in tables.items():
            if segment not in columns:
                self._read_device(table)
        self._synchronize_devices()
        measured = {
            segment: self._read_columns(table, columns[segment], units)
            if segment in columns
            else self._take_sensor(table, segment, stated[segment])
            for segment, table in tables.items()
        }
        self._tables.clear()  # of a day they are gigabytes
        unused = [key for key in _UNUSED if key in self._data and key not in self._used]
        if unused:
            raise BadSession(f"{self._data.at(unused[0])}: {_UNUSED[unused[0]]}; leave it out")
        return measured

    def list_diagnostics(self) -> Iterator[Diagnostic]:
        """List what devices assumed, and the files whose times are those of packets."""
        for device in self._devices.values():
            yield from device.diagnostics
        for name, packet in self._packets.items():
            facts: dict[str, float | str] = {"variant": "packets", "packet": packet}
            yield Diagnostic("time-stamps-uneven", INFO, name, facts=facts)

    def _find_file(self, keys: TomlTable) -> Path:
        file = (keys if "file" in keys else self._data).text("file", None)
        if file is None:
            raise BadSession(f"{self._data.at('file')} is missing; the .csv or .parquet file beside {self._path}")
        if "file" not in keys:
            self._used.add("file")
        return self._path.parent / file

    # Of a known format

    def _read_device(self, keys: TomlTable) -> None:
        """Read the file of a sensor without columns, whose format defines them."""
        data, path = self._data, self._find_file(keys)
        own = keys if "format" in keys else data
        self._used |= {"format", "use"} if own is data else {"use"}
        stated = own.text("format", None)
        if stated is not None:
            format: str | None = find_format(stated, self._path.parent, own.at("format"))
        elif path.exists():
            format = detect_format(path)
        else:
            raise MissingFile(f"{path}: no such file or folder")
        if format is None:
            keys.names("gyro", 3)  # an error: the session must name the columns of a table
            return
        use = data.choice("use", USES) if "use" in data else None
        # The rate in [data] holds for the file in [data], or for all files where it names none.
        rate_table = keys if "rate_hz" in keys or ("file" in keys and "file" in data) else data
        rate_hz = rate_table.number("rate_hz", None, positive=True)
        if rate_table is data:
            self._used.add("rate_hz")
        for key in ("time", "time_unit"):
            if key in keys:
                raise BadSession(f"{keys.at(key)}: {_UNUSED[key]}; leave it out")
        if self._rates.setdefault(path, rate_hz) != rate_hz:
            raise BadSession(f"{rate_table.at('rate_hz')}: {path.name} is read with another rate for another sensor")
        if path not in self._devices:
            self._devices[path] = read_device(path, format, use, rate_hz)

    def _synchronize_devices(self) -> None:
        """Find when devices whose clocks start at power-on began, so that the earliest one begins at zero."""
        running = {path: device for path, device in self._devices.items() if device.since_power_on}
        first = {path: device.begin for path, device in running.items()}
        for path, device in running.items():
            if device.wraps_s:  # one device's counter wrapped before the recording, the other's did not
                reference = next(iter(first.values()))
                first[path] += device.wraps_s * round((reference - first[path]) / device.wraps_s)
        origin = min(first.values(), default=0.0)
        self._begins = {path: begin - origin for path, begin in first.items()}

    def _take_sensor(self, keys: TomlTable, segment: str, stated: SensorKeys) -> _Measured:
        """Take a sensor of a device's file."""
        path = self._find_file(keys)
        device = self._devices[path]
        label = choose_label(keys, device, segment, path)
        sensor = device.sensors[label]
        offset = keys.number("offset_s", 0.0) or 0.0
        key = (path, id(sensor.time), offset)
        if key not in self._clocks:
            time = sensor.time - device.begin + self._begins[path] if path in self._begins else sensor.time
            self._clocks[key] = self._build_clock(path, time + offset, str(path))
        mount = sensor.mount if stated.mount is None else stated.mount
        columns = {signal: [f"{label} {signal}"] for signal in sensor.signals}
        aligned = _read_aligned(keys, stated, sensor.signals, device.aligned)
        return _Measured(keys.place.rstrip("."), path, columns, self._clocks[key], sensor.signals, {}, mount, aligned)

    # Of columns that the session names

    def _read_columns(self, keys: TomlTable, stated: SensorKeys, units: Mapping[str, float]) -> _Measured:
        """Read the columns or arrays of a sensor."""
        data, path = self._data, self._find_file(keys)
        # A sensor with its own file has its own clock, or that of [data] where [data] names no file.
        states = any(key in keys for key in ("time", "time_unit", "rate_hz"))
        own = keys if states or ("file" in keys and "file" in data) else data
        name, rate_hz = own.text("time", None), own.number("rate_hz", None, positive=True)
        unit = TIME_UNITS[own.choice("time_unit", TIME_UNITS, "s")]
        if own is data:
            self._used |= {"time", "rate_hz"} | ({"time_unit"} if name is not None else set())
        elif "time_unit" in keys and rate_hz is not None:
            raise BadSession(f"{keys.at('time_unit')}: {_UNUSED['time_unit']}; leave it out")
        if (name is None) == (rate_hz is None):
            raise BadSession(
                f"{own.at('time')} or rate_hz is needed, one of the two, and {'neither' if name is None else 'both'} "
                f"is there: a column of times, or a rate"
            )
        table, signals = self._open(keys, path, stated.signals, name, own)
        offset = keys.number("offset_s", 0.0) or 0.0
        key = (path, keys.place if is_array_file(path) else "", name, unit, rate_hz, offset)
        if key not in self._clocks:
            if rate_hz is not None:
                time, source = np.arange(table.height) / rate_hz, own.at("rate_hz")
            else:
                time = unit * read_columns(table, [str(name)], str(path), own.at("time"))[:, 0]
                source = str(path)
            self._clocks[key] = self._build_clock(path, time + offset, source)
        place = keys.place.rstrip(".")
        values = {
            signal: units.get(signal, 1.0) * read_columns(table, names, str(path), f"{self._path}: {place}.{signal}")
            for signal, names in signals.items()
        }
        if path in self._tables:  # columns that have been read make room: of a day the table is gigabytes
            read = [name for names in signals.values() for name in names]
            self._tables[path] = table.with_columns(pl.lit(None).alias(name) for name in read)
        aligned = _read_aligned(keys, stated, signals, False)
        return _Measured(place, path, signals, self._clocks[key], values, units, stated.mount, aligned)

    def _open(
        self, keys: TomlTable, path: Path, signals: Mapping[str, list[str]], time: str | None, own: TomlTable
    ) -> tuple[pl.DataFrame, Mapping[str, list[str]]]:
        """Read the table of a sensor, with the names by signal; of an HDF5 or MATLAB file the columns that it needs."""
        if not is_array_file(path):
            for signal, names in signals.items():
                if len(names) == 1:  # an error: one array, but the file is a table of columns
                    keys.names(signal, WIDTHS[signal])
            if path not in self._tables:
                self._tables[path] = read_table(path)
            return self._tables[path], signals
        if path not in self._arrays:
            self._arrays[path] = ArrayFile(path)
        file = self._arrays[path]
        named = {
            signal: file.expand(names[0], WIDTHS[signal], keys.at(signal)) if len(names) == 1 else names
            for signal, names in signals.items()
        }
        wanted = {name: keys.at(signal) for signal, names in named.items() for name in names}
        if time is not None:
            wanted[time] = own.at("time")
        return file.table(wanted), named

    def _build_clock(self, path: Path, time: np.ndarray, source: str) -> Clock:
        """Build the clock of a sensor; rows that are missing for long are an error where gaps are not accepted."""
        clock = build_clock(time, source)
        if clock.packet > 1:
            self._packets[path.name] = clock.packet
        lost = find_runs(mark_lost_samples(clock, clock.row >= 0) == LONG)
        if lost and not self._gaps:
            before, after = lost[0][0] - 1, lost[0][1]
            raise BadData(
                f"{path}: rows are missing after row {clock.row[before] + 1}: time steps by "
                f"{clock.time[after] - clock.time[before]:.3f} s at {clock.time[before]:.3f} s; "
                f"{_explain_gap_limit(clock)}"
            )
        return clock


def _read_aligned(keys: TomlTable, stated: SensorKeys, signals: Mapping[str, object], default: bool) -> bool:
    """Read whether the orientations of a sensor are its segment's own."""
    aligned = default if stated.aligned is None else stated.aligned
    if aligned and stated.mount is not None:
        raise BadSession(
            f"{keys.at('mount')} stands beside aligned orientations, which are the segment's own; leave it out, or "
            f"state aligned = false"
        )
    if aligned and "orientation" not in signals:
        raise BadSession(f"{keys.at('aligned')} = true needs orientations; leave it out where there are none")
    return aligned


def _refuse_shared_columns(path: Path, measured: Mapping[str, _Measured]) -> None:
    """Raise an error where two sensors have a column in common."""
    owner: dict[tuple[Path, str], str] = {}
    for segment, each in measured.items():
        for signal, name in ((signal, name) for signal, names in each.columns.items() for name in names):
            other = owner.setdefault((each.path, name), segment)
            if other != segment:
                raise BadSession(
                    f"{path}: sensors.{segment}.{signal} names column '{name}' of {each.path.name}, which is that of "
                    f"sensors.{other}; each sensor has columns of its own"
                )


# Sensors -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Measured:
    """The samples of a sensor as its file has them.

    Parameters
    ----------
    place : its table in the session, such as ``sensors.torso``
    path, columns : the file, and the names of the columns in it, by signal
    clock : its times, with lost rows filled in
    values : signal → (n, k) in SI, of the rows of the file
    units : signal → SI unit of the file's numbers, where it is another
    mount : (4,) xyzw, sensor to segment; None: not stated
    aligned : its orientations are the segment's own
    """

    place: str
    path: Path
    columns: Mapping[str, list[str]]
    clock: Clock
    values: Mapping[str, np.ndarray]
    units: Mapping[str, float]
    mount: np.ndarray | None
    aligned: bool

    def list_samples(self) -> tuple[np.ndarray, ...]:
        """List the times (n,) [s] of the file's rows, and the values of each signal."""
        clock = self.clock
        # Without lost rows no copy is made.
        time = clock.time if clock.row[-1] == len(clock.row) - 1 else clock.time[clock.row >= 0]
        return (time, *self.values.values())

    def bridge_gaps(self, segment: str, check: SensorCheck, gaps: bool) -> tuple[Sensor, np.ndarray]:
        """Put the rows on the clock and bridge gaps; with the marks (n,) of lost samples.

        Raises
        ------
        BadData
            A signal has no numbers, or a gap is too long and `gaps` are not accepted.
        """
        clock = self.clock
        faults = check.faults.get(segment, [])
        frozen = np.zeros(len(clock.time), dtype=bool)
        for fault in faults:
            frozen |= (clock.time > fault.first) & (clock.time <= fault.last)
        marks, signals = {}, {}
        for name in self.values:
            place = f"{self.path}: {self.place}.{name}"
            signals[name], good = self._place_on_clock(name)
            if not good.any():
                listed = ", ".join(self.columns[name])
                raise BadData(f"{place}: no numbers from {format_span(clock.time[[0, -1]])} in {listed}")
            marks[name] = mark_lost_samples(clock, good)
            if not gaps and (marks[name] == LONG).any():
                first, last = find_runs(marks[name] == LONG)[0]
                raise BadData(
                    f"{place}: {last - first} samples without numbers, {(last - first) * clock.step:.3f} s from "
                    f"{clock.time[first]:.3f} s; {_explain_gap_limit(clock)}"
                )
            if frozen.any():
                marks[name] = mark_lost_samples(clock, good & ~frozen)
        all_marks = np.max(list(marks.values()), axis=0)
        gap = all_marks == LONG if gaps or faults else None
        if "orientation" in signals:
            quat = bridge_quat(signals["orientation"], marks["orientation"], clock)
            return OrientationSensor(quat, self.mount, gap, self.aligned), all_marks
        gyro_S = bridge(signals["gyro"], marks["gyro"], clock, rate=True)
        accel_S = bridge(signals["accel"], marks["accel"], clock)
        gap_marks = np.where(frozen, GOOD, all_marks)  # frozen samples have a diagnostic of their own
        return ImuSensor(gyro_S, accel_S, self.mount, gap, check.gyro_range[segment]), gap_marks

    def _place_on_clock(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Put the values (n, k) of a signal on the clock, with a mask (n,) of the samples that exist."""
        rows, clock = self.values[name], self.clock
        exists = clock.row >= 0
        if exists.all() and len(rows) == len(clock.row):
            values = rows
        else:
            values = np.full((len(clock.row), rows.shape[1]), np.nan)
            values[exists] = rows[clock.row[exists]]
        good = np.isfinite(values).all(axis=1)
        too_large = np.flatnonzero((np.abs(values) > LARGEST_NUMBER).any(axis=1))
        if too_large.size:
            raise BadData(
                f"{self.path}: {self.place}.{name} holds "
                f"{np.nanmax(np.abs(values[too_large[0]])) / self.units.get(name, 1.0):.3g} in row "
                f"{clock.row[too_large[0]] + 1}; no sensor measures as much, leave cells of lost samples empty"
            )
        if name != "orientation":
            return values, good
        norm = np.linalg.norm(values, axis=1)
        good &= norm > 0.0  # many exports write zeros for a lost sample
        not_unit = np.flatnonzero(good & (np.abs(norm - 1.0) > NORM_ERROR))
        if not_unit.size:
            raise BadData(
                f"{self.path}: {self.place}.orientation has length {norm[not_unit[0]]:.3g} in row "
                f"{clock.row[not_unit[0]] + 1}; a unit quaternion is needed, columns in the order x, y, z, w"
            )
        return values / np.where(good, norm, np.nan)[:, None], good


def _explain_gap_limit(clock: Clock) -> str:
    return (
        f"up to {1e3 * clock.longest_bridge:.0f} ms are bridged; cut the recording there, or accept gaps by --gaps "
        f"(gaps=True)"
    )


def _report_bridged_gaps(segment: str, marks: np.ndarray, step: float) -> Iterator[Diagnostic]:
    """Report the bridged gaps of a sensor, from the marks (n,) of its samples and their usual step [s].

    Short gaps are reported where they are many.
    """
    long, short = ([last - first for first, last in find_runs(marks == mark)] for mark in (LONG, BRIDGED))
    if long:
        facts: dict[str, float | str] = {"samples": sum(long), "gaps": len(long)}
        yield Diagnostic("samples-lost", WARNING, segment, max(long) * step, max(LONGEST_GAP_S, step), facts)
    elif sum(short) > MOST_LOST * len(marks):
        facts = {"variant": "short", "longest": max(short) * step}
        yield Diagnostic("samples-lost", WARNING, segment, sum(short) / len(marks), MOST_LOST, facts)
