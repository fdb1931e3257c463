"""aMEKF: the multiplicative Kalman filter corrected in motion too, by the bound on where a hand can go; causal.

No single acceleration is trusted. The specific force, turned into the almost-inertial frame of the gyroscope, is summed
to a horizontal velocity and position; a tilt error of a degree would send them off by 8 m in 10 s, and a person's
segment does not go there. That is the idea of VQF's low-pass in that frame (Laidig and Seel 2023, Information Fusion
91) as a Kalman filter, so that the same innovations also teach it the gyroscope's own errors: bias, scale and
misalignment (the usual 3×3), and the difference between the bias in motion and in a static phase. Rotation about
horizontal axes makes these visible through gravity, and the heading, which nothing measures, is better for it.

The 25 error states (`ErrorStates`) are additive but for the attitude, which is on the left (in W), so that one over a
turn stays what it is. Measured rate = (I + M) true rate + bias. Errors of velocity and position are those of the
invariant filter (Barrau and Bonnabel 2017, IEEE TAC 62(4)): θ × g e_z alone drives them, so that the bound on them
never says anything of the heading.

The strapdown runs at each sample, the covariance once a block (`AmekfParams.block_s`): over a block the transition is
exact in the sums of R_WS and R_WS ω, which is why 25 states cost less than six at each sample. In a static block (the
paper's static phase, Lisini Baldi 2019) velocity is zero and the gyroscope reads its bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..arguments import check_fields
from ..compilation import inlined, kernel
from ..errors import BadOption
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import fill_matrix, rotate_by_world_vector, rotate_unit_by_rate
from .base import STATIC_TURN_NOISE, FilterRun, OneSample, prepare_samples
from .covariance import fill_symmetric, into_sensor
from .noise import SensorNoise
from .static import static_step


class ErrorStates(NamedTuple):
    """Where each error stands among the 25."""

    attitude: slice = slice(0, 3)  # θ [rad], in W
    velocity: slice = slice(3, 5)  # [m/s], horizontal, in W
    position: slice = slice(5, 7)  # [m], horizontal, in W
    gyro_bias: slice = slice(7, 10)  # [rad/s], in S, in a static phase
    gyro_matrix: slice = slice(10, 19)  # M, rows first
    accel_bias: slice = slice(19, 22)  # [m/s²], in S
    motion_bias: slice = slice(22, 25)  # [rad/s], in S: the gyroscope's bias in motion less that in a static phase


ERROR = ErrorStates()
STATES = 25
PROPAGATED = 7  # θ, velocity and position change over a block, the other states stay
SMOOTHED = (0, 1, 2, 7, 8, 9, 22, 23, 24)  # the states that the smoother corrects: θ, bias, bias in motion
MEASUREMENTS = 5  # of a static block: velocity (2) and bias (3); of another: velocity (2) and position (2)
VELOCITY, POSITION, GYRO_BIAS = ERROR.velocity.start, ERROR.position.start, ERROR.gyro_bias.start

FADE_S = 0.1  # [s] in which a held rate fades
LARGEST_LOST_TURN = 4.0  # [rad] of unknown turn are as good as any more
# Squared Mahalanobis distance beyond which an innovation of two, of three axes is doubted: as rare as 3 σ of one.
DOUBTED_2, DOUBTED_3 = 11.83, 14.16

# What the compiled steps work on are records: one number or array a name.
TRANSITION = [
    ("R", float, (3, 3)),  # Σ R_WS dt [s]
    ("R_rate", float, (3, 3, 3)),  # Σ R_WS ω_c dt [rad], for the axes c = x, y, z of S
    ("R_moving", float, (3, 3)),  # Σ R_WS dt [s] over the samples that are not static
]
SUMS = np.dtype(
    [
        *TRANSITION,  # before dt is applied
        ("gyro", float, 3),  # [rad/s]
        ("rate_squared", float),  # [rad²/s²]
        ("acceleration", float),  # [m/s²]
        ("impact", float),  # [m/s²] of it, beyond the limit
        ("static", float),  # samples
        ("lost_turn", float),  # [rad²], variance
        ("lost_force", float),  # [s]
    ],
    align=True,
)
# A block's transition and corrections. The smoother keeps one of each block and goes through them backward.
BLOCK = np.dtype(
    [
        *TRANSITION,
        ("length", float),  # [s]
        ("lost_turn", float),  # [rad²], variance of the turn that was lost in it
        ("measurements", np.int64),  # their number n; of each:
        ("state", np.int64, MEASUREMENTS),  # the index of the state that it measures
        ("root", float, MEASUREMENTS),  # 1/√s, s the innovation's variance
        ("innovation", float, MEASUREMENTS),  # over √s
        ("gain", float, (MEASUREMENTS, STATES)),  # P h/√s
        ("correction", float, STATES),  # of the states
        ("P_rows", float, (len(SMOOTHED), STATES)),  # rows `SMOOTHED` of P after it
    ],
    align=True,
)
# The state of a sensor is one record, so that a run may be cut anywhere and a bank of sensors stacks them.
STATE = np.dtype(
    [
        ("quat_WS", float, 4),  # xyzw
        ("gyro_bias", float, 3),  # [rad/s] as stated: that in motion where the sample is not static
        ("attitude_cov", float, 6),  # [rad²] upper triangle, in S
        ("x", float, STATES),  # the attitude's error stays zero
        ("P", float, (STATES, STATES)),
        ("sums", SUMS),
        ("held_rate", float, 3),  # [rad/s] the last good one, without bias
        ("held_s", float),  # [s] since then
        ("samples", np.int64),  # in the open block
        # room for intermediate values, nothing that lasts
        ("R_WS", float, (3, 3)),
        ("P_rows", float, (PROPAGATED, STATES)),
        ("P_columns", float, (STATES, PROPAGATED)),
        ("P_corner", float, (PROPAGATED, PROPAGATED)),
        ("block", BLOCK),
    ],
    align=True,
)
MODEL = np.dtype(
    [
        ("dt", float),  # [s]
        ("block", np.int64),  # samples
        ("gravity", float),  # [m/s²]
        ("gyro_noise", float),  # [rad²/s]
        ("accel_noise", float),  # [m/s²]² s
        ("speed", float),  # [m²/s²] variance of a block, as the next two
        ("position", float),  # [m²]
        ("static_speed", float),  # [m²/s²]
        ("static_bias", float),  # [rad²/s²] by which gyro over a static block is not the bias
        ("static_turn", float),  # [rad²/s] heading that a static sensor may turn unseen
        ("rate_noise", float),
        ("force_noise", float),
        ("bias_walk", float),  # [rad²/s³]
        ("matrix_walk", float),  # [1/s]
        ("accel_bias_walk", float),
        ("motion_bias_walk", float),
        ("lost_rate", float),  # [rad/s] standard deviation
        ("lost_force", float),  # [m²/s⁴]
        ("gyro_limit", float),  # [rad/s]
        ("accel_limit", float),  # [m/s²]
        ("impact", float),  # [m/s²]
        ("accel_matrix", float, (3, 3)),  # measured to true
    ],
    align=True,
)
_NO_BLOCKS = np.empty(0, BLOCK)


@dataclass(frozen=True)
class AmekfParams:
    """How wrong a MEMS sensor and how bounded a person's motion is; standard deviations, the same for all recordings.

    The gyroscope's and the accelerometer's known errors (`gyro_matrix`, `accel_matrix`, `accel_bias`, of a calibration)
    are taken off; `gyro_matrix_std` and `accel_bias_std` say how well they are known.
    """

    block_s: float = 0.25  # [s] between corrections; the covariance is propagated over it in one step
    speed_std: float = 1.0  # [m/s] of the sensor, horizontal, each axis, new each `motion_s`
    position_std: float = 1.5  # [m] around where it mostly is, horizontal, each axis, new each `motion_s`
    motion_s: float = 1.0  # [s]
    static_speed_std: float = 0.01  # [m/s] in a static phase
    rate_noise: float = 3e-4  # [1/√Hz] of gyro in motion, a share of |ω|: what the matrix does not explain
    force_noise: float = 0.01  # share of the summed |acceleration| by which a block's velocity change is off
    impact: float = 100.0  # [m/s²] acceleration beyond which is an impact: velocity is off by as much as that adds
    tilt_std: float = 0.2  # [rad] at the start, which may be in motion; a first rest soon says more
    gyro_matrix_std: float = 0.002  # each entry of M
    gyro_matrix_walk: float = 1e-6  # [1/√s]
    gyro_bias_walk: float = 5e-6  # [rad/s/√s], 10 deg/h in 100 s
    static_bias_std: float = 1e-4  # [rad/s] by which the mean of gyro over a static block is not the bias, sway aside
    static_turn_noise: float = STATIC_TURN_NOISE  # [rad/√s]
    motion_bias_std: float = 1.7e-4  # [rad/s], 0.01 deg/s, bias in motion less that in a static phase
    motion_bias_walk: float = 5e-5  # [rad/s/√s]
    accel_bias_std: float = 0.03  # [m/s²], 3 mg
    accel_bias_walk: float = 1e-4  # [m/s²/√s]
    gyro_range: float = np.inf  # [rad/s]; a sample at it is clipped: turned by it, but the turn is uncertain
    accel_range: float = np.inf  # [m/s²]
    lost_rate_std: float = 2.0  # [rad/s] of the unknown rate while gyro is lost (NaN) or clipped
    lost_force_std: float = 5.0  # [m/s²] of the unknown acceleration while accel is lost or clipped
    gyro_matrix: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))  # M: measured = (I + M) true
    accel_matrix: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))  # measured = (I + this) true + bias
    accel_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [m/s²]

    def __post_init__(self) -> None:
        check_fields(self, "")
        for name, value in vars(self).items():
            if name in ("gyro_matrix", "accel_matrix", "accel_bias"):
                shape = (3,) if name == "accel_bias" else (3, 3)
                if np.shape(value) != shape or not np.isfinite(value).all():
                    raise BadOption(f"{name} must be finite numbers of shape {shape}")
            elif not value >= 0.0 or (value == 0.0 and name in ("block_s", "speed_std", "position_std", "motion_s")):
                raise BadOption(f"{name} = {value}: a number above 0 is needed (0 switches off what is no bound)")


class AmekfState:
    """Views of the record that the compiled steps work on."""

    def __init__(self, record: np.ndarray) -> None:
        self.record = record  # (1,) of `STATE`
        self.quat_WS = record["quat_WS"][0]  # (4,) xyzw
        self.gyro_bias = record["gyro_bias"][0]  # (3,) [rad/s]
        self.x = record["x"][0]  # (25,) as `ErrorStates`
        self.P = record["P"][0]  # (25, 25)


class Amekf:
    """aMEKF of one sensor. First bias, its covariance, noise and gravity come from `noise`.

    What bad data does: a NaN sample of gyro holds the last rate, which fades in 0.1 s, and the attitude's covariance
    grows with the time squared; a NaN sample of accel counts as gravity alone, and the velocity's covariance grows; a
    sample beyond the ranges in `params` does the same, but is used. The velocity that an impact (`AmekfParams.impact`)
    adds is not trusted. A bias that jumps is taken over in the next static phase at once; until then it tilts by some
    degrees. Without any static phase all is learned in motion, the tilt in ten seconds, the others in a minute or so.
    Time is not an input: gaps, repeated and late samples are the readers' to mend.
    """

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, params: AmekfParams | None = None
    ) -> None:
        self.params = params or AmekfParams()
        self.rate_hz = rate_hz
        self.noise = noise
        self.block = max(1, round(self.params.block_s * rate_hz))
        self.model = _model(noise, rate_hz, self.block, self.params)
        self.state = AmekfState(np.zeros(1, STATE))
        self.state.quat_WS[:], self.state.gyro_bias[:] = quat_WS, noise.gyro_bias
        self._set_errors()
        self._one = OneSample()

    def _set_errors(self) -> None:
        p, x, std = self.params, self.state.x, np.zeros(STATES)
        x[ERROR.gyro_bias], x[ERROR.gyro_matrix] = self.noise.gyro_bias, p.gyro_matrix.ravel()
        x[ERROR.accel_bias] = p.accel_bias
        std[ERROR.attitude] = p.tilt_std, p.tilt_std, 1e-5  # the heading of the start is zero by definition
        std[ERROR.velocity], std[ERROR.position] = p.speed_std, p.position_std
        std[ERROR.gyro_matrix], std[ERROR.accel_bias] = p.gyro_matrix_std, p.accel_bias_std
        std[ERROR.motion_bias] = p.motion_bias_std
        np.fill_diagonal(self.state.P, std**2)
        self.state.P[ERROR.gyro_bias, ERROR.gyro_bias] = self.noise.gyro_bias_cov

    @property
    def live(self) -> Callable[..., None]:
        """The kernel that steps many sensors at a time (`bank.LiveBank`)."""
        return _live

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool) -> FilterRun:
        return self.run_recorded(gyro_S, accel_S, static, _NO_BLOCKS)

    def run_recorded(
        self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool, blocks: np.ndarray
    ) -> FilterRun:
        """`run` that also fills one of `blocks`, an array of `BLOCK`, at the end of each block."""
        gyro, accel, is_static = prepare_samples(gyro_S, accel_S, static)
        out = np.empty((len(gyro), 4)), np.empty((len(gyro), 3)), np.empty((len(gyro), 3, 3))
        _run(self.state.record, self.model, gyro, accel, is_static, blocks, *out)
        return FilterRun(*out)

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: bool) -> np.ndarray:
        one = self._one
        sample = one.fill(gyro_S, accel_S, static)
        _run(self.state.record, self.model, *sample, _NO_BLOCKS, one.quat_WS, one.gyro_bias, one.attitude_cov)
        return one.quat_WS[0].copy()


def _model(noise: SensorNoise, rate_hz: float, block: int, p: AmekfParams) -> np.ndarray:
    """(1,) of `MODEL`."""
    length = block / rate_hz
    # By how much the mean of gyro over a static block is off: a person who stands still sways.
    white, sway = float(np.trace(noise.gyro_cov)) / 3.0 / block, noise.sway_density(rate_hz)
    model = np.zeros(1, MODEL)
    values = {
        "dt": 1.0 / rate_hz,
        "block": block,
        "gravity": noise.gravity,
        "gyro_noise": float(np.trace(noise.gyro_cov)) / 3.0 / rate_hz,
        "accel_noise": float(np.trace(noise.accel_cov)) / 3.0 * noise.gravity**2 / rate_hz,
        "speed": p.speed_std**2 * p.motion_s / length,
        "position": p.position_std**2 * p.motion_s / length,
        "static_speed": p.static_speed_std**2,
        "static_bias": p.static_bias_std**2 + white + sway / length,
        # Who sways may turn slowly as well: an eighth of what the sway adds up to (our assumption).
        "static_turn": p.static_turn_noise**2 + sway / 8.0,
        "rate_noise": p.rate_noise**2,
        "force_noise": p.force_noise**2,
        "bias_walk": p.gyro_bias_walk**2,
        "matrix_walk": p.gyro_matrix_walk**2,
        "accel_bias_walk": p.accel_bias_walk**2,
        "motion_bias_walk": p.motion_bias_walk**2,
        "lost_rate": p.lost_rate_std,
        "lost_force": p.lost_force_std**2,
        "gyro_limit": p.gyro_range,
        "accel_limit": p.accel_range,
        "impact": p.impact,
        "accel_matrix": np.linalg.inv(np.eye(3) + p.accel_matrix),
    }
    for name, value in values.items():
        model[name] = value
    return model


@kernel
def transition_rows(block, gravity, P, out):  # type: ignore[no-untyped-def]
    """Rows of ``F P`` that differ from P's, those of θ, velocity and position, to `out` (7, m); `P` is (25, m).

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
    """P ← F P Fᵀ + Q over the block that ends."""
    P, rows, columns, corner = state.P, state.P_rows, state.P_columns, state.P_corner
    block, sums = state.block, state.sums
    transition_rows(block, model.gravity, P, rows)
    for i in range(PROPAGATED):
        for j in range(PROPAGATED, STATES):
            P[i, j] = rows[i, j]
            P[j, i] = rows[i, j]
    # The corner, F's rows against those of F P: with them as columns it is the same product again.
    for i in range(PROPAGATED):
        for j in range(STATES):
            columns[j, i] = rows[i, j]
    transition_rows(block, model.gravity, columns, corner)
    for i in range(PROPAGATED):
        for j in range(PROPAGATED):
            P[i, j] = 0.5 * (corner[i, j] + corner[j, i])

    dt, length = model.dt, block.length
    turn = model.gyro_noise * length + model.rate_noise * sums.rate_squared * dt + sums.lost_turn
    push = model.accel_noise * length + model.force_noise * (sums.acceleration * dt) ** 2 + (sums.impact * dt) ** 2
    push += model.lost_force * sums.lost_force**2
    _add_variance(P, ERROR.attitude, turn)
    _add_variance(P, ERROR.velocity, push)
    _add_variance(P, ERROR.gyro_bias, model.bias_walk * length)
    _add_variance(P, ERROR.gyro_matrix, model.matrix_walk * length)
    _add_variance(P, ERROR.accel_bias, model.accel_bias_walk * length)
    _add_variance(P, ERROR.motion_bias, model.motion_bias_walk * length)


