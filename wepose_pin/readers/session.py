"""The session file: what the user writes about a recording (TOML), and the CSV or Parquet it names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl

from ..errors import BadData, BadOption, BadPhase, BadSession, MissingFile, one_of
from ..recording import AXES, SEGMENTS, START_POSES, Intervals, Recording, Sensor, check, check_phases, mount_from_axes
from .clocks import BRIDGED, LONG, Clock, bridge, bridge_quat, clock_of, common_time, lost_samples, on_time, runs
from .keys import Keys, is_number, read_toml
from .plausibility import sensor_notes
from .tables import Rows, columns, one_column, read_table

GYRO_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
ACCEL_UNITS = {"m/s^2": 1.0, "g": 9.80665}
STRAPPINGS = ("as_calibrated", "new")
# How far a quaternion's norm may be off 1: decimals that were cut.
NORM_OFF = 1e-2


def load_session(path: str | Path, gaps: bool = False) -> Recording:
    """Read ``session.toml`` and the data it names.

    Parameters
    ----------
    path : the session file, or its folder
    gaps : accept lost samples for longer than 50 ms: they are bridged, and marked in `Sensor.gap`

    Raises
    ------
    WeposeError
        With one line that names the file, the key or column, the value found and what would be right.
    """
    reader = SessionReader(path, gaps=gaps)
    return reader.recording(0, len(reader.time))


def iter_session(path: str | Path, seconds: float = 600.0) -> Iterator[Recording]:
    """A session in pieces of `seconds`, for recordings that do not fit in memory: only its times are held as a whole.

    Put together, the pieces are what `load_session` gives: to the bit, or to rounding where clocks differ and it is
    resampled. A piece has the phases that touch it. What can be said of a whole recording only is not said: units are
    checked by the phases that a piece has.

    Raises
    ------
    WeposeError
        As `load_session`, at the piece that it comes from.
    """
    if not is_number(seconds) or seconds <= 0.0:
        raise BadOption(f"seconds={seconds!r}: the length of a piece, above 0, is needed")
    reader = SessionReader(path, in_memory=False)
    n = len(reader.time)
    size = max(2, round(seconds * reader.rate_hz))
    first = 0
    while first < n:
        last = n if n - first < size + 2 else first + size  # no piece of a single sample at the end
        yield reader.recording(first, last)
        first = last


@dataclass(frozen=True)
class _Plan:
    """Where a sensor's values stand: columns by signal, its file, its own clock."""

    place: str
    path: Path
    signals: Mapping[str, list[str]]
    clock: Clock
    mount: np.ndarray | None


