"""What a reader finds in the file of a device: its sensors, in SI, each with its clock."""

import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..body import load_table
from ..data_tables import LARGEST_NUMBER
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, one_of
from ..libraries import library_errors
from ..recording.clocks import interpolate, spread_equal_times
from ..recording.limits import STANDARD_GRAVITY
from .guess import guess_unit

# What a sensor is read for → the signals that it needs.
NEEDED = {"raw": ("gyro", "accel"), "orientation": ("orientation",)}
GYRO_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
ACCEL_UNITS = {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY}
FEWEST = 3  # samples of a recording
# Where the gyroscope's clock is not the accelerometer's, a sample is between two that are at most so many steps apart.
LONGEST_STEPS = 2.5


class Signal(NamedTuple):
    """The samples of one signal of a sensor."""

    time: np.ndarray  # (n,) [s]
    values: np.ndarray  # (n, 3) in SI, or (n, 4) xyzw; NaN: lost


class DeviceSensor(NamedTuple):
    """A sensor in a device's file."""

    time: np.ndarray  # (n,) [s] on the device's clock
    signals: Mapping[str, np.ndarray]  # "gyro" [rad/s] and "accel" [m/s²] (n, 3), or "orientation" (n, 4) xyzw
    segment: str | None = None  # that its name says; None: it is not clear
    mount: np.ndarray | None = None  # (4,) xyzw, sensor to segment, where the file states it


class Device(NamedTuple):
    """The contents of a device's file."""

    kind: str  # a key of `NEEDED`
    sensors: Mapping[str, DeviceSensor]  # the file's name of each sensor or segment → what it measured
    since_power_on: bool = True  # the clock starts at power-on, or at another arbitrary moment
    aligned: bool = False  # the orientations are the segments' own, in one world
    diagnostics: tuple[Diagnostic, ...] = ()  # assumptions, and missing data

    @property
    def begin(self) -> float:
        """The earliest time [s] of its sensors."""
        return min(float(np.nanmin(sensor.time)) for sensor in self.sensors.values())


class Reference(NamedTuple):
    """What another system measured, on its own clock and in its own world V."""

    time: np.ndarray  # (n,) [s]
    quat_VT: Mapping[str, np.ndarray]  # segment → (n, 4) xyzw, its frame to V; NaN: missing
    points: Mapping[str, np.ndarray]  # point → (n, 3) [m] in V; NaN: missing
    up: str | None = None  # the axis of V that is up; None: not known
    own_frames: bool = False  # frames are of another convention than ours
    diagnostics: tuple[Diagnostic, ...] = ()


def make_device(
    path: Path,
    sensors: Mapping[str, Mapping[str, Signal]],
    needs: str,
    use: str | None = None,
    rate_hz: float | None = None,
    diagnostics: Sequence[Diagnostic] = (),
    hints: Mapping[str, str] | None = None,
) -> Device:
    """Make a `Device` of the signals of its sensors, label → signal → samples.

    Parameters
    ----------
    needs : what the file must have, for an error's text
    use : "raw" or "orientation"; None: raw data where a sensor has them, else orientations
    rate_hz : replaces the times
    hints : label → another text that may name its segment

    Raises
    ------
    BadData
        No sensor has what `use` asks for; numbers that no device measures; signals without a time in common.
    """
    for kind in [use] if use else NEEDED:
        complete = {label: each for label, each in sensors.items() if set(NEEDED[kind]) <= set(each)}
        if complete:
            break
    else:
        raise BadData(f"{path}: no sensor in it has {needs}{'; leave out data.use' if use else ''}")
    read: dict[str, DeviceSensor] = {}
    for label, signals in complete.items():
        for signal in NEEDED[kind]:
            check_measured(f"{path}: {signal} of {label}", signals[signal].values)
        time, values = join_signals(f"{path.name} {label}", {name: signals[name] for name in NEEDED[kind]})
        if len(time) < FEWEST:
            raise BadData(f"{path}: holds {len(time)} samples of {label}; the export is empty or cut off")
        texts = [label, (hints or {}).get(label, ""), path.absolute().stem if len(complete) == 1 else ""]
        segment = next(filter(None, map(load_table().guess_segment, filter(None, texts))), None)
        read[label] = DeviceSensor(np.arange(len(time)) / rate_hz if rate_hz else time, values, segment)
    if left_out := [label for label in sensors if label not in read]:
        facts = {"devices": ", ".join(left_out), "signals": " and ".join(NEEDED[kind])}
        missing = Diagnostic("sensors-left-out", WARNING, path.name, len(left_out), facts=facts)
        diagnostics = [*diagnostics, missing]
    return Device(kind, read, diagnostics=tuple(diagnostics))


