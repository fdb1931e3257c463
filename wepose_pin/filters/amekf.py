"""aMEKF: a causal multiplicative extended Kalman filter of one IMU's attitude, corrected in motion as well.

Pseudo-measurements correct it: the horizontal velocity and position of a sensor on a person are bounded. The specific
force, rotated to the filter's world, is integrated to them (the almost-inertial frame of VQF, Laidig and Seel 2023,
Information Fusion 91). A tilt error of 1° would give 8 m in 10 s; a segment does not move so far. The same innovations
estimate the gyroscope's bias, its scale and misalignment (3×3), and the difference of the bias between motion and
static phases, which rotation about horizontal axes makes observable. The heading is not observed; it improves with
these parameters.

V is the sensor's own world: z up, heading that of the filter's start. The 25 errors (`ErrorStates`) are additive
except the attitude error, a rotation on the left, in V: R = exp(θ) R_estimated. It does not change when the sensor
rotates. Measured rate = (I + M) true rate + bias. Errors of velocity and position are those of
the invariant filter (Barrau and Bonnabel 2017, IEEE TAC 62(4)): θ × g e_z alone drives them, so that their bound gives
no information on the heading.

The strapdown runs at each sample, the covariance once a block (`AmekfParams.block_s`): over a block the transition is
exact in the sums of R_VS and R_VS ω. In a static block (static phase of Lisini Baldi 2019, IEEE Sensors Journal) the
velocity is zero and the gyroscope measures its bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arguments import check_fields
from ..compilation import inlined, kernel
from ..errors import BadOption
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import fill_matrix, rotate_by_world_vector, rotate_unit_by_rate
from .base import (
    RATE_VAR,
    START_HEADING_STD,
    STATIC_TURN_NOISE,
    VERTICAL_COLUMNS,
    FilterRun,
    add_correction,
    into_sensor,
    make_record,
    make_run,
    prepare_samples,
    store_sample,
)
from .noise import SensorNoise


class ErrorStates(NamedTuple):
    """Index range of each error among the 25."""

    attitude: slice = slice(0, 3)  # θ [rad], on the left, in V
    velocity: slice = slice(3, 5)  # [m/s], horizontal, in V
    position: slice = slice(5, 7)  # [m], horizontal, in V
    gyro_bias: slice = slice(7, 10)  # [rad/s], in S, in a static phase
    gyro_matrix: slice = slice(10, 19)  # M, rows first
    accel_bias: slice = slice(19, 22)  # [m/s²], in S
    motion_bias: slice = slice(22, 25)  # [rad/s], in S: the gyroscope's bias in motion less that in a static phase


ERROR = ErrorStates()
STATES = 25
COLUMNS = 32  # of matrices in the record: rows of whole processor vectors; beyond the 25 states they are zero
PROPAGATED_STATES = 7  # θ, velocity and position change over a block, the other states stay
SMOOTHED_STATES = (0, 1, 2, 7, 8, 9, 22, 23, 24)  # states that the smoother corrects: θ, bias, bias in motion
MAX_MEASUREMENTS = 5  # of a static block: velocity (2) and bias (3); of another: velocity (2) and position (2)
VELOCITY, POSITION, GYRO_BIAS = ERROR.velocity.start, ERROR.position.start, ERROR.gyro_bias.start
MOTION_BIAS = ERROR.motion_bias.start

HELD_RATE_FADE_S = 0.1  # [s] in which the last rate before a lost sample fades
MAX_LOST_ROTATION_STD = 4.0  # [rad] beyond which the uncertainty of a lost rotation is not increased
# Squared Mahalanobis distance beyond which an innovation of two or three axes is an outlier: χ² quantiles of 0.9973,
# which is 3 σ of one axis.
OUTLIER_CHI2_2, OUTLIER_CHI2_3 = 11.83, 14.16

# Records of the compiled steps.
SUMS = np.dtype(
    [
        ("gyro", float, 3),  # [rad/s]
        ("rate_squared", float),  # [rad²/s²]
        ("acceleration_sum", float),  # [m/s²] magnitude
        ("impact_excess", float),  # [m/s²] magnitude beyond the limit of an impact
        ("static_samples", float),
        ("lost_rotation_var", float),  # [rad²]
        ("lost_accel_s", float),  # [s]
    ],
    align=True,
)
# A block's transition and corrections. The smoother keeps one of each block and goes through them backward.
BLOCK = np.dtype(
    [
        ("R", float, (3, 3)),  # Σ R_VS dt [s]
        ("R_rate", float, (3, 3, 3)),  # Σ R_VS ω_c dt [rad], for the axes c = x, y, z of S
        ("R_moving", float, (3, 3)),  # Σ R_VS dt [s] over the samples that are not static
        ("length", float),  # [s]
        ("lost_rotation_var", float),  # [rad²] of the rotation lost in the block
        ("measurements", np.int64),  # number n of measurements; the next four have n rows
        ("state_index", np.int64, MAX_MEASUREMENTS),  # of the measured state
        ("inv_innovation_std", float, MAX_MEASUREMENTS),  # 1/√s, s the innovation's variance
        ("normalized_innovation", float, MAX_MEASUREMENTS),  # innovation/√s
        ("normalized_gain", float, (MAX_MEASUREMENTS, STATES)),  # P h/√s
        ("correction", float, STATES),  # of the states
        ("P_smoothed_rows", float, (len(SMOOTHED_STATES), STATES)),  # rows `SMOOTHED_STATES` of P after the block
    ],
    align=True,
)
# The state of a sensor is one record, so that a run may be cut anywhere and a bank of sensors stacks them.
STATE = np.dtype(
    [
        ("quat_VS", float, 4),  # xyzw
        ("gyro_bias", float, 3),  # [rad/s] as returned: with the motion bias where the sample is not static
        ("attitude_cov", float, 6),  # [rad²] upper triangle, error on the right, in S
        ("x", float, STATES),  # as `ErrorStates`; the attitude's error is always zero
        ("P", float, (STATES, COLUMNS)),
        ("sums", SUMS),
        ("last_rate", float, 3),  # [rad/s] without bias; it fades while samples are lost
        ("lost_s", float),  # [s] since the last good sample of gyro
        ("samples", np.int64),  # in the open block
        ("about_vertical", float, VERTICAL_COLUMNS),  # as `base.AboutVertical`
        # work space
        ("R_VS", float, (3, 3)),
        ("FP_rows", float, (PROPAGATED_STATES, COLUMNS)),
        ("FP_columns", float, (STATES, 8)),  # the last column is zero
        ("FPF_corner", float, (PROPAGATED_STATES, 8)),
        ("gains", float, (3, COLUMNS)),  # P h/√s of the measurements that are taken together
        ("measured", float, 3),
        ("block", BLOCK),
    ],
    align=True,
)
_NO_BLOCKS = np.empty(0, BLOCK)


@dataclass(frozen=True)
class AmekfParams:
    """How wrong a MEMS sensor and how bounded a person's motion is; standard deviations for all recordings."""

    block_s: float = 0.25  # [s] between corrections; the covariance is propagated over it in one step
    speed_std: float = 1.0  # [m/s] of the sensor, horizontal, per axis; independent values every `motion_s`
    position_std: float = 1.5  # [m] about its mean, horizontal, per axis; independent values every `motion_s`
    motion_s: float = 1.0  # [s] correlation time of motion
    static_speed_std: float = 0.01  # [m/s] in a static phase
    rate_noise: float = 3e-4  # [1/√Hz] of gyro in motion, a fraction of |ω|: what the matrix does not explain
    force_noise: float = 0.01  # error of a block's velocity change, a fraction of the summed |acceleration|
    impact: float = 100.0  # [m/s²] beyond it is an impact: the excess, integrated, is a velocity error
    tilt_std: float = 0.2  # [rad] at the start, which may be in motion
    gyro_matrix_std: float = 0.002  # each entry of M
    gyro_matrix_walk: float = 1e-6  # [1/√s]
    gyro_bias_walk: float = 5e-6  # [rad/s/√s], 10 deg/h in 100 s
    static_bias_std: float = 1e-4  # [rad/s] of the mean of gyro over a static block about the bias, without sway
    static_turn_noise: float = STATIC_TURN_NOISE  # [rad/√s]
    motion_bias_std: float = 1.7e-4  # [rad/s], 0.01 deg/s, bias in motion less that in a static phase
    motion_bias_walk: float = 5e-5  # [rad/s/√s]
    accel_bias_std: float = 0.03  # [m/s²], 3 mg
    accel_bias_walk: float = 1e-4  # [m/s²/√s]
    gyro_range: float = np.inf  # [rad/s] full scale; a saturated sample's rotation is as uncertain as a lost one
    lost_rate_std: float = 2.0  # [rad/s] of the unknown rate while gyro is lost (NaN) or saturated
    lost_force_std: float = 5.0  # [m/s²] of the unknown acceleration while accel is lost (NaN)

    def __post_init__(self) -> None:
        check_fields(self, "")
        for name, value in vars(self).items():
            if not value >= 0.0 or (value == 0.0 and name in ("block_s", "speed_std", "position_std", "motion_s")):
                raise BadOption(f"{name} = {value}: a number above 0 is needed (0 switches off what is no bound)")