@inlined
def _add_variance(P, states, variance):  # type: ignore[no-untyped-def]
    for i in range(states.start, states.stop):
        P[i, i] += variance


@inlined
def _correct(state, at, measured, variance):  # type: ignore[no-untyped-def]
    """Kalman correction by a measurement of state `at`: P ← P − P h hᵀ P/s, what it does to the states is added up."""
    P, block = state.P, state.block
    m, correction = block.measurements, block.correction
    gain = block.gain[m]
    root = 1.0 / np.sqrt(P[at, at] + variance)
    innovation = (measured - state.x[at] - correction[at]) * root
    for j in range(STATES):
        gain[j] = P[at, j] * root
    for j in range(STATES):
        correction[j] += gain[j] * innovation
    for i in range(STATES):
        share = gain[i]
        for j in range(STATES):
            P[i, j] -= share * gain[j]
    block.state[m], block.root[m], block.innovation[m] = at, root, innovation
    block.measurements = m + 1


@inlined
def _doubt_of_pair(state, at, variance):  # type: ignore[no-untyped-def]
    """Variance to add to that of a measurement, zero, of two axes, so that it is at most `DOUBTED_2` off: an impact."""
    P, x, correction = state.P, state.x, state.block.correction
    y0, y1 = -x[at] - correction[at], -x[at + 1] - correction[at + 1]
    a, b, c = P[at, at] + variance, P[at, at + 1], P[at + 1, at + 1] + variance
    size, trace = y0 * y0 + y1 * y1, a + c
    determinant, scaled = a * c - b * b, y0 * y0 * c + y1 * y1 * a - 2.0 * y0 * y1 * b
    missing = DOUBTED_2 * determinant - scaled
    if missing >= 0.0:
        return 0.0
    half = 0.5 * (DOUBTED_2 * trace - size)
    root = np.sqrt(half * half - DOUBTED_2 * missing)
    return (root - half) / DOUBTED_2 if half < 0.0 else -missing / (root + half)


