"""aMEKF: a causal multiplicative extended Kalman filter of one IMU's attitude, corrected in motion as well.

Pseudo-measurements correct it: the horizontal velocity and position of a sensor on a person are bounded. The specific
force, rotated to the filter's world, is integrated to them (the almost-inertial frame of VQF, Laidig and Seel 2023,
Information Fusion 91). A tilt error of 1° would give 8 m in 10 s; a segment does not move so far. The same innovations
estimate the gyroscope's bias, its scale and misalignment (3×3), which rotation about horizontal axes makes observable.
The heading is not observed; it improves with these parameters.

V is the sensor's own world: z up, heading that of the filter's start. The 22 errors are additive except the
attitude error, a rotation on the left, in V: R = exp(θ) R_estimated. It does not change when the sensor
rotates. Measured rate = (I + M) true rate + bias. Errors of velocity and position are those of
the invariant filter (Barrau and Bonnabel 2017, IEEE TAC 62(4)): θ × g e_z alone drives them, so that their bound gives
no information on the heading.

The strapdown runs at each sample, the covariance once a block (`AmekfParams.block_s`): over a block the transition is
exact in the sums of R_VS and R_VS ω. In a static block (static phase of Lisini Baldi 2019, IEEE Sensors Journal) the
velocity is zero and the gyroscope measures its bias.
"""

from dataclasses import dataclass

import numpy as np

from ..arguments import NonNegative, Positive, PositiveOrInfinite
from ..compilation import inlined, kernel
from ..recording.limits import HIGHEST_ACCEL_SQUARED
from ..rotations import fill_matrix, rotate_by_vector, rotate_by_world_vector
from . import base
from .phases import SensorNoise, average_variance

# Index range of each error among the states
ATTITUDE = slice(0, 3)  # θ [rad], on the left, in V
VELOCITY = slice(3, 5)  # [m/s], horizontal, in V
POSITION = slice(5, 7)  # [m], horizontal, in V
GYRO_BIAS = slice(7, 10)  # [rad/s], in S
GYRO_MATRIX = slice(10, 19)  # M, rows first
ACCEL_BIAS = slice(19, 22)  # [m/s²], in S
STATES = 22
COLUMNS = 24  # of matrices in the record: rows of whole processor vectors; beyond the 22 states they are zero
PROPAGATED_STATES = 7  # θ, velocity and position change over a block, the other states stay
SMOOTHED_STATES = (0, 1, 2, 7, 8, 9)  # states that the smoother corrects: θ, bias
MAX_MEASUREMENTS = 5  # of a static block: velocity (2) and bias (3); of another: velocity (2) and position (2)

# Squared Mahalanobis distance beyond which an innovation of two or three axes is an outlier: χ² quantiles of 0.9973,
# which is 3 σ of one axis.
OUTLIER_CHI2_2, OUTLIER_CHI2_3 = 11.83, 14.16

