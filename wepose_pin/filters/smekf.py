"""sMEKF: the multiplicative Kalman filter that corrects in static phases alone (Lisini Baldi 2019, Algorithm 1).

One thing differs from the paper, which works to first order (`published`). Its transition Φ = I − [ω δt]× lets the
standard deviation grow by √(1 + (ω δt)²) a sample, at 720 deg/s and 100 Hz to 10⁶ deg in 20 s. Its corrections rotate
the attitude and not the covariance, so that static phases seem to measure the heading. Over two minutes of simulated
motion with static phases the rms heading error is 0.57 deg as published and 0.10 deg here.

The state is x = [a; b]: the attitude error a [rad] and the gyroscope bias b [rad/s] in S. The paper's a is on the
right of `quat_VS`, in S, as that of `attitude_cov`. Inside, a is on the left, in V, where it changes neither with the
sensor's rotation nor with a correction of the attitude: Φ is the identity and P need not be rotated.

Measurement model: gyro = ω + b + w_ω, accel/g = R_VSᵀ e_z + w_g. In a static phase ω = 0, so gyro measures b. Σ_ω and
Σ_g are the covariances of the white noises w_ω and w_g, Σ_b that of the bias's random walk. A person's sway and the
accelerometer's bias are correlated from sample to sample, so that the covariances of static samples are inflated: many
samples of a static phase count as few.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from scipy.spatial.transform import Rotation

from ..arguments import NonNegative, check_fields
from ..compilation import fma, inlined, kernel
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import C0, C1, C2, C3, S0, S1, S2, S3, half_angle_terms, up_in_sensor
from .base import (
    RATE_VAR,
    START_HEADING_STD,
    STATIC_TURN_NOISE,
    VERTICAL_COLUMNS,
    FilterRun,
    add_correction,
    make_record,
    make_run,
    prepare_samples,
    store_sample,
    symmetric,
)
from .noise import ACCEL_BIAS_STD, SWAY_CORRELATION_S, SensorNoise


@dataclass(frozen=True)
class SmekfParams:
    """What the static phase does not say of a sensor; standard deviations."""

    tilt_std: NonNegative = ACCEL_BIAS_STD  # [rad] of roll and pitch at the start
    static_turn_noise: NonNegative = (
        STATIC_TURN_NOISE  # [rad/√s] of undetected rotation about the vertical in a static phase
    )
    gyro_scale_std: NonNegative = 0.002  # of the gyroscope's scale, which no static phase shows
    gyro_range: float = np.inf  # [rad/s]; a sample at it is used, and the covariance grows by what may be beyond

    def __post_init__(self) -> None:
        check_fields(self, "")


# At a missing sample (NaN, or beyond `recording.limits`) the last rate is held and fades with the time constant HOLD_S,
# no correction is made, and the attitude's standard deviation grows by the motion that may have been missed: after T
# seconds by LOST_RATE_STD T²/(T + HOLD_S), up to π.
HOLD_S = 0.1  # [s] about as long as the rate of an arm keeps its value
LOST_RATE_STD = 2.5  # [rad/s] of an arm in motion (our assumption)

# The state of a sensor is one record, its constants (`Smekf.model`) are another. Upper triangles are xx xy xz yy yz zz.
STATE = np.dtype(
    [
        ("quat_VS", float, 4),  # xyzw
        ("gyro_bias", float, 3),  # [rad/s]
        ("attitude_cov", float, 6),  # [rad²] upper triangle: P_aa in S, and what the gyroscope's scale adds
        ("turned", float),  # [rad] net rotation about the vertical since the start
        ("P_aa", float, 6),  # [rad²] upper triangle, of a in V
        ("P_ab", float, (3, 3)),  # [rad²/s] of a in V and b in S
        ("P_bb", float, 6),  # [rad²/s²] upper triangle
        ("held_rate", float, 3),  # [rad/s] the last that was measured
        ("lost_s", float),  # [s] since then
        ("about_vertical", float, VERTICAL_COLUMNS),  # as `base.AboutVertical`
    ],
    align=True,
)
_UPPER = np.triu_indices(3)
# Below this (θ/2)² four terms of a power series are enough; the first terms left out are under 3e-17.
SHORT_SERIES = 1e-3
D0, D1, D2, D3 = ((-1) ** k / factorial(2 * k + 3) for k in range(4))  # (θ − sin θ)/θ³ in θ²


class SmekfState:
    """Views of the record that the compiled steps work on."""

    def __init__(self, record: np.ndarray) -> None:
        self.record = record  # (1,) of `STATE`
        self.quat_VS = record["quat_VS"][0]  # (4,) xyzw
        self.gyro_bias = record["gyro_bias"][0]  # (3,) [rad/s]

    @property
    def P(self) -> np.ndarray:
        """Covariance (6, 6) of [a; b], both in S; a copy."""
        record, R_VS = self.record[0], Rotation.from_quat(self.quat_VS).as_matrix()
        ab = R_VS.T @ record["P_ab"]
        return np.block([[R_VS.T @ symmetric(record["P_aa"]) @ R_VS, ab], [ab.T, symmetric(record["P_bb"])]])


class Smekf:
    """sMEKF of one sensor. Σ_ω, Σ_g, Σ_b, the first bias and the size of gravity come from `noise`.

    Missing samples are NaN: the last rate is held and fades, and `attitude_cov` grows by the motion that may have been
    missed (HOLD_S, LOST_RATE_STD). `run` is that of `base.OrientationFilter`.
    """

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_VS: np.ndarray, params: SmekfParams | None = None
    ) -> None:
        self.params = p = params or SmekfParams()
        self.noise, self.rate_hz = noise, rate_hz
        dt, record = 1.0 / rate_hz, np.zeros(1, STATE)
        sway_cov = noise.sway_density(rate_hz) * rate_hz * np.eye(3)
        accel_bias_cov = ACCEL_BIAS_STD**2 * SWAY_CORRELATION_S * rate_hz * np.eye(3)
        self.model = make_record(
            dt=dt,  # [s]
            inverse_gravity=1.0 / noise.gravity,  # [s²/m]
            attitude_step=(dt * dt * noise.gyro_cov)[_UPPER],  # [rad²] δt² Σ_ω
            bias_step=(dt * dt * noise.bias_step_cov)[_UPPER],  # [rad²/s²] δt² Σ_b
            static_gyro_cov=(noise.gyro_cov + sway_cov)[_UPPER],  # [rad²/s²]
            static_accel_cov=(noise.accel_cov + accel_bias_cov)[_UPPER],  # of accel/g
            fade=float(np.exp(-dt / HOLD_S)),  # factor on a held rate at each missing sample
            static_turn=p.static_turn_noise**2 * dt,  # [rad²] variance of an undetected turn in a static sample
            scale_var=p.gyro_scale_std**2,
            gyro_range=p.gyro_range,  # [rad/s]
        )
        record["quat_VS"], record["gyro_bias"] = quat_VS, noise.gyro_bias
        tilt_var, heading_var, up = p.tilt_std**2, START_HEADING_STD**2, np.array(up_in_sensor(record["quat_VS"][0]))
        record["P_aa"] = tilt_var + heading_var, 0.0, 0.0, tilt_var + heading_var, 0.0, heading_var
        record["attitude_cov"] = (tilt_var * (np.eye(3) - np.outer(up, up)) + heading_var * np.eye(3))[_UPPER]
        record["P_bb"] = noise.gyro_bias_cov[_UPPER]
        record["about_vertical"][0, RATE_VAR] = up @ noise.gyro_bias_cov @ up
        self.state = SmekfState(record)

    def run(
        self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool, out: FilterRun | None = None
    ) -> FilterRun:
        gyro, accel, is_static = prepare_samples(gyro_S, accel_S, static)
        out = out or make_run(len(gyro))
        _run(self.state.record, self.model, gyro, accel, is_static, *out)
        return out


@inlined
def step(state, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """Take one sample of one sensor: the records of state and constants, gyro [rad/s], accel [m/s²]."""
    dt, bias, held = model.dt, state.gyro_bias, state.held_rate
    is_measured = gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED  # false for NaN
    lost_var = 0.0
    if is_measured:
        wx, wy, wz = gx - bias[0], gy - bias[1], gz - bias[2]
    else:
        wx, wy, wz = model.fade * held[0], model.fade * held[1], model.fade * held[2]
    if is_measured and max(abs(gx), abs(gy), abs(gz)) < model.gyro_range:
        state.lost_s = 0.0
    else:
        before, after = state.lost_s, state.lost_s + dt
        std_before = min(np.pi, LOST_RATE_STD * before * before / (before + HOLD_S))
        std_after = min(np.pi, LOST_RATE_STD * after * after / (after + HOLD_S))
        lost_var = std_after * std_after - std_before * std_before
        state.lost_s = after
    held[0], held[1], held[2] = wx, wy, wz
    wx, wy, wz = wx * dt, wy * dt, wz * dt
    P, R = predict(state, model, wx, wy, wz, lost_var)
    if static and is_measured and ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        P, R = correct(state, model, P, R, gx, gy, gz, ax, ay, az)
    store_covariance(state, P)
    update_attitude_cov(state, model, P, R, wx, wy, wz)


@inlined
def update_attitude_cov(state, model, P, R, wx, wy, wz):  # type: ignore[no-untyped-def]
    """Set the stated attitude covariance after the rotation w [rad]: P_aa in S, and the error of the gyroscope's scale.

    A scale that is wrong by s gives the heading an error of s times the rotation about the vertical. It gives the tilt
    an error too, which static phases correct. The scale is no part of the filter's state, as in the paper.
    """
    state.turned += dot(R[6], wx, R[7], wy, R[8], wz)
    aa, _, bb = P
    heading_var = model.scale_var * state.turned * state.turned
    stated = rotate_symmetric(transpose(R), (aa[0], aa[1], aa[2], aa[3], aa[4], aa[5] + heading_var))
    for i in range(6):
        state.attitude_cov[i] = stated[i]
    state.about_vertical[RATE_VAR] = compute_variance_along(bb, R[6], R[7], R[8])


# Matrices are tuples below, since numbers stay in registers and the entries of an array would not: nine numbers, rows
# first, or the six of an upper triangle. The covariance P is (P_aa, P_ab, P_bb).


@inlined
def load_covariance(state):  # type: ignore[no-untyped-def]
    a, b, c = state.P_aa, state.P_ab, state.P_bb
    return (
        (a[0], a[1], a[2], a[3], a[4], a[5]),
        (b[0, 0], b[0, 1], b[0, 2], b[1, 0], b[1, 1], b[1, 2], b[2, 0], b[2, 1], b[2, 2]),
        (c[0], c[1], c[2], c[3], c[4], c[5]),
    )


@inlined
def store_covariance(state, P):  # type: ignore[no-untyped-def]
    P_aa, P_ab, P_bb = P
    a, b, c = state.P_aa, state.P_ab, state.P_bb
    a[0], a[1], a[2], a[3], a[4], a[5] = P_aa
    b[0, 0], b[0, 1], b[0, 2], b[1, 0], b[1, 1], b[1, 2], b[2, 0], b[2, 1], b[2, 2] = P_ab
    c[0], c[1], c[2], c[3], c[4], c[5] = P_bb


@inlined
def predict(state, model, wx, wy, wz, lost_var):  # type: ignore[no-untyped-def]
    """Algorithm 1, prediction by the turn w = (gyro − b) δt: q ← q ⊗ exp(w); return F P Fᵀ + G Q Gᵀ and R_VS.

    F = [[I, B], [0, I]] of errors in V, B = −δt R_VS ∫₀¹ exp(−[w]× u) du, R_VS after the turn. G Q Gᵀ is
    δt² diag(R_VS Σ_ω R_VSᵀ, Σ_b). `lost_var` [rad²] is added on top.
    """
    dt, P = model.dt, load_covariance(state)
    square = dot(wx, wx, wy, wy, wz, wz)
    half, cosine, d = rotation_terms(square)
    R = turn(state.quat_VS, load_quat(state.quat_VS), (half * wx, half * wy, half * wz, cosine))
    s, c = 2.0 * half * cosine, 2.0 * half * half  # sin θ/θ, (1 − cos θ)/θ²
    B = multiply(R, sum_of_three(-dt * s, dt * c, -dt * d, wx, wy, wz))
    aa, ab, bb = P
    b = (
        add_dot(ab[0], B[0], bb[0], B[1], bb[1], B[2], bb[2]),
        add_dot(ab[1], B[0], bb[1], B[1], bb[3], B[2], bb[4]),
        add_dot(ab[2], B[0], bb[2], B[1], bb[4], B[2], bb[5]),
        add_dot(ab[3], B[3], bb[0], B[4], bb[1], B[5], bb[2]),
        add_dot(ab[4], B[3], bb[1], B[4], bb[3], B[5], bb[4]),
        add_dot(ab[5], B[3], bb[2], B[4], bb[4], B[5], bb[5]),
        add_dot(ab[6], B[6], bb[0], B[7], bb[1], B[8], bb[2]),
        add_dot(ab[7], B[6], bb[1], B[7], bb[3], B[8], bb[4]),
        add_dot(ab[8], B[6], bb[2], B[7], bb[4], B[8], bb[5]),
    )  # P_ab + B P_bb
    p, q = rotate_symmetric(R, model.attitude_step), model.bias_step
    # P_aa + B P_ba + (P_ab + B P_bb) Bᵀ
    a = (
        add_dot(
            add_dot(aa[0] + p[0] + lost_var, B[0], ab[0], B[1], ab[1], B[2], ab[2]), b[0], B[0], b[1], B[1], b[2], B[2]
        ),
        add_dot(add_dot(aa[1] + p[1], B[0], ab[3], B[1], ab[4], B[2], ab[5]), b[0], B[3], b[1], B[4], b[2], B[5]),
        add_dot(add_dot(aa[2] + p[2], B[0], ab[6], B[1], ab[7], B[2], ab[8]), b[0], B[6], b[1], B[7], b[2], B[8]),
        add_dot(
            add_dot(aa[3] + p[3] + lost_var, B[3], ab[3], B[4], ab[4], B[5], ab[5]), b[3], B[3], b[4], B[4], b[5], B[5]
        ),
        add_dot(add_dot(aa[4] + p[4], B[3], ab[6], B[4], ab[7], B[5], ab[8]), b[3], B[6], b[4], B[7], b[5], B[8]),
        add_dot(
            add_dot(aa[5] + p[5] + lost_var, B[6], ab[6], B[7], ab[7], B[8], ab[8]), b[6], B[6], b[7], B[7], b[8], B[8]
        ),
    )
    return (a, b, (bb[0] + q[0], bb[1] + q[1], bb[2] + q[2], bb[3] + q[3], bb[4] + q[4], bb[5] + q[5])), R


@inlined
def correct(state, model, P, R, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction in a static phase; return P and R_VS after it.

    y = [R_VS accel/g; gyro], h = [e_z; b̂], H = [[[e_z]×, 0], [0, I]] of errors in V. A correction of the attitude does
    not change e_z, so that P, whose long axis is the heading, need not follow it.

    The noises of the two are independent, so gyro is taken first and accel after it, which is the same correction with
    two S of (3, 3) in place of one of (6, 6).
    """
    bias, up = state.gyro_bias, (R[6], R[7], R[8])
    # gyro: H P = [P_ba, P_bb], S = P_bb + Σ_ω
    Q = model.static_gyro_cov
    _, b, c = P
    S = c[0] + Q[0], c[1] + Q[1], c[2] + Q[2], c[3] + Q[3], c[4] + Q[4], c[5] + Q[5]
    x, y, z = (
        (b[0], b[3], b[6], c[0], c[1], c[2]),
        (b[1], b[4], b[7], c[1], c[3], c[4]),
        (b[2], b[5], b[8], c[2], c[4], c[5]),
    )
    P, d = fuse(P, (x, y, z), S, (gx - bias[0], gy - bias[1], gz - bias[2]))
    # accel: H P = [−y; x; 0] of the rows x, y of P, S = H P Hᵀ + R_VS Σ_g R_VSᵀ; what gyro said is off the innovation.
    # Its vertical part measures nothing of the state, only the noise that it shares with the others.
    Q, g = rotate_symmetric(R, model.static_accel_cov), model.inverse_gravity
    ax, ay, az = ax * g, ay * g, az * g
    share = 1.0 / Q[5] if Q[5] > 0.0 else 0.0
    lx, ly, off = share * Q[2], share * Q[4], add_dot(-1.0, R[6], ax, R[7], ay, R[8], az)
    a, b, _ = P
    x, y = (a[0], a[1], a[2], b[0], b[1], b[2]), (-a[1], -a[3], -a[4], -b[3], -b[4], -b[5])
    horizontal = fma(-lx, Q[2], Q[0] + a[3]), fma(-lx, Q[4], Q[1] - a[1]), fma(-ly, Q[4], Q[3] + a[0])
    P, e = fuse_two(
        P,
        (y, x),
        horizontal,
        add_dot(fma(-lx, off, d[1]), R[0], ax, R[1], ay, R[2], az),
        add_dot(fma(-ly, off, -d[0]), R[3], ax, R[4], ay, R[5], az),
    )
    tx, ty, tz = d[0] + e[0], d[1] + e[1], d[2] + e[2]
    half, cosine, _ = rotation_terms(dot(tx, tx, ty, ty, tz, tz))
    after_R = turn(state.quat_VS, (half * tx, half * ty, half * tz, cosine), load_quat(state.quat_VS))
    bx, by, bz = d[3] + e[3], d[4] + e[4], d[5] + e[5]
    bias[0] += bx
    bias[1] += by
    bias[2] += bz
    a, b, c = P
    after = compute_variance_along(c, up[0], up[1], up[2])
    add_correction(state.about_vertical, tz, dot(up[0], bx, up[1], by, up[2], bz), after)
    return ((a[0], a[1], a[2], a[3], a[4], a[5] + model.static_turn), b, c), after_R


