"""Orientation filters, one file each with one protocol (`base.OrientationFilter`), and the classes that run them.

`METHODS` names them. `SensorFilters` runs one for each sensor, on whole recordings or sample by sample;
`estimate_orientation` runs one on an array, from the static phase to the orientations.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..arguments import Positive, check_arguments, check_names, check_value
from ..diagnostics import WARNING, Diagnostic, join_text, render
from ..errors import BadData, BadPhase, WeposeWarning
from ..recording import ImuSensor, OrientationSensor, Recording
from ..recording.faults import check_arrays, find_gyro_range
from ..recording.limits import HIGHEST_ACCEL, HIGHEST_RATE
from ..recording.plausibility import is_in_degrees
from .amekf import AMEKF
from .amekf import AmekfParams as AmekfParams
from .base import Orientation as Orientation
from .base import OrientationFilter, make_orientation
from .base import join_orientations as join_orientations
from .complementary import GDC, NCF
from .complementary import GdcParams as GdcParams
from .complementary import NcfParams as NcfParams
from .phases import (
    MOVES_DEG_S,
    MOVING_TILT_STD,
    TYPICAL,
    SensorNoise,
    estimate_noise,
    estimate_start_tilt,
)
from .smekf import PUBLISHED_SMEKF, SMEKF
from .smekf import SmekfParams as SmekfParams
from .smoother import SMOOTHER
from .static import USUAL_TEST, StaticTest, find_static, make_static_records

METHODS: dict[str, OrientationFilter] = {
    "amekf": AMEKF,
    "smoother": SMOOTHER,
    "smekf": SMEKF,
    "smekf_published": PUBLISHED_SMEKF,
    "ncf": NCF,
    "gdc": GDC,
}
BEST = "amekf"  # of those that need no future (docs/validation.md)
OFFLINE = frozenset({"smoother"})  # for whole recordings only: no live update, no run cut in two
STATIC_ONLY = frozenset({"smekf", "smekf_published"})  # they correct while the sensor is static


def _run(
    filter_: OrientationFilter, records: Sequence[Sequence[np.ndarray]], samples: Sequence[np.ndarray], out: Orientation
) -> None:
    """Fill `out` by the static test and the filter from `samples` gyro_S, accel_S (n, 3), contiguous."""
    filled = (out.quat_VS, out.gyro_bias, out.attitude_cov, out.about_vertical)[: 4 if filter_.has_covariance else 2]
    find_static(*records[0], *samples, out.static)
    filter_.run(*records[1], *samples, out.static, *filled)


class SensorFilters:
    """One filter for each sensor: `push` takes chunks, `step` a sample of each sensor, with bit-identical results.

    A filter starts with the tilt of the start phase and runs forward from its first sample, and backward over earlier
    samples, so that a recording may begin in motion. The smoother runs forward over all samples, from the end of the
    backward run, and takes the whole recording as one chunk.

    Parameters
    ----------
    noises : sensor → its noise, from its static phase; other sensors have no filter
    method : a key of `METHODS`
    params : the filter's own; None: its defaults, with the tilt of the start phase as it is known
    static_test : when a sensor counts as static; "smekf_published" uses conditions (1) to (4) alone, the paper's
    start : samples of the start phase, in the first chunk; None: the first window of `static_test`, static or not
    drifts : whether the covariance contains the drift of the heading in motion, which a heading filter knows by itself

    Attributes
    ----------
    names : the k sensors
    quat_VS, gyro_bias, static, attitude_cov, about_vertical : (k, …) after the last sample, as `Orientation`; the next
        step overwrites them
    """

    def __init__(
        self,
        noises: Mapping[str, SensorNoise],
        *,
        method: str = BEST,
        params: Any = None,
        static_test: StaticTest | None = None,
        start: slice | None = None,
        drifts: bool = False,
    ) -> None:
        self._filter, self._params, self._start, self._drifts = METHODS[method], params, start, drifts
        self._is_offline, self._test = method in OFFLINE, static_test or USUAL_TEST
        if self._filter is PUBLISHED_SMEKF:
            self._test = replace(self._test, rate_stds=np.inf)
        self.names, self._noises = tuple(noises), dict(noises)
        self._records: dict[str, Sequence[Sequence[np.ndarray]]] = {}  # of the static test and of the filter
        k = len(self.names)
        self._now = make_orientation(k, TYPICAL, covariance=self._filter.has_covariance)
        self._rows = [self._now.take(slice(i, i + 1)) for i in range(k)]  # of each sensor
        self.quat_VS, self.gyro_bias, self.static, self.attitude_cov = self._now[:4]
        self.about_vertical = self._now.about_vertical

    def push(self, chunk: Recording) -> dict[str, Orientation]:
        """Filter a chunk; `BadData`: the start phase has no gravity."""
        orientations = {name: self._run_chunk(name, chunk.imus[name], chunk.rate_hz) for name in self.names}
        for i, each in enumerate(orientations.values()):
            for name, values in each.sampled().items():
                getattr(self._now, name)[i] = values[-1] if len(values) else getattr(self._now, name)[i]
        return orientations

    def step(self, gyro_S: np.ndarray, accel_S: np.ndarray) -> np.ndarray:
        """Take a sample of each sensor, `gyro_S` (k, 3) [rad/s], `accel_S` (k, 3) [m/s²]; return `quat_VS` (k, 4).

        A sensor whose sample did not come has NaN in its row: its rate is held and fades, its covariance grows.
        """
        gyro_S, accel_S = np.ascontiguousarray(gyro_S, dtype=float), np.ascontiguousarray(accel_S, dtype=float)
        for i, name in enumerate(self.names):
            _run(self._filter, self._records[name], (gyro_S[i : i + 1], accel_S[i : i + 1]), self._rows[i])
        return self.quat_VS

    def _run_chunk(self, name: str, sensor: ImuSensor, rate_hz: float) -> Orientation:
        """Filter a chunk of one sensor."""
        gyro_S, accel_S = (np.ascontiguousarray(each, dtype=float) for each in (sensor.gyro_S, sensor.accel_S))
        if sensor.gap is not None:
            # A long bridge is a guess and no measurement: filters get NaN, and their covariance grows over it.
            gyro_S, accel_S = (np.where(sensor.gap[:, None], np.nan, values) for values in (gyro_S, accel_S))
        begin, cov = 0, None
        out = make_orientation(len(gyro_S), self._noises[name], covariance=self._filter.has_covariance)
        if name not in self._records:
            begin = self._begin(name, gyro_S, accel_S, rate_hz, sensor.gyro_range, out)
        if self._is_offline and out.attitude_cov is not None:  # forward over all samples
            begin, cov = 0, out.attitude_cov[:begin].copy()
        _run(self._filter, self._records[name], (gyro_S[begin:], accel_S[begin:]), out.take(slice(begin, None)))
        if cov is not None and out.attitude_cov is not None:
            # The smoother's heading is exact where the recording begins; headings are aligned in the start phase.
            out.attitude_cov[: len(cov)] = cov
        return out

    def _begin(
        self, name: str, gyro_S: np.ndarray, accel_S: np.ndarray, rate_hz: float, gyro_range: float, out: Orientation
    ) -> int:
        """Start the filter; fill `out` before its first sample by filtering backward, and return that sample."""
        noise, filter_, params = self._noises[name], self._filter, self._params
        phase = self._start or slice(0, self._test.samples(rate_hz))
        quat_VS, tilt_std = estimate_start_tilt(gyro_S[phase], accel_S[phase], noise, rate_hz)
        if self._start is None:  # the sensor may move there
            tilt_std = MOVING_TILT_STD
        if params is None and filter_.params_type is not None:
            known = {"tilt_std": tilt_std} | ({} if self._drifts else {"drift_rate_std": 0.0})
            params = filter_.params_type(**known if filter_.has_covariance else {})
        if gyro_range < getattr(params, "gyro_range", -np.inf):
            params = replace(params, gyro_range=gyro_range)
        static_records, first = make_static_records(noise, rate_hz, self._test), int(phase.start)
        if first > 0:  # rates and bias change their sign backward in time; specific forces do not
            backward = METHODS[BEST] if self._is_offline else filter_
            mirrored = replace(noise, gyro_bias=-noise.gyro_bias)
            start = _rotate(quat_VS, gyro_S[first] - noise.gyro_bias, rate_hz)
            static = tuple(record.copy() for record in static_records)
            static[0]["bias"] *= -1.0
            records = static, backward.make_records(mirrored, rate_hz, start, params)
            run = make_orientation(first, mirrored, covariance=backward.has_covariance)
            samples = [np.ascontiguousarray(each) for each in (-gyro_S[first:0:-1], accel_S[first - 1 :: -1])]
            _run(backward, records, samples, run)
            for field, values in run.sampled().items():
                getattr(out, field)[:first] = values[::-1]
            out.gyro_bias[:first] *= -1.0
            if out.about_vertical is not None:  # what the backward run has corrected is none of the forward run
                out.about_vertical[:first] = 0.0
            if self._is_offline:  # forward over all samples, which it alone uses, from the end of that run
                quat_VS = _rotate(run.quat_VS[-1], -gyro_S[0] - run.gyro_bias[-1], rate_hz)
                params = params if self._params else replace(params, tilt_std=MOVING_TILT_STD)
        self._records[name] = static_records, filter_.make_records(noise, rate_hz, quat_VS, params)
        return first


def _rotate(quat_VS: np.ndarray, rate: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return the orientation (4,) after a sample of a rate (3,) [rad/s]; a lost one rotates nothing."""
    turned = quat_VS.copy()
    rotations.rotate_by_vector(turned, *(np.where(np.isfinite(rate), rate, 0.0) / rate_hz))
    return turned


