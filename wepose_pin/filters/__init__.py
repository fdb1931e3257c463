"""Orientation filters: one file each, one protocol (`base.OrientationFilter`).

`sensors.METHODS` names them; `estimate_orientation` runs one on an array, from the static phase to the orientations.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ..arguments import check_arguments, check_value
from ..diagnostics import WARNING, Diagnostic, join_text, render
from ..errors import BadData, BadOption, BadPhase, WeposeWarning
from ..recording import ImuSensor, Recording
from ..recording.faults import check_arrays, find_gyro_range, find_largest
from ..recording.limits import HIGHEST_ACCEL, HIGHEST_RATE
from .amekf import AmekfParams as AmekfParams
from .base import Orientation as Orientation
from .base import join_orientations as join_orientations
from .complementary import GdcParams as GdcParams
from .complementary import NcfParams as NcfParams
from .phases import TYPICAL, estimate_noise
from .sensors import BEST as BEST
from .sensors import METHODS as METHODS
from .sensors import OFFLINE as OFFLINE
from .sensors import STATIC_ONLY as STATIC_ONLY
from .sensors import SensorFilters as SensorFilters
from .sensors import check_method as check_method
from .smekf import SmekfParams as SmekfParams
from .static import StaticTest


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
    kind = METHODS[method].params_type
    check_value("params", params, kind | None if kind else type(None))
    try:
        gyro, accel = (np.asarray(values, dtype=float, order="C") for values in (gyro_S, accel_S))
    except (TypeError, ValueError) as error:
        raise BadData(f"gyro_S and accel_S must be arrays of numbers (n, 3): {error}") from None
    if not (np.isfinite(rate_hz) and rate_hz > 0.0 and (static is None or np.isfinite(static).all())):
        raise BadOption(f"rate_hz = {rate_hz} and static = {static}: finite numbers, samples a second and seconds")
    if gyro.ndim != 2 or gyro.shape[1] != 3 or accel.shape != gyro.shape:
        raise BadData(f"gyro_S {gyro.shape} and accel_S {accel.shape} must both be (n, 3)")
    limits = ("gyro_S", gyro, HIGHEST_RATE, "rad/s"), ("accel_S", accel, HIGHEST_ACCEL, "m/s^2")
    for name, values, most, unit in limits:
        largest = find_largest(values)
        if not largest < np.inf:  # NaN
            raise BadData("gyro_S and accel_S must be finite numbers; fill or cut gaps first")
        if largest > most:
            raise BadData(
                f"{name} has a value of {largest:.6g}: no sensor measures above {most:g} {unit}; check the unit"
            )
    check_arrays("", rate_hz, {"": (gyro, accel)})
    noise, start, diagnostics = TYPICAL, None, tuple[Diagnostic, ...]()
    if static is None:
        facts = {"method": method} | ({"variant": "estimated"} if method in ("amekf", "smoother") else {})
        diagnostics = (Diagnostic("static-phase-missing", WARNING, facts=facts),)
        warnings.warn(join_text(render(diagnostics[0])), WeposeWarning, stacklevel=2)
    else:
        first, last = round(static[0] * rate_hz), round(static[1] * rate_hz) + 1
        if not 0 <= first < last <= len(gyro) + 1:
            raise BadPhase(f"static = {static} [s] is outside the data, which lasts {len(gyro) / rate_hz:.3f} s")
        noise, start = estimate_noise(gyro[first:last], accel[first:last], rate_hz), slice(first, last)
    sensor = ImuSensor(gyro, accel, gyro_range=find_gyro_range(gyro, accel))
    filters = SensorFilters({"": noise}, method=method, params=params, static_test=static_test, start=start)
    return filters.push(Recording("", np.empty(len(gyro)), rate_hz, {"": sensor}))[""]._replace(diagnostics=diagnostics)