# A block's transition and corrections. The smoother keeps one of each block and goes through them backward.
BLOCK = np.dtype(
    [
        ("R", float, (3, 3)),  # Σ R_VS dt [s]
        ("R_rate", float, (3, 3, 3)),  # Σ R_VS ω_c dt [rad], for the axes c = x, y, z of S
        ("length", float),  # [s]
        ("accel_s", float),  # [s] of that in which accel was measured
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


@dataclass(frozen=True)
class AmekfParams(base.FilterParams):
    """How wrong a MEMS sensor and how bounded a person's motion is; standard deviations for all recordings."""

    block_s: Positive = 0.25  # [s] between corrections; the covariance is propagated over it in one step
    speed_std: Positive = 1.0  # [m/s] of the sensor, horizontal, per axis; independent values every `motion_s`
    position_std: Positive = 1.5  # [m] about its mean, horizontal, per axis; independent values every `motion_s`
    motion_s: Positive = 1.0  # [s] correlation time of motion
    static_speed_std: NonNegative = 0.01  # [m/s] in a static phase
    rate_noise: NonNegative = 3e-4  # [1/√Hz] of gyro in motion, a fraction of |ω|: what the matrix does not explain
    force_noise: NonNegative = 0.01  # error of a block's velocity change, a fraction of the summed |acceleration|
    impact: Positive = 100.0  # [m/s²] beyond it is an impact: the excess, integrated, is a velocity error
    tilt_std: NonNegative = 0.2  # [rad] at the start, which may be in motion
    gyro_matrix_std: NonNegative = 0.002  # each entry of M
    drift_rate_std: NonNegative = base.DRIFT_RATE_STD  # [rad/s] of the heading in motion, apart from the bias
    gyro_bias_walk: NonNegative = 5e-5  # [rad/s/√s], 100 deg/h in 100 s: it changes with motion too
    static_turn_noise: NonNegative = base.STATIC_TURN_NOISE  # [rad/√s]
    accel_bias_std: NonNegative = 0.03  # [m/s²], 3 mg
    accel_bias_walk: NonNegative = 1e-4  # [m/s²/√s]
    gyro_range: PositiveOrInfinite = np.inf  # [rad/s] full scale; at it the covariance grows by what may be beyond
    lost_force_std: NonNegative = 5.0  # [m/s²] of the unknown acceleration while accel is lost (NaN)


@kernel
def fill_transition_rows(block, gravity, P, out):  # type: ignore[no-untyped-def]
    """Fill `out` (7, m) with the rows of ``F P`` of θ, velocity and position, which differ from those of `P` (22, m).

    θ⁺ = θ − Σ R dt b − Σ R ω dt M, v⁺ = v + ∫ θ × g e_z − Σ R dt f, p⁺ = p + ∫ v, the integrals by the trapezoid, of
    θ × g e_z while accel is measured; b, f are the errors of the gyroscope's and the accelerometer's bias.
    """
    columns = P.shape[1]
    bias, matrix, force = P[GYRO_BIAS], P[GYRO_MATRIX], P[ACCEL_BIAS]
    for i in range(3):
        for j in range(columns):
            out[i, j] = P[i, j]
        for c in range(3):
            R = block.R[i, c]
            for j in range(columns):
                out[i, j] -= R * bias[c, j]
            x, y, z = block.R_rate[0, i, c], block.R_rate[1, i, c], block.R_rate[2, i, c]
            for j in range(columns):
                out[i, j] -= x * matrix[3 * c, j] + y * matrix[3 * c + 1, j] + z * matrix[3 * c + 2, j]
    g, t = 0.5 * block.accel_s * gravity, 0.5 * block.length
    for i in range(2):
        sign, other = (g, 1) if i == 0 else (-g, 0)
        v, p = VELOCITY.start + i, POSITION.start + i
        x, y, z = block.R[i, 0], block.R[i, 1], block.R[i, 2]
        for j in range(columns):
            moved = x * force[0, j] + y * force[1, j] + z * force[2, j]
            out[v, j] = P[v, j] + sign * (P[other, j] + out[other, j]) - moved
        for j in range(columns):
            out[p, j] = P[p, j] + t * (P[v, j] + out[v, j])


@inlined
def _propagate(state, model):  # type: ignore[no-untyped-def]
    """Propagate over the block that ends: P ← F P Fᵀ + Q."""
    P, rows, columns, corner, block = state.P, state.FP_rows, state.FP_columns, state.FPF_corner, state.block
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

    dt = model.dt
    attitude_var = model.rate_noise_psd * state.rate_squared * dt
    velocity_var = model.force_error_var * (state.acceleration_sum * dt) ** 2
    velocity_var += (state.impact_excess * dt) ** 2 + model.lost_accel_var * state.lost_accel_s**2
    for i in range(STATES):
        P[i, i] += model.noise_psd[i] * block.length
    for i in range(3):
        P[i, i] = base.add_lost(P[i, i] + attitude_var, block.lost_rotation_var)
    P[VELOCITY.start, VELOCITY.start] += velocity_var
    P[VELOCITY.start + 1, VELOCITY.start + 1] += velocity_var


@inlined
def _correct(state, at, axes, variance):  # type: ignore[no-untyped-def]
    """Correct by `state.measured` of two or three states from `at` on: P ← P − P h hᵀ P/s for one after the other.

    The correction of the states is summed up. The gains come first, so that P is gone through once.
    """
    P, block, gains = state.P, state.block, state.gains
    for m in range(3):
        gain, measured_state, row = gains[m], at + m, block.measurements
        if m == axes:
            gain[:] = 0.0
            break
        for j in range(COLUMNS):
            gain[j] = P[measured_state, j]
        for before in range(m):
            share = gains[before, measured_state]
            for j in range(COLUMNS):
                gain[j] -= share * gains[before, j]
        inv_std = 1.0 / np.sqrt(gain[measured_state] + variance)
        innovation = (state.measured[m] - state.x[measured_state] - block.correction[measured_state]) * inv_std
        for j in range(COLUMNS):
            gain[j] *= inv_std
        for j in range(STATES):
            block.correction[j] += gain[j] * innovation
            block.normalized_gain[row, j] = gain[j]
        block.state_index[row], block.inv_innovation_std[row] = measured_state, inv_std
        block.normalized_innovation[row] = innovation
        block.measurements += 1
    for i in range(STATES):
        first, second, third = gains[0, i], gains[1, i], gains[2, i]
        for j in range(COLUMNS):
            P[i, j] -= first * gains[0, j] + second * gains[1, j] + third * gains[2, j]


@inlined
def _correct_to_zero(state, at, variance):  # type: ignore[no-untyped-def]
    """Correct by a measurement of two states from `at` on, zero; an outlier gets the variance that it shows itself.

    So it counts as little as an ordinary one: a vehicle, which no bound of a person's motion holds for, gives many in a
    row. Both axes share the variance: the directions of the sensor's axes do not matter.
    """
    P, x, correction = state.P, state.x, state.block.correction
    y0, y1 = x[at] + correction[at], x[at + 1] + correction[at + 1]
    expected = 0.5 * (P[at, at] + P[at + 1, at + 1])
    state.measured[:] = 0.0
    size = y0 * y0 + y1 * y1
    if size > OUTLIER_CHI2_2 * (expected + variance):
        variance = size - expected
    _correct(state, at, 2, variance)


@inlined
def _correct_bias(state, variance):  # type: ignore[no-untyped-def]
    """Correct by the mean of gyro over a static block; where it is an outlier, the bias has jumped by as much."""
    P, at, y = state.P, GYRO_BIAS.start, state.innovation
    size, expected = 0.0, variance
    for i in range(3):
        state.measured[i] = state.gyro_sum[i] / state.samples
        y[i] = state.measured[i] - state.x[at + i] - state.block.correction[at + i]
        size += y[i] * y[i]
        expected += P[at + i, at + i] / 3.0
    if size > OUTLIER_CHI2_3 * expected:
        for i in range(3):
            for j in range(3):
                P[at + i, at + j] += y[i] * y[j]
    _correct(state, at, 3, variance)


@inlined
def _finish_block(state, model):  # type: ignore[no-untyped-def]
    """Propagate P over the block, correct by the bounds of motion or by the static phase, and begin the next block."""
    x, P, block, R = state.x, state.P, state.block, state.R_VS
    block.length, block.lost_rotation_var, block.measurements = state.samples * model.dt, state.lost_rotation_var, 0
    block.accel_s = block.length - state.lost_accel_s
    block.correction[:] = 0.0
    _propagate(state, model)
    static = state.static_samples == state.samples
    if static:
        P[2, 2] += model.static_heading_psd * block.length
    _correct_to_zero(state, VELOCITY.start, model.static_velocity_var if static else model.velocity_var)
    if static:
        _correct_bias(state, model.static_bias_var)
    else:
        _correct_to_zero(state, POSITION.start, model.position_var)
    vertical = state.about_vertical
    vertical[base.HEADING] += block.correction[2]
    vertical[base.RATE_VAR] = 0.0
    for i in range(3):
        vertical[base.RATE] += R[2, i] * block.correction[GYRO_BIAS.start + i]
        for j in range(3):
            vertical[base.RATE_VAR] += R[2, i] * R[2, j] * P[GYRO_BIAS.start + i, GYRO_BIAS.start + j]
    for i in range(VELOCITY.start, STATES):
        x[i] += block.correction[i]
    rotate_by_world_vector(state.quat_VS, block.correction[0], block.correction[1], block.correction[2])
    state.samples = state.static_samples = 0
    state.rate_squared = state.acceleration_sum = state.impact_excess = 0.0
    state.lost_rotation_var = state.lost_accel_s = 0.0
    state.gyro_sum[:] = 0.0


@inlined
def _step(state, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """Filter one sample, gyro [rad/s], accel [m/s²]. Return whether a block ended."""
    dt, x, R, block, began = model.dt, state.x, state.R_VS, state.block, 1.0 if state.samples else 0.0
    bias = x[GYRO_BIAS]
    ux, uy, uz, is_measured, lost_var = base.bridge_rate(state, model, gx, gy, gz, bias[0], bias[1], bias[2])
    if is_measured:
        state.gyro_sum[0] += gx
        state.gyro_sum[1] += gy
        state.gyro_sum[2] += gz
        state.static_samples += static
    state.lost_rotation_var += lost_var
    M = x[GYRO_MATRIX]
    wx = ux - (M[0] * ux + M[1] * uy + M[2] * uz)
    wy = uy - (M[3] * ux + M[4] * uy + M[5] * uz)
    wz = uz - (M[6] * ux + M[7] * uy + M[8] * uz)
    state.rate_squared += wx * wx + wy * wy + wz * wz
    rotate_by_vector(state.quat_VS, wx * dt, wy * dt, wz * dt)
    fill_matrix(state.quat_VS, R)
    for i in range(3):
        for c in range(3):
            R_dt = R[i, c] * dt
            block.R[i, c] = began * block.R[i, c] + R_dt
            block.R_rate[0, i, c] = began * block.R_rate[0, i, c] + R_dt * ux
            block.R_rate[1, i, c] = began * block.R_rate[1, i, c] + R_dt * uy
            block.R_rate[2, i, c] = began * block.R_rate[2, i, c] + R_dt * uz
    velocity, position, force_bias = x[VELOCITY], x[POSITION], x[ACCEL_BIAS]
    position[0] += dt * velocity[0]
    position[1] += dt * velocity[1]
    if ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        fx, fy, fz = ax - force_bias[0], ay - force_bias[1], az - force_bias[2]
        ax = R[0, 0] * fx + R[0, 1] * fy + R[0, 2] * fz
        ay = R[1, 0] * fx + R[1, 1] * fy + R[1, 2] * fz
        az = R[2, 0] * fx + R[2, 1] * fy + R[2, 2] * fz - model.gravity
        size = np.sqrt(ax * ax + ay * ay + az * az)
        state.acceleration_sum += size
        state.impact_excess += max(0.0, size - model.impact_limit)
        velocity[0] += dt * ax
        velocity[1] += dt * ay
    else:
        state.lost_accel_s += dt
    state.samples += 1
    ended = state.samples == model.block_samples
    if ended:
        _finish_block(state, model)
        fill_matrix(state.quat_VS, R)
    return ended


@kernel
def run(states, models, blocks, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    """Filter samples as `OrientationFilter.run`; fill one of `blocks` at the end of each block, while any are left."""
    state, model = states[0], models[0]
    P, row = state.P, 0
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if _step(state, model, gx, gy, gz, ax, ay, az, static[k]) and row < len(blocks):
            for n in range(len(SMOOTHED_STATES)):
                for j in range(STATES):
                    state.block.P_smoothed_rows[n, j] = state.P[SMOOTHED_STATES[n], j]
            blocks[row] = state.block
            row += 1
        attitude = P[0, 0], P[0, 1], P[0, 2], P[1, 0], P[1, 1], P[1, 2], P[2, 0], P[2, 1], P[2, 2]
        state.moved_s += model.dt * (not static[k])
        base.into_sensor(state.R_VS, attitude, state.lost_rotation_var, model.drift_var * state.moved_s**2, out_cov[k])
        for i in range(4):
            out_quat[k, i] = state.quat_VS[i]
        for i in range(3):
            out_bias[k, i], out_vertical[k, i] = state.x[GYRO_BIAS.start + i], state.about_vertical[i]


def make_records(noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, p: AmekfParams) -> tuple[np.ndarray, ...]:
    """Return the state and the constants of an aMEKF."""
    x, std, P = np.zeros(STATES), np.zeros(STATES), np.zeros((STATES, COLUMNS))
    x[GYRO_BIAS] = noise.gyro_bias
    std[ATTITUDE] = p.tilt_std, p.tilt_std, base.START_HEADING_STD
    std[VELOCITY], std[POSITION] = p.speed_std, p.position_std
    std[GYRO_MATRIX], std[ACCEL_BIAS] = p.gyro_matrix_std, p.accel_bias_std
    np.fill_diagonal(P, std**2)
    P[GYRO_BIAS, GYRO_BIAS] = noise.gyro_bias_cov
    state = base.make_record(
        quat_VS=quat_VS,  # (4,) xyzw
        x=x,  # (22,) the attitude's error is always zero
        P=P,  # (22, 24)
        about_vertical=np.array([0.0, 0.0, average_variance(noise.gyro_bias_cov)]),  # as `Orientation`
        last_rate=np.zeros(3),  # [rad/s] as `bridge_rate`
        lost_s=0.0,  # [s] the same
        moved_s=0.0,  # [s] in motion since the start
        # sums over the samples of the open block
        samples=np.int64(0),
        static_samples=np.int64(0),
        gyro_sum=np.zeros(3),  # [rad/s]
        rate_squared=0.0,  # [rad²/s²]
        acceleration_sum=0.0,  # [m/s²] magnitude
        impact_excess=0.0,  # [m/s²] magnitude beyond the limit of an impact
        lost_rotation_var=0.0,  # [rad²]
        lost_accel_s=0.0,  # [s]
        block=np.zeros((), BLOCK),
        # work space
        R_VS=np.zeros((3, 3)),
        FP_rows=np.zeros((PROPAGATED_STATES, COLUMNS)),
        FP_columns=np.zeros((STATES, 8)),  # the last column is zero
        FPF_corner=np.zeros((PROPAGATED_STATES, 8)),
        gains=np.zeros((3, COLUMNS)),  # P h/√s of the measurements that are taken together
        measured=np.zeros(3),
        innovation=np.zeros(3),
    )
    block_samples = max(1, round(p.block_s * rate_hz))
    length = block_samples / rate_hz
    gyro_var, accel_var = average_variance(noise.gyro_cov), average_variance(noise.accel_cov)
    noise_psd = np.zeros(STATES)
    noise_psd[ATTITUDE] = gyro_var / rate_hz
    noise_psd[VELOCITY] = accel_var * noise.gravity**2 / rate_hz
    noise_psd[GYRO_BIAS], noise_psd[ACCEL_BIAS] = p.gyro_bias_walk**2, p.accel_bias_walk**2
    # Errors of the mean of gyro over a static block: white noise, and the sway of a standing person.
    white, sway = gyro_var / block_samples, noise.sway_density(rate_hz)
    model = base.make_record(
        dt=1.0 / rate_hz,  # [s]
        block_samples=np.int64(block_samples),
        gravity=noise.gravity,  # [m/s²]
        noise_psd=noise_psd,  # (22,) by which the variance of each state grows in a second
        velocity_var=p.speed_std**2 * p.motion_s / length,  # [m²/s²] of a block's measurement, as the next three
        position_var=p.position_std**2 * p.motion_s / length,  # [m²]
        static_velocity_var=p.static_speed_std**2,  # [m²/s²]
        static_bias_var=white + sway / length,  # [rad²/s²] of gyro's mean about the bias
        # [rad²/s] A person who sways may also rotate slowly about the vertical: an eighth of the sway (assumption).
        static_heading_psd=p.static_turn_noise**2 + sway / 8.0,
        rate_noise_psd=p.rate_noise**2,  # [1/Hz] of gyro, relative to |ω|
        force_error_var=p.force_noise**2,  # [1] of the summed |acceleration| of a block
        lost_accel_var=p.lost_force_std**2,  # [m²/s⁴]
        drift_var=p.drift_rate_std**2,  # [rad²/s²]
        gyro_range=p.gyro_range,  # [rad/s]
        impact_limit=p.impact,  # [m/s²]
    )
    return state, model


# A lost sample of accel counts as gravity alone, and the velocity's covariance grows. A jump of the bias is adopted in
# the next static phase; until then the tilt error reaches some degrees. Without a static phase everything is estimated
# in motion: the tilt in ten seconds, the other parameters in about a minute.
AMEKF = base.OrientationFilter(lambda *of_sensor: (*make_records(*of_sensor), np.empty(0, BLOCK)), run, AmekfParams)