@inlined
def _squared_distance(P, at, variance, y0, y1, y2):  # type: ignore[no-untyped-def]
    """Squared Mahalanobis distance of an innovation of three axes with `variance` each."""
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
def _widen_if_jumped(state, mean_x, mean_y, mean_z, variance):  # type: ignore[no-untyped-def]
    """Where gyro over a static block says that the bias has jumped, its covariance grows by as much."""
    P, x, correction, at = state.P, state.x, state.block.correction, GYRO_BIAS
    y0 = mean_x - x[at] - correction[at]
    y1 = mean_y - x[at + 1] - correction[at + 1]
    y2 = mean_z - x[at + 2] - correction[at + 2]
    if _squared_distance(P, at, variance, y0, y1, y2) > DOUBTED_3:
        P[at, at] += y0 * y0
        P[at + 1, at + 1] += y1 * y1
        P[at + 2, at + 2] += y2 * y2
        for i, j, product in ((0, 1, y0 * y1), (0, 2, y0 * y2), (1, 2, y1 * y2)):
            P[at + i, at + j] += product
            P[at + j, at + i] += product


@inlined
def _end_block(state, model):  # type: ignore[no-untyped-def]
    """Propagate P over the block, correct by what bounds the motion, or by the static phase; begin the next block."""
    x, P, sums, block = state.x, state.P, state.sums, state.block
    count = state.samples
    for i in range(3):
        for c in range(3):
            block.R[i, c] = sums.R[i, c] * model.dt
            block.R_moving[i, c] = sums.R_moving[i, c] * model.dt
            for axis in range(3):
                block.R_rate[axis, i, c] = sums.R_rate[axis, i, c] * model.dt
    block.length, block.lost_turn, block.measurements = count * model.dt, sums.lost_turn, 0
    for j in range(STATES):
        block.correction[j] = 0.0

    _propagate(state, model)
    static = sums.static == count
    if static:
        P[2, 2] += model.static_turn * block.length
    # Pairs and triples of axes are doubted together, so that it does not matter where the sensor's axes point.
    for group in range(2):
        if group == 0:
            at, axes = VELOCITY, 2
            variance = model.static_speed if static else model.speed
            variance += _doubt_of_pair(state, at, variance)
        elif static:
            at, axes, variance = GYRO_BIAS, 3, model.static_bias
            _widen_if_jumped(state, sums.gyro[0] / count, sums.gyro[1] / count, sums.gyro[2] / count, variance)
        else:
            at, axes, variance = POSITION, 2, model.position
            variance += _doubt_of_pair(state, at, variance)
        for i in range(axes):
            _correct(state, at + i, sums.gyro[i] / count if axes == 3 else 0.0, variance)
    for i in range(VELOCITY, STATES):
        x[i] += block.correction[i]
    rotate_by_world_vector(state.quat_WS, block.correction[0], block.correction[1], block.correction[2])
    state.samples = 0
    _clear(sums)