@inlined
def fuse(P, rows, S, innovation):  # type: ignore[no-untyped-def]
    """Correct by three measurements: return P − (H P)ᵀ S⁻¹ (H P) and the error state (6,) (H P)ᵀ S⁻¹ (y − h).

    `rows` are those of H P (3, 6), S is its upper triangle, `innovation` is y − h. A direction in which S is zero
    corrects nothing. The first is taken by itself, the others with what is left of them.
    """
    x, y, z = rows
    inverse = 1.0 / S[0] if S[0] > 0.0 else 0.0
    k, m, e = inverse * S[1], inverse * S[2], innovation[0]
    y, z = less(y, k, x), less(z, m, x)
    rest = fma(-k, S[1], S[3]), fma(-k, S[2], S[4]), fma(-m, S[2], S[5])
    P, error = fuse_two(
        subtract_outer(P, inverse, x), (y, z), rest, fma(-k, e, innovation[1]), fma(-m, e, innovation[2])
    )
    return P, less(error, -inverse * e, x)


@inlined
def fuse_two(P, rows, S, first, second):  # type: ignore[no-untyped-def]
    """Correct by two measurements, as `fuse`: `first` and `second` are their innovations."""
    x, y = rows
    inverse = 1.0 / S[0] if S[0] > 0.0 else 0.0
    k = inverse * S[1]
    var, y = fma(-k, S[1], S[2]), less(y, k, x)
    other = 1.0 / var if var > 0.0 else 0.0
    error = less(less((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), -inverse * first, x), -other * fma(-k, first, second), y)
    return subtract_outer(subtract_outer(P, inverse, x), other, y), error


