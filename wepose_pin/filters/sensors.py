"""The filters of a recording's sensors, chunk by chunk; each sensor has a world of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import Diagnostic
from ..errors import WeposeError
from ..recording import OrientationSensor, Recording
from . import BEST, FilterSettings, Orientation, SensorRun, check_method
from .base import run_in_parallel
from .noise import SensorNoise, estimate_noise
from .phases import check_common_rotation, check_motion, find_reference_phases
from .static import StaticTest


class FilteredRecording(NamedTuple):
    """Orientations of every sensor in its own world, without mounts."""

    R_VS: dict[str, Rotation]  # segment → n orientations of its sensor
    R_VS_start: dict[str, Rotation]  # their mean in the start pose
    orientation: dict[str, Orientation]  # the filter's result; none for measured orientations
    start: tuple[float, float]  # [s]
    static_phase: tuple[float, float]  # [s]
    diagnostics: list[Diagnostic]  # of the recording, and of its start pose


class SensorFilters:
    """The filters of a recording in chunks; `filter_recording` is one chunk.

    Parameters
    ----------
    first : the recording's first chunk, with the phases `start` and `static`
    method, static_test, sways : as in `filter_recording`

    Attributes
    ----------
    start, static_phase, diagnostics : as in `FilteredRecording`

    Raises
    ------
    WeposeError
        A start phase with too few samples; an unknown method.
    """

    def __init__(
        self, first: Recording, *, method: str = BEST, static_test: StaticTest | None = None, sways: bool = True
    ) -> None:
        check_method(method)
        self.start, self.static_phase, self.diagnostics = find_reference_phases(first)
        self._runs: dict[str, SensorRun] = {}
        noises: dict[str, SensorNoise] = {}
        for segment, sensor in first.sensors.items():
            if not sensor.aligned:
                self.diagnostics += check_motion(first, segment, self.start, "start")
            if self.static_phase != self.start and not sensor.aligned:
                self.diagnostics += check_motion(first, segment, self.static_phase, "static")
            if isinstance(sensor, OrientationSensor):
                continue
            static = first.find_measured(segment, self.static_phase)
            try:
                worn = self.static_phase == self.start and sways
                noise = estimate_noise(sensor.gyro_S[static], sensor.accel_S[static], first.rate_hz, worn)
            except WeposeError as error:
                raise type(error)(f"{first.where()}: sensors.{segment}: {error}") from error
            noises[segment] = noise
        self.diagnostics += check_common_rotation(first, noises, self.static_phase)
        for segment, noise in noises.items():
            settings = FilterSettings(
                method,
                static_test=static_test or StaticTest(),
                measured_start=True,
                start=first.span(self.start),
                gyro_range=first.imus[segment].gyro_range,
            )
            self._runs[segment] = SensorRun(first.rate_hz, noise, settings)

    def push(self, chunk: Recording) -> dict[str, Orientation]:
        """Filter a chunk; the smoother takes the whole recording as one."""
        measured = []
        for segment in self._runs:
            sensor = chunk.imus[segment]
            gyro_S, accel_S = sensor.gyro_S, sensor.accel_S
            if sensor.gap is not None:
                # A long bridge is a guess and no measurement: filters get NaN, and their covariance grows over it.
                gyro_S, accel_S = (np.where(sensor.gap[:, None], np.nan, values) for values in (gyro_S, accel_S))
            measured.append((gyro_S, accel_S))
        results = run_in_parallel(lambda run, signals: run.push(*signals), self._runs.values(), measured)
        return dict(zip(self._runs, results, strict=True))


def filter_recording(
    recording: Recording, *, method: str = BEST, static_test: StaticTest | None = None, sways: bool = True
) -> FilteredRecording:
    """Filter every sensor, and check that the start pose is static.

    Parameters
    ----------
    sways : whether a person stands in the start pose; a mechanism stands still

    Raises
    ------
    WeposeError
        A start phase with too few samples; an unknown method.
    """
    filters = SensorFilters(recording, method=method, static_test=static_test, sways=sways)
    return combine_chunk(filters, recording, filters.push(recording))


def combine_chunk(
    filters: SensorFilters, chunk: Recording, orientation: Mapping[str, Orientation]
) -> FilteredRecording:
    """Combine a chunk that contains the start pose with its orientations from `filters`."""
    R_VS = collect_rotations(chunk, orientation)
    R_VS_start = {segment: R[chunk.find_measured(segment, filters.start)].mean() for segment, R in R_VS.items()}
    return FilteredRecording(
        R_VS, R_VS_start, dict(orientation), filters.start, filters.static_phase, filters.diagnostics
    )


def collect_rotations(chunk: Recording, orientation: Mapping[str, Orientation]) -> dict[str, Rotation]:
    """Collect segment → n orientations of its sensor, each in a world of its own."""
    return {
        segment: Rotation.from_quat((sensor if isinstance(sensor, OrientationSensor) else orientation[segment]).quat_WS)
        for segment, sensor in chunk.sensors.items()
    }