class AmekfState:
    """State of the filter: views of the record of the compiled steps."""

    def __init__(self, record: np.ndarray) -> None:
        self.record = record  # (1,) of `STATE`
        self.quat_VS = record["quat_VS"][0]  # (4,) xyzw
        self.gyro_bias = record["gyro_bias"][0]  # (3,) [rad/s]
        self.x = record["x"][0]  # (25,) as `ErrorStates`
        self.P = record["P"][0, :, :STATES]  # (25, 25)


class Amekf:
    """aMEKF of one sensor.

    A NaN sample of gyro holds the last rate, which fades in `HELD_RATE_FADE_S`, and the attitude's covariance grows
    with the time squared. A NaN sample of accel counts as gravity alone, and the velocity's covariance grows. A sample
    beyond the range in `params` is used, and the covariance grows as for a lost one. An impact (`AmekfParams.impact`)
    increases the velocity's covariance. A jump of the bias is adopted in the next static phase; until then the tilt
    error reaches some degrees. Without a static phase everything is estimated in motion: the tilt in ten seconds, the
    other parameters in about a minute. Time is not an input: readers bridge gaps and remove duplicates.

    Parameters
    ----------
    noise : first bias, its covariance, noise and gravity
    quat_VS : (4,) xyzw at the start; its heading defines the filter's world
    """

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, params: AmekfParams | None = None
    ) -> None:
        self.params = params or AmekfParams()
        self.rate_hz = rate_hz
        self.noise = noise
        self.block_samples = max(1, round(self.params.block_s * rate_hz))
        self.model = _build_model(noise, rate_hz, self.block_samples, self.params)
        self.state = AmekfState(np.zeros(1, STATE))
        self.state.quat_VS[:], self.state.gyro_bias[:] = quat_VS, noise.gyro_bias
        p, x, std = self.params, self.state.x, np.zeros(STATES)
        x[ERROR.gyro_bias] = noise.gyro_bias
        std[ERROR.attitude] = p.tilt_std, p.tilt_std, START_HEADING_STD
        std[ERROR.velocity], std[ERROR.position] = p.speed_std, p.position_std
        std[ERROR.gyro_matrix], std[ERROR.accel_bias] = p.gyro_matrix_std, p.accel_bias_std
        std[ERROR.motion_bias] = p.motion_bias_std
        np.fill_diagonal(self.state.P, std**2)
        self.state.P[ERROR.gyro_bias, ERROR.gyro_bias] = noise.gyro_bias_cov
        bias_var = float(np.trace(noise.gyro_bias_cov)) / 3.0
        self.state.record["about_vertical"][0, RATE_VAR] = bias_var + p.motion_bias_std**2

    def run(
        self,
        gyro_S: np.ndarray,
        accel_S: np.ndarray,
        static: np.ndarray | bool,
        out: FilterRun | None = None,
        blocks: np.ndarray = _NO_BLOCKS,
    ) -> FilterRun:
        """Filter as `base.OrientationFilter`, and fill one of `blocks`, an array of `BLOCK`, at the end of each."""
        gyro, accel, is_static = prepare_samples(gyro_S, accel_S, static)
        out = out or make_run(len(gyro))
        _run(self.state.record, self.model, gyro, accel, is_static, blocks, *out)
        return out


