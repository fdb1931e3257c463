"""The filters of a recording's sensors: chunk by chunk, each sensor in a world of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import Diagnostic
from ..errors import WeposeError
from ..recording import CONFIGURATION, OrientationSensor, Recording
from . import BEST, OFFLINE, Orientation, SensorRun, check_method
from .base import run_in_parallel
from .noise import SensorNoise, estimate_noise
from .phases import check_common_rotation, check_motion, find_reference_phases
from .static import StaticTest


class FilteredRecording(NamedTuple):
    """Every sensor in its own world, before any mount is known."""

    R_VS: dict[str, Rotation]  # segment → n orientations of its sensor
    at_start: dict[str, Rotation]  # their mean in the start pose
    orientation: dict[str, Orientation]  # what the filter gave; none for measured orientations
    start: tuple[float, float]  # [s]
    static_phase: tuple[float, float]  # [s]
    diagnostics: list[Diagnostic]  # of the recording, and of its start pose


class SensorFilters:
    """The filters of a recording that comes in chunks; `filter_recording` is one chunk.

    Parameters
    ----------
    first : the chunk that the recording begins with, and in which the phases `start` and `static` are
    method, static_test : as `filter_recording`

    Attributes
    ----------
    start, static_phase, diagnostics : as in `FilteredRecording`
    ahead : the smoother's: `push` gives the chunk before, and the last one comes from `finish`

    Raises
    ------
    WeposeError
        A start phase in which there are too few samples; an unknown method.
    """

    def __init__(self, first: Recording, *, method: str = BEST, static_test: StaticTest | None = None) -> None:
        check_method(method)
        self.start, self.static_phase, self.diagnostics = find_reference_phases(first)
        self._held: Recording | None = None  # the chunk that the smoother has not given yet
        self._runs: dict[str, SensorRun] = {}
        noises: dict[str, SensorNoise] = {}
        for segment, sensor in first.sensors.items():
            if not sensor.aligned:
                self.diagnostics += check_motion(first, segment, self.start, "start")
            if self.static_phase != self.start and not sensor.aligned:
                self.diagnostics += check_motion(first, segment, self.static_phase, "static")
            if isinstance(sensor, OrientationSensor):
                continue
            at_rest = first.find_measured(segment, self.static_phase)
            try:
                worn = self.static_phase == self.start and first.start_pose != CONFIGURATION  # a robot does not sway
                noise = estimate_noise(sensor.gyro_S[at_rest], sensor.accel_S[at_rest], first.rate_hz, worn)
            except WeposeError as error:
                raise type(error)(f"{first.where()}: sensors.{segment}: {error}") from error
            noises[segment] = noise
        self.diagnostics += check_common_rotation(first, noises, self.static_phase)
        for segment, noise in noises.items():
            self._runs[segment] = SensorRun(
                first.rate_hz,
                noise,
                method,
                static_test=static_test,
                measured_start=True,
                start=first.span(self.start),
                gyro_range=first.imus[segment].gyro_range,
            )
        self.ahead = method in OFFLINE and bool(self._runs)

    def push(self, chunk: Recording) -> tuple[Recording, dict[str, Orientation]] | None:
        """Take a chunk; gives a chunk and what the filters say of it: this one, or with the smoother the one before."""
        measured = []
        for segment in self._runs:
            sensor = chunk.imus[segment]
            gyro_S, accel_S = sensor.gyro_S, sensor.accel_S
            if sensor.gap is not None:
                # A long bridge is a guess that no filter may take for measured: lost, its covariance grows over it.
                gyro_S, accel_S = (np.where(sensor.gap[:, None], np.nan, values) for values in (gyro_S, accel_S))
            measured.append((gyro_S, accel_S))
        before, self._held = self._held, chunk
        results = run_in_parallel(lambda run, of: run.push(*of), self._runs.values(), measured)
        orientation = {segment: of for segment, of in zip(self._runs, results, strict=True) if of is not None}
        if len(orientation) < len(self._runs):
            return None
        filtered = before if self.ahead else chunk
        assert filtered is not None
        return filtered, orientation

    def finish(self) -> tuple[Recording, dict[str, Orientation]]:
        """The smoother's last chunk."""
        assert self._held is not None
        orientation = run_in_parallel(SensorRun.finish, self._runs.values())
        return self._held, dict(zip(self._runs, orientation, strict=True))


def filter_recording(
    recording: Recording, *, method: str = BEST, static_test: StaticTest | None = None
) -> FilteredRecording:
    """Filter every sensor; the start pose, and how still it was.

    Raises
    ------
    WeposeError
        A start phase in which there are too few samples; an unknown method.
    """
    filters = SensorFilters(recording, method=method, static_test=static_test)
    _, orientation = filters.push(recording) or filters.finish()
    return combine_chunk(filters, recording, orientation)


def combine_chunk(
    filters: SensorFilters, chunk: Recording, orientation: Mapping[str, Orientation]
) -> FilteredRecording:
    """A chunk that `filters` gave, if the start pose is in it."""
    R_VS = collect_rotations(chunk, orientation)
    at_start = {segment: R[chunk.find_measured(segment, filters.start)].mean() for segment, R in R_VS.items()}
    return FilteredRecording(
        R_VS, at_start, dict(orientation), filters.start, filters.static_phase, filters.diagnostics
    )


def collect_rotations(chunk: Recording, orientation: Mapping[str, Orientation]) -> dict[str, Rotation]:
    """Segment → n orientations of its sensor, each in a world of its own."""
    return {
        segment: Rotation.from_quat((sensor if isinstance(sensor, OrientationSensor) else orientation[segment]).quat_WS)
        for segment, sensor in chunk.sensors.items()
    }