def collect_orientations(recording: Recording, filtered: Mapping[str, Orientation]) -> dict[str, Rotation]:
    """Return segment → n orientations R_VS of its sensor, `filtered` or measured; without mounts."""
    return {
        segment: Rotation.from_quat((sensor if isinstance(sensor, OrientationSensor) else filtered[segment]).quat_VS)
        for segment, sensor in recording.sensors.items()
    }


def average_start(
    recording: Recording, R_VS: Mapping[str, Rotation], start: tuple[float, float]
) -> dict[str, Rotation]:
    """Return segment → mean orientation of its sensor in the start pose [s]."""
    return {name: each[recording.find_measured(name, start)].mean() for name, each in R_VS.items()}


def estimate_orientation(
    gyro_S: np.ndarray,
    accel_S: np.ndarray,
    rate_hz: Positive,
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
    sensor's range, `attitude_cov` grows by the rotation that may have gone unmeasured. In motion the heading drifts by
    more than the bias explains, which `attitude_cov` contains (`drift_rate_std` of the parameters).

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
        measurement; rates in deg/s; a static phase outside the data, with motion, or without gravity in m/s².

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
    check_names("method", [method], METHODS)
    kind = METHODS[method].params_type
    check_value("params", params, kind | None if kind else type(None))
    try:
        gyro, accel = (np.asarray(values, dtype=float, order="C") for values in (gyro_S, accel_S))
    except (TypeError, ValueError) as error:
        raise BadData(f"gyro_S and accel_S must be arrays of numbers (n, 3): {error}") from None
    if gyro.ndim != 2 or gyro.shape[1] != 3 or accel.shape != gyro.shape:
        raise BadData(f"gyro_S {gyro.shape} and accel_S {accel.shape} must both be (n, 3)")
    limits = ("gyro_S", gyro, HIGHEST_RATE, "rad/s"), ("accel_S", accel, HIGHEST_ACCEL, "m/s^2")
    for name, values, most, unit in limits:
        largest = max(values.max(initial=0.0), -values.min(initial=0.0))
        if not largest < np.inf:  # NaN
            raise BadData("gyro_S and accel_S must be finite numbers; fill or cut gaps first")
        if largest > most:
            raise BadData(
                f"{name} has a value of {largest:.6g}: no sensor measures above {most:g} {unit}; check the unit"
            )
    check_arrays("", rate_hz, {"": (gyro, accel)})
    sensor = ImuSensor(gyro, accel, gyro_range=find_gyro_range(gyro, accel))
    if is_in_degrees(gyro, accel, rate_hz):
        raise BadData(
            "gyro_S: gravity would tumble by these rates, and accel_S shows that it does not; rad/s are needed"
        )
    noise, start, diagnostics = TYPICAL, None, tuple[Diagnostic, ...]()
    if static is None:
        facts = {"method": method} | ({"variant": "estimated"} if method in ("amekf", "smoother") else {})
        diagnostics = (Diagnostic("static-phase-missing", WARNING, facts=facts),)
        warnings.warn(join_text(render(diagnostics[0])), WeposeWarning, stacklevel=2)
    else:
        first, last = np.round(np.multiply(static, rate_hz)) + (0.0, 1.0)
        if not 0.0 <= first < last <= len(gyro) + 1:
            raise BadPhase(f"static = {static} [s] is outside the data, which lasts {len(gyro) / rate_hz:.3f} s")
        start = slice(int(first), int(last))
        noise = estimate_noise(gyro[start], accel[start], rate_hz)
        if (rate_deg_s := float(np.degrees(np.sqrt(np.trace(noise.gyro_cov))))) > MOVES_DEG_S:
            raise BadPhase(f"static = {static} [s]: the sensor turns at {rate_deg_s:.0f} deg/s rms; name other seconds")
    options = {"params": params, "static_test": static_test, "start": start}
    filters = SensorFilters({"": noise}, method=method, drifts=True, **options)
    return filters.push(Recording("", np.empty(len(gyro)), rate_hz, {"": sensor}))[""]._replace(diagnostics=diagnostics)
