"""The session file: what the user writes about a recording (TOML), and the CSV or Parquet it names."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .. import so3
from ..errors import BadData, BadSession, MissingFile, one_of
from ..recording import AXES, SEGMENTS, START_POSES, Intervals, Recording, Sensor, check, mount_from_axes
from .tables import columns, read_table

GYRO_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
ACCEL_UNITS = {"m/s^2": 1.0, "g": 9.80665}
STRAPPINGS = ("as_calibrated", "new")

# A sample later than this after its neighbour is a gap, which nobody may fill in silence.
LONGEST_GAP_S = 0.05
# A step this far from the usual one (as a share of it) makes the rate uneven; clocks of devices jitter less.
UNEVEN = 0.5


def load_session(path: str | Path) -> Recording:
    """Read ``session.toml`` and the data it names.

    Raises
    ------
    WeposeError
        With one line that names the file, the key or column, the value found and what would be right.
    """
    path = Path(path)
    top = _Keys(_read_toml(path), path.name, "")
    top.allow("name", "start_pose", "strapping", "data", "phases", "sensors")
    data = top.table("data")
    data.allow("file", "time", "rate_hz", "gyro_unit", "accel_unit", "truth")
    tables = top.table("sensors")
    for segment in tables.values:
        if segment not in SEGMENTS:
            raise BadSession(f"{path.name}: sensors.{segment} is not a segment; {one_of(SEGMENTS, segment)}")

    clocks: dict[str, np.ndarray] = {}
    sensors: dict[str, Sensor] = {}
    for segment in tables.values:
        clocks[segment], sensors[segment] = _read_sensor(path, data, tables.table(segment))
    if not sensors:
        raise BadSession(
            f"{path.name}: no sensors; one [sensors.<segment>] table each, segments: {', '.join(SEGMENTS)}"
        )
    time, notes = _common_time(path.name, clocks)
    truth = data.text("truth", None)
    recording = Recording(
        name=top.text("name", path.parent.name) or path.stem,
        time=time,
        rate_hz=(len(time) - 1) / (time[-1] - time[0]),
        sensors={name: _on_time(sensor, clocks[name], time) for name, sensor in sensors.items()},
        phases=_phases(top.table("phases", {})),
        start_pose=top.choice("start_pose", START_POSES, "n_pose"),
        strapping=top.choice("strapping", STRAPPINGS, "as_calibrated"),
        source=path,
        truth=path.parent / truth if truth else None,
        notes=notes,
    )
    return check(recording)


def _read_toml(path: Path) -> dict[str, Any]:
    if path.is_dir():
        path = path / "session.toml"
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingFile(f"{path}: no such file; a session file is wanted here") from None
    except (OSError, UnicodeDecodeError) as error:
        raise MissingFile(f"{path}: cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise BadSession(f"{path.name}: not valid TOML: {error}") from error


@dataclass(frozen=True)
class _Keys:
    """A TOML table with its place, so that each error can say where it is."""

    values: Mapping[str, Any]
    file: str
    place: str

    def at(self, key: str) -> str:
        return f"{self.file}: {self.place}{key}"

    def allow(self, *known: str) -> None:
        for key in self.values:
            if key not in known:
                raise BadSession(f"{self.at(key)} is not a known key; {one_of(known, key)}")

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> _Keys:
        value = self.values.get(key, default)
        if value is None:
            raise BadSession(f"{self.at(key)} is missing; a table [{self.place}{key}] is needed")
        if not isinstance(value, dict):
            raise BadSession(f"{self.at(key)} = {value!r} is not a table; write [{self.place}{key}]")
        return _Keys(value, self.file, f"{self.place}{key}.")

    def text(self, key: str, default: str | None) -> str | None:
        value = self.values.get(key, default)
        if value is not None and not isinstance(value, str):
            raise BadSession(f"{self.at(key)} = {value!r} is not text; write it in quotes")
        return value

    def choice(self, key: str, choices: Any, default: str | None = None) -> str:
        value = self.text(key, default)
        if value is None:
            raise BadSession(f"{self.at(key)} is missing; {one_of(choices)}")
        if value not in choices:
            raise BadSession(f"{self.at(key)} = '{value}' is not known; {one_of(choices, value)}")
        return value

    def number(self, key: str, default: float | None, positive: bool = False) -> float | None:
        value = self.values.get(key, default)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise BadSession(f"{self.at(key)} = {value!r} is not a number")
        if positive and value <= 0:
            raise BadSession(f"{self.at(key)} = {value!r} must be greater than 0")
        return float(value)

    def names(self, key: str, count: int) -> list[str]:
        value = self.values.get(key)
        if not isinstance(value, list) or len(value) != count or not all(isinstance(v, str) for v in value):
            found = "missing" if value is None else f"{value!r}"
            raise BadSession(f"{self.at(key)} is {found}; a list of {count} column names is needed")
        return value


def _read_sensor(path: Path, data: _Keys, keys: _Keys) -> tuple[np.ndarray, Sensor]:
    """A sensor and its own clock [s]; keys of its own stand before those of [data]."""
    keys.allow("gyro", "accel", "orientation", "mount", "file", "time", "rate_hz", "offset_s")
    own = "file" in keys.values
    file = (keys if own else data).text("file", None)
    if file is None:
        raise BadSession(f"{data.at('file')} is missing; the .csv or .parquet file beside {path.name}")
    table = read_table(path.parent / file)
    clock_keys = keys if own or "time" in keys.values or "rate_hz" in keys.values else data
    name = clock_keys.text("time", None)
    rate_hz = clock_keys.number("rate_hz", None, positive=True)
    if (name is None) == (rate_hz is None):
        raise BadSession(
            f"{clock_keys.at('time')} or rate_hz is needed, one of the two: a column in seconds, or a rate"
        )
    if name is not None:
        clock = columns(table, [name], file, clock_keys.at("time"))[:, 0]
    else:
        assert rate_hz is not None
        clock = np.arange(table.height) / rate_hz
    clock = clock + (keys.number("offset_s", 0.0) or 0.0)

    mount = _mount(keys.table("mount")) if "mount" in keys.values else None
    if "orientation" in keys.values:
        if "gyro" in keys.values or "accel" in keys.values:
            raise BadSession(f"{keys.at('orientation')} stands beside gyro or accel; a sensor has one or the other")
        quat = columns(table, keys.names("orientation", 4), file, keys.at("orientation"))
        norm = np.linalg.norm(quat, axis=1)
        odd = np.flatnonzero(np.abs(norm - 1.0) > 1e-2)
        if odd.size:
            raise BadData(
                f"{file}: {keys.place}orientation has length {norm[odd[0]]:.3g} in row {odd[0] + 1}; "
                f"a unit quaternion is needed, columns in the order x, y, z, w"
            )
        return clock, Sensor(quat_WS=quat / norm[:, None], stated_quat_LS=mount)
    gyro_unit = GYRO_UNITS[data.choice("gyro_unit", GYRO_UNITS)]
    accel_unit = ACCEL_UNITS[data.choice("accel_unit", ACCEL_UNITS)]
    return clock, Sensor(
        gyro_S=gyro_unit * columns(table, keys.names("gyro", 3), file, keys.at("gyro")),
        accel_S=accel_unit * columns(table, keys.names("accel", 3), file, keys.at("accel")),
        stated_quat_LS=mount,
    )


def _mount(keys: _Keys) -> np.ndarray:
    keys.allow("up", "forward")
    up, forward = keys.choice("up", AXES), keys.choice("forward", AXES)
    if abs(AXES[up] @ AXES[forward]) > 0.5:
        raise BadSession(
            f"{keys.at('forward')} = '{forward}' is parallel to up = '{up}'; name two different sensor axes"
        )
    return mount_from_axes(up, forward)


def _phases(keys: _Keys) -> dict[str, Intervals]:
    phases: dict[str, Intervals] = {}
    for name, value in keys.values.items():
        well = isinstance(value, list) and all(
            isinstance(pair, list) and len(pair) == 2 and all(isinstance(v, int | float) for v in pair)
            for pair in value
        )
        if not well:
            raise BadSession(f"{keys.at(name)} = {value!r} is not a list of intervals; write [[from, to]] in seconds")
        phases[name] = tuple((float(a), float(b)) for a, b in value)
    return phases


def _common_time(where: str, clocks: Mapping[str, np.ndarray]) -> tuple[np.ndarray, tuple[str, ...]]:
    """One time base for all sensors: their own where they share an even one, else an even one over their overlap."""
    for segment, clock in clocks.items():
        # Sense of time first: the steps below mean nothing before it.
        check(Recording(f"{where}: sensors.{segment}", clock, 1.0, {segment: Sensor(quat_WS=np.ones((len(clock), 4)))}))
        step = np.diff(clock)
        gap = int(np.argmax(step))
        usual = float(np.median(step))
        if step[gap] > max(LONGEST_GAP_S, 2.5 * usual):
            raise BadData(
                f"{where}: sensors.{segment}: a gap of {step[gap]:.3f} s at {clock[gap]:.3f} s; at most "
                f"{LONGEST_GAP_S * 1e3:.0f} ms are bridged, cut the recording there"
            )
    first = next(iter(clocks.values()))
    shared = all(clock is first or np.array_equal(clock, first) for clock in clocks.values())
    steps = np.concatenate([np.diff(clock) for clock in clocks.values()])
    usual = float(np.median(np.diff(first)))
    uneven = float(np.max(np.abs(np.diff(first) / usual - 1.0)))
    if shared and uneven <= UNEVEN:
        return first, ()
    start, end = max(c[0] for c in clocks.values()), min(c[-1] for c in clocks.values())
    if not start < end:
        raise BadData(f"{where}: the sensors' clocks do not overlap; check each sensor's time and offset_s [s]")
    dt = 1.0 / np.round(1.0 / usual, 3)
    time = start + dt * np.arange(int((end - start) / dt + 1e-9) + 1)
    note = (
        f"resampled to {1.0 / dt:g} Hz from {start:.3f} to {end:.3f} s: "
        f"steps between {steps.min() * 1e3:.2f} and {steps.max() * 1e3:.2f} ms"
    )
    return time, (note,)


def _on_time(sensor: Sensor, clock: np.ndarray, time: np.ndarray) -> Sensor:
    """The sensor on another time base: rotations on the rotation, accelerations linearly.

    The gyroscope is integrated on its own clock, the orientation interpolated along each interval's own rate, and
    differenced again, so that no rotation is lost or made.
    """
    if clock is time:
        return sensor
    if sensor.quat_WS is not None:
        return replace(sensor, quat_WS=Slerp(clock, Rotation.from_quat(sensor.quat_WS))(time).as_quat())
    assert sensor.gyro_S is not None
    assert sensor.accel_S is not None
    turned = so3.integrate(sensor.gyro_S[1:] * np.diff(clock)[:, None])
    on_time = Slerp(clock, Rotation.from_quat(turned))(time)
    rate = (on_time[:-1].inv() * on_time[1:]).as_rotvec() / np.diff(time)[:, None]
    accel = np.column_stack([np.interp(time, clock, axis) for axis in sensor.accel_S.T])
    return replace(sensor, gyro_S=np.concatenate([rate[:1], rate]), accel_S=accel)
