"""sMEKF: the multiplicative Kalman filter that corrects in static phases alone (Lisini Baldi 2019, Algorithm 1).

One thing differs from the paper, which works to first order. Its transition Φ = I − [ω δt]× lets the standard deviation
grow by √(1 + (ω δt)²) a sample, at 720 deg/s and 100 Hz to 10⁶ deg in 20 s. Its corrections rotate the attitude and not
the covariance, so that static phases seem to measure the heading. Here Φ = exp(−[ω δt]×), and a correction rotates the
covariance too. `PublishedSmekf` is the paper's, to the first order.

The state is x = [a; b]: the attitude error a [rad] on the right of `quat_WS`, in the sensor frame, and the gyroscope
bias b [rad/s]. Measurement model: gyro = ω + b + w_ω, accel/g = R_WSᵀ e_z + w_g. In a static phase ω = 0, so gyro
measures b. Σ_ω and Σ_g are the covariances of the white noises w_ω and w_g, Σ_b that of the bias's random walk, P₀ that
of the state at the first sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..compilation import fma, inlined, kernel
from ..errors import BadOption
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import rotate_by_vector, rotation_terms, up_in_sensor
from .base import (
    RATE_VAR,
    STATIC_TURN_NOISE,
    VERTICAL_COLUMNS,
    FilterRun,
    OneSample,
    add_correction,
    integrate_corrections,
    make_run,
    prepare_samples,
)
from .covariance import fill_symmetric, symmetric
from .noise import SWAY_CORRELATION_S, SensorNoise
from .start import ACCEL_BIAS_STD
from .static import static_step

GYRO_SCALE_STD = 0.002  # of a calibrated MEMS gyroscope, as in `amekf.AmekfParams.gyro_matrix_std`
HEADING_FLOOR = 1e-5  # [rad] keeps P₀ positive definite about the vertical


@dataclass(frozen=True)
class SmekfParams:
    """Covariances of the filter; the defaults are those of the authors' published software.

    Their P₀ gives the heading, which nothing measures, a standard deviation of 1.8 deg; `starting_params` takes P₀ from
    the start phase. Their Σ_b is some 2 Σ_ω, orders of magnitude above the drift of a real bias, so that each static
    phase forgets the ones before and the covariance is too large.

    Over two minutes of simulated motion with static phases (`tests/test_filters.py`) the normalised estimation error
    squared, which is 3 for a right covariance and less for one that is too large, and the rms heading error are: 1.9
    and 0.57 deg with the paper's P₀, Σ_b and first order; 0.5 and 0.10 deg exact and with `starting_params`; 0.7 and
    0.08 deg with the Σ_b of a bias that drifts by 10 deg/h as well. The simulated accelerometer has no bias and the
    gyroscope no wrong scale, which `starting_params` allows for.
    """

    attitude_cov0: float | np.ndarray = 1e-3  # [rad²], a number or (3, 3) in S
    bias_cov0: float | np.ndarray = 1e-3  # [rad²/s²], a number or (3, 3)
    bias_step_cov: np.ndarray | None = None  # (3, 3) Σ_b [rad²/s²]; None: of the static phase's first differences
    static_gyro_cov: np.ndarray | None = None  # (3, 3) [rad²/s²] of static gyro about the bias; None: Σ_ω
    static_accel_cov: np.ndarray | None = None  # (3, 3) of static accel/g about the vertical; None: Σ_g
    static_turn_noise: float = 0.0  # [rad/√s] of undetected rotation about the vertical in a static phase; the paper: 0
    gyro_scale_std: float = 0.0  # of the gyroscope's scale, which no static phase shows; the paper: 0
    gyro_range: float = np.inf  # [rad/s]; a sample at it is used, and the covariance grows by what may be beyond


def starting_params(noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, tilt_std: float) -> SmekfParams:
    """Return the parameters with P₀ of the start phase: the tilt as it is known, the heading exact by definition.

    A person's sway and the accelerometer's bias are correlated from sample to sample, while Σ_ω and Σ_g stand for white
    noise. The covariances of static samples are therefore inflated: many samples of a static phase count as few.

    Parameters
    ----------
    quat_WS : (4,) xyzw, the orientation from which the filter starts
    tilt_std : [rad] one standard deviation of its roll and pitch
    """
    up_S = np.array(up_in_sensor(quat_WS))
    across = np.eye(3) - np.outer(up_S, up_S)
    return SmekfParams(
        attitude_cov0=tilt_std**2 * across + HEADING_FLOOR**2 * np.eye(3),
        bias_cov0=noise.gyro_bias_cov,
        static_gyro_cov=noise.gyro_cov + noise.sway_density(rate_hz) * rate_hz * np.eye(3),
        static_accel_cov=noise.accel_cov + ACCEL_BIAS_STD**2 * SWAY_CORRELATION_S * rate_hz * np.eye(3),
        static_turn_noise=STATIC_TURN_NOISE,
        gyro_scale_std=GYRO_SCALE_STD,
    )


# At a missing sample (NaN, or beyond `recording.limits`) the last rate is held and fades with the time constant HOLD_S,
# no correction is made, and the attitude's standard deviation grows by the motion that may have been missed: after T
# seconds by LOST_RATE_STD T²/(T + HOLD_S), up to π.
HOLD_S = 0.1  # [s] about as long as the rate of an arm keeps its value
LOST_RATE_STD = 2.5  # [rad/s] of an arm in motion (our assumption)

# The state of a sensor is one record, its constants (the model) are another. Upper triangles are xx xy xz yy yz zz.
STATE = np.dtype(
    [
        ("quat_WS", float, 4),  # xyzw
        ("gyro_bias", float, 3),  # [rad/s]
        ("attitude_cov", float, 6),  # [rad²] upper triangle: P_aa, and what the gyroscope's scale adds to the heading
        ("turned", float),  # [rad] net rotation about the vertical since the start
        ("P_aa", float, 6),  # [rad²] upper triangle
        ("P_ab", float, (3, 3)),  # [rad²/s]
        ("P_bb", float, 6),  # [rad²/s²] upper triangle
        ("held_rate", float, 3),  # [rad/s] the last that was measured
        ("lost_s", float),  # [s] since then
        ("about_vertical", float, VERTICAL_COLUMNS),  # as `base.AboutVertical`
    ],
    align=True,
)
MODEL = np.dtype(
    [
        ("dt", float),  # [s]
        ("inverse_gravity", float),  # [s²/m]
        ("attitude_step", float, 6),  # [rad²] δt² Σ_ω
        ("bias_step", float, 6),  # [rad²/s²] δt² Σ_b
        ("static_gyro_cov", float, 6),  # [rad²/s²]
        ("static_accel_cov", float, 6),  # of accel/g
        ("fade", float),  # factor on a held rate at each missing sample
        ("first_order", np.bool_),
        ("static_turn", float),  # [rad²] variance of an undetected turn in a static sample
        ("scale_var", float),  # of the gyroscope's scale
        ("gyro_range", float),  # [rad/s]
    ],
    align=True,
)
_UPPER = np.triu_indices(3)


class SmekfState:
    """Views of the record that the compiled steps work on."""

    def __init__(self, record: np.ndarray) -> None:
        self.record = record  # (1,) of `STATE`
        self.quat_WS = record["quat_WS"][0]  # (4,) xyzw
        self.gyro_bias = record["gyro_bias"][0]  # (3,) [rad/s]

    @property
    def P(self) -> np.ndarray:
        """Covariance (6, 6) of [a; b]; a copy."""
        record = self.record[0]
        aa, bb = symmetric(record["P_aa"]), symmetric(record["P_bb"])
        return np.block([[aa, record["P_ab"]], [record["P_ab"].T, bb]])


class Smekf:
    """sMEKF of one sensor. Σ_ω, Σ_g, Σ_b, the first bias and the size of gravity come from `noise`.

    Missing samples are NaN: the last rate is held and fades, and `attitude_cov` grows by the motion that may have been
    missed (HOLD_S, LOST_RATE_STD). `run` and `update` are those of `base.OrientationFilter`.
    """

    first_order = False  # the paper's transition I − [ω δt]× in place of exp(−[ω δt]×)

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, params: SmekfParams | None = None
    ) -> None:
        self.params = params or SmekfParams()
        self.noise = noise
        self.rate_hz = rate_hz
        self.model = _model(noise, 1.0 / rate_hz, self.params, self.first_order)
        record = np.zeros(1, STATE)
        record["quat_WS"], record["gyro_bias"] = quat_WS, noise.gyro_bias
        record["P_aa"] = record["attitude_cov"] = _matrix(self.params.attitude_cov0)[_UPPER]
        record["P_bb"] = _matrix(self.params.bias_cov0)[_UPPER]
        record["about_vertical"][0, RATE_VAR] = float(np.trace(_matrix(self.params.bias_cov0))) / 3.0
        self.state = SmekfState(record)
        self._one = OneSample()

    @property
    def bank_kernel(self) -> Callable[..., None]:
        """The kernel that steps many sensors at a time (`bank.LiveBank`)."""
        return _step_bank

    def run(
        self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool, out: FilterRun | None = None
    ) -> FilterRun:
        gyro, accel, is_static = prepare_samples(gyro_S, accel_S, static)
        out = out or make_run(len(gyro))
        _run(self.state.record, self.model, gyro, accel, is_static, *out)
        return out

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: bool) -> np.ndarray:
        one = self._one
        sample = one.fill(gyro_S, accel_S, static)
        out = one.quat_WS, one.gyro_bias, one.attitude_cov, one.about_vertical
        _run(self.state.record, self.model, *sample, *out)
        return one.quat_WS[0].copy()


class PublishedSmekf(Smekf):
    """sMEKF as published: transition and corrections of the covariance to the first order.

    `filters.SensorRun` gives it the paper's static test too.
    """

    first_order = True


def _matrix(cov: float | np.ndarray) -> np.ndarray:
    """A covariance (3, 3) that may be given as one variance."""
    array = np.asarray(cov, dtype=float)
    if array.ndim == 0 and 0.0 <= array < np.inf:
        return array * np.eye(3)
    matrix = array if array.ndim == 2 else array * np.eye(3)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix)[0] < -1e-15:
        raise BadOption(f"covariance {cov!r}: a variance from 0 on is needed, or a positive semidefinite (3, 3)")
    return matrix


def _model(noise: SensorNoise, dt: float, params: SmekfParams, first_order: bool) -> np.ndarray:
    """Return the constants of a sensor's filter, (1,) of `MODEL`."""

    def upper(cov: np.ndarray | None, default: np.ndarray) -> np.ndarray:
        return (default if cov is None else _matrix(cov))[_UPPER]

    model = np.zeros(1, MODEL)
    model["dt"], model["inverse_gravity"] = dt, 1.0 / noise.gravity
    model["attitude_step"] = (dt * dt * noise.gyro_cov)[_UPPER]
    model["bias_step"] = dt * dt * upper(params.bias_step_cov, noise.bias_step_cov)
    model["static_gyro_cov"] = upper(params.static_gyro_cov, noise.gyro_cov)
    model["static_accel_cov"] = upper(params.static_accel_cov, noise.accel_cov)
    model["fade"], model["first_order"] = np.exp(-dt / HOLD_S), first_order
    model["static_turn"], model["gyro_range"] = params.static_turn_noise**2 * dt, params.gyro_range
    model["scale_var"] = params.gyro_scale_std**2
    return model