def _build_model(noise: SensorNoise, rate_hz: float, block_samples: int, p: AmekfParams) -> np.ndarray:
    """Build the coefficients of a block, a record (1,)."""
    length = block_samples / rate_hz
    # Errors of the mean of gyro over a static block: white noise, and the sway of a standing person.
    white, sway = float(np.trace(noise.gyro_cov)) / 3.0 / block_samples, noise.sway_density(rate_hz)
    return make_record(
        dt=1.0 / rate_hz,  # [s]
        block_samples=block_samples,
        gravity=noise.gravity,  # [m/s²]
        gyro_noise_psd=float(np.trace(noise.gyro_cov)) / 3.0 / rate_hz,  # [rad²/s]
        accel_noise_psd=float(np.trace(noise.accel_cov)) / 3.0 * noise.gravity**2 / rate_hz,  # [m²/s³]
        velocity_var=p.speed_std**2 * p.motion_s / length,  # [m²/s²] of a block's measurement, as the next three
        position_var=p.position_std**2 * p.motion_s / length,  # [m²]
        static_velocity_var=p.static_speed_std**2,  # [m²/s²]
        static_bias_var=p.static_bias_std**2 + white + sway / length,  # [rad²/s²] of the mean of gyro about the bias
        # [rad²/s] A person who sways may also rotate slowly about the vertical: an eighth of the sway (assumption).
        static_heading_psd=p.static_turn_noise**2 + sway / 8.0,
        rate_noise_psd=p.rate_noise**2,  # [1/Hz] of gyro, relative to |ω|
        velocity_error_fraction_sq=p.force_noise**2,  # [1] of the summed |acceleration| of a block
        bias_walk=p.gyro_bias_walk**2,  # [rad²/s³]
        matrix_walk=p.gyro_matrix_walk**2,  # [1/s]
        accel_bias_walk=p.accel_bias_walk**2,  # [m²/s⁵]
        motion_bias_walk=p.motion_bias_walk**2,  # [rad²/s³]
        lost_rate_std=p.lost_rate_std,  # [rad/s]
        lost_accel_var=p.lost_force_std**2,  # [m²/s⁴]
        gyro_limit=p.gyro_range,  # [rad/s]
        impact_limit=p.impact,  # [m/s²]
    )