@inlined
def _clear(sums):  # type: ignore[no-untyped-def]
    for i in range(3):
        sums.gyro[i] = 0.0
        for c in range(3):
            sums.R[i, c] = sums.R_moving[i, c] = 0.0
            for axis in range(3):
                sums.R_rate[axis, i, c] = 0.0
    sums.rate_squared = sums.acceleration = sums.impact = sums.static = sums.lost_turn = sums.lost_force = 0.0


@inlined
def _true_rate(state, model, gx, gy, gz, static):  # type: ignore[no-untyped-def]
    """The sample's rate without the errors that are known, as three floats, and without the bias alone, as three.

    A lost sample, and how uncertain the turn of a lost or clipped one is, are taken care of here.
    """
    x, sums, held = state.x, state.sums, state.held_rate
    bias, motion_bias, M = x[ERROR.gyro_bias], x[ERROR.motion_bias], x[ERROR.gyro_matrix]
    moving = 0.0 if static else 1.0
    bx, by, bz = bias[0] + moving * motion_bias[0], bias[1] + moving * motion_bias[1], bias[2] + moving * motion_bias[2]
    if gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED:  # false for NaN
        ux, uy, uz = gx - bx, gy - by, gz - bz
        good = max(abs(gx), abs(gy), abs(gz)) < model.gyro_limit
        sums.gyro[0] += gx
        sums.gyro[1] += gy
        sums.gyro[2] += gz
        sums.static += 1.0 - moving
    else:
        fade = 1.0 - min(1.0, model.dt / FADE_S)
        ux, uy, uz = fade * held[0], fade * held[1], fade * held[2]
        good = False
    held[0], held[1], held[2] = ux, uy, uz
    if good:
        state.held_s = 0.0
    else:
        before = state.held_s
        if before * model.lost_rate < LARGEST_LOST_TURN:
            sums.lost_turn += model.lost_rate * model.lost_rate * model.dt * (2.0 * before + model.dt)
        state.held_s = before + model.dt
    state.gyro_bias[0], state.gyro_bias[1], state.gyro_bias[2] = bx, by, bz
    wx = ux - (M[0] * ux + M[1] * uy + M[2] * uz)
    wy = uy - (M[3] * ux + M[4] * uy + M[5] * uz)
    wz = uz - (M[6] * ux + M[7] * uy + M[8] * uz)
    return wx, wy, wz, ux, uy, uz


