"""What the sensors measured: SI units, one even time base, sensors named by the segment that they are on.

`Recording` is checked once; the rooms after this one rely on the check. What a file or a live source gives becomes one
in these steps: `clocks` (the sensors' own times, lost samples, resampling) of a file; `arrivals` of a live source;
`faults` and `plausibility` say whether the sensors measured, by the `limits` of what sensors can.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..arguments import EACH_TIME, Positive, check_array, check_fields, check_names, check_value
from ..diagnostics import Diagnostic
from ..documents import TomlTable
from ..errors import BadData, BadOption, BadPhase, WrongUnit, one_of
from .faults import check_arrays, find_gyro_range
from .intervals import Intervals, check_phases, check_time, find_runs, format_span, format_time, select_interval  # noqa: F401
from .plausibility import check_signals
from .sensors import AXES, ImuSensor, OrientationSensor, Sensor, compute_rate  # noqa: F401


def compute_mount(up: str, forward: str) -> np.ndarray:
    """Compute `quat_LS` (4,) xyzw from the sensor axes that point up and forward in the start pose, as ``"+x", "-z"``.

    The rows of R_LS are the segment's axes in the sensor.
    """
    up_S, forward_S = AXES[up], AXES[forward]
    return Rotation.from_matrix([forward_S, np.cross(up_S, forward_S), up_S]).as_quat()


def read_axes(table: TomlTable, up: str | None = None, forward: str | None = None) -> tuple[str, str]:
    """Read the two axis names from a table with the keys `up` and `forward`; missing keys take the defaults."""
    up, forward = table.choice("up", AXES, up), table.choice("forward", AXES, forward)
    if abs(AXES[up] @ AXES[forward]) > 0.5:
        raise table.error(f"{table.at('forward')} = '{forward}' is parallel to up = '{up}'; name two different axes")
    return up, forward


def find_mount_axes(quat_LS: np.ndarray) -> tuple[str, str]:
    """Find the axis names, up and forward, whose mount by `compute_mount` is nearest to this one."""
    R_LS = Rotation.from_quat(quat_LS)
    pairs = [(up, forward) for up in AXES for forward in AXES if AXES[up] @ AXES[forward] == 0.0]
    return min(pairs, key=lambda pair: (R_LS * Rotation.from_quat(compute_mount(*pair)).inv()).magnitude())


# Recordings ----------------------------------------------------------------------------------------------------------

# A start pose whose joints the session states.
CONFIGURATION = "configuration"

RATE_ERROR = 0.01  # allowed relative error of the stated rate; it is the relative error of all angles
LONGEST_STEP = 2.5  # allowed step between two times, in steps of the rate; readers resample uneven clocks


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
            As `check` and `check_signals`; a sensor that is neither, or that is dead or frozen.

        Examples
        --------
        >>> torso = recording.sensors["torso"]
        >>> mine = wp.Recording.from_arrays(100.0, torso=(torso.gyro_S, torso.accel_S), mounts={"torso": ("+z", "+x")})
        >>> mine.sensors
        {'torso': ImuSensor(2250 samples)}
        """
        check_value("rate_hz", rate_hz, Positive)
        check_value("mounts", mounts or {}, Mapping[str, tuple[str, str]])
        check_names("mounts", mounts or {}, sensors)
        built: dict[str, Sensor] = {}
        count = 0
        for segment, values in sensors.items():
            mount = None
            if mounts and segment in mounts:
                axes = dict(zip(("up", "forward"), mounts[segment], strict=False))
                mount = compute_mount(*read_axes(TomlTable(axes, "mounts", f"{segment}.", BadOption)))
            arrays: tuple[Any, ...] = values if isinstance(values, tuple) else (values,)
            shapes = [getattr(each, "shape", type(each).__name__) for each in arrays]
            if [shape[1:] for shape in shapes] == [(4,)]:
                built[segment] = OrientationSensor(arrays[0], mount)
            elif [shape[1:] for shape in shapes] == [(3,), (3,)]:
                built[segment] = ImuSensor(arrays[0], arrays[1], mount)
            else:
                needed = "the arrays gyro_S and accel_S, (n, 3) each, or quat_VS, (n, 4), are needed"
                raise BadData(f"{segment}: {needed}, not {' and '.join(map(str, shapes))}")
            count = count or len(arrays[0])
        recording = cls(name, np.arange(count) / rate_hz, rate_hz, built, phases or {}).check()
        check_arrays(f"{name}: sensors.", rate_hz, {each: (s.gyro_S, s.accel_S) for each, s in recording.imus.items()})
        for each, imu in recording.imus.items():
            built[each] = replace(imu, gyro_range=find_gyro_range(imu.gyro_S, imu.accel_S))
        recording = replace(recording, sensors=built)
        try:
            return replace(recording, diagnostics=recording.check_signals())
        except WrongUnit as error:
            raise BadData(
                f"{error.finding}; gyro_S in rad/s, accel_S in m/s² and the right rate_hz are needed"
            ) from None

    def check(self) -> Recording:
        """Check a recording and return it.

        `BadOption`: a field has a wrong type. `BadData`: shapes differ, samples are too few, a number is not finite,
        time does not increase or contradicts the rate. `BadPhase`: a phase is empty or outside the recording.
        """
        where, time = self.where(), self.time
        check_fields(self, f"{where}: ")
        count = len(time)
        if not self.sensors:
            raise BadData(f"{where}: no sensors; at least one is needed")
        if count < 2:
            raise BadData(f"{where}: time has {count} samples; a recording has at least 2")
        check_array(f"{where}: time", time, (count,), kind="missing")
        check_time(where, time)
        steps, seconds = count - 1, float(time[-1] - time[0])
        if abs(seconds * self.rate_hz - steps) > max(1.0, RATE_ERROR * steps):
            raise BadData(
                f"{where}: rate_hz = {self.rate_hz:g}, and time has {steps / seconds:.6g} samples a second; they must "
                f"agree to {100.0 * RATE_ERROR:g} %"
            )
        k = int(np.argmax(np.diff(time)))
        if (time[k + 1] - time[k]) * self.rate_hz > LONGEST_STEP:
            raise BadData(
                f"{where}: time goes from {time[k]:.3f} to {time[k + 1]:.3f} s in one step at {self.rate_hz:g} Hz; "
                f"fill or cut the gap first"
            )
        if not all(0 <= tick < count for tick in self.resets):
            raise BadOption(f"{where}: resets = {self.resets}: samples from 0 to {count - 1} are needed")
        for segment, sensor in self.sensors.items():
            place = f"{where}: sensors.{segment}"
            if isinstance(sensor, ImuSensor):
                check_array(f"{place}.gyro", sensor.gyro_S, (count, 3), EACH_TIME)
                check_array(f"{place}.accel", sensor.accel_S, (count, 3), EACH_TIME)
            else:
                check_array(f"{place}.orientation", sensor.quat_VS, (count, 4), EACH_TIME, unit=1e-6)
            if sensor.stated_quat_LS is not None:
                check_array(f"{place}.stated_quat_LS", sensor.stated_quat_LS, (4,), unit=1e-6)
            if sensor.gap is not None:
                check_array(f"{place}.gap", sensor.gap, (count,), EACH_TIME, kind="flag")
        check_phases(where, time, self.phases)
        return self

    def check_signals(self) -> tuple[Diagnostic, ...]:
        """Check the sensors' values as `plausibility.check_signals` does."""
        return check_signals(self.where(), self.time, self.rate_hz, self.phases, self.imus)

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
        """Return the recording of a span of samples; `phases` are not cut."""
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
            add, free = "add", "; without joined hands: `protocol` free" if name == "clasp" else ""
            if (source := Path(self.where())).suffix == ".mcap":
                add = f"write a session by `wepose info {source.name} --write` and add"
            raise BadPhase(
                f"{self.where()}: phases.{name} is needed here and missing; {add} [phases] {name} = [[from, to]] in "
                f"seconds; {one_of(self.phases, name)}{free}"
            )
        return intervals


def join_recordings(first: Recording, second: Recording) -> Recording:
    """Join two recordings of the same sensors in time: diagnostics of both, other fields of the first."""
    sensors: dict[str, Sensor] = {}
    for name in first.sensors:
        sensor, joined = second.sensors[name], dict[str, Any](gap=None)
        for signal in ("gyro_S", "accel_S", "gap") if isinstance(sensor, ImuSensor) else ("quat_VS", "gap"):
            pair = [getattr(part, signal) for part in (first.sensors[name], sensor)]
            if all(values is not None for values in pair):
                joined[signal] = np.concatenate(pair)
        sensors[name] = replace(sensor, **joined)
    resets = (*first.resets, *(len(first) + tick for tick in second.resets))
    diagnostics = (*first.diagnostics, *(each for each in second.diagnostics if each not in first.diagnostics))
    time = np.concatenate([first.time, second.time])
    return replace(first, time=time, sensors=sensors, resets=resets, diagnostics=diagnostics)