@kernel
def fill_transition_rows(block, gravity, P, out):  # type: ignore[no-untyped-def]
    """Fill `out` (7, m) with the rows of ``F P`` of θ, velocity and position, which differ from those of `P` (25, m).

    θ⁺ = θ − Σ R dt b − Σ R ω dt M − Σ_moving R dt d, v⁺ = v + ∫ θ × g e_z − Σ R dt f, p⁺ = p + ∫ v, the integrals by
    the trapezoid; b, d, f are the errors of bias, bias in motion and accelerometer bias.
    """
    columns = P.shape[1]
    bias, moving = P[ERROR.gyro_bias], P[ERROR.motion_bias]
    matrix, force = P[ERROR.gyro_matrix], P[ERROR.accel_bias]
    for i in range(3):
        for j in range(columns):
            out[i, j] = P[i, j]
        for c in range(3):
            R, R_moving = block.R[i, c], block.R_moving[i, c]
            for j in range(columns):
                out[i, j] -= R * bias[c, j] + R_moving * moving[c, j]
            x, y, z = block.R_rate[0, i, c], block.R_rate[1, i, c], block.R_rate[2, i, c]
            for j in range(columns):
                out[i, j] -= x * matrix[3 * c, j] + y * matrix[3 * c + 1, j] + z * matrix[3 * c + 2, j]
    g, t = 0.5 * block.length * gravity, 0.5 * block.length
    for i in range(2):
        sign, other = (g, 1) if i == 0 else (-g, 0)
        v, p = VELOCITY + i, POSITION + i
        x, y, z = block.R[i, 0], block.R[i, 1], block.R[i, 2]
        for j in range(columns):
            out[v, j] = (
                P[v, j] + sign * (P[other, j] + out[other, j]) - (x * force[0, j] + y * force[1, j] + z * force[2, j])
            )
        for j in range(columns):
            out[p, j] = P[p, j] + t * (P[v, j] + out[v, j])