class SessionReader:
    """A session understood, with its clocks read and checked; `recording` then reads values.

    Parameters
    ----------
    gaps : accept lost samples for longer than 50 ms
    in_memory : hold the tables as a whole; else they are read by rows, each `recording` after the one before

    Attributes
    ----------
    time, rate_hz : the common time base (n,) [s], and its rate
    """

    def __init__(self, path: str | Path, *, gaps: bool = False, in_memory: bool = True) -> None:
        path = Path(path)
        self.path = path / "session.toml" if path.is_dir() else path
        self.gaps = gaps
        top = Keys(read_toml(self.path, "a session file"), str(self.path))
        top.allow("name", "start_pose", "strapping", "data", "phases", "sensors")
        data, sensors = top.table("data"), top.table("sensors", {})
        data.allow("file", "time", "rate_hz", "gyro_unit", "accel_unit", "truth")
        for segment in sensors.values:
            if segment not in SEGMENTS:
                raise BadSession(f"{self.path}: sensors.{segment} is not a segment; {one_of(SEGMENTS, segment)}")
        if not sensors.values:
            raise BadSession(
                f"{self.path}: no sensors; one [sensors.<segment>] table each, segments: {', '.join(SEGMENTS)}"
            )
        self._head = Recording(
            name=top.text("name", None) or self.path.absolute().parent.name or self.path.stem,
            time=np.empty(0),
            rate_hz=0.0,
            sensors={},
            phases=_phases(top.table("phases", {})),
            start_pose=top.choice("start_pose", START_POSES, "n_pose"),
            strapping=top.choice("strapping", STRAPPINGS, "as_calibrated"),
            source=self.path,
            truth=_truth(self.path, data),
        )
        keys = {segment: _sensor_keys(sensors.table(segment)) for segment in sensors.values}
        if any("gyro" in signals for signals, _ in keys.values()):
            self._units = {
                "gyro": GYRO_UNITS[data.choice("gyro_unit", GYRO_UNITS)],
                "accel": ACCEL_UNITS[data.choice("accel_unit", ACCEL_UNITS)],
            }
        self._tables: dict[Path, pl.DataFrame | Rows] = {}
        self._clocks: dict[tuple[Path, str | None, float | None, float], Clock] = {}
        self._in_memory = in_memory
        self._plans = {
            segment: self._plan(sensors.table(segment), data, signals, mount)
            for segment, (signals, mount) in keys.items()
        }
        clocks = {segment: plan.clock for segment, plan in self._plans.items()}
        self.time, self._notes = common_time(str(self.path), clocks)
        self._resampled = bool(self._notes)
        self.rate_hz = (len(self.time) - 1) / float(self.time[-1] - self.time[0])
        check_phases(str(self.path), self.time, self._head.phases)

    def _plan(self, keys: Keys, data: Keys, signals: Mapping[str, list[str]], mount: np.ndarray | None) -> _Plan:
        file = (keys if "file" in keys else data).text("file", None)
        if file is None:
            raise BadSession(f"{data.at('file')} is missing; the .csv or .parquet file beside {self.path}")
        path = self.path.parent / file
        # A file of its own has a clock of its own.
        own = keys if any(key in keys for key in ("file", "time", "rate_hz")) else data
        name, rate_hz = own.text("time", None), own.number("rate_hz", None, positive=True)
        if (name is None) == (rate_hz is None):
            found = "neither" if name is None else "both"
            raise BadSession(
                f"{own.at('time')} or rate_hz is needed, one of the two, and {found} is there: a column in seconds, "
                f"or a rate"
            )
        offset = keys.number("offset_s", 0.0) or 0.0
        if path not in self._tables:
            self._tables[path] = read_table(path) if self._in_memory else Rows(path)
        key = (path, name, rate_hz, offset)
        if key not in self._clocks:
            table, place = self._tables[path], own.at("time")
            if isinstance(table, Rows):
                time, height = one_column(path, name, str(path), place)
            else:
                time = columns(table, [name], str(path), place)[:, 0] if name is not None else np.empty(0)
                height = table.height
            if rate_hz is not None:
                time = np.arange(height) / rate_hz
            self._clocks[key] = clock = clock_of(time + offset, str(path))
            lost = runs(lost_samples(clock, clock.row >= 0) == LONG)
            if lost and not self.gaps:
                before, after = lost[0][0] - 1, lost[0][1]
                raise BadData(
                    f"{path}: rows are missing after row {clock.row[before] + 1}: time steps by "
                    f"{clock.time[after] - clock.time[before]:.3f} s at {clock.time[before]:.3f} s; {_too_long(clock)}"
                )
        return _Plan(keys.place.rstrip("."), path, signals, self._clocks[key], mount)

    def recording(self, first: int, last: int) -> Recording:
        """The recording from sample `first` of the common time to before `last`, checked."""
        time = self.time[first:last]
        windows = {segment: self._window(plan, first, last) for segment, plan in self._plans.items()}
        rows: dict[Path, slice] = {}
        for segment, (low, high) in windows.items():
            plan = self._plans[segment]
            there = plan.clock.row[low:high]
            begin, end = int(there[there >= 0].min(initial=2**62)), int(there.max(initial=-1)) + 1
            so_far = rows.get(plan.path, slice(begin, end))
            rows[plan.path] = slice(min(begin, so_far.start), max(end, so_far.stop))
        tables = {path: self._tables[path][span] for path, span in rows.items()}

        sensors: dict[str, Sensor] = {}
        bridged: dict[str, list[str]] = {}
        for segment, (low, high) in windows.items():
            plan = self._plans[segment]
            clock = replace(plan.clock, time=plan.clock.time[low:high], row=plan.clock.row[low:high])
            sensor, marks = self._sensor(plan, clock, tables[plan.path], rows[plan.path].start)
            if not self._resampled:
                sensors[segment] = _cut(sensor, first - low, last - low)
                marks = marks[first - low : last - low]
            else:
                before = 1 if first else 0  # a rate needs the sample before it
                sensor = on_time(sensor, clock.time, self.time[first - before : last])
                sensors[segment] = _cut(sensor, before, last - first + before)
            for text in _gap_notes(marks, clock.step):
                bridged.setdefault(text, []).append(segment)
        gap_notes = [f"sensors.{', '.join(names)}: {text}" for text, names in bridged.items()]
        whole = last - first == len(self.time)
        recording = replace(
            self._head,
            time=time,
            rate_hz=self.rate_hz,
            sensors=sensors,
            phases=self._head.phases if whole else _within(self._head.phases, time),
            notes=(*self._notes, *gap_notes),
        )
        notes = sensor_notes(check(recording), whole=whole)
        return replace(recording, notes=(*recording.notes, *notes))

    def _window(self, plan: _Plan, first: int, last: int) -> tuple[int, int]:
        """The samples on a sensor's own clock that the piece needs, neighbours for bridging and resampling included."""
        clock = plan.clock
        margin = int(np.ceil(clock.longest_bridge / clock.step)) + 2
        if self._resampled:
            margin += int(np.ceil(1.0 / self.rate_hz / clock.step))
            ends = self.time[[max(first - 1, 0), last - 1]]
            first, last = (int(k) for k in np.searchsorted(clock.time, ends) + [-1, 1])
        return max(0, first - margin), min(len(clock.time), last + margin)

    def _sensor(self, plan: _Plan, clock: Clock, table: pl.DataFrame, first_row: int) -> tuple[Sensor, np.ndarray]:
        """A stretch of a sensor on its own clock with its gaps bridged, and their marks."""
        found = {
            name: self._signal(plan, name, clock, table, first_row) for name in plan.signals
        }  # (values, good) each
        marks = {}
        for name, (_, good) in found.items():
            place = f"{plan.path}: {plan.place}.{name}"
            if not good.any():
                columns_ = ", ".join(plan.signals[name])
                raise BadData(f"{place}: no numbers from {clock.time[0]:g} to {clock.time[-1]:g} s in {columns_}")
            marks[name] = lost_samples(clock, good)
            if not self.gaps and (marks[name] == LONG).any():
                first, last = runs(marks[name] == LONG)[0]
                raise BadData(
                    f"{place}: {last - first} samples without numbers, {(last - first) * clock.step:.3f} s from "
                    f"{clock.time[first]:.3f} s; {_too_long(clock)}"
                )
        every = np.max(list(marks.values()), axis=0)
        gap = every == LONG if self.gaps else None
        if "orientation" in found:
            quat = bridge_quat(found["orientation"][0], marks["orientation"], clock)
            return Sensor(quat_WS=quat, stated_quat_LS=plan.mount, gap=gap), every
        gyro_S = bridge(found["gyro"][0], marks["gyro"], clock, rate=True)
        accel_S = bridge(found["accel"][0], marks["accel"], clock)
        return Sensor(gyro_S=gyro_S, accel_S=accel_S, stated_quat_LS=plan.mount, gap=gap), every

    def _signal(
        self, plan: _Plan, name: str, clock: Clock, table: pl.DataFrame, first_row: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values (n, k) in SI on the clock, and which of them are there (n,)."""
        place = f"{self.path}: {plan.place}.{name}"
        read = columns(table, plan.signals[name], str(plan.path), place, first_row)
        there = clock.row >= 0
        if there.all() and len(read) == len(clock.row):
            values = read
        else:
            values = np.full((len(clock.row), read.shape[1]), np.nan)
            values[there] = read[clock.row[there] - first_row]
        good = np.isfinite(values).all(axis=1)
        if name != "orientation":
            return self._units[name] * values, good
        norm = np.linalg.norm(values, axis=1)
        good &= norm > 0.0  # zeros stand for "not seen" in many exports
        odd = np.flatnonzero(good & (np.abs(norm - 1.0) > NORM_OFF))
        if odd.size:
            raise BadData(
                f"{plan.path}: {plan.place}.orientation has length {norm[odd[0]]:.3g} in row "
                f"{clock.row[odd[0]] + 1}; a unit quaternion is needed, columns in the order x, y, z, w"
            )
        return values / np.where(good, norm, np.nan)[:, None], good


def _sensor_keys(keys: Keys) -> tuple[dict[str, list[str]], np.ndarray | None]:
    """Columns by signal, and the mount as stated."""
    keys.allow("gyro", "accel", "orientation", "mount", "file", "time", "rate_hz", "offset_s")
    mount = _mount(keys.table("mount")) if "mount" in keys else None
    if "orientation" not in keys:
        return {"gyro": keys.names("gyro", 3), "accel": keys.names("accel", 3)}, mount
    if "gyro" in keys or "accel" in keys:
        raise BadSession(f"{keys.at('orientation')} stands beside gyro or accel; a sensor has one or the other")
    return {"orientation": keys.names("orientation", 4)}, mount


def _mount(keys: Keys) -> np.ndarray:
    keys.allow("up", "forward")
    up, forward = keys.choice("up", AXES), keys.choice("forward", AXES)
    if abs(AXES[up] @ AXES[forward]) > 0.5:
        raise BadSession(
            f"{keys.at('forward')} = '{forward}' is parallel to up = '{up}'; name two different sensor axes"
        )
    return mount_from_axes(up, forward)


def _phases(keys: Keys) -> dict[str, Intervals]:
    phases: dict[str, Intervals] = {}
    for name, value in keys.values.items():
        well = isinstance(value, list) and all(
            isinstance(pair, list) and len(pair) == 2 and all(is_number(v) for v in pair) for pair in value
        )
        if not well:
            raise BadSession(f"{keys.at(name)} = {value!r} is not a list of intervals; write [[from, to]] in seconds")
        phases[name] = tuple((float(a), float(b)) for a, b in value)
        for first, last in phases[name]:
            if not first < last:
                raise BadPhase(f"{keys.at(name)}: [{first:g}, {last:g}] is empty; the earlier time comes first")
    return phases


def _truth(path: Path, data: Keys) -> Path | None:
    name = data.text("truth", None)
    if name is None:
        return None
    if not (path.parent / name).is_file():
        raise MissingFile(
            f"{data.at('truth')}: no such file '{name}' beside {path.name}; name it rightly or not at all"
        )
    return path.parent / name


def _within(phases: Mapping[str, Intervals], time: np.ndarray) -> dict[str, Intervals]:
    """The phases cut to a piece; those that do not touch it are not in it."""
    low, high = float(time[0]), float(time[-1])
    cut = {name: tuple((max(a, low), min(b, high)) for a, b in spans) for name, spans in phases.items()}
    return {name: kept for name, spans in cut.items() if (kept := tuple(s for s in spans if s[0] < s[1]))}


def _cut(sensor: Sensor, first: int, last: int) -> Sensor:
    signals = {name: getattr(sensor, name) for name in ("gyro_S", "accel_S", "quat_WS", "gap")}
    return replace(sensor, **{name: v[first:last] for name, v in signals.items() if v is not None})


def _too_long(clock: Clock) -> str:
    return (
        f"up to {1e3 * clock.longest_bridge:.0f} ms are bridged; cut the recording there, or accept gaps by --gaps "
        f"(gaps=True)"
    )


def _gap_notes(marks: np.ndarray, step: float) -> Iterator[str]:
    """What was bridged, in words."""
    for mark, word in ((LONG, "long gaps accepted, bridged and marked"), (BRIDGED, "short gaps bridged")):
        spans = [last - first for first, last in runs(marks == mark)]
        if spans:
            yield f"{len(spans)} {word}: {sum(spans)} samples, the longest {1e3 * max(spans) * step:.0f} ms"
