"""A pose that comes in pieces, thinned to what a page can show; extremes and what lasts are kept from all samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..alignment import Segments
from ..diagnostics import Diagnostic, from_json
from ..filters import Orientation
from ..recording import Intervals, Recording
from ..tracking import TrackedPose
from .measures import Signal, hands_of, signal_of

MOST = 20_000  # samples that are kept


@dataclass(frozen=True)
class Whole:
    """What a thinned pose no longer tells of the recording."""

    samples: int
    rate_hz: float
    steps_ms: tuple[float, float]  # shortest and longest step between samples
    signals: Mapping[str, Signal]  # a row for each kept sample, of all from it to the next
    peak_speed: Mapping[str, float]  # hand → [m/s]
    diagnostics: Sequence[Diagnostic]


def whole_of(pose: TrackedPose) -> Whole:
    """That of a pose which has all its samples."""
    recording = pose.recording
    assert recording is not None
    steps = 1e3 * np.diff(recording.time)
    hands = hands_of(pose, recording.rate_hz)
    return Whole(
        len(recording),
        recording.rate_hz,
        (float(steps.min()), float(steps.max())),
        {name: signal_of(recording, name, pose) for name in recording.sensors},
        {name: hand.peak_speed for name, hand in hands.items()},
        [from_json(each) for each in pose.summary()["diagnostics"]],
    )


class Thinner:
    """Takes the pieces of `tracking.track_pieces`; `thinned` is for `track_report` and the page.

    Parameters
    ----------
    samples : of the whole recording
    """

    def __init__(self, samples: int) -> None:
        self._every = max(1, samples // MOST)
        self._seen = 0
        self._kept: list[TrackedPose] = []
        self._signals: dict[str, list[Signal]] = {}
        self._peak_speed: dict[str, float] = {}
        self._steps = (np.inf, 0.0)
        self._last = np.nan  # [s]
        self._error: Exception | None = None

    def add(self, piece: TrackedPose) -> None:
        """The next piece. What fails here is kept for `thinned`: it must not stop what the pieces are for."""
        try:
            self._add(piece)
        except Exception as error:
            self._error = self._error or error

    def _add(self, piece: TrackedPose) -> None:
        recording = piece.recording
        assert recording is not None
        at = np.arange(-self._seen % self._every, len(recording), self._every)
        for name in recording.sensors:
            self._take_signal(name, signal_of(recording, name, piece), at)
        for name, hand in hands_of(piece, recording.rate_hz).items():
            self._peak_speed[name] = max(self._peak_speed.get(name, 0.0), hand.peak_speed)
        steps = 1e3 * np.diff(recording.time, prepend=self._last)
        self._steps = min(self._steps[0], float(np.nanmin(steps))), max(self._steps[1], float(np.nanmax(steps)))
        self._seen, self._last = self._seen + len(recording), float(recording.time[-1])
        if len(at):
            self._kept.append(_rows(piece, at, recording.rate_hz / self._every))

    def thinned(self, phases: Mapping[str, Intervals], diagnostics: Sequence[Diagnostic]) -> tuple[TrackedPose, Whole]:
        """The pose, and what it no longer tells; `phases` and `diagnostics` of the whole recording.

        Raises the first error of `add`, of any kind.
        """
        if self._error is not None:
            raise self._error
        last = self._kept[-1]
        assert last.recording is not None
        pose = _joined(self._kept, phases)
        signals = {name: _joined_signal(parts) for name, parts in self._signals.items()}
        rate_hz = last.recording.rate_hz * self._every
        return pose, Whole(self._seen, rate_hz, self._steps, signals, self._peak_speed, diagnostics)

    def _take_signal(self, name: str, signal: Signal, at: np.ndarray) -> None:
        """Bins that begin at the kept samples; what comes before the first belongs to the last bin so far."""
        parts = self._signals.setdefault(name, [])
        edges = at if len(at) and at[0] == 0 else np.concatenate([[0], at]).astype(int)
        of = signal._replace(
            rate=np.maximum.reduceat(signal.rate, edges),
            cut=np.logical_or.reduceat(signal.cut, edges),
            gap=np.logical_or.reduceat(signal.gap, edges),
            rest=None if signal.rest is None else np.logical_and.reduceat(signal.rest, edges),
        )
        if len(edges) > len(at):
            before = parts[-1]
            before.rate[-1] = max(before.rate[-1], of.rate[0])
            before.cut[-1] |= of.cut[0]
            before.gap[-1] |= of.gap[0]
            if before.rest is not None and of.rest is not None:
                before.rest[-1] &= of.rest[0]
            of = of._replace(
                rate=of.rate[1:], cut=of.cut[1:], gap=of.gap[1:], rest=None if of.rest is None else of.rest[1:]
            )
        if len(at):
            parts.append(of)
        else:  # a piece shorter than a bin: its bias is the last one, its peak may be the largest
            parts[-1] = parts[-1]._replace(bias=of.bias, peak_accel=max(parts[-1].peak_accel, of.peak_accel))


def _joined_signal(parts: list[Signal]) -> Signal:
    rest = [part.rest for part in parts if part.rest is not None]
    last = parts[-1]
    return last._replace(
        rate=np.concatenate([part.rate for part in parts]),
        cut=np.concatenate([part.cut for part in parts]),
        gap=np.concatenate([part.gap for part in parts]),
        rest=np.concatenate(rest) if rest else None,
        peak_accel=max(part.peak_accel for part in parts),
    )


def _rows(pose: TrackedPose, at: np.ndarray, rate_hz: float) -> TrackedPose:
    """The samples `at` of a pose, as if it had been recorded so slowly."""
    assert pose.recording is not None
    assert pose.segments is not None

    def each(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: values[at] for name, values in arrays.items()}

    sensors = {}
    for name, sensor in pose.recording.sensors.items():
        signals = {key: getattr(sensor, key) for key in ("gyro_S", "accel_S", "quat_WS", "gap")}
        sensors[name] = replace(sensor, **{key: v[at] for key, v in signals.items() if v is not None})
    orientation = {
        name: Orientation(
            of.quat_WS[at],
            of.gyro_bias[at],
            of.static[at],
            None if of.attitude_cov is None else of.attitude_cov[at],
            of.noise,
        )
        for name, of in pose.segments.orientation.items()
    }
    return replace(
        pose,
        time=pose.time[at],
        quat_WL=each(pose.quat_WL),
        points=each(pose.points),
        q=None if pose.q is None else pose.q[at],
        segment_cov=each(pose.segment_cov),
        point_cov=each(pose.point_cov),
        gap=each(pose.gap),
        recording=replace(pose.recording, time=pose.recording.time[at], rate_hz=rate_hz, sensors=sensors),
        segments=replace(
            pose.segments,
            time=pose.segments.time[at],
            quat_WL=each(pose.segments.quat_WL),
            covariance_W=each(pose.segments.covariance_W),
            orientation=orientation,
        ),
    )


def _joined(poses: list[TrackedPose], phases: Mapping[str, Intervals]) -> TrackedPose:
    """One pose of many; what is one number comes from the last."""
    last = poses[-1]
    recordings = [pose.recording for pose in poses if pose.recording is not None]
    segments = [pose.segments for pose in poses if pose.segments is not None]

    def each(of: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        return {name: np.concatenate([arrays[name] for arrays in of]) for name in of[0]}

    def optional(values: list[Any]) -> np.ndarray | None:
        return None if any(value is None for value in values) else np.concatenate(values)

    sensors = {}
    for name, sensor in recordings[-1].sensors.items():
        all_of = [recording.sensors[name] for recording in recordings]
        sensors[name] = replace(
            sensor,
            gyro_S=optional([of.gyro_S for of in all_of]),
            accel_S=optional([of.accel_S for of in all_of]),
            quat_WS=optional([of.quat_WS for of in all_of]),
            gap=optional([of.gap for of in all_of]),
        )
    orientation = {}
    for name, last_of in segments[-1].orientation.items():
        runs = [s.orientation[name] for s in segments]
        orientation[name] = Orientation(
            np.concatenate([of.quat_WS for of in runs]),
            np.concatenate([of.gyro_bias for of in runs]),
            np.concatenate([of.static for of in runs]),
            optional([of.attitude_cov for of in runs]),
            last_of.noise,
        )
    joined: Segments = replace(
        segments[-1],
        time=np.concatenate([s.time for s in segments]),
        quat_WL=each([s.quat_WL for s in segments]),
        covariance_W=each([s.covariance_W for s in segments]),
        orientation=orientation,
    )
    recording: Recording = replace(
        recordings[0],
        time=np.concatenate([of.time for of in recordings]),
        sensors=sensors,
        phases=phases,
    )
    return replace(
        last,
        time=np.concatenate([pose.time for pose in poses]),
        quat_WL=each([pose.quat_WL for pose in poses]),
        points=each([pose.points for pose in poses]),
        q=optional([pose.q for pose in poses]),
        segment_cov=each([pose.segment_cov for pose in poses]),
        point_cov=each([pose.point_cov for pose in poses]),
        gap=each([pose.gap for pose in poses]),
        recording=recording,
        segments=joined,
    )