@inlined
def step(state, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """Take one sample of one sensor: records of `STATE` and `MODEL`, gyro [rad/s], accel [m/s²]."""
    dt, bias, held = model.dt, state.gyro_bias, state.held_rate
    integrate_corrections(state.about_vertical, dt)
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
    P = predict(state, model, wx * dt, wy * dt, wz * dt, lost_var)
    if static and is_measured and ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        P = correct(state, model, P, gx, gy, gz, ax, ay, az)
    store_covariance(state, P)
    update_attitude_cov(state, model, P, wx * dt, wy * dt, wz * dt)


@inlined
def update_attitude_cov(state, model, P, wx, wy, wz):  # type: ignore[no-untyped-def]
    """Set the stated attitude covariance after the rotation w [rad]: P_aa and the error of the gyroscope's scale.

    A scale that is wrong by s gives the heading an error of s times the rotation about the vertical. It gives the tilt
    an error too, which static phases correct. The scale is no part of the filter's state, as in the paper.
    """
    ux, uy, uz = up_in_sensor(state.quat_WS)
    state.turned += wx * ux + wy * uy + wz * uz
    heading_var = model.scale_var * state.turned * state.turned
    P_aa, _, P_bb = P
    cov = add_along(P_aa, heading_var, ux, uy, uz)
    for i in range(6):
        state.attitude_cov[i] = cov[i]
    state.about_vertical[RATE_VAR] = compute_variance_along(P_bb, ux, uy, uz)


# The covariance P is the tuple (P_aa, P_ab, P_bb) below: upper triangles of six numbers, and nine numbers, rows first.
# Numbers stay in registers, the entries of an array would not.


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
    """Algorithm 1, prediction by the turn w = (gyro − b) δt: q ← q ⊗ exp(w); return F P Fᵀ + G Q Gᵀ.

    G Q Gᵀ = δt² diag(Σ_ω, Σ_b). `lost_var` [rad²] is added on top.
    """
    rotate_by_vector(state.quat_WS, wx, wy, wz)
    A, B = transition(wx, wy, wz, model.dt, model.first_order)
    aa, ab, bb = propagate(load_covariance(state), A, B)
    p, q = model.attitude_step, model.bias_step
    aa = (
        aa[0] + p[0] + lost_var, aa[1] + p[1], aa[2] + p[2],
        aa[3] + p[3] + lost_var, aa[4] + p[4], aa[5] + p[5] + lost_var,
    )  # fmt: skip
    return aa, ab, (bb[0] + q[0], bb[1] + q[1], bb[2] + q[2], bb[3] + q[3], bb[4] + q[4], bb[5] + q[5])


@inlined
def dot(a, x, b, y, c, z):  # type: ignore[no-untyped-def]
    """a x + b y + c z."""
    return fma(a, x, fma(b, y, c * z))


@inlined
def add_dot(more, a, x, b, y, c, z):  # type: ignore[no-untyped-def]
    """more + a x + b y + c z."""
    return fma(a, x, fma(b, y, fma(c, z, more)))


@inlined
def transition(wx, wy, wz, dt, first_order):  # type: ignore[no-untyped-def]
    """A and B of F = [[A, B], [0, I]] over the turn w [rad] in δt [s].

    A = exp(−[w]×) and B = −δt ∫₀¹ exp(−[w]× u) du; to first order, as the paper writes it, A = I − [w]×, B = −δt I.
    """
    cosine, s, c, d = 1.0, 1.0, 0.0, 0.0
    e = 1.0  # B's share of I, s where A's is cos θ
    if not first_order:
        cosine, s, c, d = rotation_terms(wx * wx + wy * wy + wz * wz)
        e = s
    # A = cos θ I − s [w]× + c w wᵀ,  B = −δt (s I − c [w]× + d w wᵀ)
    return sum_of_three(cosine, -s, c, wx, wy, wz), sum_of_three(-dt * e, dt * c, -dt * d, wx, wy, wz)


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
def propagate(P, A, B):  # type: ignore[no-untyped-def]
    """F P Fᵀ of F = [[A, B], [0, I]]."""
    aa, ab, bb = P
    b = times_symmetric(A, B, ab, bb)  # A P_ab + B P_bb
    ba = ab[0], ab[3], ab[6], ab[1], ab[4], ab[7], ab[2], ab[5], ab[8]
    a = times_symmetric(B, A, ba, aa)  # A P_aa + B P_ba
    return (
        (
            add_dot(dot(a[0], A[0], a[1], A[1], a[2], A[2]), b[0], B[0], b[1], B[1], b[2], B[2]),
            add_dot(dot(a[0], A[3], a[1], A[4], a[2], A[5]), b[0], B[3], b[1], B[4], b[2], B[5]),
            add_dot(dot(a[0], A[6], a[1], A[7], a[2], A[8]), b[0], B[6], b[1], B[7], b[2], B[8]),
            add_dot(dot(a[3], A[3], a[4], A[4], a[5], A[5]), b[3], B[3], b[4], B[4], b[5], B[5]),
            add_dot(dot(a[3], A[6], a[4], A[7], a[5], A[8]), b[3], B[6], b[4], B[7], b[5], B[8]),
            add_dot(dot(a[6], A[6], a[7], A[7], a[8], A[8]), b[6], B[6], b[7], B[7], b[8], B[8]),
        ),
        b,
        bb,
    )


@inlined
def times_symmetric(A, B, X, S):  # type: ignore[no-untyped-def]
    """A X + B S of matrices and an upper triangle S."""
    return (
        add_dot(dot(B[0], S[0], B[1], S[1], B[2], S[2]), A[0], X[0], A[1], X[3], A[2], X[6]),
        add_dot(dot(B[0], S[1], B[1], S[3], B[2], S[4]), A[0], X[1], A[1], X[4], A[2], X[7]),
        add_dot(dot(B[0], S[2], B[1], S[4], B[2], S[5]), A[0], X[2], A[1], X[5], A[2], X[8]),
        add_dot(dot(B[3], S[0], B[4], S[1], B[5], S[2]), A[3], X[0], A[4], X[3], A[5], X[6]),
        add_dot(dot(B[3], S[1], B[4], S[3], B[5], S[4]), A[3], X[1], A[4], X[4], A[5], X[7]),
        add_dot(dot(B[3], S[2], B[4], S[4], B[5], S[5]), A[3], X[2], A[4], X[5], A[5], X[8]),
        add_dot(dot(B[6], S[0], B[7], S[1], B[8], S[2]), A[6], X[0], A[7], X[3], A[8], X[6]),
        add_dot(dot(B[6], S[1], B[7], S[3], B[8], S[4]), A[6], X[1], A[7], X[4], A[8], X[7]),
        add_dot(dot(B[6], S[2], B[7], S[4], B[8], S[5]), A[6], X[2], A[7], X[5], A[8], X[8]),
    )


@inlined
def rotate_covariance(P, A):  # type: ignore[no-untyped-def]
    """F P Fᵀ of F = [[A, 0], [0, I]]."""
    s, x, bb = P
    a = (
        dot(A[0], s[0], A[1], s[1], A[2], s[2]),
        dot(A[0], s[1], A[1], s[3], A[2], s[4]),
        dot(A[0], s[2], A[1], s[4], A[2], s[5]),
        dot(A[3], s[0], A[4], s[1], A[5], s[2]),
        dot(A[3], s[1], A[4], s[3], A[5], s[4]),
        dot(A[3], s[2], A[4], s[4], A[5], s[5]),
        dot(A[6], s[0], A[7], s[1], A[8], s[2]),
        dot(A[6], s[1], A[7], s[3], A[8], s[4]),
        dot(A[6], s[2], A[7], s[4], A[8], s[5]),
    )
    return (
        (
            dot(a[0], A[0], a[1], A[1], a[2], A[2]),
            dot(a[0], A[3], a[1], A[4], a[2], A[5]),
            dot(a[0], A[6], a[1], A[7], a[2], A[8]),
            dot(a[3], A[3], a[4], A[4], a[5], A[5]),
            dot(a[3], A[6], a[4], A[7], a[5], A[8]),
            dot(a[6], A[6], a[7], A[7], a[8], A[8]),
        ),
        (
            dot(A[0], x[0], A[1], x[3], A[2], x[6]),
            dot(A[0], x[1], A[1], x[4], A[2], x[7]),
            dot(A[0], x[2], A[1], x[5], A[2], x[8]),
            dot(A[3], x[0], A[4], x[3], A[5], x[6]),
            dot(A[3], x[1], A[4], x[4], A[5], x[7]),
            dot(A[3], x[2], A[4], x[5], A[5], x[8]),
            dot(A[6], x[0], A[7], x[3], A[8], x[6]),
            dot(A[6], x[1], A[7], x[4], A[8], x[7]),
            dot(A[6], x[2], A[7], x[5], A[8], x[8]),
        ),
        bb,
    )


@inlined
def correct(state, model, P, gx, gy, gz, ax, ay, az):  # type: ignore[no-untyped-def]
    """Algorithm 1, correction in a static phase; return P after it.

    y = [accel/g; gyro], h = [R_WSᵀ e_z; b̂], H = [[[R_WSᵀ e_z]×, 0], [0, I]].

    The noises of the two are independent, so gyro is taken first and accel after it, which is the same correction with
    two S of (3, 3) in place of one of (6, 6).
    """
    bias = state.gyro_bias
    ux, uy, uz = up_in_sensor(state.quat_WS)
    # gyro: H P = [P_ba, P_bb], S = P_bb + Σ_ω
    R = model.static_gyro_cov
    _, b, c = P
    before = compute_variance_along(c, ux, uy, uz)
    S = c[0] + R[0], c[1] + R[1], c[2] + R[2], c[3] + R[3], c[4] + R[4], c[5] + R[5]
    rows = (
        (b[0], b[3], b[6], c[0], c[1], c[2]),
        (b[1], b[4], b[7], c[1], c[3], c[4]),
        (b[2], b[5], b[8], c[2], c[4], c[5]),
    )
    P, d = fuse(P, rows, S, (gx - bias[0], gy - bias[1], gz - bias[2]))
    # accel: H P = [u]× [P_aa, P_ab], S = [u]× P_aa [u]×ᵀ + Σ_g; what gyro said of the attitude is off the innovation
    R = model.static_accel_cov
    g = model.inverse_gravity
    innovation = (
        fma(ax, g, -ux) - (uy * d[2] - uz * d[1]),
        fma(ay, g, -uy) - (uz * d[0] - ux * d[2]),
        fma(az, g, -uz) - (ux * d[1] - uy * d[0]),
    )
    a, b, _ = P
    x, y = (a[0], a[1], a[2], b[0], b[1], b[2]), (a[1], a[3], a[4], b[3], b[4], b[5])
    z = a[2], a[4], a[5], b[6], b[7], b[8]
    row0, row1, row2 = difference(uy, z, uz, y), difference(uz, x, ux, z), difference(ux, y, uy, x)
    S = (
        fma(row0[2], uy, fma(-row0[1], uz, R[0])),
        fma(row0[0], uz, fma(-row0[2], ux, R[1])),
        fma(row0[1], ux, fma(-row0[0], uy, R[2])),
        fma(row1[0], uz, fma(-row1[2], ux, R[3])),
        fma(row1[1], ux, fma(-row1[0], uy, R[4])),
        fma(row2[1], ux, fma(-row2[0], uy, R[5])),
    )
    P, e = fuse(P, (row0, row1, row2), S, innovation)
    tx, ty, tz = d[0] + e[0], d[1] + e[1], d[2] + e[2]
    rotate_by_vector(state.quat_WS, tx, ty, tz)
    if not model.first_order:
        # The direction of the vertical in S changes with the correction. The long axis of P, the heading, has to follow
        # it: otherwise it would have a horizontal part, which the next sample of accel would correct.
        A, _ = transition(tx, ty, tz, 0.0, False)
        P = rotate_covariance(P, A)
    bx, by, bz = d[3] + e[3], d[4] + e[4], d[5] + e[5]
    bias[0] += bx
    bias[1] += by
    bias[2] += bz
    aa, ab, bb = P
    after = compute_variance_along(bb, ux, uy, uz)
    add_correction(state.about_vertical, ux * tx + uy * ty + uz * tz, ux * bx + uy * by + uz * bz, before, after)
    return add_along(aa, model.static_turn, ux, uy, uz), ab, bb


@inlined
def add_along(P, variance, ux, uy, uz):  # type: ignore[no-untyped-def]
    """P + variance u uᵀ of an upper triangle."""
    x, y, z = variance * ux, variance * uy, variance * uz
    return fma(x, ux, P[0]), fma(x, uy, P[1]), fma(x, uz, P[2]), fma(y, uy, P[3]), fma(y, uz, P[4]), fma(z, uz, P[5])


@inlined
def compute_variance_along(P, ux, uy, uz):  # type: ignore[no-untyped-def]
    """Compute uᵀ P u of an upper triangle."""
    x, y, z = dot(P[0], ux, P[1], uy, P[2], uz), dot(P[1], ux, P[3], uy, P[4], uz), dot(P[2], ux, P[4], uy, P[5], uz)
    return dot(x, ux, y, uy, z, uz)


@inlined
def difference(a, x, b, y):  # type: ignore[no-untyped-def]
    """a x − b y of six numbers each."""
    return (
        fma(a, x[0], -b * y[0]), fma(a, x[1], -b * y[1]), fma(a, x[2], -b * y[2]),
        fma(a, x[3], -b * y[3]), fma(a, x[4], -b * y[4]), fma(a, x[5], -b * y[5]),
    )  # fmt: skip


@inlined
def less(x, b, y):  # type: ignore[no-untyped-def]
    """x − b y of six numbers each."""
    return (
        fma(-b, y[0], x[0]), fma(-b, y[1], x[1]), fma(-b, y[2], x[2]),
        fma(-b, y[3], x[3]), fma(-b, y[4], x[4]), fma(-b, y[5], x[5]),
    )  # fmt: skip


@inlined
def fuse(P, rows, S, innovation):  # type: ignore[no-untyped-def]
    """Correct by three measurements: return P − (H P)ᵀ S⁻¹ (H P) and the error state (6,) (H P)ᵀ S⁻¹ (y − h).

    With S = L D Lᵀ and V = L⁻¹ H P these are P − Vᵀ D⁻¹ V and Vᵀ D⁻¹ L⁻¹ (y − h). `rows` are those of H P (3, 6), S is
    its upper triangle, `innovation` is y − h. A direction in which S is zero corrects nothing.
    """
    # D = (p0, p1/p0, p2/(p0 p1)) of the minors p, so that no division waits for another.
    p0 = S[0] if S[0] > 0.0 else 1.0
    minor, across = fma(p0, S[3], -S[1] * S[1]), fma(p0, S[4], -S[1] * S[2])
    p1 = minor if minor > 0.0 else 1.0
    p2 = fma(fma(p0, S[5], -S[2] * S[2]), p1, -across * across)
    r0, r1 = 1.0 / p0, 1.0 / p1
    i0, i1 = r0 if S[0] > 0.0 else 0.0, p0 * r1 if minor > 0.0 else 0.0
    i2 = p0 * p1 / p2 if p2 > 0.0 else 0.0
    l10, l20, l21 = S[1] * r0, S[2] * r0, across * r1
    e0 = innovation[0]
    e1 = fma(-l10, e0, innovation[1])
    e2 = fma(-l20, e0, fma(-l21, e1, innovation[2]))
    a = rows[0]
    b = less(rows[1], l10, a)
    c = less(less(rows[2], l20, a), l21, b)
    aa, ab, bb = P

    p, q, r = -i0 * a[0], -i1 * b[0], -i2 * c[0]
    aa0, aa1 = add_dot(aa[0], p, a[0], q, b[0], r, c[0]), add_dot(aa[1], p, a[1], q, b[1], r, c[1])
    aa2 = add_dot(aa[2], p, a[2], q, b[2], r, c[2])
    ab0, ab1 = add_dot(ab[0], p, a[3], q, b[3], r, c[3]), add_dot(ab[1], p, a[4], q, b[4], r, c[4])
    ab2 = add_dot(ab[2], p, a[5], q, b[5], r, c[5])
    g0 = -dot(p, e0, q, e1, r, e2)
    p, q, r = -i0 * a[1], -i1 * b[1], -i2 * c[1]
    aa3, aa4 = add_dot(aa[3], p, a[1], q, b[1], r, c[1]), add_dot(aa[4], p, a[2], q, b[2], r, c[2])
    ab3, ab4 = add_dot(ab[3], p, a[3], q, b[3], r, c[3]), add_dot(ab[4], p, a[4], q, b[4], r, c[4])
    ab5 = add_dot(ab[5], p, a[5], q, b[5], r, c[5])
    g1 = -dot(p, e0, q, e1, r, e2)
    p, q, r = -i0 * a[2], -i1 * b[2], -i2 * c[2]
    aa5 = add_dot(aa[5], p, a[2], q, b[2], r, c[2])
    ab6, ab7 = add_dot(ab[6], p, a[3], q, b[3], r, c[3]), add_dot(ab[7], p, a[4], q, b[4], r, c[4])
    ab8 = add_dot(ab[8], p, a[5], q, b[5], r, c[5])
    g2 = -dot(p, e0, q, e1, r, e2)
    p, q, r = -i0 * a[3], -i1 * b[3], -i2 * c[3]
    bb0, bb1 = add_dot(bb[0], p, a[3], q, b[3], r, c[3]), add_dot(bb[1], p, a[4], q, b[4], r, c[4])
    bb2 = add_dot(bb[2], p, a[5], q, b[5], r, c[5])
    g3 = -dot(p, e0, q, e1, r, e2)
    p, q, r = -i0 * a[4], -i1 * b[4], -i2 * c[4]
    bb3, bb4 = add_dot(bb[3], p, a[4], q, b[4], r, c[4]), add_dot(bb[4], p, a[5], q, b[5], r, c[5])
    g4 = -dot(p, e0, q, e1, r, e2)
    p, q, r = -i0 * a[5], -i1 * b[5], -i2 * c[5]
    bb5 = add_dot(bb[5], p, a[5], q, b[5], r, c[5])
    g5 = -dot(p, e0, q, e1, r, e2)
    P = (
        (aa0, aa1, aa2, aa3, aa4, aa5),
        (ab0, ab1, ab2, ab3, ab4, ab5, ab6, ab7, ab8),
        (bb0, bb1, bb2, bb3, bb4, bb5),
    )
    return P, (g0, g1, g2, g3, g4, g5)


@kernel
def _run(states, models, gyro_S, accel_S, static, out_quat, out_bias, out_cov, out_vertical):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        step(state, model, gx, gy, gz, accel_S[k, 0], accel_S[k, 1], accel_S[k, 2], static[k])
        for i in range(4):
            out_quat[k, i] = state.quat_WS[i]
        for i in range(VERTICAL_COLUMNS):
            out_vertical[k, i] = state.about_vertical[i]
        for i in range(3):
            out_bias[k, i] = state.gyro_bias[i]
        fill_symmetric(state.attitude_cov, out_cov[k])


@kernel
def _step_bank(states, models, detectors, block, tail, gyro_S, accel_S, static):  # type: ignore[no-untyped-def]
    """One sample of each of k sensors, detector and filter; arrays with a row a sensor, as `bank.LiveBank` has them."""
    for i in range(len(states)):
        gx, gy, gz = gyro_S[i, 0], gyro_S[i, 1], gyro_S[i, 2]
        ax, ay, az = accel_S[i, 0], accel_S[i, 1], accel_S[i, 2]
        static[i] = static_step(detectors[i], block[i], tail[i], gx, gy, gz, ax, ay, az)
        step(states[i], models[i], gx, gy, gz, ax, ay, az, static[i])
