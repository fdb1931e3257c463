"""The session file, in which the user describes a recording (TOML), and the data files that it names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..diagnostics import INFO, WARNING, Diagnostic
from ..documents import TomlTable
from ..errors import BadData, BadSession, MissingFile, printable
from ..model.table import NEUTRAL_POSE
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
from .tables import read_columns, read_table

# Allowed error of a quaternion's norm, from rounded decimals.
NORM_ERROR = 1e-2
SI = {"gyro": 1.0, "accel": 1.0}
# Optional keys of [data]; a key that no sensor uses is an error.
_FOR_SENSORS = ("file", "time", "time_unit", "rate_hz", "gyro_unit", "accel_unit", "format", "use")


def load_session(path: str | Path, gaps: bool = False) -> Recording:
    """Read ``session.toml`` and the data it names.

    Parameters
    ----------
    path : the session file, or its folder
    gaps : accept gaps longer than 50 ms: they are bridged, and marked in the sensor's `gap`

    Raises
    ------
    WeposeError
        One line that names the file, the key or column, its value and what would be right.
    """
    return SessionReader(path, gaps=gaps).recording()


@dataclass(frozen=True)
class _Plan:
    """Source of a sensor's values: columns by signal, the file, the sensor's clock."""

    place: str
    path: Path
    table: str  # key of the reader's table
    signals: Mapping[str, list[str]]
    units: Mapping[str, float]
    clock: Clock
    mount: np.ndarray | None
    aligned: bool


class SessionReader:
    """A reader of a session: it reads and checks keys and clocks at once, and values in `recording`, once.

    Parameters
    ----------
    gaps : accept gaps longer than 50 ms
    values : the session's contents, where the file does not exist yet

    Attributes
    ----------
    time, rate_hz : the common time base (n,) [s], and its rate
    phases, start_pose, remounted : as in the whole `Recording`
    any_aligned : whether the orientations of a sensor are its segment's own
    """

    def __init__(
        self,
        path: str | Path,
        *,
        gaps: bool = False,
        values: Mapping[str, Any] | None = None,
    ) -> None:
        path = Path(path)
        self.path = path / "session.toml" if path.is_dir() else path
        self.gaps = gaps
        top = read_session_file(self.path) if values is None else check_session_keys(values, self.path)
        data, sensors = top.table("data"), top.table("sensors", {})
        data.allow(*_FOR_SENSORS, "truth")
        self._used: set[str] = set()  # keys of `_FOR_SENSORS` that a sensor uses
        start_pose = top.text("start_pose", NEUTRAL_POSE) or NEUTRAL_POSE
        # Whether the names are segments, and the start pose one of theirs, is checked where the body is known.
        tables = {name: table for name in sensors.values if not (table := sensors.table(name)).flag("ignore")}
        if not tables:
            raise BadSession(f"{self.path}: no sensors; one [sensors.<segment>] table each, without # before its lines")
        self._head = Recording(
            name=printable(top.text("name", None) or self.path.absolute().parent.name or self.path.stem),
            time=np.empty(0),
            rate_hz=0.0,
            sensors={},
            phases=read_phases(top.table("phases", {})),
            start_pose=start_pose,
            joints=read_joints(top, start_pose),
            model=find_model(self.path, top),
            remounted=top.flag("remounted"),
            source=self.path,
            truth=find_truth(self.path, data),
        )
        stated = {segment: read_sensor_keys(table) for segment, table in tables.items()}
        self._units: Mapping[str, float] = SI
        if any(sensor.signals for sensor in stated.values()):
            raw = any("gyro" in sensor.signals for sensor in stated.values())
            self._units = {
                signal: known[data.choice(key, known)] if raw or key in data else 1.0
                for signal, key, known in (("gyro", "gyro_unit", GYRO_UNITS), ("accel", "accel_unit", ACCEL_UNITS))
            }
            self._used |= {"gyro_unit", "accel_unit"}
        self._tables: dict[str, pl.DataFrame] = {}
        self._clocks: dict[tuple[str, str | None, float, float | None, float], Clock] = {}
        self._array_files: dict[Path, ArrayFile] = {}
        self.devices: dict[Path, Device] = {}
        self._device_rates: dict[Path, float | None] = {}
        for segment, sensor in stated.items():
            if not sensor.signals:
                self._read_device(tables[segment], data)
        self._synchronize_devices()
        self._plans = {segment: self._make_plan(tables[segment], data, sensor) for segment, sensor in stated.items()}
        unused = [key for key in _FOR_SENSORS if key in data and key not in self._used]
        if unused:
            raise BadSession(f"{data.at(unused[0])}: {_explain_unused(unused[0])}; leave it out")
        clocks = {segment: plan.clock for segment, plan in self._plans.items()}
        self.time, resampled = find_common_time(str(self.path), clocks)
        self._resampled = bool(resampled)
        packets = {plan.path: clock.packet for plan in self._plans.values() if (clock := plan.clock).packet > 1}
        self._diagnostics = (
            *resampled,
            *(each for device in self.devices.values() for each in device.diagnostics),
            *(Diagnostic("packet-times-spread", INFO, path.name, packet) for path, packet in packets.items()),
        )
        self.rate_hz = measure_rate(self.time)
        check_phases(str(self.path), self.time, self._head.phases)
        self.phases, self.start_pose, self.remounted = self._head.phases, start_pose, self._head.remounted
        self._refuse_shared_columns()

    def _refuse_shared_columns(self) -> None:
        """Raise an error where two sensors have a column in common."""
        owner: dict[tuple[Path, str], str] = {}
        for segment, plan in self._plans.items():
            for signal, name in ((signal, name) for signal, names in plan.signals.items() for name in names):
                other = owner.setdefault((plan.path, name), segment)
                if other != segment:
                    raise BadSession(
                        f"{self.path}: {plan.place}.{signal} names column '{name}' of {plan.path.name}, which is that "
                        f"of sensors.{other}; each sensor has columns of its own"
                    )

    def _find_file(self, keys: TomlTable, data: TomlTable) -> Path:
        file = (keys if "file" in keys else data).text("file", None)
        if file is None:
            raise BadSession(f"{data.at('file')} is missing; the .csv or .parquet file beside {self.path}")
        if "file" not in keys:
            self._used.add("file")
        return self.path.parent / file

    def _read_device(self, keys: TomlTable, data: TomlTable) -> None:
        """Read a file of a known format, which defines its columns."""
        path = self._find_file(keys, data)
        own = keys if "format" in keys else data
        if own.values.get("format") == "apdm_hdf5":
            raise BadSession(
                f"{own.at('format')} = 'apdm_hdf5' is no longer known; name each sensor's arrays, as `wepose info "
                f"{path.name}` proposes"
            )
        stated = own.text("format", None)
        if stated is not None:
            format: str | None = find_format(stated, self.path.parent, own.at("format"))
        else:
            format = detect_format(path) if path.exists() else None
        self._used |= {"format", "use"} if own is data else {"use"}
        if format is None:
            if not path.exists():
                raise MissingFile(f"{path}: no such file or folder")
            keys.names("gyro", 3)  # an error: the session must name the columns of a table
        else:
            use = data.choice("use", USES) if "use" in data else None
            # The rate in [data] holds for the file in [data], or for all files where it names none.
            rate_table = keys if "rate_hz" in keys or ("file" in keys and "file" in data) else data
            rate_hz = rate_table.number("rate_hz", None, positive=True)
            if rate_table is data:
                self._used.add("rate_hz")
            for key in ("time", "time_unit"):
                if key in keys:
                    raise BadSession(f"{keys.at(key)}: {_explain_unused(key)}; leave it out")
            if path in self.devices and rate_hz != self._device_rates[path]:
                raise BadSession(
                    f"{rate_table.at('rate_hz')}: {path.name} is read with another rate for another sensor"
                )
            if path not in self.devices:
                self.devices[path] = read_device(path, format, use, rate_hz)
                self._device_rates[path] = rate_hz

    def _synchronize_devices(self) -> None:
        """Shift the times of devices whose clocks start at power-on, so that the earliest one begins at zero."""
        running = {path: device for path, device in self.devices.items() if device.since_power_on}
        first = {path: min(map(_find_begin, _list_tables(device))) for path, device in running.items()}
        for path, device in running.items():
            if device.wraps_s:  # one device's counter wrapped before the recording, the other's did not
                reference = next(iter(first.values()))
                first[path] += device.wraps_s * round((reference - first[path]) / device.wraps_s)
        origin = min(first.values(), default=0.0)
        for path, device in self.devices.items():
            begin = min(map(_find_begin, _list_tables(device)))
            for label in (None, *device.own_tables):
                table = device.table if label is None else device.own_tables[label]
                if path in first:
                    table = table.with_columns(time=table["time"].to_numpy() - begin + (first[path] - origin))
                self._tables[_name_table(path, label)] = table

    def _make_plan(self, keys: TomlTable, data: TomlTable, stated: SensorKeys) -> _Plan:
        path, segment = self._find_file(keys, data), keys.place.removeprefix("sensors.")[:-1]
        device = None if stated.signals else self.devices[path]
        # A sensor with its own file has its own clock, or that of [data] where [data] names no file.
        states = any(key in keys for key in ("time", "time_unit", "rate_hz"))
        own = keys if states or ("file" in keys and "file" in data) else data
        name, rate_hz = own.text("time", None), own.number("rate_hz", None, positive=True)
        unit = TIME_UNITS[own.choice("time_unit", TIME_UNITS, "s")]
        if device is not None:
            name, rate_hz, unit = "time", None, 1.0
        else:
            if own is data:
                self._used |= {"time", "rate_hz"} | ({"time_unit"} if name is not None else set())
            elif "time_unit" in keys and rate_hz is not None:
                raise BadSession(f"{keys.at('time_unit')}: {_explain_unused('time_unit')}; leave it out")
        if (name is None) == (rate_hz is None):
            text = "neither" if name is None else "both"
            raise BadSession(
                f"{own.at('time')} or rate_hz is needed, one of the two, and {text} is there: a column of times, "
                f"or a rate"
            )
        offset = keys.number("offset_s", 0.0) or 0.0
        which = str(path)
        if device is not None:
            label = choose_label(keys, device, segment, path)
            which = _name_table(path, label if label in device.own_tables else None)
            signals: Mapping[str, list[str]] = device.signals(label)
        else:
            signals = stated.signals
            if is_array_file(path):
                which = f"{path} {segment}"
                self._tables[which], signals = self._read_arrays(keys, path, signals, name, own)
            else:
                for signal, names in signals.items():
                    if len(names) == 1:  # an error: one array, but the file is a table of columns
                        keys.names(signal, WIDTHS[signal])
        if which not in self._tables:
            self._tables[which] = read_table(path)
        key = (which, name, unit, rate_hz, offset)
        if key not in self._clocks:
            table = self._tables[which]
            if rate_hz is not None:
                time = np.arange(table.height) / rate_hz
            else:
                time = unit * read_columns(table, [name or "time"], str(path), own.at("time"))[:, 0]
            source = str(path) if rate_hz is None else own.at("rate_hz")
            self._clocks[key] = clock = build_clock(time + offset, source)
            lost = find_runs(mark_lost_samples(clock, clock.row >= 0) == LONG)
            if lost and not self.gaps:
                before, after = lost[0][0] - 1, lost[0][1]
                raise BadData(
                    f"{path}: rows are missing after row {clock.row[before] + 1}: time steps by "
                    f"{clock.time[after] - clock.time[before]:.3f} s at {clock.time[before]:.3f} s; "
                    f"{_explain_gap_limit(clock)}"
                )
        aligned = stated.aligned if stated.aligned is not None else device is not None and device.aligned
        if aligned and stated.mount is not None:
            raise BadSession(
                f"{keys.at('mount')} stands beside aligned orientations, which are the segment's own; leave it out, or "
                f"state aligned = false"
            )
        if aligned and "orientation" not in signals:
            raise BadSession(f"{keys.at('aligned')} = true needs orientations; leave it out where there are none")
        units = SI if device is not None else self._units
        place = keys.place.rstrip(".")
        mount = stated.mount if device is None or stated.mount is not None else device.mounts.get(label)
        return _Plan(place, path, which, signals, units, self._clocks[key], mount, aligned)

    def _read_arrays(
        self, keys: TomlTable, path: Path, signals: Mapping[str, list[str]], time: str | None, own: TomlTable
    ) -> tuple[pl.DataFrame, Mapping[str, list[str]]]:
        """Read the columns of an HDF5 or MATLAB file that a sensor and its clock need; with their names by signal."""
        if path not in self._array_files:
            self._array_files[path] = ArrayFile(path)
        file = self._array_files[path]
        named = {
            signal: file.expand(names[0], WIDTHS[signal], keys.at(signal)) if len(names) == 1 else names
            for signal, names in signals.items()
        }
        wanted = {name: keys.at(signal) for signal, names in named.items() for name in names}
        if time is not None:
            wanted[time] = own.at("time")
        return file.table(wanted), named

    def recording(self) -> Recording:
        """Read and check the recording.

        Raises
        ------
        BadData
            As `check_sensors`, `check_recording` and `check_signals`, and where values are no numbers.
        """
        samples = {segment: self._read_samples(plan) for segment, plan in self._plans.items()}
        self._tables.clear()
        start = next(iter(self.phases.get("start", ())), None)
        check = check_sensors(str(self.path), samples, start)
        sensors: dict[str, Sensor] = {}
        bridged: list[Diagnostic] = []
        for segment, plan in self._plans.items():
            sensor, marks = self._read_sensor(plan, check, samples.pop(segment)[1:])
            sensors[segment] = resample(sensor, plan.clock.time, self.time) if self._resampled else sensor
            bridged += _report_bridged_gaps(segment, marks, plan.clock.step)
        recording = replace(
            self._head,
            time=self.time,
            rate_hz=self.rate_hz,
            sensors=sensors,
            diagnostics=(*self._diagnostics, *check.diagnostics, *bridged),
        )
        check_recording(recording)
        return replace(recording, diagnostics=(*recording.diagnostics, *check_signals(recording)))

    def _read_samples(self, plan: _Plan) -> tuple[np.ndarray, ...]:
        """Read all rows of a sensor in SI: times (n,), and gyro and accel (n, 3) or orientations (n, 4)."""
        clock = plan.clock
        # Without lost rows no copy is made.
        time = clock.time if clock.row[-1] == len(clock.row) - 1 else clock.time[clock.row >= 0]
        values = [
            plan.units.get(name, 1.0)
            * read_columns(self._tables[plan.table], columns, str(plan.path), f"{self.path}: {plan.place}.{name}")
            for name, columns in plan.signals.items()
        ]
        return (time, *values)

    def _read_sensor(self, plan: _Plan, check: SensorCheck, rows: tuple[np.ndarray, ...]) -> tuple[Sensor, np.ndarray]:
        """Put the rows of a sensor's signals on its own clock and bridge its gaps; with the gaps' marks."""
        clock = plan.clock
        signals = {
            name: self._place_on_clock(plan, name, values) for name, values in zip(plan.signals, rows, strict=True)
        }
        marks = {}
        segment = plan.place.removeprefix("sensors.")
        faults = check.faults.get(segment, [])
        frozen = np.zeros(len(clock.time), dtype=bool)
        for fault in faults:
            frozen |= (clock.time > fault.first) & (clock.time <= fault.last)
        for name, (_, good) in signals.items():
            place = f"{plan.path}: {plan.place}.{name}"
            if not good.any():
                columns_ = ", ".join(plan.signals[name])
                raise BadData(f"{place}: no numbers from {format_span(clock.time[[0, -1]])} in {columns_}")
            marks[name] = mark_lost_samples(clock, good)
            if not self.gaps and (marks[name] == LONG).any():
                first, last = find_runs(marks[name] == LONG)[0]
                raise BadData(
                    f"{place}: {last - first} samples without numbers, {(last - first) * clock.step:.3f} s from "
                    f"{clock.time[first]:.3f} s; {_explain_gap_limit(clock)}"
                )
            if frozen.any():
                marks[name] = mark_lost_samples(clock, good & ~frozen)
        all_marks = np.max(list(marks.values()), axis=0)
        gap = all_marks == LONG if self.gaps or faults else None
        if "orientation" in signals:
            quat = bridge_quat(signals["orientation"][0], marks["orientation"], clock)
            return OrientationSensor(quat, plan.mount, gap, plan.aligned), all_marks
        gyro_S = bridge(signals["gyro"][0], marks["gyro"], clock, rate=True)
        accel_S = bridge(signals["accel"][0], marks["accel"], clock)
        gap_marks = np.where(frozen, GOOD, all_marks)  # frozen samples have a diagnostic of their own
        return ImuSensor(gyro_S, accel_S, plan.mount, gap, check.gyro_range[segment]), gap_marks

    def _place_on_clock(self, plan: _Plan, name: str, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Place the rows (m, k) of a signal on the clock: (n, k), and a mask (n,) of the samples that exist."""
        clock = plan.clock
        exists = clock.row >= 0
        if exists.all():
            values = rows
        else:
            values = np.full((len(clock.row), rows.shape[1]), np.nan)
            values[exists] = rows[clock.row[exists]]
        good = np.isfinite(values).all(axis=1)
        too_large = np.flatnonzero((np.abs(values) > LARGEST_NUMBER).any(axis=1))
        if too_large.size:
            raise BadData(
                f"{plan.path}: {plan.place}.{name} holds "
                f"{np.nanmax(np.abs(values[too_large[0]])) / plan.units.get(name, 1.0):.3g} in row "
                f"{clock.row[too_large[0]] + 1}; no sensor measures as much, leave cells of lost samples empty"
            )
        if name != "orientation":
            return values, good
        norm = np.linalg.norm(values, axis=1)
        good &= norm > 0.0  # many exports write zeros for a lost sample
        not_unit = np.flatnonzero(good & (np.abs(norm - 1.0) > NORM_ERROR))
        if not_unit.size:
            raise BadData(
                f"{plan.path}: {plan.place}.orientation has length {norm[not_unit[0]]:.3g} in row "
                f"{clock.row[not_unit[0]] + 1}; a unit quaternion is needed, columns in the order x, y, z, w"
            )
        return values / np.where(good, norm, np.nan)[:, None], good


