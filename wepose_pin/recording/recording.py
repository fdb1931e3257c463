"""`Recording`: the sensors' measurements, checked once; the rooms after this one rely on the check."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..arguments import Positive, check_array, check_fields, check_numbers, check_value
from ..diagnostics import Diagnostic, notebook_html
from ..documents import TomlTable
from ..errors import BadData, BadOption, BadPhase, WrongOption, one_of
from .limits import MEDIAN_FORCE
from .sensors import ImuSensor, OrientationSensor, Sensor, compute_mount, join_sensors, read_axes

Intervals = tuple[tuple[float, float], ...]
MOST_BEYOND = 5.0  # samples by which an interval may exceed a recording: who states 0 s means its beginning

# A start pose whose joints the session states.
CONFIGURATION = "configuration"

RATE_ERROR = 0.01  # allowed relative error of the stated rate; it is the relative error of all angles
LONGEST_STEP = 2.5  # allowed step between two times, in steps of the rate; readers resample uneven clocks

EACH_TIME = ", a row for each time"  # part of an error's text on an array's shape


class Mark(NamedTuple):
    """A text that was marked at a time."""

    time: float  # [s]
    text: str


@dataclass(frozen=True)
class Recording:
    """Sensors on one uniform time base.

    Parameters
    ----------
    name : of the recording, for messages and titles
    time : (n,) [s], uniform at `rate_hz` to within the clock's jitter
    rate_hz : samples a second
    sensors : segment → `ImuSensor` or `OrientationSensor`, n samples each
    phases : name → intervals [s] on `time`; in `start` the person holds the start pose, in `static` the sensors lie on
        a table
    start_pose : the pose in the phase `start`: "n_pose", another that the body's table names, or "configuration"
    remounted : the sensors were remounted after the subject's calibration, so that its mounts do not hold here
    start_is_guessed : `phases.start` was found in the motion and not stated by the user
    source : the file of the recording, for messages
    truth : a file with reference poses; None: there is none
    resets : numbers of the samples before which a live session reset the headings, with the person in the start pose
    marks : texts that were marked in a live session, with their times [s]
    joints : joint → value [rad or m] in the start pose "configuration"; joints that are not named are at zero
    model : the body that wears the sensors: the file of a table or a URDF, or the name of a body of the package;
        empty: the upper body
    diagnostics : assumptions, bridged gaps and faults from reading
    """

    name: str
    time: np.ndarray
    rate_hz: Positive
    sensors: Mapping[str, Sensor]
    phases: Mapping[str, Intervals] = field(default_factory=dict)
    start_pose: str = "n_pose"
    remounted: bool = False
    start_is_guessed: bool = False
    source: Path | None = None
    truth: Path | None = None
    resets: tuple[int, ...] = ()
    marks: tuple[Mark, ...] = ()
    joints: Mapping[str, float] = field(default_factory=dict)
    model: str = ""
    diagnostics: tuple[Diagnostic, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        phases = f", phases {', '.join(self.phases)}" if self.phases else ""
        seconds = float(self.time[-1] - self.time[0])
        about = f"{seconds:.1f} s at {self.rate_hz:g} Hz, {len(self.sensors)} sensors"
        return f"Recording({self.name!r}: {about}{phases})"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{escape(segment)}</td><td>{escape(repr(sensor))}</td><td>mount "
            f"{'not ' if sensor.stated_quat_LS is None else ''}stated</td></tr>"
            for segment, sensor in self.sensors.items()
        )
        return notebook_html(self, self.diagnostics, [f"<table>{rows}</table>"])

    @classmethod
    def from_arrays(
        cls,
        rate_hz: float,
        *,
        name: str = "recording",
        phases: Mapping[str, Intervals] | None = None,
        mounts: Mapping[str, tuple[str, str]] | None = None,
        **sensors: tuple[np.ndarray, np.ndarray] | np.ndarray,
    ) -> Recording:
        """Make a recording of samples at an even rate, the first of them at 0 s, and check it.

        Parameters
        ----------
        rate_hz : float
            Samples a second.
        name : str
            Of the recording.
        phases : mapping, optional
            Name → intervals [s]; without `start` the start pose is found in the motion.
        mounts : mapping, optional
            Segment → axes of its sensor that point up and forwards in the N-pose, such as ("+z", "+x"); not needed with
            the subject of a calibration.
        **sensors
            Segment → (gyro_S, accel_S), (n, 3) [rad/s] and (n, 3) [m/s²], or quat_VS, (n, 4) xyzw. Fill or cut gaps
            first.

        Raises
        ------
        WeposeError
            As `check`; a sensor that is neither.

        Examples
        --------
        >>> torso = recording.sensors["torso"]
        >>> mine = wp.Recording.from_arrays(100.0, torso=(torso.gyro_S, torso.accel_S), mounts={"torso": ("+z", "+x")})
        >>> mine.sensors
        {'torso': ImuSensor(2250 samples)}
        """
        check_value("rate_hz", rate_hz, Positive)
        check_value("mounts", mounts or {}, Mapping[str, tuple[str, str]])
        built: dict[str, Sensor] = {}
        count = 0
        for segment, values in sensors.items():
            mount = None
            if mounts and segment in mounts:
                axes = dict(zip(("up", "forward"), mounts[segment], strict=False))
                mount = compute_mount(*read_axes(TomlTable(axes, "mounts", f"{segment}.", BadOption)))
            if isinstance(values, np.ndarray):
                built[segment] = OrientationSensor(values, mount)
            elif isinstance(values, tuple) and len(values) == 2:
                built[segment] = ImuSensor(*values, mount)
            else:
                raise BadData(f"{segment}: gyro_S and accel_S, (n, 3) each, or quat_VS, (n, 4), are needed")
            count = count or len(np.atleast_1d(values[0] if isinstance(values, tuple) else values))
        return cls(name, np.arange(count) / rate_hz, rate_hz, built, phases or {}).check()

    def check(self) -> Recording:
        """Check a recording that was built in code, as `check_recording`, and its unit of force; return it."""
        check_recording(self)
        for segment, sensor in self.imus.items():
            force = float(np.median(np.linalg.norm(sensor.accel_S, axis=1)))
            if force and not MEDIAN_FORCE[0] < force < MEDIAN_FORCE[1]:
                raise BadData(
                    f"{self.where()}: sensors.{segment}.accel_S is {force:.3g} in the median; m/s² is needed, 9.8 "
                    f"where nothing moves"
                )
        return self

    @property
    def imus(self) -> dict[str, ImuSensor]:
        """Segment → sensor, of the sensors that have a gyroscope and an accelerometer."""
        return {segment: sensor for segment, sensor in self.sensors.items() if isinstance(sensor, ImuSensor)}

    def where(self) -> str:
        """Return the beginning of an error's text: the file, or the recording's name."""
        return str(self.source) if self.source else self.name

    def span(self, interval: tuple[float, float]) -> slice:
        """Return the slice of samples within the interval [s], both ends included."""
        first, last = np.searchsorted(self.time, [interval[0] - 1e-9, interval[1] + 1e-9])
        return slice(int(first), int(last))

    def find_measured(self, segment: str, interval: tuple[float, float]) -> np.ndarray:
        """Return the numbers (k,) of the samples within the interval [s] that the sensor measured: those in no gap."""
        span, gap = self.span(interval), self.sensors[segment].gap
        samples = np.arange(len(self))[span]
        return samples if gap is None else samples[~gap[span]]

    def cut(self, span: slice) -> Recording:
        """Return the recording of a span of samples; `phases` and `marks` are not cut."""
        first, last, _ = span.indices(len(self))
        span = slice(first, last)
        sensors = {name: sensor.part(span) for name, sensor in self.sensors.items()}
        resets = tuple(tick - first for tick in self.resets if first <= tick < last)
        return replace(self, time=self.time[first:last], sensors=sensors, resets=resets)

    def chunks(self, seconds: float, first_s: float = 0.0) -> Iterator[Recording]:
        """Iterate over consecutive chunks of `seconds`; the last one may be half a chunk longer or shorter.

        The first one has `first_s` where that is more.
        """
        size = max(1, round(seconds * self.rate_hz))
        first, last = 0, max(size, round(first_s * self.rate_hz))
        while first < len(self):
            last = len(self) if len(self) - last < 0.5 * size else last
            yield self.cut(slice(first, last))
            first, last = last, last + size

    def phase(self, name: str) -> Intervals:
        """Return the intervals of a phase; `BadPhase`: the recording does not have it."""
        intervals = self.phases.get(name, ())
        if not intervals:
            live = bool(self.source) and str(self.source).endswith(".mcap")
            add = f"write a session by `wepose info {Path(self.where()).name} --write` and add" if live else "add"
            raise BadPhase(
                f"{self.where()}: phases.{name} is needed here and missing; {add} [phases] {name} = "
                f"[[from, to]] in seconds; {one_of(self.phases, name)}"
                f"{'; without joined hands: --protocol free' if name == 'clasp' else ''}"
            )
        return intervals


def join_recordings(first: Recording, second: Recording) -> Recording:
    """Join two recordings of the same sensors in time; diagnostics are those of both, all else is the first's."""
    sensors = {name: join_sensors([sensor, second.sensors[name]]) for name, sensor in first.sensors.items()}
    resets = (*first.resets, *(len(first) + tick for tick in second.resets))
    diagnostics = (*first.diagnostics, *(each for each in second.diagnostics if each not in first.diagnostics))
    time = np.concatenate([first.time, second.time])
    return replace(first, time=time, sensors=sensors, resets=resets, diagnostics=diagnostics)