@inlined
def _acceleration(state, model, ax, ay, az):  # type: ignore[no-untyped-def]
    """The sample's horizontal acceleration in W, as two floats; zero for a lost sample."""
    sums, bias, A, R = state.sums, state.x[ERROR.accel_bias], model.accel_matrix, state.R_WS
    if not ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        sums.lost_force += model.dt
        return 0.0, 0.0
    if max(abs(ax), abs(ay), abs(az)) >= model.accel_limit:
        sums.lost_force += model.dt
    ax, ay, az = ax - bias[0], ay - bias[1], az - bias[2]
    fx = A[0, 0] * ax + A[0, 1] * ay + A[0, 2] * az
    fy = A[1, 0] * ax + A[1, 1] * ay + A[1, 2] * az
    fz = A[2, 0] * ax + A[2, 1] * ay + A[2, 2] * az
    ax = R[0, 0] * fx + R[0, 1] * fy + R[0, 2] * fz
    ay = R[1, 0] * fx + R[1, 1] * fy + R[1, 2] * fz
    az = R[2, 0] * fx + R[2, 1] * fy + R[2, 2] * fz - model.gravity
    size = np.sqrt(ax * ax + ay * ay + az * az)
    sums.acceleration += size
    sums.impact += max(0.0, size - model.impact)
    return ax, ay