@inlined
def _propagate(state, model):  # type: ignore[no-untyped-def]
    """Propagate over the block that ends: P ← F P Fᵀ + Q."""
    P, rows, columns, corner = state.P, state.FP_rows, state.FP_columns, state.FPF_corner
    block, sums = state.block, state.sums
    fill_transition_rows(block, model.gravity, P, rows)
    for i in range(PROPAGATED_STATES):
        for j in range(PROPAGATED_STATES, STATES):
            P[i, j] = rows[i, j]
            P[j, i] = rows[i, j]
    # The corner of (F P) Fᵀ is the transpose of F (F P)ᵀ: the same product, with the rows as columns.
    for i in range(PROPAGATED_STATES):
        for j in range(STATES):
            columns[j, i] = rows[i, j]
    fill_transition_rows(block, model.gravity, columns, corner)
    for i in range(PROPAGATED_STATES):
        for j in range(PROPAGATED_STATES):
            P[i, j] = 0.5 * (corner[i, j] + corner[j, i])

    dt, length = model.dt, block.length
    attitude_var = (
        model.gyro_noise_psd * length + model.rate_noise_psd * sums.rate_squared * dt + sums.lost_rotation_var
    )
    velocity_error_var = model.velocity_error_fraction_sq * (sums.acceleration_sum * dt) ** 2
    velocity_var = model.accel_noise_psd * length + velocity_error_var + (sums.impact_excess * dt) ** 2
    velocity_var += model.lost_accel_var * sums.lost_accel_s**2
    _add_variance(P, ERROR.attitude, attitude_var)
    _add_variance(P, ERROR.velocity, velocity_var)
    _add_variance(P, ERROR.gyro_bias, model.bias_walk * length)
    _add_variance(P, ERROR.gyro_matrix, model.matrix_walk * length)
    _add_variance(P, ERROR.accel_bias, model.accel_bias_walk * length)
    _add_variance(P, ERROR.motion_bias, model.motion_bias_walk * length)


@inlined
def _add_variance(P, states, variance):  # type: ignore[no-untyped-def]
    """Add a variance to each of a range of states."""
    for i in range(states.start, states.stop):
        P[i, i] += variance


@inlined
def _correct(state, at, axes, measured, variance):  # type: ignore[no-untyped-def]
    """Correct by measurements of two or three states from `at` on: P ← P − P h hᵀ P/s for one after the other.

    The correction of the states is summed up. The gains come first, so that P is gone through once.
    """
    P, block, gains = state.P, state.block, state.gains
    correction = block.correction
    for m in range(axes):
        gain, measured_state = gains[m], at + m
        for j in range(COLUMNS):
            gain[j] = P[measured_state, j]
        for before in range(m):
            share = gains[before, measured_state]
            for j in range(COLUMNS):
                gain[j] -= share * gains[before, j]
        inv_std = 1.0 / np.sqrt(gain[measured_state] + variance)
        innovation = (measured[m] - state.x[measured_state] - correction[measured_state]) * inv_std
        for j in range(COLUMNS):
            gain[j] *= inv_std
        for j in range(STATES):
            correction[j] += gain[j] * innovation
        row = block.measurements + m
        block.state_index[row], block.inv_innovation_std[row] = measured_state, inv_std
        block.normalized_innovation[row] = innovation
        for j in range(STATES):
            block.normalized_gain[row, j] = gain[j]
    block.measurements += axes
    for i in range(STATES):
        first, second = gains[0, i], gains[1, i]
        for j in range(COLUMNS):
            P[i, j] = P[i, j] - first * gains[0, j] - second * gains[1, j]
    if axes == 3:
        for i in range(STATES):
            third = gains[2, i]
            for j in range(COLUMNS):
                P[i, j] -= third * gains[2, j]