def check_recording(recording: Recording) -> Recording:
    """Check a recording and return it.

    `BadOption`: a field has a wrong type. `BadData`: shapes differ, samples are too few, a number is not finite, time
    does not increase or contradicts the rate. `BadPhase`: a phase is empty or outside the recording.
    """
    where, time = recording.where(), recording.time
    check_fields(recording, f"{where}: ")
    if not recording.sensors:
        raise BadData(f"{where}: no sensors; one [sensors.<segment>] table each")
    if len(time) < 2:
        raise BadData(f"{where}: time has {len(time)} samples; a recording has at least 2")
    check_array(f"{where}: time", time, (len(time),))
    check_time(where, time)
    steps, seconds = len(time) - 1, float(time[-1] - time[0])
    if abs(seconds * recording.rate_hz - steps) > max(1.0, RATE_ERROR * steps):
        raise BadData(
            f"{where}: rate_hz = {recording.rate_hz:g}, and time has {steps / seconds:.6g} samples a second; they must "
            f"agree to {100.0 * RATE_ERROR:g} %"
        )
    k = int(np.argmax(np.diff(time)))
    if (time[k + 1] - time[k]) * recording.rate_hz > LONGEST_STEP:
        raise BadData(
            f"{where}: time goes from {time[k]:.3f} to {time[k + 1]:.3f} s in one step at {recording.rate_hz:g} Hz; "
            f"fill or cut the gap first"
        )
    if not all(0 <= tick < len(time) for tick in recording.resets):
        raise BadOption(f"{where}: resets = {recording.resets}: samples from 0 to {len(time) - 1} are needed")
    for segment, sensor in recording.sensors.items():
        place, count = f"{where}: sensors.{segment}", len(time)
        if isinstance(sensor, ImuSensor):
            check_numbers(f"{place}.gyro", sensor.gyro_S, (count, 3), EACH_TIME)
            check_numbers(f"{place}.accel", sensor.accel_S, (count, 3), EACH_TIME)
        else:
            check_numbers(f"{place}.orientation", sensor.quat_VS, (count, 4), EACH_TIME, unit=1e-6)
        if sensor.stated_quat_LS is not None:
            check_numbers(f"{place}.stated_quat_LS", sensor.stated_quat_LS, (4,), unit=1e-6)
        if sensor.gap is not None:
            check_array(f"{place}.gap", sensor.gap, (count,), "b", EACH_TIME)
    check_phases(where, time, recording.phases)
    return recording