@inlined
def less(x, b, y):  # type: ignore[no-untyped-def]
    """x − b y of six numbers each."""
    return (
        fma(-b, y[0], x[0]), fma(-b, y[1], x[1]), fma(-b, y[2], x[2]),
        fma(-b, y[3], x[3]), fma(-b, y[4], x[4]), fma(-b, y[5], x[5]),
    )  # fmt: skip


@inlined
def subtract_outer(P, share, row):  # type: ignore[no-untyped-def]
    """P − share row rowᵀ."""
    aa, ab, bb = P
    x, y, z, u, v, w = row
    p, q, r = -share * x, -share * y, -share * z
    s, t = -share * u, -share * v
    return (
        (fma(p, x, aa[0]), fma(p, y, aa[1]), fma(p, z, aa[2]), fma(q, y, aa[3]), fma(q, z, aa[4]), fma(r, z, aa[5])),
        (
            fma(p, u, ab[0]), fma(p, v, ab[1]), fma(p, w, ab[2]),
            fma(q, u, ab[3]), fma(q, v, ab[4]), fma(q, w, ab[5]),
            fma(r, u, ab[6]), fma(r, v, ab[7]), fma(r, w, ab[8]),
        ),
        (
            fma(s, u, bb[0]), fma(s, v, bb[1]), fma(s, w, bb[2]),
            fma(t, v, bb[3]), fma(t, w, bb[4]), fma(-share * w, w, bb[5]),
        ),
    )  # fmt: skip


