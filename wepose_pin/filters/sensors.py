"""The filters of a recording's sensors, chunk by chunk or a sample of each at a time; each sensor has its own world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import Diagnostic
from ..errors import BadData, WeposeError
from ..recording import OrientationSensor, Recording
from . import BEST, OFFLINE, FilterSettings, Orientation, SensorRun, amekf, check_method, smekf
from .base import FilterRun, run_in_parallel, symmetric
from .noise import SensorNoise, estimate_noise
from .phases import check_common_rotation, check_motion, find_reference_phases
from .static import StaticState, StaticTest

# Kernels that take a sample of each sensor, static detector and filter together.
STEPS = {"amekf": amekf.step_bank, "smekf": smekf.step_bank, "smekf_published": smekf.step_bank}


class FilteredRecording(NamedTuple):
    """Orientations of every sensor in its own world, without mounts."""

    R_VS: dict[str, Rotation]  # segment → n orientations of its sensor
    R_VS_start: dict[str, Rotation]  # their mean in the start pose
    orientation: dict[str, Orientation]  # the filter's result; none for measured orientations
    start: tuple[float, float]  # [s]
    static_phase: tuple[float, float]  # [s]
    diagnostics: list[Diagnostic]  # of the recording, and of its start pose


class SensorFilters:
    """The filters of a recording: `push` takes chunks, `step` a sample of each sensor, with bit-identical results.

    After the first chunk the states of all sensors share memory, so that `step` of a method in `STEPS` is one compiled
    call for all of them, which allocates nothing. The next `step` overwrites its result and the arrays named here.

    Parameters
    ----------
    first : the recording's first chunk, with the phases `start` and `static`
    method, static_test, sways : as in `filter_recording`

    Attributes
    ----------
    start, static_phase, diagnostics : as in `FilteredRecording`
    names : the k segments whose sensors have a filter
    quat_VS, gyro_bias : (k, 4) xyzw, (k, 3) [rad/s] now
    static : (k,) bool, of the last step

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
        self.names = tuple(noises)
        self._runs = [
            SensorRun(
                first.rate_hz,
                noise,
                FilterSettings(
                    method,
                    static_test=static_test or StaticTest(),
                    measured_start=True,
                    start=first.span(self.start),
                    gyro_range=first.imus[segment].gyro_range,
                ),
            )
            for segment, noise in noises.items()
        ]
        self._step: Any = STEPS.get(method) if self.names else None
        self._method, self._is_begun = method, False

    def push(self, chunk: Recording) -> dict[str, Orientation]:
        """Filter a chunk; the smoother takes the whole recording as one."""
        measured = []
        for segment in self.names:
            sensor = chunk.imus[segment]
            gyro_S, accel_S = sensor.gyro_S, sensor.accel_S
            if sensor.gap is not None:
                # A long bridge is a guess and no measurement: filters get NaN, and their covariance grows over it.
                gyro_S, accel_S = (np.where(sensor.gap[:, None], np.nan, values) for values in (gyro_S, accel_S))
            measured.append((gyro_S, accel_S))
        results = run_in_parallel(lambda run, signals: run.push(*signals), self._runs, measured)
        if not self._is_begun and self._method not in OFFLINE:
            self._share_memory()
        self._is_begun = True
        return dict(zip(self.names, results, strict=True))

    def _share_memory(self) -> None:
        """Put the states of all sensors side by side, for `step`."""
        filters, detectors = [run.filter for run in self._runs], [run.detector for run in self._runs]
        k = len(filters)
        self.static = np.zeros(k, dtype=np.bool_)
        self.quat_VS, self.gyro_bias = np.empty((k, 4)), np.empty((k, 3))
        if self._step is not None:
            self._states = np.concatenate([filter_.state.record for filter_ in filters])
            self._models = np.concatenate([filter_.model for filter_ in filters])
            self._detector_states = StaticState(
                *map(np.concatenate, zip(*(detector.state for detector in detectors), strict=True))
            )
            self.quat_VS, self.gyro_bias = self._states["quat_VS"], self._states["gyro_bias"]
        for i, (filter_, detector) in enumerate(zip(filters, detectors, strict=True)):
            if self._step is not None:
                filter_.state = type(filter_.state)(self._states[i : i + 1])
                detector.state = StaticState(*(values[i : i + 1] for values in self._detector_states))
            else:
                self.quat_VS[i], self.gyro_bias[i] = filter_.state.quat_VS, filter_.state.gyro_bias
                filter_.state = type(filter_.state)(self.quat_VS[i], self.gyro_bias[i])

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Take a sample of each sensor, `gyro_S` (k, 3) [rad/s], `accel_S` (k, 3) [m/s²]; return `quat_VS` (k, 4).

        A sensor whose sample did not come has NaN in its row: its rate is held and fades, its covariance grows.
        """
        gyro, accel = np.ascontiguousarray(gyro_S, dtype=float), np.ascontiguousarray(accel_S, dtype=float)
        shape = self.gyro_bias.shape
        if gyro.shape != shape or accel.shape != shape:  # the compiled step would read beyond their ends
            raise BadData(f"gyro_S {gyro.shape} and accel_S {accel.shape}: a row for each of {shape[0]} sensors")
        if self._step is not None:
            self._step(self._states, self._models, *self._detector_states, gyro, accel, self.static)
            return self.quat_VS
        for i, run in enumerate(self._runs):
            one = slice(i, i + 1)
            self.static[one] = run.detector.run(gyro[one], accel[one])
            out = FilterRun(self.quat_VS[one], self.gyro_bias[one], None)
            run.filter.run(gyro[one], accel[one], self.static[one], out)
        return self.quat_VS

    @property
    def attitude_cov(self) -> np.ndarray | None:
        """Covariance (k, 3, 3) [rad²] of the error on the right, in S; a copy. None: the filters have none."""
        return None if self._step is None else symmetric(self._states["attitude_cov"])

    @property
    def about_vertical(self) -> np.ndarray | None:
        """(k, 3) as `AboutVertical`; a view. None: the filters have no covariance."""
        return None if self._step is None else np.asarray(self._states["about_vertical"])


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
    orientation = filters.push(recording)
    R_VS = {
        segment: Rotation.from_quat((sensor if isinstance(sensor, OrientationSensor) else orientation[segment]).quat_VS)
        for segment, sensor in recording.sensors.items()
    }
    R_VS_start = find_start_orientations(recording, orientation, filters.start)
    return FilteredRecording(R_VS, R_VS_start, orientation, filters.start, filters.static_phase, filters.diagnostics)


def find_start_orientations(
    first: Recording, orientation: Mapping[str, Orientation], start: tuple[float, float]
) -> dict[str, Rotation]:
    """Find segment → mean orientation of its sensor in the start pose `start` [s], from a chunk that contains it."""
    R_VS_start = {}
    for segment, sensor in first.sensors.items():
        source = sensor if isinstance(sensor, OrientationSensor) else orientation[segment]
        R_VS_start[segment] = Rotation.from_quat(source.quat_VS[first.find_measured(segment, start)]).mean()
    return R_VS_start
