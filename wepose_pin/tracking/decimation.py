"""A recording tracked in chunks, decimated to what a page can show; extremes and what lasts are of all samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np

from ..alignment import join_segments
from ..kinematics import Pose
from ..recording import join_recordings
from .measures import Measures, Signal, measure, measure_signal, measure_tips
from .tracked import TrackedRecording

MOST = 20_000  # samples that are kept


class Decimator:
    """Takes the chunks of a tracked recording and keeps so many samples that they can be shown.

    Parameters
    ----------
    samples : of the whole recording; 0: all are kept
    """

    def __init__(self, samples: int) -> None:
        self._every = max(1, samples // MOST)
        self._seen = 0
        self._parts: list[TrackedRecording] = []
        self._signals: dict[str, list[Signal]] = {}
        self._peak_speed: dict[str, float] = {}
        self._steps = (np.inf, 0.0)
        self._last = np.nan  # [s]
        self._error: Exception | None = None

    def add(self, chunk: TrackedRecording) -> None:
        """Add the next chunk. `decimated` raises the errors of this function, so that they do not stop the tracking."""
        try:
            self._add(chunk)
        except Exception as error:
            self._error = self._error or error

    def _add(self, chunk: TrackedRecording) -> None:
        recording = chunk.recording
        at = np.arange(-self._seen % self._every, len(recording), self._every)
        for name in recording.sensors:
            self._take_signal(name, measure_signal(recording, name, chunk), at)
        for name, tip in measure_tips(chunk.pose, recording.rate_hz, chunk.model.table).items():
            self._peak_speed[name] = max(self._peak_speed.get(name, 0.0), tip.peak_speed)
        steps = 1e3 * np.diff(recording.time, prepend=self._last)
        self._steps = min(self._steps[0], float(np.nanmin(steps))), max(self._steps[1], float(np.nanmax(steps)))
        self._seen, self._last = self._seen + len(recording), float(recording.time[-1])
        if len(at):
            part = chunk if len(at) == len(recording) else _decimate(chunk, at, recording.rate_hz / self._every)
            self._parts.append(part)

    @cached_property
    def decimated(self) -> tuple[TrackedRecording, Measures]:
        """The kept samples, and the measures: extremes and what lasts of all samples, the rest of the kept ones.

        Raises the first error of `add`, of any kind.
        """
        if self._error is not None:
            raise self._error
        tracked = _join_recordings(self._parts)
        measures = measure(tracked, {name: _join_signals(parts) for name, parts in self._signals.items()})
        return tracked, replace(
            measures,
            samples=self._seen,
            rate_hz=tracked.recording.rate_hz * self._every,
            steps_ms=self._steps,
            tips={name: tip._replace(peak_speed=self._peak_speed[name]) for name, tip in measures.tips.items()},
        )

    def _take_signal(self, name: str, signal: Signal, at: np.ndarray) -> None:
        """Bins that begin at the kept samples; what comes before the first belongs to the last bin so far."""
        parts = self._signals.setdefault(name, [])
        edges = at if len(at) and at[0] == 0 else np.concatenate([[0], at]).astype(int)
        merged = signal._replace(
            rate=np.maximum.reduceat(signal.rate, edges),
            cut=np.logical_or.reduceat(signal.cut, edges),
            gap=np.logical_or.reduceat(signal.gap, edges),
            static=None if signal.static is None else np.logical_and.reduceat(signal.static, edges),
        )
        if len(edges) > len(at):
            before = parts[-1]
            before.rate[-1] = max(before.rate[-1], merged.rate[0])
            before.cut[-1] |= merged.cut[0]
            before.gap[-1] |= merged.gap[0]
            if before.static is not None and merged.static is not None:
                before.static[-1] &= merged.static[0]
            merged = merged._replace(
                rate=merged.rate[1:],
                cut=merged.cut[1:],
                gap=merged.gap[1:],
                static=None if merged.static is None else merged.static[1:],
            )
        if len(at):
            parts.append(merged)
        else:  # a chunk shorter than a bin: its bias is the last one, its peak may be the largest
            parts[-1] = parts[-1]._replace(bias=merged.bias, peak_accel=max(parts[-1].peak_accel, merged.peak_accel))


def _join_signals(parts: list[Signal]) -> Signal:
    static = [part.static for part in parts if part.static is not None]
    last = parts[-1]
    return last._replace(
        rate=np.concatenate([part.rate for part in parts]),
        cut=np.concatenate([part.cut for part in parts]),
        gap=np.concatenate([part.gap for part in parts]),
        static=np.concatenate(static) if static else None,
        peak_accel=max(part.peak_accel for part in parts),
    )


def _decimate(tracked: TrackedRecording, at: np.ndarray, rate_hz: float) -> TrackedRecording:
    """The samples `at` of a recording, as if it had been recorded so slowly."""
    pose, recording, segments = tracked.pose, tracked.recording, tracked.segments
    sensors = {name: sensor.part(at) for name, sensor in recording.sensors.items()}
    return replace(
        tracked,
        pose=Pose(*(_rows(getattr(pose, entry.name), at) for entry in fields(Pose))),
        recording=replace(recording, time=recording.time[at], rate_hz=rate_hz, sensors=sensors),
        segments=replace(
            segments,
            time=segments.time[at],
            quat_WL=_rows(segments.quat_WL, at),
            covariance_W=_rows(segments.covariance_W, at),
            orientation={name: orientation.take(at) for name, orientation in segments.orientation.items()},
        ),
    )


def _rows(values: Any, at: np.ndarray) -> Any:
    """Rows of an array, or of each array of a mapping."""
    if isinstance(values, Mapping):
        return {name: array[at] for name, array in values.items()}
    return None if values is None else values[at]


def _join_recordings(parts: list[TrackedRecording]) -> TrackedRecording:
    """One of many; what is one number comes from the last."""
    if len(parts) == 1:
        return parts[0]
    return replace(
        parts[-1],
        pose=Pose(*(_concatenate([getattr(part.pose, entry.name) for part in parts]) for entry in fields(Pose))),
        recording=reduce(join_recordings, [part.recording for part in parts]),
        segments=join_segments([part.segments for part in parts]),
    )


def _concatenate(values: list[Any]) -> Any:
    """Arrays put together, or each array of mappings; None where one is missing."""
    if isinstance(values[0], Mapping):
        return {name: np.concatenate([arrays[name] for arrays in values]) for name in values[0]}
    return None if any(value is None for value in values) else np.concatenate(values)