@inlined
def rotation_terms(square):  # type: ignore[no-untyped-def]
    """sin(θ/2)/θ, cos(θ/2), (θ − sin θ)/θ³ of θ² = `square`; a sample's are power series, to the last bit or two.

    With θ = ‖w‖, exp([w]×) = cos θ I + sin θ/θ [w]× + (1 − cos θ)/θ² w wᵀ. The integral of exp([w]× u) over u from 0 to
    1 has sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³ in their place.
    """
    h = 0.25 * square
    if h < SHORT_SERIES:
        half, cosine = fma(fma(fma(S3, h, S2), h, S1), h, S0), fma(fma(fma(C3, h, C2), h, C1), h, C0)
        return half, cosine, fma(fma(fma(D3, square, D2), square, D1), square, D0)
    half, cosine = half_angle_terms(h)
    return half, cosine, (1.0 - 2.0 * half * cosine) / square


@inlined
def load_quat(quat):  # type: ignore[no-untyped-def]
    return quat[0], quat[1], quat[2], quat[3]


@inlined
def turn(out, a, b):  # type: ignore[no-untyped-def]
    """Fill `out` (4,) with a ⊗ b of two quaternions xyzw, normalised; return its matrix R_VS."""
    x = fma(a[3], b[0], fma(a[0], b[3], fma(a[1], b[2], -a[2] * b[1])))
    y = fma(a[3], b[1], fma(-a[0], b[2], fma(a[1], b[3], a[2] * b[0])))
    z = fma(a[3], b[2], fma(a[0], b[1], fma(-a[1], b[0], a[2] * b[3])))
    w = fma(a[3], b[3], fma(-a[0], b[0], fma(-a[1], b[1], -a[2] * b[2])))
    square = fma(w, w, dot(x, x, y, y, z, z))
    # Of an almost unit quaternion 1/norm is 1 − (square − 1)/2, to 3/8 (square − 1)².
    scale = fma(-0.5, square, 1.5) if abs(square - 1.0) < 1e-8 else 1.0 / np.sqrt(square)
    x, y, z, w = x * scale, y * scale, z * scale, w * scale
    out[0], out[1], out[2], out[3] = x, y, z, w
    x2, y2, z2 = x + x, y + y, z + z
    xy, xz, yz = x * y2, x * z2, y * z2
    return (
        fma(-z, z2, fma(-y, y2, 1.0)), fma(-w, z2, xy), fma(w, y2, xz),
        fma(w, z2, xy), fma(-z, z2, fma(-x, x2, 1.0)), fma(-w, x2, yz),
        fma(-w, y2, xz), fma(w, x2, yz), fma(-y, y2, fma(-x, x2, 1.0)),
    )  # fmt: skip


