"""What the orientation filters share: their protocol, their result, samples that were lost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ..arguments import check_fields
from ..compilation import fma, inlined
from ..diagnostics import Diagnostic
from ..recording.limits import HIGHEST_RATE_SQUARED
from .phases import ACCEL_BIAS_STD, SensorNoise

# [rad/√s] by which a static sensor may rotate about the vertical undetected: 0.01 deg/s for 10 s at a time
STATIC_TURN_NOISE = 8e-4
# [rad/s] at which a heading drifts in motion, though the bias at rest is known: with it the errors on BROAD and on a
# UR5 arm are as large as stated
DRIFT_RATE_STD = float(np.deg2rad(0.03))
START_HEADING_STD = 1e-5  # [rad] the start defines the heading; above zero, so that P can be inverted

# While the gyroscope is lost (NaN, or beyond `recording.limits`) the last rate is held and fades with the time constant
# HOLD_S. While it is lost or saturated, the attitude's standard deviation grows by the motion that may have been
# missed: after T seconds by s T²/(T + HOLD_S) with s = LOST_RATE_STD or, where it is saturated, the range: what is cut
# off may be as much as what is measured. No axis is less certain than by MOST_LOST_STD.
HOLD_S = 0.1  # [s] about as long as the rate of an arm keeps its value
LOST_RATE_STD = 2.5  # [rad/s] of an arm in motion (our assumption)
MOST_LOST_STD = np.pi / np.sqrt(3.0)  # [rad] of an angle of which nothing is known

TILT_VAR = ACCEL_BIAS_STD**2  # [rad²] by the bias of the accelerometer, in each static phase the same

# Columns of `Orientation.about_vertical`
HEADING, RATE, RATE_VAR = range(3)


class Orientation(NamedTuple):
    """Orientation of one sensor over time.

    V is the sensor's own world: z up, zero heading at the first sample of the phase from which the filter starts.

    Parameters
    ----------
    quat_VS : (n, 4) xyzw, after the sample
    gyro_bias : (n, 3) [rad/s]
    static : (n,) bool, the sensor did not move
    attitude_cov : (n, 3, 3) [rad²] of the error rotation vector in S, on the right of `quat_VS`; None where the filter
        has none
    noise : of gyroscope and accelerometer in the static phase
    diagnostics : what the user should know
    about_vertical : (n, 3) what the filter does about the vertical, where headings are corrected from outside: [rad]
        the sum of the corrections of its heading since the start, [rad/s] the sum of those of the gyroscope's bias,
        each at the attitude that the sensor had then, and [rad²/s²] the variance of the bias now; None where the
        filter has no covariance
    """

    quat_VS: np.ndarray
    gyro_bias: np.ndarray
    static: np.ndarray
    attitude_cov: np.ndarray | None
    noise: SensorNoise
    diagnostics: tuple[Diagnostic, ...] = ()
    about_vertical: np.ndarray | None = None

    def take(self, rows: slice | np.ndarray) -> Orientation:
        """Take the samples `rows`, of a slice as views."""
        return self._replace(**{name: values[rows] for name, values in self.sampled().items()})

    def sampled(self) -> dict[str, Any]:
        """Name → values of each sample, of those that the filter has."""
        return {name: values for name, values in self._asdict().items() if isinstance(values, np.ndarray)}

    def __repr__(self) -> str:
        bias = float(np.degrees(np.linalg.norm(self.gyro_bias[-1]))) if len(self.gyro_bias) else float("nan")
        share = 100.0 * float(np.mean(self.static)) if len(self.static) else float("nan")
        return f"Orientation({len(self.quat_VS)} samples, {share:.0f} % static, gyro bias {bias:.2f} deg/s)"


def join_orientations(parts: Sequence[Orientation]) -> Orientation:
    """Join the samples of one sensor's orientations; what is not of each sample is that of the last part."""
    sampled = [part.sampled() for part in parts]
    joined: dict[str, Any] = {name: np.concatenate([part[name] for part in sampled]) for name in sampled[0]}
    return parts[-1]._replace(**joined)


def make_orientation(n: int, noise: SensorNoise, *, covariance: bool) -> Orientation:
    """Return arrays for n samples, to be filled."""
    cov, vertical = (np.empty((n, 3, 3)), np.empty((n, 3))) if covariance else (None, None)
    return Orientation(np.empty((n, 4)), np.empty((n, 3)), np.empty(n, np.bool_), cov, noise, (), vertical)


