"""Tracking without a look ahead: from the end of the start pose on, sample by sample or a recording at once.

Both go through the same compiled steps, so that a live session and its recording give the same quaternions to the bit.
The start pose is filtered when it has ended; nothing that comes later changes what was said.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..alignment import (
    START_POSE_STD,
    SWAYS_DEG,
    SWAYS_DEG_S,
    Segments,
    covariance_of,
    heading_to,
    segment_orientations,
)
from ..compilation import kernel
from ..errors import BadOption, BadPhase
from ..filters import BEST, OFFLINE, Orientation, check_method
from ..filters.bank import bank_of
from ..filters.base import in_parallel
from ..pose import spread
from ..recording import ImuSensor, Intervals, OrientationSensor, Recording, Sensor
from ..recording.clocks import Clock
from ..recording.gaps import GOOD, LONG, bridge
from ..rotations import product
from ..static import StaticTest
from ..subject import Subject

HOLD_S = 3.0  # [s] of standing still for a start pose that nobody named
LOOK_S = 0.1  # [s] from look to look at whether a person moves
QUIET_S = 0.5  # [s] over which a look goes
RESET_S = 0.5  # [s] over which the orientation is averaged for a heading reset


class StartGuide:
    """Waits for `HOLD_S` in which no sensor moves or is lost: the start pose of a session without `phases.start`.

    Attributes
    ----------
    state : "waiting" for sensors, "hold", "moved" (in the last second, and held again since), "ready"
    held_s : [s] of stillness so far
    missing, moving : columns of the sensors that are lost, or that moved last
    """

    def __init__(self, rate_hz: float, sensors: int, hold_s: float = HOLD_S) -> None:
        self.state, self.missing, self.moving = "waiting", tuple(range(sensors)), tuple[int, ...]()
        self._rate, self._hold = rate_hz, round(hold_s * rate_hz)
        self._every, self._window = max(1, round(LOOK_S * rate_hz)), max(4, round(QUIET_S * rate_hz))
        self._gyro = np.zeros((self._hold, sensors, 3))
        self._held = 0
        self._tick = 0
        self._moved_at = -np.inf

    @property
    def held_s(self) -> float:
        return self._held / self._rate

    @property
    def begin(self) -> int:
        """Tick with which the stillness began."""
        return self._tick - self._held

    @property
    def end(self) -> int:
        """The last tick so far."""
        return self._tick - 1

    def push(self, gyro_S: np.ndarray) -> str:
        """One tick, (k, 3) [rad/s], NaN where a sensor is lost; gives the state."""
        if self.state == "ready":
            return self.state
        self._tick += 1
        self.missing = tuple(np.flatnonzero(~np.isfinite(gyro_S).all(axis=1)).tolist())
        if self.missing:
            self.state, self._held = "waiting", 0
            return self.state
        self._gyro[self._held] = gyro_S
        self._held += 1
        if self._held % self._every == 0 or self._held == self._hold:
            held = self._gyro[: self._held]
            last = held[-self._window :]
            rate = np.sqrt(np.mean(np.sum((last - last.mean(axis=0)) ** 2, axis=2), axis=0))
            turn = np.linalg.norm(np.cumsum(held - held.mean(axis=0), axis=0) / self._rate, axis=2).max(axis=0)
            mean = np.linalg.norm(held.mean(axis=0), axis=1)
            moves = (np.degrees(rate) > SWAYS_DEG_S) | (np.degrees(turn) > SWAYS_DEG) | (np.degrees(mean) > SWAYS_DEG_S)
            if moves.any():
                self.moving = tuple(np.flatnonzero(moves).tolist())
                self._held, self._moved_at = 0, self._tick
        if self._held == self._hold:
            self.state = "ready"
        else:
            self.state = "moved" if self._tick - self._moved_at < self._rate else "hold"
        return self.state


class Run(NamedTuple):
    """A stretch of ticks through a `CausalTracker`; k sensors in the order of its `names`."""

    quat_WL: np.ndarray  # (n, k, 4) xyzw
    quat_VS: np.ndarray  # (n, k, 4) xyzw, each sensor in its own world
    gyro_bias: np.ndarray  # (n, k, 3) [rad/s]
    static: np.ndarray  # (n, k) bool
    attitude_cov: np.ndarray | None  # (n, k, 3, 3) [rad²], error on the right, in S; None: the filter has none


class CausalTracker:
    """Segment orientations from the end of the start pose on.

    Parameters
    ----------
    until : a recording that ends with its start pose, `phases.start`
    subject : lengths and mounts; None for the session's stated mounts

    Attributes
    ----------
    names : segments, in the order of all columns
    start : `Segments` of the start pose: mounts, headings, warnings
    heading : (k,) ψ [rad] from each sensor's world to W
    quat_WL, static, gyro_bias : (k, 4) xyzw, (k,), (k, 3) [rad/s] after the last step; overwritten by the next

    Raises
    ------
    WeposeError
        A method that needs the whole recording, sensors with measured orientations, and as `segment_orientations`.
    """

    def __init__(
        self,
        until: Recording,
        subject: Subject | None = None,
        *,
        method: str = BEST,
        static_test: StaticTest | None = None,
    ) -> None:
        check_method(method)
        if method in OFFLINE:
            raise BadOption(f"method '{method}' needs the whole recording; 'amekf' looks at nothing ahead")
        for name, sensor in until.sensors.items():
            if isinstance(sensor, OrientationSensor):
                raise BadOption(
                    f"{until.where()}: sensors.{name} comes with measured orientations: there is no filter to run "
                    f"causally; leave the option out"
                )
        self.start = segment_orientations(until, subject, method=method, static_test=static_test)
        self.names = tuple(until.sensors)
        self.rate_hz, self.method = until.rate_hz, method
        found = [self.start.orientation[name] for name in self.names]
        self._filters = [of.filter for of in found if of.filter is not None]
        self._detectors = [of.detector for of in found if of.detector is not None]
        self._bank = bank_of(self._filters, self._detectors)
        self._until, self._subject = until, subject
        self._mount = np.array([self.start.quat_LS[name] for name in self.names])
        self.heading = np.array([self.start.heading[name] for name in self.names])
        self._turn = _about_z(self.heading)
        self._recent = np.stack([of.quat_WS for of in found], axis=1)[-max(1, round(RESET_S * self.rate_hz)) :].copy()
        self._at = 0  # the oldest of them
        self.quat_WL = np.zeros((len(self.names), 4))
        _place(self._turn, self._recent[-1:], self._mount, self.quat_WL, self.quat_WL[None].copy())
        self._forgiven: np.ndarray | None = None  # (k,) [rad²] of heading that a reset took away

    @property
    def static(self) -> np.ndarray:
        return self._bank.static

    @property
    def gyro_bias(self) -> np.ndarray:
        return self._bank.gyro_bias

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """`quat_WL` (k, 4) after one tick, (k, 3) [rad/s], (k, 3) [m/s²], NaN where a sensor is lost."""
        self._recent[self._at] = self._bank.update(gyro_S, accel_S)
        _place(self._turn, self._recent[self._at : self._at + 1], self._mount, self.quat_WL, self.quat_WL[None])
        self._at = (self._at + 1) % len(self._recent)
        return self.quat_WL

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> Run:
        """Many ticks at once, (n, k, 3) each; for a tracker that is never stepped. The same bits as steps give."""
        n, k = gyro_S.shape[:2]
        gyro, accel = (np.ascontiguousarray(np.moveaxis(x, 1, 0), dtype=float) for x in (gyro_S, accel_S))
        statics = in_parallel(lambda i: self._detectors[i].run(gyro[i], accel[i]), range(k))
        runs = in_parallel(lambda i: self._filters[i].run(gyro[i], accel[i], statics[i]), range(k))
        quat_VS = np.stack([run.quat_WS for run in runs], axis=1)
        quat_WL = np.empty((n, k, 4))
        _place(self._turn, quat_VS, self._mount, self.quat_WL, quat_WL)
        self._recent = np.concatenate([self._in_order(), quat_VS])[-len(self._recent) :].copy()
        self._at = 0
        covs = [run.attitude_cov for run in runs if run.attitude_cov is not None]
        cov = np.stack(covs, axis=1) if covs else None
        return Run(quat_WL, quat_VS, np.stack([run.gyro_bias for run in runs], axis=1), np.stack(statics, axis=1), cov)

    def reset(self, heading_var: np.ndarray | None = None) -> None:
        """Headings anew: the person stands in the start pose again, and has for `RESET_S`.

        `heading_var` (k,) [rad²]: what the filters' own covariance says of the heading now; it no longer counts.
        """
        recent = self._in_order()
        aligned = recent * np.sign(np.einsum("nki,ki->nk", recent, recent[-1]))[:, :, None]
        mean = aligned.sum(axis=0)
        mean /= np.linalg.norm(mean, axis=1)[:, None]
        for i in range(len(self.names)):
            self.heading[i] = heading_to(Rotation.from_quat(mean[i]), Rotation.from_quat(self._mount[i]))
        self._turn = _about_z(self.heading)
        self._forgiven = heading_var if heading_var is not None else self.heading_var()

    def heading_var(self) -> np.ndarray | None:
        """(k,) [rad²] variance of each heading by its filter alone, of steps; None where the filter has none."""
        cov = self._bank.attitude_cov
        return None if cov is None else vertical_var(self._recent[self._at - 1], cov)

    def heading_std(self) -> np.ndarray:
        """(k,) [rad] one standard deviation of each segment's heading now, as `track` states it: the mounts' part too.

        NaN where the filter has none.
        """
        return np.sqrt([cov[2, 2] for cov in self._covariances_W()])

    def std(self) -> np.ndarray:
        """(k,) [rad] one standard deviation of an axis of each segment now; NaN where the filter has none."""
        return spread(self._covariances_W())

    def _covariances_W(self) -> np.ndarray:
        """(k, 3, 3) [rad²] of each segment in W now; NaN where the filter has none."""
        cov = self._bank.attitude_cov
        if cov is None:
            return np.full((len(self.names), 3, 3), np.nan)
        now = self._recent[self._at - 1]
        return np.concatenate([self.covariance_W(i, now[i : i + 1], cov[i : i + 1]) for i in range(len(cov))])

    def covariance_W(self, i: int, quat_VS: np.ndarray, attitude_cov: np.ndarray) -> np.ndarray:
        """(n, 3, 3) [rad²] of sensor i's segment in W, error on the left of `quat_WL`, since the last reset.

        As `alignment.covariance_of`; after a reset the heading is as good as a person stands, and grows from there.
        """
        R_WS = Rotation.from_rotvec([0.0, 0.0, self.heading[i]]) * Rotation.from_quat(quat_VS)
        of = self.start.orientation[self.names[i]]._replace(attitude_cov=attitude_cov)
        mount = Rotation.from_quat(self._mount[i])
        cov = covariance_of(self._until, self.names[i], self._subject, R_WS, mount, of)
        if self._forgiven is not None:
            var = vertical_var(quat_VS, attitude_cov)
            grown = np.maximum(0.0, var - self._forgiven[i])
            # The mount's part of the heading stays: the reset has set that of the start pose alone.
            share = np.sqrt((np.maximum(cov[:, 2, 2] - var, 0.0) + grown + START_POSE_STD**2) / cov[:, 2, 2])
            cov[:, 2, :] *= share[:, None]
            cov[:, :, 2] *= share[:, None]
        return cov

    def _in_order(self) -> np.ndarray:
        return np.concatenate([self._recent[self._at :], self._recent[: self._at]])


def causal_segments(
    recording: Recording,
    subject: Subject | None = None,
    *,
    method: str = BEST,
    static_test: StaticTest | None = None,
) -> tuple[Recording, Segments]:
    """What follows the start pose: that part of the recording, and its segments by a `CausalTracker`.

    Without `phases.start` the start pose is the first `HOLD_S` in which nothing moves, as in a live session. Headings
    are set anew before each of `recording.resets`.

    Raises
    ------
    WeposeError
        As `CausalTracker`; nobody stands still; nothing follows the start pose.
    """
    until, first = start_of(recording)
    tracker = CausalTracker(until, subject, method=method, static_test=static_test)
    names = tracker.names
    gyro, accel = np.empty((len(recording) - first, len(names), 3)), np.empty((len(recording) - first, len(names), 3))
    for i, name in enumerate(names):
        sensor = recording.imus[name]
        lost = np.zeros(len(gyro), dtype=bool) if sensor.gap is None else sensor.gap[first:]
        # A long bridge was made by what came after it: it is no look ahead only as a gap.
        gyro[:, i] = np.where(lost[:, None], np.nan, sensor.gyro_S[first:])
        accel[:, i] = np.where(lost[:, None], np.nan, sensor.accel_S[first:])
    resets = {tick - first for tick in recording.resets if first <= tick < len(recording)}  # two at once are one
    if 0 in resets:
        tracker.reset()
    edges = sorted({0, *resets, len(gyro)})
    runs: list[Run] = []
    covariances: list[list[np.ndarray]] = []
    for begin, end in pairwise(edges):
        if runs:
            last = runs[-1]
            cov = last.attitude_cov
            tracker.reset(None if cov is None else vertical_var(last.quat_VS[-1], cov[-1]))
        run = tracker.run(gyro[begin:end], accel[begin:end])
        runs.append(run)
        if run.attitude_cov is not None:
            cov = run.attitude_cov
            covariances.append([tracker.covariance_W(i, run.quat_VS[:, i], cov[:, i]) for i in range(len(names))])
    quat_WL, quat_VS, bias, static = (
        np.concatenate([getattr(run, part) for run in runs]) for part in ("quat_WL", "quat_VS", "gyro_bias", "static")
    )
    attitude = np.concatenate([run.attitude_cov for run in runs]) if covariances else None
    orientation = {
        name: Orientation(
            quat_VS[:, i],
            bias[:, i],
            static[:, i],
            None if attitude is None else attitude[:, i],
            tracker.start.orientation[name].noise,
        )
        for i, name in enumerate(names)
    }
    rest = _part(recording, slice(first, len(recording)))
    return rest, replace(
        tracker.start,
        time=rest.time,
        quat_WL={name: quat_WL[:, i] for i, name in enumerate(names)},
        heading={name: float(tracker.heading[i]) for i, name in enumerate(names)},
        orientation=orientation,
        covariance_W={name: np.concatenate([of[i] for of in covariances]) for i, name in enumerate(names)}
        if covariances
        else {},
    )


def start_of(recording: Recording) -> tuple[Recording, int]:
    """The recording until its start pose ends, with that as `phases.start`, and the first sample after it.

    Raises
    ------
    BadPhase
        No start pose; it ends with the recording.
    """
    if recording.phases.get("start"):
        interval = recording.phases["start"][0]
        last = recording.span(interval).stop
    else:
        guide = StartGuide(recording.rate_hz, len(recording.sensors))
        still = np.zeros((len(recording), 3))
        rates = [s.gyro_S if isinstance(s, ImuSensor) else still for s in recording.sensors.values()]
        for tick in np.stack(rates, axis=1):
            if guide.push(tick) == "ready":
                break
        else:
            raise BadPhase(
                f"{recording.where()}: nobody stands still for {HOLD_S:g} s ({guide.held_s:.1f} s at its end); "
                f"name the seconds of the start pose, [phases] start = [[from, to]]"
            )
        interval = float(recording.time[guide.begin]), float(recording.time[guide.end])
        last = guide.end + 1
    if last >= len(recording):
        raise BadPhase(f"{recording.where()}: phases.start ends with the recording; nothing is left to track")
    return until_start(recording, interval), last


def until_start(recording: Recording, interval: tuple[float, float]) -> Recording:
    """From the start pose's begin, or that of a phase `still` before its end, to its end.

    What was lost in it is bridged by what is left of it: whoever reads a whole recording bridges with what came later.

    Raises
    ------
    BadPhase
        A sensor that sent nothing in it.
    """
    before: dict[str, Intervals] = {"start": (interval,)}
    still = recording.phases.get("still", ())
    span = recording.span(interval)
    begin = span.start
    if still and still[0][1] <= interval[1]:
        before["still"] = still[:1]
        begin = min(begin, recording.span(still[0]).start)
    part = _part(recording, slice(begin, span.stop))
    clock = Clock(np.arange(len(part)) / part.rate_hz, np.arange(len(part)), 1.0 / part.rate_hz)
    sensors = {name: _bridged(part, name, clock) for name in part.sensors}
    return replace(part, phases=before, sensors=sensors)


def _bridged(part: Recording, name: str, clock: Clock) -> Sensor:
    """A sensor with its gaps filled anew."""
    sensor = part.sensors[name]
    if isinstance(sensor, OrientationSensor) or sensor.gap is None or not sensor.gap.any():
        return sensor
    if sensor.gap.all():
        raise BadPhase(f"{part.where()}: phases.start: sensors.{name} sent nothing in it; name seconds in which all do")
    marks = np.where(sensor.gap, LONG, GOOD).astype(np.int8)
    gyro_S, accel_S = bridge(sensor.gyro_S, marks, clock, rate=True), bridge(sensor.accel_S, marks, clock)
    return replace(sensor, gyro_S=gyro_S, accel_S=accel_S)


def _part(recording: Recording, span: slice) -> Recording:
    """The samples of a span; phases as they were."""
    sensors = {name: sensor.part(span) for name, sensor in recording.sensors.items()}
    return replace(recording, time=recording.time[span], sensors=sensors)


def vertical_var(quat_VS: np.ndarray, attitude_cov: np.ndarray) -> np.ndarray:
    """(n,) [rad²]: variance about the vertical of errors on the right (n, 3, 3), in S."""
    up_S = Rotation.from_quat(quat_VS).inv().apply([0.0, 0.0, 1.0])
    return np.einsum("na,nab,nb->n", up_S, attitude_cov, up_S)


def _about_z(angle: np.ndarray) -> np.ndarray:
    return rotations.exp(angle[:, None] * [0.0, 0.0, 1.0])


@kernel
def _place(turn, quat_VS, mount, last, out):  # type: ignore[no-untyped-def]
    """``turn ⊗ quat_VS ⊗ mount⁻¹`` for each of n ticks and k sensors, of the sign that is nearer to `last` (k, 4)."""
    for n in range(len(quat_VS)):
        for k in range(len(turn)):
            ax, ay, az, aw = turn[k, 0], turn[k, 1], turn[k, 2], turn[k, 3]
            bx, by, bz, bw = quat_VS[n, k, 0], quat_VS[n, k, 1], quat_VS[n, k, 2], quat_VS[n, k, 3]
            x, y, z, w = product(ax, ay, az, aw, bx, by, bz, bw)
            rx, ry, rz, rw = product(x, y, z, w, -mount[k, 0], -mount[k, 1], -mount[k, 2], mount[k, 3])
            sign = 1.0
            if rx * last[k, 0] + ry * last[k, 1] + rz * last[k, 2] + rw * last[k, 3] < 0.0:
                sign = -1.0
            last[k, 0], last[k, 1], last[k, 2], last[k, 3] = sign * rx, sign * ry, sign * rz, sign * rw
            out[n, k, 0], out[n, k, 1], out[n, k, 2], out[n, k, 3] = last[k, 0], last[k, 1], last[k, 2], last[k, 3]