# Times and intervals -------------------------------------------------------------------------------------------------


def format_time(time: float, decimals: int = 3) -> str:
    """Format a time [s] to the millisecond as in the file, also on a clock that starts in 1970."""
    return f"{time:.{decimals}f}".rstrip("0").rstrip(".")


def format_span(interval: Sequence[float] | np.ndarray) -> str:
    """Format an interval [s] as "begin to end s"."""
    return f"{format_time(interval[0])} to {format_time(interval[1])} s"


def check_time(where: str, time: np.ndarray) -> None:
    """Check that times (n,) [s] are finite and increase strictly; `where` begins the error's text."""
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise BadData(f"{where}: time: not a finite number in row {bad[0] + 1}; every row needs its time in seconds")
    back = np.flatnonzero(time[1:] <= time[:-1])
    if back.size:
        k = int(back[0])
        if time[k + 1] == time[k]:
            fault, remedy = "stands still", "delete one of the two rows"
        else:
            fault, remedy = "goes back", "sort the rows by time, or cut the recording there"
        raise BadData(
            f"{where}: time {fault} in row {k + 2}: {format_time(time[k + 1], 6)} s after {format_time(time[k], 6)} s; "
            f"it must grow in every row: {remedy}"
        )


def check_phases(where: str, time: np.ndarray, phases: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Check that every interval [s] has a positive length and lies in the recording, to `MOST_BEYOND` samples."""
    for name, intervals in phases.items():
        for first, last in intervals:
            place = f"{where}: phases.{name}: [{format_time(first)}, {format_time(last)}]"
            if not first < last:
                raise BadPhase(f"{place} is empty; the first number is the earlier one, in seconds")
            if _is_beyond(time, first, last):
                raise BadPhase(f"{place} is outside the recording, which runs from {time[0]:.3f} to {time[-1]:.3f} s")


def _is_beyond(time: np.ndarray, first: float, last: float) -> bool:
    slack = MOST_BEYOND * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return bool(first < time[0] - slack or last > time[-1] + slack)


def check_selection(interval: tuple[float, float] | None, phase: str | None = None) -> None:
    """Raise `WrongOption` where the interval [s] does not run forwards, or a phase is given besides."""
    if interval is None:
        return
    shown = f"{interval[0]:g} {interval[1]:g}"
    if not interval[0] < interval[1]:
        raise WrongOption("interval", shown, "two times in seconds are needed, the earlier one first")
    if phase is not None:
        raise WrongOption("interval", shown, f"--phase {phase} is given too; only one of them can select the time")


def select_interval(
    time: np.ndarray,
    phases: Mapping[str, Sequence[tuple[float, float]]],
    interval: tuple[float, float] | None,
    phase: str | None,
) -> tuple[float, float] | None:
    """Return the interval [s] that --interval or --phase selects; None: neither is given.

    `time` (n,) [s]: the interval may exceed it by `MOST_BEYOND` samples at each end. `phases`: name → intervals [s]; of
    a phase with several intervals ``NAME:2`` is the second. `WrongOption`: both are given; the interval is outside the
    recording; there is no such phase, or it has several intervals.
    """
    check_selection(interval, phase)
    if phase is None:
        if interval is not None and _is_beyond(time, *interval):
            shown = f"{format_time(interval[0])} {format_time(interval[1])}"
            raise WrongOption("interval", shown, f"the recording runs from {format_span((time[0], time[-1]))}")
        return interval
    name, number = phase, 0
    if phase not in phases and (numbered := re.fullmatch(r"(.+):(\d{1,6})", phase)):
        name, number = numbered[1], int(numbered[2])
    intervals = phases.get(name, ())
    if not intervals:
        known = [each for each in phases if phases[each]]
        choices = one_of(known, name) if known else "the recording has no phases; use --interval FROM TO"
        raise WrongOption("phase", phase, f"the recording has no such phase; {choices}")
    if number > len(intervals) or (number == 0 and (len(intervals) > 1 or name != phase)):
        spans = ", ".join(f"{name}:{k} ({format_span(span)})" for k, span in enumerate(intervals[:5], 1))
        more = f" … {name}:{len(intervals)}" if len(intervals) > 5 else ""
        count = "one interval" if len(intervals) == 1 else f"{len(intervals)} intervals"
        raise WrongOption("phase", phase, f"{name} has {count}; choose {spans}{more}")
    return intervals[max(number, 1) - 1]
