"""Orientation filters: one file each, one protocol (`base.OrientationFilter`).

``METHODS`` names them; `estimate_orientation` runs one on an array, from the static phase to the orientations.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from .. import rotations
from ..arguments import check_arguments
from ..diagnostics import WARNING, Diagnostic, notebook_html, render
from ..errors import BadData, BadOption, BadPhase, WeposeWarning, one_of
from ..recording.faults import find_faults, find_gyro_range
from ..recording.limits import HIGHEST_ACCEL, HIGHEST_RATE, STANDARD_GRAVITY
from .amekf import Amekf, AmekfParams
from .base import AboutVertical, FilterRun, OrientationFilter
from .gdc import Gdc, GdcParams
from .ncf import Ncf, NcfParams
from .noise import MOVING_TILT_STD, SensorNoise, StartTilt, estimate_noise, estimate_start_tilt
from .smekf import PublishedSmekf, Smekf, SmekfParams, starting_params
from .smoother import Smoother
from .static import USUAL_TEST, StaticDetector, StaticTest

__all__ = [
    "BEST",
    "METHODS",
    "OFFLINE",
    "STATIC_ONLY",
    "TYPICAL",
    "AboutVertical",
    "Amekf",
    "AmekfParams",
    "FilterRun",
    "FilterSettings",
    "Gdc",
    "GdcParams",
    "Ncf",
    "NcfParams",
    "Orientation",
    "OrientationFilter",
    "PublishedSmekf",
    "SensorRun",
    "Smekf",
    "SmekfParams",
    "Smoother",
    "check_method",
    "estimate_orientation",
    "join_orientations",
    "run_filter",
]

METHODS: dict[str, type] = {
    "amekf": Amekf,
    "smoother": Smoother,
    "smekf": Smekf,
    "smekf_published": PublishedSmekf,
    "ncf": Ncf,
    "gdc": Gdc,
}
BEST = "amekf"  # of those that need no future (docs/validation.md)
OFFLINE = frozenset({"smoother"})  # for whole recordings only: no live update, no run cut in two
STATIC_ONLY = frozenset({"smekf", "smekf_published"})  # they correct while the sensor is static

# For a sensor without a static phase: noise of a usual MEMS sensor at 100 to 300 Hz, a bias as it may be from the
# factory. Only amekf and smoother estimate the bias in motion.
TYPICAL = SensorNoise(
    gyro_bias=np.zeros(3),
    gyro_bias_cov=np.deg2rad(0.5) ** 2 * np.eye(3),
    gyro_cov=np.deg2rad(0.1) ** 2 * np.eye(3),
    accel_cov=0.003**2 * np.eye(3),
    bias_step_cov=2.0 * np.deg2rad(0.1) ** 2 * np.eye(3),
    gravity=STANDARD_GRAVITY,
)


class Orientation(NamedTuple):
    """Orientation of one sensor over time.

    V is the sensor's own world: z up, zero heading at the first sample of the phase from which the filter starts.

    Parameters
    ----------
    quat_VS : (n, 4) xyzw
    gyro_bias : (n, 3) [rad/s]
    static : (n,) bool, the sensor did not move
    attitude_cov : (n, 3, 3) [rad²] of the error rotation vector in S, on the right of `quat_VS`; None where the filter
        has none
    noise : of gyroscope and accelerometer in the static phase
    diagnostics : what the user should know
    about_vertical : (n, 3), as `base.AboutVertical`; None where the filter has no covariance
    """

    quat_VS: np.ndarray
    gyro_bias: np.ndarray
    static: np.ndarray
    attitude_cov: np.ndarray | None
    noise: SensorNoise
    diagnostics: tuple[Diagnostic, ...] = ()
    about_vertical: np.ndarray | None = None

    def take(self, rows: slice | np.ndarray) -> Orientation:
        """Take the samples `rows`."""
        values: dict[str, Any] = {name: getattr(self, name) for name in _OF_EACH_SAMPLE}
        taken: dict[str, Any] = {name: None if each is None else each[rows] for name, each in values.items()}
        return self._replace(**taken)

    def __repr__(self) -> str:
        bias = float(np.degrees(np.linalg.norm(self.gyro_bias[-1]))) if len(self.gyro_bias) else float("nan")
        share = 100.0 * float(np.mean(self.static)) if len(self.static) else float("nan")
        return f"Orientation({len(self.quat_VS)} samples, {share:.0f} % static, gyro bias {bias:.2f} deg/s)"

    def _repr_html_(self) -> str:
        return notebook_html(self, self.diagnostics)


_OF_EACH_SAMPLE = ("quat_VS", "gyro_bias", "static", "attitude_cov", "about_vertical")


def join_orientations(parts: Sequence[Orientation]) -> Orientation:
    """Join the samples of one sensor's orientations; what is not of each sample is that of the last part."""
    joined: dict[str, Any] = {}
    for name in _OF_EACH_SAMPLE:
        values = [getattr(part, name) for part in parts]
        joined[name] = None if any(value is None for value in values) else np.concatenate(values)
    return parts[-1]._replace(**joined)