def _list_tables(device: Device) -> list[pl.DataFrame]:
    return list(device.own_tables.values()) or [device.table]


def _find_begin(table: pl.DataFrame) -> float:
    return float(np.nanmin(table["time"].to_numpy()))


def _name_table(path: Path, label: str | None) -> str:
    """Name the table of a device, or of its sensor with a clock of its own, among those of a session."""
    return str(path) if label is None else f"{path} {label}"


def _explain_unused(key: str) -> str:
    """Explain why a known key has no effect in this session."""
    if key in ("time", "time_unit"):
        return "no sensor here has times in a column: the format has its own, or rate_hz replaces them"
    return {
        "file": "every sensor names a file of its own",
        "rate_hz": "every sensor has a time of its own",
        "gyro_unit": "the format of every sensor here has its own units",
        "accel_unit": "the format of every sensor here has its own units",
        "format": "no sensor here is read by it: they state columns, or a format of their own",
        "use": "no sensor here has a format with both; state the columns to read",
    }[key]


def _explain_gap_limit(clock: Clock) -> str:
    return (
        f"up to {1e3 * clock.longest_bridge:.0f} ms are bridged; cut the recording there, or accept gaps by --gaps "
        f"(gaps=True)"
    )


def _report_bridged_gaps(segment: str, marks: np.ndarray, step: float) -> Iterator[Diagnostic]:
    """Report the bridged gaps of a sensor, from the marks (n,) of its samples and their usual step [s]."""
    for mark, code, severity in ((LONG, "long-gaps-bridged", WARNING), (BRIDGED, "short-gaps-bridged", INFO)):
        spans = [last - first for first, last in find_runs(marks == mark)]
        if spans:
            facts = {"samples": sum(spans), "gaps": len(spans)}
            yield Diagnostic(code, severity, segment, max(spans) * step, max(LONGEST_GAP_S, step), facts)