@inlined
def _compute_added_variance(state, at, variance):  # type: ignore[no-untyped-def]
    """Compute the variance to add to that of a measurement, zero, of two axes, so that it is no outlier.

    The smallest s ≥ 0 with yᵀ (C + s I)⁻¹ y ≤ `OUTLIER_CHI2_2`, C the innovation's covariance: the larger root of a
    quadratic equation.
    """
    P, x, correction = state.P, state.x, state.block.correction
    y0, y1 = -x[at] - correction[at], -x[at + 1] - correction[at + 1]
    a, b, c = P[at, at] + variance, P[at, at + 1], P[at + 1, at + 1] + variance
    size, trace = y0 * y0 + y1 * y1, a + c
    determinant, scaled = a * c - b * b, y0 * y0 * c + y1 * y1 * a - 2.0 * y0 * y1 * b
    chi2_deficit = OUTLIER_CHI2_2 * determinant - scaled
    if chi2_deficit >= 0.0:
        return 0.0
    half = 0.5 * (OUTLIER_CHI2_2 * trace - size)
    root = np.sqrt(half * half - OUTLIER_CHI2_2 * chi2_deficit)
    return (root - half) / OUTLIER_CHI2_2 if half < 0.0 else -chi2_deficit / (root + half)


@inlined
def _squared_distance(P, at, variance, y0, y1, y2):  # type: ignore[no-untyped-def]
    """Compute the squared Mahalanobis distance of an innovation of three axes; the measurement has `variance` each."""
    a, b, c = P[at, at] + variance, P[at, at + 1], P[at, at + 2]
    e, f, i = P[at + 1, at + 1] + variance, P[at + 1, at + 2], P[at + 2, at + 2] + variance
    # Cholesky
    l0 = np.sqrt(a)
    l1, l2 = b / l0, c / l0
    l3 = np.sqrt(e - l1 * l1)
    l4 = (f - l1 * l2) / l3
    l5 = np.sqrt(i - l2 * l2 - l4 * l4)
    z0 = y0 / l0
    z1 = (y1 - l1 * z0) / l3
    z2 = (y2 - l2 * z0 - l4 * z1) / l5
    return z0 * z0 + z1 * z1 + z2 * z2


@inlined
def _inflate_jumped_bias(state, mean_x, mean_y, mean_z, variance):  # type: ignore[no-untyped-def]
    """Add the squared jump to the bias covariance if the mean of gyro over a static block is an outlier."""
    P, x, correction, at = state.P, state.x, state.block.correction, GYRO_BIAS
    y0 = mean_x - x[at] - correction[at]
    y1 = mean_y - x[at + 1] - correction[at + 1]
    y2 = mean_z - x[at + 2] - correction[at + 2]
    if _squared_distance(P, at, variance, y0, y1, y2) > OUTLIER_CHI2_3:
        P[at, at] += y0 * y0
        P[at + 1, at + 1] += y1 * y1
        P[at + 2, at + 2] += y2 * y2
        for i, j, product in ((0, 1, y0 * y1), (0, 2, y0 * y2), (1, 2, y1 * y2)):
            P[at + i, at + j] += product
            P[at + j, at + i] += product


