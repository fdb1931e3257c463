"""aMEKF: the multiplicative Kalman filter corrected in motion too, by the bound on where a hand can go; causal.

No single acceleration is trusted. The specific force, turned into the almost-inertial frame of the gyroscope, is summed
to a horizontal velocity and position; a tilt error of a degree would send them off by 8 m in 10 s, and a person's
segment does not go there. That is the idea of VQF's low-pass in that frame (Laidig and Seel 2023, Information Fusion
91) as a Kalman filter, so that the same innovations also teach it the gyroscope's own errors: bias, scale and
misalignment (the usual 3×3), and what the bias differs by in motion from that at rest. Turns about horizontal axes make
these visible through gravity, and the heading, which nothing measures, is better for it.

The 25 error states, additive but for the attitude: θ [rad] on the left (in W), so that one over a turn stays what it
is; horizontal velocity [m/s] and position [m]; gyroscope bias at rest [rad/s]; gyroscope matrix M, rows first
(measured = (I + M) true); accelerometer bias [m/s²]; bias in motion less that at rest [rad/s]. Error of velocity and
position are taken as in the invariant filter (Barrau and Bonnabel 2017, IEEE TAC 62(4)): they are driven by θ × g e_z
alone, so that the bound on them never says anything of the heading.

The strapdown runs at each sample, the covariance once a block (`AmekfParams.block_s`): over a block the transition is
exact in the sums of R_WS and R_WS ω, which is why 25 states cost less than six at each sample. At rest (the paper's
static phase, Lisini Baldi 2019) velocity is zero and the gyroscope reads its bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ..arguments import check_fields
from ..compilation import inlined, kernel
from ..errors import BadOption
from ..recording.limits import HIGHEST_ACCEL_SQUARED, HIGHEST_RATE_SQUARED
from ..rotations import fill_matrix, rotate_by_world_vector, rotate_unit_by_rate
from .base import REST_TURN_NOISE, FilterRun, OneSample, samples
from .noise import SensorNoise
from .static import static_step

# Error states
_V, _P, _B, _M, _F, _D = 3, 5, 7, 10, 19, 22  # velocity, position, bias, matrix, accel (force) bias, bias in motion
STATES = 25

# Sums over a block: of R (9, rows first), of R ω_c for c = x, y, z (9 each), of R while moving (9), and the rest.
_MOVING = 36
_GYRO, _RATE2, _FORCE, _KNOCK, _STATIC, _LOST_TURN, _LOST_FORCE, _SUMS = 45, 48, 49, 50, 51, 52, 53, 54
# Kept from sample to sample besides: last good rate (3), how long it has been held.
_HELD, _HELD_S, _KEPT = 0, 3, 4
_FADE_S = 0.1  # [s] in which a held rate fades
_LOST = 4.0  # [rad] of unknown turn are as good as any more
# Parameters in the order in which the compiled steps take them
_PARAMETERS = (
    "gravity gyro_noise accel_noise speed position zero_speed rate_noise force_noise bias_walk matrix_walk "
    "accel_bias_walk motion_bias_walk rest_bias lost_rate lost_force gyro_limit accel_limit knock rest_turn"
).split()

# A tape row, for the smoother: transition sums (45), the block's length [s], variance of the turn lost in it, number of
# measurements; for each the state it is of, 1/√s, innovation/√s and P h/√s; then of some states their correction and
# their rows of P after it.
TAPE_ROWS = (0, 1, 2, _B, _B + 1, _B + 2, _D, _D + 1, _D + 2)
MEASUREMENTS = 5
TAPE_LENGTH, TAPE_LOST, TAPE_MEASURED, TAPE_FIRST = 45, 46, 47, 48
TAPE_STEP = STATES + 3
TAPE_D = TAPE_FIRST + MEASUREMENTS * TAPE_STEP
TAPE_P = TAPE_D + len(TAPE_ROWS)
TAPE = TAPE_P + len(TAPE_ROWS) * STATES

# Squared Mahalanobis distance beyond which an innovation of two, of three axes is doubted: as rare as 3 σ of one.
_DOUBTED_2, _DOUBTED_3 = 11.83, 14.16
_NO_TAPE = np.empty((0, TAPE))


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
    rest_speed_std: float = 0.01  # [m/s] in a static phase
    rate_noise: float = 3e-4  # [1/√Hz] of gyro in motion, a share of |ω|: what the matrix does not explain
    force_noise: float = 0.01  # share of the summed |acceleration| by which a block's velocity change is off
    knock: float = 100.0  # [m/s²] acceleration beyond which is a hit: velocity is off by as much as that adds
    tilt_std: float = 0.2  # [rad] at the start, which may be in motion; a first rest soon says more
    gyro_matrix_std: float = 0.002  # each entry of M
    gyro_matrix_walk: float = 1e-6  # [1/√s]
    gyro_bias_walk: float = 5e-6  # [rad/s/√s], 10 deg/h in 100 s
    rest_bias_std: float = 1e-4  # [rad/s] by which the mean of gyro over a static block is not the bias, sway aside
    rest_turn_noise: float = REST_TURN_NOISE  # [rad/√s]
    motion_bias_std: float = 1.7e-4  # [rad/s], 0.01 deg/s, bias in motion less that at rest
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


# The state of a sensor is one row of numbers, so that it may be cut anywhere and a bank of sensors stacks them: quat_WS
# xyzw, bias as stated [rad/s], the attitude's covariance in S as an upper triangle (these three where smekf has them),
# x, P, sums, kept, samples in the open block; then room for a block's end, which is no state.
_X, _COV, _SUM, _KEEP, _COUNT, _ROOM = 13, 38, 663, 717, 721, 722
STATE_SIZE = _ROOM + 9 + 7 * STATES + STATES * 7 + 7 * 7 + STATES + STATES


class AmekfState:
    """Views of the row of numbers that the compiled steps work on."""

    def __init__(self, row: np.ndarray) -> None:
        self.row = row  # (1180,)
        self.quat_WS = row[:4]  # (4,) xyzw
        self.gyro_bias = row[4:7]  # (3,) [rad/s]
        self.x = row[_X:_COV]  # (25,) the states as the module says; the attitude's error stays zero
        self.P = row[_COV:_SUM].reshape(STATES, STATES)


class Amekf:
    """aMEKF of one sensor. First bias, its covariance, noise and gravity come from `noise`.

    What bad data does: a NaN sample of gyro holds the last rate, which fades in 0.1 s, and the attitude's covariance
    grows with the time squared; a NaN sample of accel counts as gravity alone, and the velocity's covariance grows; a
    sample beyond the ranges in `params` does the same, but is used. What a knock (`AmekfParams.knock`) adds to velocity
    is not believed. A bias that jumps is taken over at the next rest at once; until then it tilts by some degrees.
    Without any rest all is learned in motion, the tilt in ten seconds, the others in a minute or so. Time is not an
    input: gaps, repeated and late samples are the readers' to mend.
    """

    def __init__(
        self, noise: SensorNoise, rate_hz: float, quat_WS: np.ndarray, params: AmekfParams | None = None
    ) -> None:
        self.params = p = params or AmekfParams()
        self.rate_hz = rate_hz
        self.noise = noise
        self.block = max(1, round(p.block_s * rate_hz))
        length = self.block / rate_hz
        # By how much the mean of gyro over a static block is off: a person who stands still sways.
        white, sway = float(np.trace(noise.gyro_cov)) / 3.0 / self.block, noise.sway_density(rate_hz)
        known = {
            "gravity": noise.gravity,
            "gyro_noise": float(np.trace(noise.gyro_cov)) / 3.0 / rate_hz,  # [rad²/s]
            "accel_noise": float(np.trace(noise.accel_cov)) / 3.0 * noise.gravity**2 / rate_hz,  # [m²/s³]
            "speed": p.speed_std**2 * p.motion_s / length,
            "position": p.position_std**2 * p.motion_s / length,
            "zero_speed": p.rest_speed_std**2,
            "rate_noise": p.rate_noise**2,
            "force_noise": p.force_noise**2,
            "bias_walk": p.gyro_bias_walk**2,
            "matrix_walk": p.gyro_matrix_walk**2,
            "accel_bias_walk": p.accel_bias_walk**2,
            "motion_bias_walk": p.motion_bias_walk**2,
            "rest_bias": p.rest_bias_std**2 + white + sway / length,
            "lost_rate": p.lost_rate_std,
            "lost_force": p.lost_force_std**2,
            "gyro_limit": p.gyro_range,
            "accel_limit": p.accel_range,
            "knock": p.knock,
            # Who sways may turn slowly as well: an eighth of what the sway adds up to (our assumption).
            "rest_turn": p.rest_turn_noise**2 + sway / 8.0,
        }
        accel = np.linalg.inv(np.eye(3) + p.accel_matrix)  # measured to true
        self.model = np.concatenate(
            [[known[name] for name in _PARAMETERS], accel.ravel(), [1.0 / rate_hz, float(self.block)]]
        )
        self.state = AmekfState(np.zeros(STATE_SIZE))
        self.state.quat_WS[:], self.state.gyro_bias[:] = quat_WS, noise.gyro_bias
        x, P = self.state.x, self.state.P
        x[_B : _B + 3], x[_M : _M + 9], x[_F : _F + 3] = noise.gyro_bias, p.gyro_matrix.ravel(), p.accel_bias
        stds = np.zeros(STATES)
        stds[:3] = p.tilt_std, p.tilt_std, 1e-5  # the heading of the start is zero by definition
        stds[_V : _V + 2], stds[_P : _P + 2] = p.speed_std, p.position_std
        stds[_M : _M + 9], stds[_F : _F + 3], stds[_D : _D + 3] = p.gyro_matrix_std, p.accel_bias_std, p.motion_bias_std
        np.fill_diagonal(P, stds**2)
        P[_B : _B + 3, _B : _B + 3] = noise.gyro_bias_cov
        self._one = OneSample()

    @property
    def live(self) -> Callable[..., None]:
        """The kernel that steps many sensors at a time (`bank.LiveBank`)."""
        return _live

    def run(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool) -> FilterRun:
        return self.taped(gyro_S, accel_S, static, _NO_TAPE)

    def taped(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: np.ndarray | bool, tape: np.ndarray) -> FilterRun:
        """`run` that writes a row of `tape` (blocks, `TAPE`) at the end of each block as well."""
        gyro, accel, at_rest = samples(gyro_S, accel_S, static)
        out = np.empty((len(gyro), 4)), np.empty((len(gyro), 3)), np.empty((len(gyro), 3, 3))
        _run(self.state.row, self.model, gyro, accel, at_rest, tape, *out)
        return FilterRun(*out)

    def update(self, gyro_S: np.ndarray, accel_S: np.ndarray, static: bool) -> np.ndarray:
        one = self._one
        sample = one.fill(gyro_S, accel_S, static)
        _run(self.state.row, self.model, *sample, _NO_TAPE, one.quat_WS, one.gyro_bias, one.attitude_cov)
        return one.quat_WS[0].copy()


@kernel
def transition_rows(sums, length, gravity, P, out):  # type: ignore[no-untyped-def]
    """Rows of ``F P`` that differ from P's, those of θ, velocity and position, to `out` (7, m); `P` is (25, m).

    θ⁺ = θ − Σ R dt b − Σ R ω dt M − Σ_moving R dt d, v⁺ = v + ∫ θ × g e_z − Σ R dt f, p⁺ = p + ∫ v, the integrals by
    the trapezoid.
    """
    columns = P.shape[1]
    for i in range(3):
        for j in range(columns):
            out[i, j] = P[i, j]
        for c in range(3):
            at_rest, moving = sums[3 * i + c], sums[_MOVING + 3 * i + c]
            for j in range(columns):
                out[i, j] -= at_rest * P[_B + c, j] + moving * P[_D + c, j]
            x, y, z = sums[9 + 3 * i + c], sums[18 + 3 * i + c], sums[27 + 3 * i + c]
            for j in range(columns):
                out[i, j] -= x * P[_M + 3 * c, j] + y * P[_M + 3 * c + 1, j] + z * P[_M + 3 * c + 2, j]
    g, t = 0.5 * length * gravity, 0.5 * length
    for i in range(2):
        sign, other = (g, 1) if i == 0 else (-g, 0)
        fx, fy, fz = sums[3 * i], sums[3 * i + 1], sums[3 * i + 2]
        for j in range(columns):
            out[3 + i, j] = (
                P[_V + i, j]
                + sign * (P[other, j] + out[other, j])
                - (fx * P[_F, j] + fy * P[_F + 1, j] + fz * P[_F + 2, j])
            )
        for j in range(columns):
            out[5 + i, j] = P[_P + i, j] + t * (P[_V + i, j] + out[3 + i, j])


@inlined
def _doubt_of_pair(P, at, r, y0, y1):  # type: ignore[no-untyped-def]
    """Variance to add to `r` of two axes, so that their innovation is at most `_DOUBTED_2` off: a knock, a walk."""
    a, b, c = P[at, at] + r, P[at, at + 1], P[at + 1, at + 1] + r
    size, trace = y0 * y0 + y1 * y1, a + c
    determinant, scaled = a * c - b * b, y0 * y0 * c + y1 * y1 * a - 2.0 * y0 * y1 * b
    missing = _DOUBTED_2 * determinant - scaled
    if missing >= 0.0:
        return 0.0
    half = 0.5 * (_DOUBTED_2 * trace - size)
    root = np.sqrt(half * half - _DOUBTED_2 * missing)
    return (root - half) / _DOUBTED_2 if half < 0.0 else -missing / (root + half)


@inlined
def _distance_of_three(P, at, r, y0, y1, y2):  # type: ignore[no-untyped-def]
    """Squared Mahalanobis distance of an innovation of three axes with variance `r` each."""
    a, b, c = P[at, at] + r, P[at, at + 1], P[at, at + 2]
    e, f, i = P[at + 1, at + 1] + r, P[at + 1, at + 2], P[at + 2, at + 2] + r
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
def _close(state, quat, x, P, sums, dt, numbers, tape, row):  # type: ignore[no-untyped-def]
    """End a block: propagate P over it, correct by what bounds the motion, or by rest."""
    at = _ROOM + 9
    rows, columns = state[at : at + 175].reshape((7, STATES)), state[at + 175 : at + 350].reshape((STATES, 7))
    corner = state[at + 350 : at + 399].reshape((7, 7))
    d, scaled = state[at + 399 : at + 424], state[at + 424 : at + 449]
    count = numbers[29]
    gravity, gyro_noise, accel_noise = numbers[0], numbers[1], numbers[2]
    speed, position, zero_speed = numbers[3], numbers[4], numbers[5]
    rate_noise, force_noise, bias_walk, matrix_walk = numbers[6], numbers[7], numbers[8], numbers[9]
    accel_walk, motion_walk, rest_bias, lost_force = numbers[10], numbers[11], numbers[12], numbers[14]
    length = count * dt
    for i in range(45):
        sums[i] *= dt
    taped = row < len(tape)
    if taped:
        for i in range(45):
            tape[row, i] = sums[i]
        tape[row, TAPE_LENGTH], tape[row, TAPE_LOST] = length, sums[_LOST_TURN]

    transition_rows(sums, length, gravity, P, rows)
    for i in range(7):
        for j in range(7, STATES):
            P[i, j] = rows[i, j]
            P[j, i] = rows[i, j]
    # The corner, F's rows against those of F P: with them as columns it is the same product again.
    for i in range(7):
        for j in range(STATES):
            columns[j, i] = rows[i, j]
    transition_rows(sums, length, gravity, columns, corner)
    for i in range(7):
        for j in range(7):
            P[i, j] = 0.5 * (corner[i, j] + corner[j, i])

    turned = gyro_noise * length + rate_noise * sums[_RATE2] * dt + sums[_LOST_TURN]
    pushed = accel_noise * length + force_noise * (sums[_FORCE] * dt) ** 2 + (sums[_KNOCK] * dt) ** 2
    pushed += lost_force * sums[_LOST_FORCE] ** 2
    for i in range(3):
        P[i, i] += turned
        P[_B + i, _B + i] += bias_walk * length
        P[_F + i, _F + i] += accel_walk * length
        P[_D + i, _D + i] += motion_walk * length
    for i in range(9):
        P[_M + i, _M + i] += matrix_walk * length
    for i in range(2):
        P[_V + i, _V + i] += pushed

    still = sums[_STATIC] == count
    if still:
        P[2, 2] += numbers[18] * length
    for j in range(STATES):
        d[j] = 0.0
    n = MEASUREMENTS if still else 4
    r = 0.0
    for m in range(n):
        # Pairs and triples of axes are doubted together, so that it does not matter where the sensor's axes point.
        at = _V + m if m < 2 else (_B if still else _P) + m - 2
        if m == 0:
            r = zero_speed if still else speed
            r += _doubt_of_pair(P, _V, r, -x[_V] - d[_V], -x[_V + 1] - d[_V + 1])
        elif m == 2 and still:
            r = rest_bias
            y0 = sums[_GYRO] / count - x[_B] - d[_B]
            y1 = sums[_GYRO + 1] / count - x[_B + 1] - d[_B + 1]
            y2 = sums[_GYRO + 2] / count - x[_B + 2] - d[_B + 2]
            if _distance_of_three(P, _B, r, y0, y1, y2) > _DOUBTED_3:  # the bias has jumped, by as much
                P[_B, _B] += y0 * y0
                P[_B + 1, _B + 1] += y1 * y1
                P[_B + 2, _B + 2] += y2 * y2
                for i, j, product in ((0, 1, y0 * y1), (0, 2, y0 * y2), (1, 2, y1 * y2)):
                    P[_B + i, _B + j] += product
                    P[_B + j, _B + i] += product
        elif m == 2:
            r = position + _doubt_of_pair(P, _P, position, -x[_P] - d[_P], -x[_P + 1] - d[_P + 1])
        y = (sums[_GYRO + m - 2] / count if m >= 2 and still else 0.0) - x[at] - d[at]
        s = P[at, at] + r
        root = 1.0 / np.sqrt(s)
        for j in range(STATES):
            scaled[j] = P[at, j] * root
        y *= root
        for j in range(STATES):
            d[j] += scaled[j] * y
        for i in range(STATES):
            gain = scaled[i]
            for j in range(STATES):
                P[i, j] -= gain * scaled[j]
        if taped:
            to = TAPE_FIRST + m * TAPE_STEP
            tape[row, to], tape[row, to + 1], tape[row, to + 2] = at, root, y
            for j in range(STATES):
                tape[row, to + 3 + j] = scaled[j]
    for i in range(3, STATES):
        x[i] += d[i]
    rotate_by_world_vector(quat, d[0], d[1], d[2])
    if taped:
        tape[row, TAPE_MEASURED] = n
        for n in range(len(TAPE_ROWS)):
            i = TAPE_ROWS[n]
            tape[row, TAPE_D + n] = d[i]
            for j in range(STATES):
                tape[row, TAPE_P + STATES * n + j] = P[i, j]
    for i in range(_SUMS):
        sums[i] = 0.0


@inlined
def into_sensor(R, P, more, out):  # type: ignore[no-untyped-def]
    """Upper triangle `out` (6,) of ``Rᵀ P R + more I`` of symmetric 3×3 `P`; `R` (9,) rows first."""
    xx, xy, xz, yy, yz, zz = P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    at = 0
    for i in range(3):
        a, b, c = R[i], R[3 + i], R[6 + i]
        u, v, w = xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c
        for j in range(i, 3):
            out[at] = R[j] * u + R[3 + j] * v + R[6 + j] * w
            at += 1
    out[0] += more
    out[3] += more
    out[5] += more


@inlined
def fill_symmetric(upper, out):  # type: ignore[no-untyped-def]
    """`out` (3, 3) of its upper triangle (6,)."""
    out[0, 0], out[0, 1], out[0, 2] = upper[0], upper[1], upper[2]
    out[1, 0], out[1, 1], out[1, 2] = upper[1], upper[3], upper[4]
    out[2, 0], out[2, 1], out[2, 2] = upper[2], upper[4], upper[5]


@inlined
def step(state, model, gx, gy, gz, ax, ay, az, static, tape, row):  # type: ignore[no-untyped-def]
    """One sample of one sensor: `state` (1180,), `model` (30,), gyro [rad/s], accel [m/s²]; whether a block ended."""
    quat, x, sums, kept, R = state[:4], state[_X:_COV], state[_SUM:_KEEP], state[_KEEP:_COUNT], state[_ROOM : _ROOM + 9]
    P = state[_COV:_SUM].reshape((STATES, STATES))
    gravity, lost_rate, gyro_limit, accel_limit, knock = model[0], model[13], model[15], model[16], model[17]
    dt = model[28]
    moving = 0.0 if static else 1.0
    bx, by, bz = x[_B] + moving * x[_D], x[_B + 1] + moving * x[_D + 1], x[_B + 2] + moving * x[_D + 2]
    if gx * gx + gy * gy + gz * gz < HIGHEST_RATE_SQUARED:  # false for NaN
        ux, uy, uz = gx - bx, gy - by, gz - bz
        good = max(abs(gx), abs(gy), abs(gz)) < gyro_limit
        sums[_GYRO] += gx
        sums[_GYRO + 1] += gy
        sums[_GYRO + 2] += gz
        sums[_STATIC] += 1.0 - moving
    else:
        fade = 1.0 - min(1.0, dt / _FADE_S)
        ux, uy, uz = fade * kept[_HELD], fade * kept[_HELD + 1], fade * kept[_HELD + 2]
        good = False
    kept[_HELD], kept[_HELD + 1], kept[_HELD + 2] = ux, uy, uz
    if good:
        kept[_HELD_S] = 0.0
    else:
        held = kept[_HELD_S]
        if held * lost_rate < _LOST:
            sums[_LOST_TURN] += lost_rate * lost_rate * dt * (2.0 * held + dt)
        kept[_HELD_S] = held + dt

    wx = ux - (x[_M] * ux + x[_M + 1] * uy + x[_M + 2] * uz)
    wy = uy - (x[_M + 3] * ux + x[_M + 4] * uy + x[_M + 5] * uz)
    wz = uz - (x[_M + 6] * ux + x[_M + 7] * uy + x[_M + 8] * uz)
    sums[_RATE2] += wx * wx + wy * wy + wz * wz
    rotate_unit_by_rate(quat, wx, wy, wz, dt)
    fill_matrix(quat, R)
    for i in range(9):
        sums[i] += R[i]
        sums[9 + i] += R[i] * ux
        sums[18 + i] += R[i] * uy
        sums[27 + i] += R[i] * uz
        sums[_MOVING + i] += R[i] * moving

    if ax * ax + ay * ay + az * az < HIGHEST_ACCEL_SQUARED:
        if max(abs(ax), abs(ay), abs(az)) >= accel_limit:
            sums[_LOST_FORCE] += dt
        ax, ay, az = ax - x[_F], ay - x[_F + 1], az - x[_F + 2]
        fx = model[19] * ax + model[20] * ay + model[21] * az
        fy = model[22] * ax + model[23] * ay + model[24] * az
        fz = model[25] * ax + model[26] * ay + model[27] * az
        ax = R[0] * fx + R[1] * fy + R[2] * fz
        ay = R[3] * fx + R[4] * fy + R[5] * fz
        az = R[6] * fx + R[7] * fy + R[8] * fz - gravity
        size = np.sqrt(ax * ax + ay * ay + az * az)
        sums[_FORCE] += size
        sums[_KNOCK] += max(0.0, size - knock)
    else:
        sums[_LOST_FORCE] += dt
        ax = ay = 0.0
    x[_P] += dt * x[_V]
    x[_P + 1] += dt * x[_V + 1]
    x[_V] += dt * ax
    x[_V + 1] += dt * ay

    state[_COUNT] += 1.0
    full = state[_COUNT] == model[29]
    if full:
        _close(state, quat, x, P, sums, dt, model, tape, row)
        state[_COUNT] = 0.0
        fill_matrix(quat, R)
    state[4], state[5], state[6] = bx, by, bz
    into_sensor(R, P, sums[_LOST_TURN], state[7:13])
    return full


@kernel
def _run(state, model, gyro_S, accel_S, static, tape, out_quat, out_bias, out_cov):  # type: ignore[no-untyped-def]
    row = 0
    for k in range(len(gyro_S)):
        gx, gy, gz = gyro_S[k, 0], gyro_S[k, 1], gyro_S[k, 2]
        ax, ay, az = accel_S[k, 0], accel_S[k, 1], accel_S[k, 2]
        if step(state, model, gx, gy, gz, ax, ay, az, static[k], tape, row):
            row += 1
        for i in range(4):
            out_quat[k, i] = state[i]
        for i in range(3):
            out_bias[k, i] = state[4 + i]
        fill_symmetric(state[7:13], out_cov[k])


@kernel
def _live(  # type: ignore[no-untyped-def]
    rows, models, block, tail, head, anchor, counts, limits, bias, gyro_S, accel_S, static
):
    """One sample of each of k sensors, detector and filter; arrays with a row a sensor, as `bank.LiveBank` has them."""
    for i in range(len(rows)):
        gx, gy, gz = gyro_S[i, 0], gyro_S[i, 1], gyro_S[i, 2]
        ax, ay, az = accel_S[i, 0], accel_S[i, 1], accel_S[i, 2]
        still = static_step(
            block[i], tail[i], head[i], anchor[i], counts[i], limits[i], bias[i], gx, gy, gz, ax, ay, az
        )
        static[i] = still
        step(rows[i], models[i], gx, gy, gz, ax, ay, az, still, models[:0], 0)  # no tape
