"""The session file, in which the user describes a recording (TOML), and the data files that it names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ..data_tables import read_columns, read_table
from ..diagnostics import INFO, WARNING, Diagnostic
from ..documents import TomlTable
from ..errors import BadData, BadSession, MissingFile, one_of
from ..recording import ImuSensor, OrientationSensor, Recording, Sensor, check_phases, check_recording, format_span
from ..recording.clocks import LONGEST_GAP_S, TIME_UNITS, Clock, build_clock, find_common_time, measure_rate
from ..recording.faults import Fault, check_sensors
from ..recording.gaps import BRIDGED, GOOD, LONG, bridge, bridge_quat, find_runs, mark_lost_samples, resample
from ..recording.plausibility import check_signals
from .arrays import ArrayFile, is_array_file
from .device import ACCEL_UNITS, GYRO_UNITS, Device, check_measured
from .registry import detect_format, find_format, read_device
from .session_file import (
    OF_COLUMNS,
    OF_FORMATS,
    WIDTHS,
    SensorKeys,
    check_columns,
    read_data_keys,
    read_head,
    read_sensor_keys,
    read_session_file,
)

NORM_ERROR = 1e-2  # of a quaternion, from rounded decimals
MOST_LOST = 0.01  # share of samples lost in short gaps, above which it is a diagnostic


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
    top = read_session_file(path, values)
    path = Path(top.file)
    stated, files = top.table("sensors", {}), _Files(path, top.table("data"))
    # Whether the names are segments, and the start pose one of theirs, is checked where the body is known.
    tables = {name: stated.table(name) for name in stated.values}
    keys = {name: read_sensor_keys(table, files.keys) for name, table in tables.items()}
    keys = {name: each for name, each in keys.items() if not each.ignore}
    check_columns(tables, keys)
    if not keys:
        raise BadSession(f"{path}: no sensors; one [sensors.<segment>] table each, without # before its lines")
    head = read_head(top)
    devices = {name: files.open_device(tables[name], each) for name, each in keys.items() if not each.signals}
    measured: dict[str, _Measured] = {}
    alike = len({bool(each.signals) for each in keys.values()}) == 1
    for name, each in keys.items():
        table, unused = tables[name], OF_FORMATS if each.signals else OF_COLUMNS
        if places := [own.at(key) for own in (table, *[files.data] * alike) for key in unused if key in own]:
            why = "the columns are named here" if each.signals else "the format of the file defines it"
            raise BadSession(f"{places[0]} has no effect, as {why}; remove it")
        if name in devices:
            measured[name] = files.take_sensor(name, table, each, devices)
        else:
            measured[name] = files.read_sensor(table, each)
        if measured[name].aligned and ("mount" in table or "orientation" not in measured[name].values):
            raise BadSession(f"{table.where}: aligned orientations are the segment's own: no mount, and no raw data")
    files.tables.clear()  # of a day they are gigabytes
    time, resampled = find_common_time(str(path), {segment: each.clock for segment, each in measured.items()})
    check_phases(str(path), time, head.phases)
    start = next(iter(head.phases.get("start", ())), None)
    samples = {name: (each.clock.time[each.clock.row >= 0], *each.values.values()) for name, each in measured.items()}
    faults, gyro_range, frozen = check_sensors(str(path), samples, start)
    sensors: dict[str, Sensor] = {}
    diagnostics = [*resampled, *files.diagnostics, *frozen]
    for segment, own in measured.items():
        sensor, marks = _bridge_gaps(own, faults.get(segment, []), gaps)
        if isinstance(sensor, ImuSensor):
            sensor = replace(sensor, gyro_range=gyro_range[segment])
        sensors[segment] = resample(sensor, own.clock.time, time) if resampled else sensor
        diagnostics += _report_bridged_gaps(segment, marks, own.clock.step)
    recording = replace(head, time=time, rate_hz=measure_rate(time), sensors=sensors, diagnostics=tuple(diagnostics))
    check_recording(recording)
    return replace(recording, diagnostics=(*recording.diagnostics, *check_signals(recording)))


class _Measured(NamedTuple):
    """The samples of a sensor as its file has them."""

    place: str  # the file and the sensor, for messages
    columns: Mapping[str, list[str]]  # names in the file, by signal
    clock: Clock  # its times, with lost rows filled in
    values: Mapping[str, np.ndarray]  # signal → (n, k) in SI, of the rows of the file
    mount: np.ndarray | None  # (4,) xyzw, sensor to segment; None: not stated
    aligned: bool  # its orientations are the segment's own


# Files -------------------------------------------------------------------------------------------------------------


class _Files:
    """The files that a session names, each read once."""

    def __init__(self, path: Path, data: TomlTable) -> None:
        self.path, self.data, self.keys = path, data, read_data_keys(data)
        self.tables: dict[Path, pl.DataFrame] = {}
        self.diagnostics: list[Diagnostic] = []  # what devices assumed, and files whose times are those of packets
        self._devices: dict[tuple[object, ...], Device] = {}
        self._arrays: dict[Path, ArrayFile] = {}
        self._clocks: dict[tuple[object, ...], Clock] = {}

    def _find_file(self, keys: SensorKeys) -> Path:
        if not keys.file:
            raise BadSession(f"{self.data.at('file')} is missing; the .csv or .parquet file beside {self.path}")
        return self.path.parent / keys.file

    def _at(self, table: TomlTable, key: str) -> str:
        """Return the place of a key of a sensor, which may stand in [data]."""
        return (table if key in table else self.data).at(key)

    def open_device(self, table: TomlTable, keys: SensorKeys) -> Device:
        """Read the file of a sensor without columns, whose format defines them."""
        path = self._find_file(keys)
        if not keys.format and not path.exists():
            raise MissingFile(f"{path}: no such file or folder")
        place = self._at(table, "format")
        format = find_format(keys.format, self.path.parent, place) if keys.format else detect_format(path)
        if format is None:
            table.names("gyro", WIDTHS["gyro"])  # an error: the session must name the columns of a table
        key = (path, format, keys.use, keys.rate_hz)
        if key not in self._devices:
            self._devices[key] = device = read_device(path, str(format), keys.use or None, keys.rate_hz)
            self.diagnostics += device.diagnostics
        return self._devices[key]

    def take_sensor(self, segment: str, table: TomlTable, keys: SensorKeys, devices: Mapping[str, Device]) -> _Measured:
        """Take a sensor of a device's file: the stated label, the one with the segment's name, or the only sensor.

        Devices whose clocks start at power-on are shifted together, so that the earliest begins at zero.
        """
        path, device = self._find_file(keys), devices[segment]
        labels = [label for label, each in device.sensors.items() if each.segment == segment] or list(device.sensors)
        if keys.label:
            labels = [table.choice("label", device.sensors, keys.label)]
        if len(labels) != 1:
            raise BadSession(f"{table.at('label')} is missing; which of {path.name} is it? {one_of(device.sensors)}")
        (label,) = labels
        sensor = device.sensors[label]
        offset_s = keys.offset_s
        if device.since_power_on:
            offset_s -= min(each.begin for each in devices.values() if each.since_power_on)
        clock = self._build_clock((path, id(sensor.time), offset_s), path, sensor.time + offset_s, str(path))
        columns = {signal: [f"{label} {signal}"] for signal in sensor.signals}
        mount = sensor.mount if keys.mount is None else keys.mount
        aligned = device.aligned if keys.aligned is None else keys.aligned
        return _Measured(f"{path}: {table.place}", columns, clock, sensor.signals, mount, aligned)

    def read_sensor(self, table: TomlTable, keys: SensorKeys) -> _Measured:
        """Read the columns or arrays of a sensor, which the session names."""
        path = self._find_file(keys)
        if bool(keys.time) == (keys.rate_hz is not None):
            stated = "both is" if keys.time else "neither is"
            raise BadSession(f"{self._at(table, 'time')} or rate_hz is needed, one of the two, and {stated} there")
        units = {"orientation": 1.0}
        for signal, unit, known in (("gyro", keys.gyro_unit, GYRO_UNITS), ("accel", keys.accel_unit, ACCEL_UNITS)):
            if signal in keys.signals and not unit:
                raise BadSession(f"{self._at(table, f'{signal}_unit')} is missing; {one_of(known)}")
            units[signal] = known.get(unit, 1.0)
        columns = dict(keys.signals)
        if is_array_file(path):
            if path not in self._arrays:
                self._arrays[path] = ArrayFile(path)
            file = self._arrays[path]
            for signal, names in columns.items():
                if len(names) == 1:
                    columns[signal] = file.expand(names[0], WIDTHS[signal], table.at(signal))
            places = {name: table.at(signal) for signal, names in columns.items() for name in names}
            content = file.table(places | ({keys.time: self._at(table, "time")} if keys.time else {}))
        else:
            for signal in (signal for signal, names in columns.items() if len(names) == 1):
                table.names(signal, WIDTHS[signal])  # an error: one array, but the file is a table of columns
            if path not in self.tables:
                self.tables[path] = read_table(path)
            content = self.tables[path]
        if keys.rate_hz is not None:
            time, source = np.arange(content.height) / keys.rate_hz, self._at(table, "rate_hz")
        else:
            time, source = read_columns(content, [keys.time], str(path), self._at(table, "time"))[:, 0], str(path)
            time = TIME_UNITS[keys.time_unit] * time
        key = (path, len(time), keys.time, keys.time_unit, keys.rate_hz, keys.offset_s)
        clock = self._build_clock(key, path, time + keys.offset_s, source)
        values = {
            signal: units[signal] * read_columns(content, names, str(path), table.at(signal))
            for signal, names in columns.items()
        }
        if path in self.tables:  # columns that have been read make room: of a day the table is gigabytes
            read = [name for names in columns.values() for name in names]
            self.tables[path] = content.with_columns(pl.lit(None).alias(name) for name in read)
        return _Measured(f"{path}: {table.place}", columns, clock, values, keys.mount, bool(keys.aligned))

    def _build_clock(self, key: tuple[object, ...], path: Path, time: np.ndarray, source: str) -> Clock:
        """Build the clock of sensors, once of those that share it."""
        if key not in self._clocks:
            self._clocks[key] = clock = build_clock(time, source)
            if clock.packet > 1:
                facts: dict[str, float | str] = {"variant": "packets", "packet": clock.packet}
                self.diagnostics.append(Diagnostic("time-stamps-uneven", INFO, path.name, facts=facts))
        return self._clocks[key]


# Gaps --------------------------------------------------------------------------------------------------------------


def _bridge_gaps(measured: _Measured, faults: Sequence[Fault], gaps: bool) -> tuple[Sensor, np.ndarray]:
    """Put the rows on the clock and bridge gaps, long ones where `gaps` are accepted; and the marks (n,) of samples."""
    clock = measured.clock
    frozen = np.zeros(len(clock.time), dtype=bool)
    for fault in faults:
        frozen |= (clock.time > fault.first) & (clock.time <= fault.last)
    signals, lost = {}, frozen.copy()
    for name, rows in measured.values.items():
        place = f"{measured.place}{name}"
        check_measured(place, rows)
        signals[name], good = _place_on_clock(rows, clock, place, name == "orientation")
        if not good.any():
            listed = ", ".join(measured.columns[name])
            raise BadData(f"{place}: no numbers from {format_span(clock.time[[0, -1]])} in {listed}")
        if not gaps and (long := find_runs(mark_lost_samples(clock, good) == LONG)):
            first, last = long[0]
            lost_s, row = (last - first) * clock.step, clock.row[:first].max(initial=-1) + 1
            raise BadData(
                f"{place}: samples are missing for {lost_s:.3f} s from {clock.time[first]:.3f} s, after row {row}; up "
                f"to 50 ms are bridged; cut the recording there, or accept gaps by --gaps (gaps=True)"
            )
        lost |= ~good
    marks = mark_lost_samples(clock, ~lost)
    gap = marks == LONG if gaps or faults else None
    marks_reported = np.where(frozen, GOOD, marks)  # frozen samples have a diagnostic of their own
    if "orientation" in signals:
        quat = bridge_quat(signals["orientation"], marks, clock)
        return OrientationSensor(quat, measured.mount, gap, measured.aligned), marks_reported
    gyro_S = bridge(signals["gyro"], marks, clock)
    accel_S = bridge(signals["accel"], marks, clock)
    return ImuSensor(gyro_S, accel_S, measured.mount, gap), marks_reported


def _place_on_clock(rows: np.ndarray, clock: Clock, place: str, is_quat: bool) -> tuple[np.ndarray, np.ndarray]:
    """Put the values (n, k) of a signal on the clock, with a mask (n,) of the samples that exist."""
    exists, values = clock.row >= 0, rows
    if not exists.all():
        values = np.full((len(clock.row), rows.shape[1]), np.nan)
        values[exists] = rows[clock.row[exists]]
    good = np.isfinite(values).all(axis=1)
    if not is_quat:
        return values, good
    norm = np.linalg.norm(values, axis=1)
    good &= norm > 0.0  # many exports write zeros for a lost sample
    not_unit = np.flatnonzero(good & (np.abs(norm - 1.0) > NORM_ERROR))
    if not_unit.size:
        length, row = norm[not_unit[0]], clock.row[not_unit[0]] + 1
        raise BadData(f"{place} has length {length:.3g} in row {row}; a unit quaternion x, y, z, w is needed")
    return values / np.where(good, norm, np.nan)[:, None], good


def _report_bridged_gaps(segment: str, marks: np.ndarray, step: float) -> Iterator[Diagnostic]:
    """Report bridged gaps, short ones where they are many, from the marks (n,) of the samples and their step [s]."""
    long, short = ([last - first for first, last in find_runs(marks == mark)] for mark in (LONG, BRIDGED))
    if long:
        facts: dict[str, float | str] = {"samples": sum(long), "gaps": len(long)}
        yield Diagnostic("samples-lost", WARNING, segment, max(long) * step, max(LONGEST_GAP_S, step), facts)
    elif sum(short) > MOST_LOST * len(marks):
        facts = {"variant": "short", "longest": max(short) * step}
        yield Diagnostic("samples-lost", WARNING, segment, sum(short) / len(marks), MOST_LOST, facts)