def check_method(method: str) -> str:
    """Check that a method of that name exists, and return it.

    Raises
    ------
    BadOption
        It does not.
    """
    if method not in METHODS:
        raise BadOption(f"method '{method}' is not known; {one_of(METHODS, method)}")
    return method


def estimate_orientation(
    gyro_S: np.ndarray,
    accel_S: np.ndarray,
    rate_hz: float,
    *,
    method: str = BEST,
    static: tuple[float, float] | None,
    params: Any = None,
    static_test: StaticTest | None = None,
) -> Orientation:
    """Estimate the orientation of a sensor from its gyroscope and accelerometer.

    V of the returned `quat_VS` is the sensor's own world: z up, and a heading that has no relation to the worlds
    of other sensors (`track` aligns them by the start pose). At the first sample of the static phase the heading is
    zero and the tilt is that of the mean accelerometer over the phase (without a phase: over the first window of
    `static_test`); the filter goes forward and backward in time from there. Where `gyro_S` is at the limit of the
    sensor's range, `attitude_cov` grows by the rotation that may have gone unmeasured.

    Parameters
    ----------
    gyro_S : (n, 3) array
        [rad/s], the rate over the interval that ends at the sample.
    accel_S : (n, 3) array
        [m/s²], specific force, +g up while static.
    rate_hz : float
        Samples a second, uniform.
    method : str
        "amekf": Kalman filter that corrects the tilt in motion too; "smoother": the same forward and backward over all
        samples; "smekf": Kalman filter that corrects in static phases alone (Lisini Baldi 2019, with an exact
        covariance and two more conditions of the static test); "smekf_published": the same as published; "ncf":
        complementary filter (Mahony 2008); "gdc": gradient descent (Madgwick 2011). "ncf" and "gdc" have no covariance.
    static : (float, float) or None
        The static phase, from and to [s] after the first sample: the sensor does not move there, and its noise and bias
        are measured. None: there is none; the noise is that of a usual MEMS sensor, and the bias starts at zero.
    params : optional
        The filter's own parameters, such as `wepose_pin.filters.AmekfParams`; None: its defaults.
    static_test : StaticTest, optional
        When the sensor counts as static; None: the default values. "smekf_published" uses conditions (1) to (4) alone.

    Returns
    -------
    Orientation
        `quat_VS` (n, 4) xyzw, `gyro_bias` (n, 3) [rad/s], `static` (n,) bool: the sensor did not move, `attitude_cov`
        (n, 3, 3) [rad²] of the error rotation vector in S, on the right of `quat_VS`, or None, `noise` of the static
        phase, `diagnostics`.

    Raises
    ------
    BadOption, BadData, BadPhase
        An unknown method; arrays that do not fit each other; samples that are not finite, frozen or otherwise no
        measurement; a static phase outside the data.

    Warns
    -----
    WeposeWarning
        There is no static phase, as `Orientation.diagnostics` says.

    Examples
    --------
    >>> sensor = recording.sensors["right_forearm"]
    >>> o = wp.estimate_orientation(sensor.gyro_S, sensor.accel_S, recording.rate_hz, static=(0.5, 4.5))
    >>> o
    Orientation(2251 samples, 28 % static, gyro bias 0.42 deg/s)
    >>> o.quat_VS.shape  # xyzw
    (2251, 4)
    """
    check_arguments(estimate_orientation, locals())
    check_method(method)
    check_arguments(METHODS[method], {"params": params})
    try:
        gyro, accel = np.asarray(gyro_S, dtype=float), np.asarray(accel_S, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadData(f"gyro_S and accel_S must be arrays of numbers (n, 3): {error}") from None
    if not (np.isfinite(rate_hz) and rate_hz > 0.0 and (static is None or np.isfinite(static).all())):
        raise BadOption(f"rate_hz = {rate_hz} and static = {static}: finite numbers, samples a second and seconds")
    if gyro.ndim != 2 or gyro.shape[1] != 3 or accel.shape != gyro.shape:
        raise BadData(f"gyro_S {gyro.shape} and accel_S {accel.shape} must both be (n, 3)")
    _check_values("gyro_S", gyro, HIGHEST_RATE, "rad/s")
    _check_values("accel_S", accel, HIGHEST_ACCEL, "m/s^2")
    for fault in find_faults({"": (np.arange(len(gyro)) / rate_hz, gyro, accel)}).get("", []):
        raise BadData(f"{fault.describe(max(fault.first, 0.0))}: it does not measure there; leave these samples out")
    noise, start = TYPICAL, None
    diagnostics: tuple[Diagnostic, ...] = ()
    if static is None:
        facts = {"method": method} | ({"variant": "estimated"} if method in ("amekf", "smoother") else {})
        missing = Diagnostic("static-phase-missing", WARNING, facts=facts)
        diagnostics = (missing,)
        warnings.warn(render(missing).line(), WeposeWarning, stacklevel=2)
    else:
        first, last = round(static[0] * rate_hz), round(static[1] * rate_hz) + 1
        if not 0 <= first < last <= len(gyro) + 1:
            raise BadPhase(f"static = {static} [s] is outside the data, which lasts {len(gyro) / rate_hz:.3f} s")
        noise, start = estimate_noise(gyro[first:last], accel[first:last], rate_hz), slice(first, last)
    settings = FilterSettings(
        method, params, static_test or USUAL_TEST, start=start, gyro_range=find_gyro_range(gyro, accel)
    )
    run = SensorRun(rate_hz, noise, settings)
    return run.push(gyro, accel)._replace(diagnostics=diagnostics)


def _check_values(name: str, values: np.ndarray, most: float, unit: str) -> None:
    """Raise `BadData` where values are not finite, or larger than a sensor measures."""
    if max(values.max(initial=0.0), -values.min(initial=0.0)) <= most:  # false for NaN
        return
    if not np.isfinite(values).all():
        raise BadData("gyro_S and accel_S must be finite numbers; fill or cut gaps first")
    k, axis = np.unravel_index(int(np.argmax(np.abs(values))), values.shape)
    raise BadData(
        f"{name}[{k}, {axis}] = {values[k, axis]:.6g}: no sensor measures above {most:g} {unit}; check the unit, and "
        f"fill or cut what is no measurement"
    )


@dataclass(frozen=True)
class FilterSettings:
    """How a filter runs on a sensor.

    Parameters
    ----------
    method : a key of `METHODS`
    params : the filter's own; None: its defaults
    static_test : when the sensor counts as static; "smekf_published" uses conditions (1) to (4) alone, the paper's
    measured_start : without `params`, smekf takes P₀ from the noise in place of the paper's (`smekf.starting_params`)
    start : samples of the start phase, in the first chunk; None: the first window of `static_test`, static or not
    gyro_range : [rad/s] at which an axis of gyro saturates
    """

    method: str
    params: Any = None
    static_test: StaticTest = USUAL_TEST
    measured_start: bool = False
    start: slice | None = None
    gyro_range: float = np.inf


class SensorRun:
    """One filter on one sensor's samples, which come in chunks; the joined results are those of the whole recording.

    The filter starts with the tilt of the start phase and runs forward from its first sample, and backward over earlier
    samples, so that a recording may begin in motion. The smoother runs forward over all samples, from the end of the
    backward run, and takes the whole recording as one chunk.

    Parameters
    ----------
    noise : of the sensor, from its static phase

    Attributes
    ----------
    filter, detector : after the samples so far

    Raises
    ------
    BadData
        The start phase has no gravity.
    """

    def __init__(self, rate_hz: float, noise: SensorNoise, settings: FilterSettings) -> None:
        self._rate_hz, self._noise, self._settings = rate_hz, noise, settings
        self._method, self._test = settings.method, settings.static_test
        if METHODS[settings.method] is PublishedSmekf:
            self._test = replace(self._test, rate_stds=np.inf)
        self.detector = StaticDetector(noise, rate_hz, self._test)
        self.filter: Any = None

    def push(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> Orientation:
        """Filter a chunk: (n, 3) [rad/s], (n, 3) [m/s²]."""
        before = self._begin(gyro_S, accel_S) if self.filter is None else None
        if before is None or self._method in OFFLINE:
            static = self.detector.run(gyro_S, accel_S)
            run = self.filter.run(gyro_S, accel_S, static)
            if before is not None:
                # The smoother's heading is exact where the recording begins; headings are aligned in the start phase.
                run.attitude_cov[: len(before[1])] = before[0].attitude_cov
        else:
            backward, static_before = before
            rest = slice(len(static_before), None)
            static = self.detector.run(gyro_S[rest], accel_S[rest])
            run = backward.extended(len(gyro_S))
            self.filter.run(gyro_S[rest], accel_S[rest], static, run.part(rest))
            static = np.concatenate([static_before, static])
        quat_VS, gyro_bias, attitude_cov, about_vertical = run
        return Orientation(quat_VS, gyro_bias, static, attitude_cov, self._noise, about_vertical=about_vertical)

    def _begin(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> tuple[FilterRun, np.ndarray] | None:
        """Create the filter; return the samples before its first one filtered, and whether they are static."""
        phase = self._settings.start or slice(0, self._test.samples(self._rate_hz))
        first, before = phase.start, None
        start = estimate_start_tilt(gyro_S[phase], accel_S[phase], self._noise, self._rate_hz)
        if self._settings.start is None:  # the sensor may move there
            static = StaticDetector(self._noise, self._rate_hz, self._test).run(gyro_S[phase], accel_S[phase])
            if not static[-1]:
                start = start._replace(tilt_std=MOVING_TILT_STD)
        if first > 0:
            before = self._run_backward(start, gyro_S[: first + 1], accel_S[:first])
            run, _ = before
            if self._method in OFFLINE:  # forward over all samples, from the end of the backward run
                turn = np.nan_to_num(gyro_S[0] - run.gyro_bias[0]) / self._rate_hz
                # The forward run alone uses these samples.
                start = StartTilt(rotations.turned(run.quat_VS[0], -turn), MOVING_TILT_STD)
        self.filter = self._create_filter(self._method, self._noise, start)
        return before

    def _run_backward(self, start: StartTilt, gyro_S: np.ndarray, accel_S: np.ndarray) -> tuple[FilterRun, np.ndarray]:
        """Filter the samples (n,) before the start phase: `accel_S` (n, 3), `gyro_S` (n + 1, 3).

        `gyro_S` has the first sample of the phase as well, whose rate leads back to the sample before. Rates and bias
        change their sign backward in time; specific forces do not.
        """
        turn = np.nan_to_num(gyro_S[-1] - self._noise.gyro_bias) / self._rate_hz
        noise = replace(self._noise, gyro_bias=-self._noise.gyro_bias)
        gyro, accel = -gyro_S[:0:-1], accel_S[::-1]
        static = StaticDetector(noise, self._rate_hz, self._test).run(gyro, accel)
        method = BEST if self._method in OFFLINE else self._method
        filter_ = self._create_filter(method, noise, start._replace(quat_VS=rotations.turned(start.quat_VS, turn)))
        run = filter_.run(gyro, accel, static)
        cov = None if run.attitude_cov is None else run.attitude_cov[::-1]
        # What the backward run has corrected is no correction of the forward run.
        vertical = None if run.about_vertical is None else np.zeros_like(run.about_vertical)
        return FilterRun(run.quat_VS[::-1], -run.gyro_bias[::-1], cov, vertical), static[::-1]

    def _create_filter(self, method: str, noise: SensorNoise, start: StartTilt) -> Any:
        params, gyro_range = self._settings.params, self._settings.gyro_range
        if params is None and method in ("amekf", "smoother"):
            params = AmekfParams() if self._settings.start is None else AmekfParams(tilt_std=start.tilt_std)
        if params is None and method == "smekf":
            params = SmekfParams()
            if self._settings.measured_start:
                params = starting_params(noise, self._rate_hz, start.quat_VS, start.tilt_std)
        if method in ("amekf", "smoother", "smekf") and gyro_range < params.gyro_range:
            params = replace(params, gyro_range=gyro_range)
        return METHODS[method](noise, self._rate_hz, start.quat_VS, params)


def run_filter(
    gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, noise: SensorNoise, settings: FilterSettings
) -> Orientation:
    """Return the orientations of one sensor, of checked arrays and known noise."""
    return SensorRun(rate_hz, noise, settings).push(gyro_S, accel_S)