@inlined
def _finish_block(state, model):  # type: ignore[no-untyped-def]
    """Propagate P over the block, correct by the bounds of motion or by the static phase, and begin the next block."""
    x, P, sums, block = state.x, state.P, state.sums, state.block
    count = state.samples
    block.length, block.lost_rotation_var, block.measurements = count * model.dt, sums.lost_rotation_var, 0
    for j in range(STATES):
        block.correction[j] = 0.0

    _propagate(state, model)
    static = sums.static_samples == count
    if static:
        P[2, 2] += model.static_heading_psd * block.length
    # Outliers are found in pairs and triples of axes: the directions of the sensor's axes do not matter.
    for group in range(2):
        if group == 0:
            at, axes = VELOCITY, 2
            variance = model.static_velocity_var if static else model.velocity_var
            variance += _compute_added_variance(state, at, variance)
        elif static:
            at, axes, variance = GYRO_BIAS, 3, model.static_bias_var
            _inflate_jumped_bias(state, sums.gyro[0] / count, sums.gyro[1] / count, sums.gyro[2] / count, variance)
        else:
            at, axes, variance = POSITION, 2, model.position_var
            variance += _compute_added_variance(state, at, variance)
        heading, rate = block.correction[2], compute_vertical_bias(block.correction, state.R_VS)
        for i in range(axes):
            state.measured[i] = sums.gyro[i] / count if axes == 3 else 0.0
        _correct(state, at, axes, state.measured, variance)
        heading, rate = block.correction[2] - heading, compute_vertical_bias(block.correction, state.R_VS) - rate
        add_correction(state.about_vertical, heading, rate, compute_vertical_bias_var(P, state.R_VS))
    for i in range(VELOCITY, STATES):
        x[i] += block.correction[i]
    rotate_by_world_vector(state.quat_VS, block.correction[0], block.correction[1], block.correction[2])
    state.samples = 0
    sums.rate_squared = sums.acceleration_sum = sums.impact_excess = 0.0
    sums.static_samples = sums.lost_rotation_var = sums.lost_accel_s = 0.0
    for i in range(3):
        sums.gyro[i] = 0.0


@inlined
def compute_vertical_bias_var(P, R_VS):  # type: ignore[no-untyped-def]
    """Compute the variance [rad²/s²] about the vertical of the gyroscope's bias in motion."""
    variance = 0.0
    for i in range(3):
        for j in range(3):
            b, d, e, m = GYRO_BIAS + i, MOTION_BIAS + i, GYRO_BIAS + j, MOTION_BIAS + j
            variance += R_VS[2, i] * R_VS[2, j] * (P[b, e] + P[b, m] + P[d, e] + P[d, m])
    return variance


@inlined
def compute_vertical_bias(x, R_VS):  # type: ignore[no-untyped-def]
    """Compute the gyroscope's bias in motion about the vertical [rad/s], of states (25,) or their corrections."""
    bias = 0.0
    for c in range(3):
        bias += R_VS[2, c] * (x[GYRO_BIAS + c] + x[MOTION_BIAS + c])
    return bias


@inlined
def _correct_rate(state, model, gx, gy, gz, static):  # type: ignore[no-untyped-def]
    """Correct the sample's rate: w = (I − M) u and u = gyro − bias [rad/s], three floats each.

    A lost sample gets the fading last rate; a lost or saturated one adds to the variance of the lost rotation.
    """
    x, sums, last = state.x, state.sums, state.last_rate
    bias, motion_bias, M = x[ERROR.gyro_bias], x[ERROR.motion_bias], x[ERROR.gyro_matrix]
    moving = 0.0 if static else 1.0
    bx, by, bz = bias[0] + moving * motion_bias[0], bias[1] + moving * motion_bias[1], bias[2] + moving * motion_bias[2]
    if gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED:  # false for NaN
        ux, uy, uz = gx - bx, gy - by, gz - bz
        good = max(abs(gx), abs(gy), abs(gz)) < model.gyro_limit
        sums.gyro[0] += gx
        sums.gyro[1] += gy
        sums.gyro[2] += gz
        sums.static_samples += 1.0 - moving
    else:
        fade = 1.0 - min(1.0, model.dt / HELD_RATE_FADE_S)
        ux, uy, uz = fade * last[0], fade * last[1], fade * last[2]
        good = False
    last[0], last[1], last[2] = ux, uy, uz
    if good:
        state.lost_s = 0.0
    else:
        lost_s = state.lost_s
        if lost_s * model.lost_rate_std < MAX_LOST_ROTATION_STD:
            sums.lost_rotation_var += model.lost_rate_std * model.lost_rate_std * model.dt * (2.0 * lost_s + model.dt)
        state.lost_s = lost_s + model.dt
    state.gyro_bias[0], state.gyro_bias[1], state.gyro_bias[2] = bx, by, bz
    wx = ux - (M[0] * ux + M[1] * uy + M[2] * uz)
    wy = uy - (M[3] * ux + M[4] * uy + M[5] * uz)
    wz = uz - (M[6] * ux + M[7] * uy + M[8] * uz)
    return wx, wy, wz, ux, uy, uz