# One object for all records of a kind: a call of a compiled step takes 1 µs more to see that two are the same.
_make_dtype = cache(lambda *fields: np.dtype(list(fields), align=True))


def make_record(**values: Any) -> np.ndarray:
    """Return a record (1,) with these fields for a compiled step; what is no NumPy object becomes a float.

    A step is compiled for the types of the record, and a parameter may be stated as an integer.
    """
    typed = {name: v if isinstance(v, np.generic | np.ndarray) else np.float64(v) for name, v in values.items()}
    dtype = _make_dtype(*((name, value.dtype, value.shape) for name, value in typed.items()))
    return np.array([tuple(typed.values())], dtype)


class FilterParams:
    """Parameters of a filter or of the static test, checked against their annotations."""

    def __post_init__(self) -> None:
        check_fields(self, "")


class OrientationFilter(NamedTuple):
    """A filter of one sensor, whose state and constants are records (1,) of a compiled step.

    V is the sensor's own world: z up, heading of the `quat_VS` from which the filter starts. A run, the same run cut in
    two, and a run sample by sample are bit-identical. A sample that is no number was lost.
    """

    # of the noise, rate_hz, quat_VS (4,), and params
    make_records: Callable[[SensorNoise, float, np.ndarray, Any], tuple[np.ndarray, ...]]
    # Takes the records, samples `gyro_S` (n, 3) [rad/s] and `accel_S` (n, 3) [m/s²], `static` (n,) bool, and the arrays
    # `quat_VS`, `gyro_bias` and with a covariance `attitude_cov`, `about_vertical` of an `Orientation`, which it fills;
    # all are contiguous.
    run: Callable[..., None]
    params_type: type | None = None  # of its parameters, if it has any
    has_covariance: bool = True


@inlined
def bridge_rate(state, model, gx, gy, gz, bx, by, bz):  # type: ignore[no-untyped-def]
    """Return the rate [rad/s] without the bias b, held while it is lost, and the variance [rad²] of what was missed.

    `state` has `last_rate` (3,) and `lost_s`, `model` has `dt` and `gyro_range`.
    """
    last, is_measured = state.last_rate, gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED  # false for NaN
    if is_measured:
        x, y, z = gx - bx, gy - by, gz - bz
    else:
        fade = max(0.0, 1.0 - model.dt / HOLD_S)
        x, y, z = fade * last[0], fade * last[1], fade * last[2]
    last[0], last[1], last[2] = x, y, z
    lost_var = 0.0
    if is_measured and max(abs(gx), abs(gy), abs(gz)) < model.gyro_range:
        state.lost_s = 0.0
    else:
        before, after = state.lost_s, state.lost_s + model.dt
        rate_std = model.gyro_range if is_measured else LOST_RATE_STD
        lost_var = (
            min(MOST_LOST_STD, rate_std * after * after / (after + HOLD_S)) ** 2
            - min(MOST_LOST_STD, rate_std * before * before / (before + HOLD_S)) ** 2
        )
        state.lost_s = after
    return x, y, z, is_measured, lost_var


@inlined
def add_lost(variance, lost_var):  # type: ignore[no-untyped-def]
    """Return the variance [rad²] of an axis with that of what was missed, up to `MOST_LOST_STD`."""
    return variance + max(0.0, min(lost_var, MOST_LOST_STD**2 - variance))


@inlined
def into_sensor(R, P, more, more_heading, out):  # type: ignore[no-untyped-def]
    """Fill `out` (3, 3) with ``Rᵀ (P + diag(TILT_VAR, TILT_VAR, more_heading)) R + more I``; `R` (3, 3), `P` (9,)."""
    xx, xy, xz, yy, yz, zz = P[0] + TILT_VAR, P[1], P[2], P[4] + TILT_VAR, P[5], P[8] + more_heading
    for i in range(3):
        a, b, c = R[0, i], R[1, i], R[2, i]
        u, v, w = fma(xx, a, fma(xy, b, xz * c)), fma(xy, a, fma(yy, b, yz * c)), fma(xz, a, fma(yz, b, zz * c))
        out[i, i] = fma(a, u, fma(b, v, fma(c, w, more)))
        for j in range(i):
            out[i, j] = out[j, i] = fma(R[0, j], u, fma(R[1, j], v, R[2, j] * w))