@inlined
def step(state, model, gx, gy, gz, ax, ay, az, static):  # type: ignore[no-untyped-def]
    """One sample of one sensor: records of `STATE` and `MODEL`, gyro [rad/s], accel [m/s²]; whether a block ended."""
    dt, x, sums, R = model.dt, state.x, state.sums, state.R_WS
    wx, wy, wz, ux, uy, uz = _true_rate(state, model, gx, gy, gz, static)
    sums.rate_squared += wx * wx + wy * wy + wz * wz
    rotate_unit_by_rate(state.quat_WS, wx, wy, wz, dt)
    fill_matrix(state.quat_WS, R)
    moving = 0.0 if static else 1.0
    for i in range(3):
        for c in range(3):
            sums.R[i, c] += R[i, c]
            sums.R_rate[0, i, c] += R[i, c] * ux
            sums.R_rate[1, i, c] += R[i, c] * uy
            sums.R_rate[2, i, c] += R[i, c] * uz
            sums.R_moving[i, c] += R[i, c] * moving
    ax, ay = _acceleration(state, model, ax, ay, az)
    velocity, position = x[ERROR.velocity], x[ERROR.position]
    position[0] += dt * velocity[0]
    position[1] += dt * velocity[1]
    velocity[0] += dt * ax
    velocity[1] += dt * ay

    state.samples += 1
    ended = state.samples == model.block
    if ended:
        _end_block(state, model)
        fill_matrix(state.quat_WS, R)
    into_sensor(R, state.P, sums.lost_turn, state.attitude_cov)
    return ended