@inlined
def _compute_horizontal_acceleration(state, model, ax, ay, az):  # type: ignore[no-untyped-def]
    """Compute the sample's horizontal acceleration in V, two floats [m/s²]; zero for a lost sample."""
    sums, bias, R = state.sums, state.x[ERROR.accel_bias], state.R_VS
    if not ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        sums.lost_accel_s += model.dt
        return 0.0, 0.0
    fx, fy, fz = ax - bias[0], ay - bias[1], az - bias[2]
    ax = R[0, 0] * fx + R[0, 1] * fy + R[0, 2] * fz
    ay = R[1, 0] * fx + R[1, 1] * fy + R[1, 2] * fz
    az = R[2, 0] * fx + R[2, 1] * fy + R[2, 2] * fz - model.gravity
    size = np.sqrt(ax * ax + ay * ay + az * az)
    sums.acceleration_sum += size
    sums.impact_excess += max(0.0, size - model.impact_limit)
    return ax, ay


@inlined
def step(state, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """Filter one sample, gyro [rad/s], accel [m/s²]; `state` of `STATE`. Return whether a block ended."""
    dt, x, sums, R = model.dt, state.x, state.sums, state.R_VS
    wx, wy, wz, ux, uy, uz = _correct_rate(state, model, gx, gy, gz, static)
    sums.rate_squared += wx * wx + wy * wy + wz * wz
    rotate_unit_by_rate(state.quat_VS, wx, wy, wz, dt)
    fill_matrix(state.quat_VS, R)
    moving, block, kept = 0.0 if static else 1.0, state.block, 1.0 if state.samples else 0.0
    for i in range(3):
        for c in range(3):
            R_dt = R[i, c] * dt
            block.R[i, c] = kept * block.R[i, c] + R_dt
            block.R_rate[0, i, c] = kept * block.R_rate[0, i, c] + R_dt * ux
            block.R_rate[1, i, c] = kept * block.R_rate[1, i, c] + R_dt * uy
            block.R_rate[2, i, c] = kept * block.R_rate[2, i, c] + R_dt * uz
            block.R_moving[i, c] = kept * block.R_moving[i, c] + R_dt * moving
    ax, ay = _compute_horizontal_acceleration(state, model, ax, ay, az)
    velocity, position = x[ERROR.velocity], x[ERROR.position]
    position[0] += dt * velocity[0]
    position[1] += dt * velocity[1]
    velocity[0] += dt * ax
    velocity[1] += dt * ay

    state.samples += 1
    ended = state.samples == model.block_samples
    if ended:
        _finish_block(state, model)
        fill_matrix(state.quat_VS, R)
    into_sensor(R, state.P, sums.lost_rotation_var, state.attitude_cov)
    return ended


@kernel
def _run(states, models, gyro_S, accel_S, static, blocks, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    row = 0
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if step(state, model, gx, gy, gz, ax, ay, az, static[k]) and row < len(blocks):
            for n in range(len(SMOOTHED_STATES)):
                for j in range(STATES):
                    state.block.P_smoothed_rows[n, j] = state.P[SMOOTHED_STATES[n], j]
            blocks[row] = state.block
            row += 1
        store_sample(state, k, out_quat, out_bias, out_cov, out_vertical)