def convert(path: Path, signal: str, values: np.ndarray, unit: str, column: str) -> np.ndarray:
    """Convert values of gyro or accel to SI by what the file calls their unit; raise `BadData` where it is unknown."""
    known = GYRO_UNITS if signal == "gyro" else ACCEL_UNITS
    guess = guess_unit(signal, unit)
    if guess is None:
        stated = f"'{unit}'" if unit else "no unit that it states"
        raise BadData(f"{path}: '{column}' is in {stated}; {one_of(known, unit)}")
    return known[guess] * values


def join_signals(place: str, signals: Mapping[str, Signal]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Join signals of different clocks on that of the first: times (n,) and values by signal.

    Values of the second signal between two samples are interpolated, NaN where these are further apart than
    `LONGEST_STEPS`. `BadData` is raised where they have no time in common.
    """
    (name, first), *rest = signals.items()
    if all(signal.time is first.time for _, signal in rest):
        return first.time, {name: signal.values for name, signal in signals.items()}
    ((other, second),) = rest
    (time, rates), (own, forces) = map(_sort_known, (first, second))
    inside = (time >= own[:1].max(initial=-np.inf)) & (time <= own[-1:].min(initial=np.inf))
    if len(own) < 2 or inside.sum() < 2:
        raise BadData(f"{place}: {name} and {other} have no time in common, of {len(time)} and {len(own)} rows")
    time, rates = time[inside], rates[inside]
    after = np.clip(np.searchsorted(own, time), 1, len(own) - 1)
    joined = interpolate(own, forces, time)
    far = own[after] - own[after - 1] > LONGEST_STEPS * np.median(np.diff(own))
    joined[far & (time != own[after]) & (time != own[after - 1])] = np.nan
    return time, {name: rates, other: joined}


def _sort_known(signal: Signal) -> Signal:
    known = np.flatnonzero(np.isfinite(signal.time))
    order = known[np.argsort(signal.time[known], kind="stable")]
    return Signal(spread_equal_times(signal.time[order]), signal.values[order])


@contextmanager
def open_folder(path: Path) -> Iterator[dict[str, Path]]:
    """Open a folder, or a zip of one, as name → file; of a file of neither kind, what lies beside it."""
    if path.suffix.lower() != ".zip" or path.is_dir():
        folder = path if path.is_dir() else path.absolute().parent
        yield {file.name: file for file in sorted(folder.iterdir()) if file.is_file()}
        return
    with tempfile.TemporaryDirectory() as unpacked:
        with library_errors(path, "a zip"), zipfile.ZipFile(path) as archive:
            archive.extractall(unpacked)
        yield {file.name: file for file in sorted(Path(unpacked).rglob("*")) if file.is_file()}


def check_measured(place: str, values: np.ndarray) -> None:
    """Raise an error on numbers (n, k) beyond `LARGEST_NUMBER`; `place` begins its text."""
    too_large = np.flatnonzero((np.abs(values) > LARGEST_NUMBER).any(axis=1))
    if too_large.size:
        largest = np.nanmax(np.abs(values[too_large[0]]))
        raise BadData(f"{place} holds {largest:.3g} in row {too_large[0] + 1}; no device measures as much")