@inlined
def sum_of_three(one, cross, outer, wx, wy, wz):  # type: ignore[no-untyped-def]
    """The matrix one I + cross [w]× + outer w wᵀ."""
    ox, oy = outer * wx, outer * wy
    xy, xz, yz = ox * wy, ox * wz, oy * wz
    ux, uy, uz = cross * wx, cross * wy, cross * wz
    return (
        fma(ox, wx, one), xy - uz, xz + uy,
        xy + uz, fma(oy, wy, one), yz - ux,
        xz - uy, yz + ux, fma(outer * wz, wz, one),
    )  # fmt: skip


@inlined
def dot(a, x, b, y, c, z):  # type: ignore[no-untyped-def]
    """a x + b y + c z."""
    return fma(a, x, fma(b, y, c * z))


@inlined
def add_dot(more, a, x, b, y, c, z):  # type: ignore[no-untyped-def]
    """more + a x + b y + c z."""
    return fma(a, x, fma(b, y, fma(c, z, more)))


@inlined
def transpose(A):  # type: ignore[no-untyped-def]
    return A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]


@inlined
def multiply(A, X):  # type: ignore[no-untyped-def]
    """A X."""
    return (
        dot(A[0], X[0], A[1], X[3], A[2], X[6]),
        dot(A[0], X[1], A[1], X[4], A[2], X[7]),
        dot(A[0], X[2], A[1], X[5], A[2], X[8]),
        dot(A[3], X[0], A[4], X[3], A[5], X[6]),
        dot(A[3], X[1], A[4], X[4], A[5], X[7]),
        dot(A[3], X[2], A[4], X[5], A[5], X[8]),
        dot(A[6], X[0], A[7], X[3], A[8], X[6]),
        dot(A[6], X[1], A[7], X[4], A[8], X[7]),
        dot(A[6], X[2], A[7], X[5], A[8], X[8]),
    )


@inlined
def rotate_symmetric(A, s):  # type: ignore[no-untyped-def]
    """A S Aᵀ of an upper triangle."""
    a = multiply(A, (s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5]))
    return (
        dot(a[0], A[0], a[1], A[1], a[2], A[2]),
        dot(a[0], A[3], a[1], A[4], a[2], A[5]),
        dot(a[0], A[6], a[1], A[7], a[2], A[8]),
        dot(a[3], A[3], a[4], A[4], a[5], A[5]),
        dot(a[3], A[6], a[4], A[7], a[5], A[8]),
        dot(a[6], A[6], a[7], A[7], a[8], A[8]),
    )


@inlined
def compute_variance_along(P, ux, uy, uz):  # type: ignore[no-untyped-def]
    """Compute uᵀ P u of an upper triangle."""
    x, y, z = dot(P[0], ux, P[1], uy, P[2], uz), dot(P[1], ux, P[3], uy, P[4], uz), dot(P[2], ux, P[4], uy, P[5], uz)
    return dot(x, ux, y, uy, z, uz)


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        step(state, model, gx, gy, gz, accel_S[k, 0], accel_S[k, 1], accel_S[k, 2], static[k])
        store_sample(state, k, out_quat, out_bias, out_cov, out_vertical)
