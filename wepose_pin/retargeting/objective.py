"""One arm's part of the quadratic objective, compiled: hand, orientation, swivel, and damping near singularities."""

from __future__ import annotations

import numpy as np

from ..compilation import compiled, inlined

# Places of the parameters of `ControllerParams` in the array that the kernels get.
POSITION, ORIENTATION, SWIVEL, GAIN, DECELERATION, SINGULAR_BELOW, DAMPING, CURVATURE = range(8)
_MIN_SWIVEL = 0.01  # [m] below it the elbow has no swivel direction
_FULL_SWIVEL = 0.05  # [m] above it the swivel task has its full weight
_LEVER = 0.2  # [m] from a joint to the hand, for the curvature of the hand's path


@compiled
def add_arm_tasks(  # type: ignore[no-untyped-def]
    H, f, J_hand, J_elbow, hand, elbow, shoulder, rotation_error, position, velocity, angular_velocity, swivel, weight,
    v, dt, tasks, joints,
):  # fmt: skip
    """Add one arm's tasks to ½ wᵀ H w − fᵀ w; return whether the arm is close to a singularity.

    Parameters
    ----------
    H, f : (n, n), (n,), changed in place
    J_hand, J_elbow : (6, n) of what the hand's, the elbow's joint carries, at the origin of B: linear [m/s] over
        angular [rad/s]; `J_elbow` is (0, 0) for an arm without a swivel task
    hand, elbow, shoulder : (3,) [m] in B
    rotation_error : (3,) [rad] from the hand's orientation to its target
    position, velocity, angular_velocity, swivel, weight : of `HandTarget`
    v : (n,) joint velocities
    joints : (k,) of the arm
    """
    n = len(v)
    linear, ahead, ahead_angular = np.empty((3, n)), np.zeros(3), np.zeros(3)
    for j in range(n):
        x, y, z = J_hand[3, j], J_hand[4, j], J_hand[5, j]
        linear[0, j] = J_hand[0, j] + y * hand[2] - z * hand[1]
        linear[1, j] = J_hand[1, j] + z * hand[0] - x * hand[2]
        linear[2, j] = J_hand[2, j] + x * hand[1] - y * hand[0]
        for i in range(3):  # half of the coming step is already decided
            ahead[i] += 0.5 * dt * linear[i, j] * v[j]
            ahead_angular[i] += 0.5 * dt * J_hand[3 + i, j] * v[j]
    v_hand, w_hand = np.empty(3), np.empty(3)
    _correct_error(position - hand - ahead, velocity, tasks, v_hand)
    _correct_error(rotation_error - ahead_angular, angular_velocity, tasks, w_hand)
    weight_p, weight_R = tasks[POSITION] * weight, tasks[ORIENTATION] * weight
    for a in range(n):
        for b in range(n):
            total = 0.0
            for i in range(3):
                total += weight_p * linear[i, a] * linear[i, b] + weight_R * J_hand[3 + i, a] * J_hand[3 + i, b]
            H[a, b] += total
        for i in range(3):
            f[a] += weight_p * linear[i, a] * v_hand[i] + weight_R * J_hand[3 + i, a] * w_hand[i]
    if J_elbow.shape[0]:
        _add_swivel_task(H, f, linear, J_elbow, hand, elbow, shoulder, swivel, weight, tasks)
    # The derivative of the Jacobian in the Hessian: where an arm is straight and its target farther away, the only term
    # that keeps the elbow from swinging through (Levenberg; Sugihara 2011 weighs it by the error too).
    distance = np.sqrt(np.sum((position - hand - ahead) ** 2))
    angle = np.sqrt(np.sum((rotation_error - ahead_angular) ** 2))
    curvature = tasks[CURVATURE] * (weight_p * _LEVER * distance + weight_R * angle)
    for j in joints:
        H[j, j] += curvature
    gram = np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for j in range(n):
                gram[a, b] += linear[a, j] * linear[b, j]
    least = np.sqrt(max(_smallest_eigenvalue(gram), 0.0))
    if least >= tasks[SINGULAR_BELOW]:
        return False
    damping = tasks[DAMPING] * (1.0 - least / tasks[SINGULAR_BELOW]) ** 2  # Nakamura and Hanafusa 1986
    for j in joints:
        H[j, j] += damping
        f[j] += 0.9 * damping * v[j]
    return True


@compiled
def _correct_error(error, feedforward, tasks, velocity):  # type: ignore[no-untyped-def]
    """Fill `velocity` (3,): the feedforward, and a correction that `DECELERATION` can stop within the error."""
    size = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    gain = tasks[GAIN]
    if size > 0.0:
        gain = min(gain, np.sqrt(2.0 * tasks[DECELERATION] / size))
    for i in range(3):
        velocity[i] = feedforward[i] + gain * error[i]


@compiled
def _add_swivel_task(H, f, linear, J_elbow, hand, elbow, shoulder, swivel, weight, tasks):  # type: ignore[no-untyped-def]
    """Rotate the elbow about the line shoulder-hand to the person's; the task fades where either arm is straight."""
    offset, upper = hand - shoulder, elbow - shoulder
    far = np.sqrt(np.sum(offset * offset))
    if far < _FULL_SWIVEL:
        return
    axis = offset / far
    along = np.sum(upper * axis)
    own = upper - along * axis
    wanted = swivel - np.sum(swivel * axis) * axis
    radius, size = np.sqrt(np.sum(own * own)), np.sqrt(np.sum(wanted * wanted))
    if radius < _MIN_SWIVEL or size < _MIN_SWIVEL:
        return
    tangent = np.empty(3)
    tangent[0] = (axis[1] * own[2] - axis[2] * own[1]) / radius
    tangent[1] = (axis[2] * own[0] - axis[0] * own[2]) / radius
    tangent[2] = (axis[0] * own[1] - axis[1] * own[0]) / radius
    angle = np.arctan2(np.sum(wanted * tangent), np.sum(wanted * own) / radius)
    w = tasks[SWIVEL] * weight * min(1.0, size / _FULL_SWIVEL) * min(1.0, radius / _FULL_SWIVEL)
    speed = radius * min(max(0.5 * tasks[GAIN] * angle, -3.0), 3.0)
    n = linear.shape[1]
    row = np.empty(n)
    for j in range(n):
        x, y, z = J_elbow[3, j], J_elbow[4, j], J_elbow[5, j]
        row[j] = (
            tangent[0] * (J_elbow[0, j] + y * elbow[2] - z * elbow[1] - along / far * linear[0, j])
            + tangent[1] * (J_elbow[1, j] + z * elbow[0] - x * elbow[2] - along / far * linear[1, j])
            + tangent[2] * (J_elbow[2, j] + x * elbow[1] - y * elbow[0] - along / far * linear[2, j])
        )
    for a in range(n):
        f[a] += w * speed * row[a]
        for b in range(n):
            H[a, b] += w * row[a] * row[b]


@inlined
def _smallest_eigenvalue(A):  # type: ignore[no-untyped-def]
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
