"""One arm's part of the quadratic programme, compiled: hand, orientation, swivel, and damping where it is singular."""

from __future__ import annotations

import numpy as np

from ..compilation import compiled, inlined

# Where each number of the tasks stands in `numbers`.
POSITION, ORIENTATION, SWIVEL, GAIN, BRAKE, STRAIGHT, DAMPING, CURVED = range(8)
_NOTHING = 0.01  # [m] a bend below which an elbow has no direction
_LEVER = 0.2  # [m] from a joint to the hand, about which its path bends
_SURE = 0.05  # [m] a bend from which on it counts in full


@compiled
def add_arm(H, f, J, above, p, elbow, shoulder, turn, position, velocity, rate, bend, weight, v, dt, numbers, joints):  # type: ignore[no-untyped-def]
    """Add one arm's tasks to ½ v'ᵀ H v' − fᵀ v'; whether its hand cannot move in some direction.

    Parameters
    ----------
    H, f : (n, n), (n,), changed in place
    J : (6, n) of what hangs on the hand's joint, at the root's origin: [m/s] over [rad/s] a unit of velocity
    above : (6, n) the same of the elbow's joint; empty (0, 0) for an arm without
    p, elbow, shoulder : (3,) [m]
    turn : (3,) [rad] from the hand's orientation to the one that it is to have
    position, velocity, rate, bend, weight : of `Aim`
    joints : (k,) the arm's own
    """
    n = len(v)
    slide, ahead, ahead_turn = np.empty((3, n)), np.zeros(3), np.zeros(3)
    for j in range(n):
        x, y, z = J[3, j], J[4, j], J[5, j]
        slide[0, j] = J[0, j] + y * p[2] - z * p[1]
        slide[1, j] = J[1, j] + z * p[0] - x * p[2]
        slide[2, j] = J[2, j] + x * p[1] - y * p[0]
        for i in range(3):  # half of the coming step is already decided
            ahead[i] += 0.5 * dt * slide[i, j] * v[j]
            ahead_turn[i] += 0.5 * dt * J[3 + i, j] * v[j]
    go, spin = np.empty(3), np.empty(3)
    _made_good(position - p - ahead, velocity, numbers, go)
    _made_good(turn - ahead_turn, rate, numbers, spin)
    w_go, w_spin = numbers[POSITION] * weight, numbers[ORIENTATION] * weight
    for a in range(n):
        for b in range(n):
            total = 0.0
            for i in range(3):
                total += w_go * slide[i, a] * slide[i, b] + w_spin * J[3 + i, a] * J[3 + i, b]
            H[a, b] += total
        for i in range(3):
            f[a] += w_go * slide[i, a] * go[i] + w_spin * J[3 + i, a] * spin[i]
    if above.shape[0]:
        _add_swivel(H, f, slide, above, p, elbow, shoulder, bend, weight, numbers)
    # What the Jacobian's own change adds to the Hessian: where an arm is straight and its target farther, the only term
    # that keeps the elbow from swinging through (Levenberg; Sugihara 2011 weighs it by the error too).
    gap = np.sqrt(np.sum((position - p - ahead) ** 2))
    angle = np.sqrt(np.sum((turn - ahead_turn) ** 2))
    bent = numbers[CURVED] * (w_go * _LEVER * gap + w_spin * angle)
    for j in joints:
        H[j, j] += bent
    gram = np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for j in range(n):
                gram[a, b] += slide[a, j] * slide[b, j]
    least = np.sqrt(max(_least_eigenvalue(gram), 0.0))
    if least >= numbers[STRAIGHT]:
        return False
    damping = numbers[DAMPING] * (1.0 - least / numbers[STRAIGHT]) ** 2  # Nakamura and Hanafusa 1986
    for j in joints:
        H[j, j] += damping
        f[j] += 0.9 * damping * v[j]
    return True


@compiled
def _made_good(error, ahead, numbers, out):  # type: ignore[no-untyped-def]
    """Velocity `ahead` and what makes an error good, no faster than `BRAKE` stops it within the error."""
    size = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    gain = numbers[GAIN]
    if size > 0.0:
        gain = min(gain, np.sqrt(2.0 * numbers[BRAKE] / size))
    for i in range(3):
        out[i] = ahead[i] + gain * error[i]


@compiled
def _add_swivel(H, f, slide, above, p, elbow, shoulder, bend, weight, numbers):  # type: ignore[no-untyped-def]
    """The elbow about the line from shoulder to hand, as the person's; it fades where either arm is straight."""
    offset, upper = p - shoulder, elbow - shoulder
    far = np.sqrt(np.sum(offset * offset))
    if far < _SURE:
        return
    axis = offset / far
    along = np.sum(upper * axis)
    own = upper - along * axis
    wanted = bend - np.sum(bend * axis) * axis
    r, size = np.sqrt(np.sum(own * own)), np.sqrt(np.sum(wanted * wanted))
    if r < _NOTHING or size < _NOTHING:
        return
    tangent = np.empty(3)
    tangent[0] = (axis[1] * own[2] - axis[2] * own[1]) / r
    tangent[1] = (axis[2] * own[0] - axis[0] * own[2]) / r
    tangent[2] = (axis[0] * own[1] - axis[1] * own[0]) / r
    angle = np.arctan2(np.sum(wanted * tangent), np.sum(wanted * own) / r)
    w = numbers[SWIVEL] * weight * min(1.0, size / _SURE) * min(1.0, r / _SURE)
    want = r * min(max(0.5 * numbers[GAIN] * angle, -3.0), 3.0)
    n = slide.shape[1]
    row = np.empty(n)
    for j in range(n):
        x, y, z = above[3, j], above[4, j], above[5, j]
        row[j] = (
            tangent[0] * (above[0, j] + y * elbow[2] - z * elbow[1] - along / far * slide[0, j])
            + tangent[1] * (above[1, j] + z * elbow[0] - x * elbow[2] - along / far * slide[1, j])
            + tangent[2] * (above[2, j] + x * elbow[1] - y * elbow[0] - along / far * slide[2, j])
        )
    for a in range(n):
        f[a] += w * want * row[a]
        for b in range(n):
            H[a, b] += w * row[a] * row[b]


@inlined
def _least_eigenvalue(A):  # type: ignore[no-untyped-def]
    """Of a symmetric (3, 3), in closed form (Smith 1961)."""
    off = A[0, 1] ** 2 + A[0, 2] ** 2 + A[1, 2] ** 2
    mean = (A[0, 0] + A[1, 1] + A[2, 2]) / 3.0
    x, y, z = A[0, 0] - mean, A[1, 1] - mean, A[2, 2] - mean
    p = np.sqrt((x * x + y * y + z * z + 2.0 * off) / 6.0)
    if p < 1e-12:
        return mean
    determinant = (
        x * (y * z - A[1, 2] ** 2)
        - A[0, 1] * (A[0, 1] * z - A[1, 2] * A[0, 2])
        + A[0, 2] * (A[0, 1] * A[1, 2] - y * A[0, 2])
    )
    half = min(max(determinant / (2.0 * p**3), -1.0), 1.0)
    return mean + 2.0 * p * np.cos((np.arccos(half) + 2.0 * np.pi) / 3.0)