@kernel
def _run(states, models, gyro_S, accel_S, static, blocks, out_quat, out_bias, out_cov):  # type: ignore[no-untyped-def]
    state, model = states[0], models[0]
    row = 0
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if step(state, model, gx, gy, gz, ax, ay, az, static[k]) and row < len(blocks):
            for n in range(len(SMOOTHED)):
                for j in range(STATES):
                    state.block.P_rows[n, j] = state.P[SMOOTHED[n], j]
            blocks[row] = state.block
            row += 1
        for i in range(4):
            out_quat[k, i] = state.quat_WS[i]
        for i in range(3):
            out_bias[k, i] = state.gyro_bias[i]
        fill_symmetric(state.attitude_cov, out_cov[k])


@kernel
def _live(states, models, detectors, block, tail, gyro_S, accel_S, static):  # type: ignore[no-untyped-def]
    """One sample of each of k sensors, detector and filter; arrays with a row a sensor, as `bank.LiveBank` has them."""
    for i in range(len(states)):
        gx, gy, gz = gyro_S[i, 0], gyro_S[i, 1], gyro_S[i, 2]
        ax, ay, az = accel_S[i, 0], accel_S[i, 1], accel_S[i, 2]
        static[i] = static_step(detectors[i], block[i], tail[i], gx, gy, gz, ax, ay, az)
        step(states[i], models[i], gx, gy, gz, ax, ay, az, static[i])
