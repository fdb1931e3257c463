"""One arm's part of the quadratic objective, compiled: hand, orientation, swivel, and damping near singularities."""

from __future__ import annotations

import numpy as np

from ..compilation import compiled

# Places of the parameters of `ControllerParams` in the array that the kernels get.
POSITION, ORIENTATION, SWIVEL, GAIN, DECELERATION, SINGULAR_BELOW, DAMPING, CURVATURE = range(8)
_MIN_SWIVEL = 0.01  # [m] below it the elbow has no swivel direction
_FULL_SWIVEL = 0.05  # [m] above it the swivel task has its full weight
_MAX_SWIVEL_RATE = 3.0  # [rad/s] of its correction
_LEVER = 0.2  # [m] from a joint to the hand, for the curvature of the hand's path


@compiled
def add_arm_tasks(  # type: ignore[no-untyped-def]
    H, f, J_hand, J_elbow, hand, elbow, shoulder, rotation_error, position, velocity, angular_velocity, swivel, weight,
    v, dt, tasks, joints,
):  # fmt: skip
    """Add one arm's tasks to ½ wᵀ H w − fᵀ w.

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
    linear, angular = _compute_point_jacobian(J_hand, hand), J_hand[3:]
    # Half of the coming step is already decided.
    distance, rotation = position - hand - 0.5 * dt * (linear @ v), rotation_error - 0.5 * dt * (angular @ v)
    weight_p, weight_R = tasks[POSITION] * weight, tasks[ORIENTATION] * weight
    H += weight_p * (linear.T @ linear) + weight_R * (angular.T @ angular)
    f += weight_p * (linear.T @ _correct_error(distance, velocity, tasks))
    f += weight_R * (angular.T @ _correct_error(rotation, angular_velocity, tasks))
    if J_elbow.shape[0]:
        _add_swivel_task(H, f, linear, J_elbow, hand, elbow, shoulder, swivel, weight, tasks)
    # The derivative of the Jacobian in the Hessian: where an arm is straight and its target farther away, the only term
    # that keeps the elbow from swinging through (Levenberg; Sugihara 2011 weighs it by the error too).
    curvature = weight_p * _LEVER * np.sqrt(distance @ distance) + weight_R * np.sqrt(rotation @ rotation)
    for j in joints:
        H[j, j] += tasks[CURVATURE] * curvature
    least = np.sqrt(max(np.linalg.eigvalsh(linear @ linear.T)[0], 0.0))
    if least >= tasks[SINGULAR_BELOW]:
        return
    damping = tasks[DAMPING] * (1.0 - least / tasks[SINGULAR_BELOW]) ** 2  # Nakamura and Hanafusa 1986
    for j in joints:
        H[j, j] += damping
        f[j] += 0.9 * damping * v[j]


@compiled
def _compute_point_jacobian(J, p):  # type: ignore[no-untyped-def]
    """Linear Jacobian (3, n) of the point `p` (3,) of a body, from `J` (6, n) at the origin."""
    linear = J[:3].copy()
    linear[0] += J[4] * p[2] - J[5] * p[1]
    linear[1] += J[5] * p[0] - J[3] * p[2]
    linear[2] += J[3] * p[1] - J[4] * p[0]
    return linear


@compiled
def _correct_error(error, feedforward, tasks):  # type: ignore[no-untyped-def]
    """Velocity (3,): the feedforward, and a correction that `DECELERATION` can stop within the error."""
    size, gain = np.sqrt(error @ error), tasks[GAIN]
    if size > 0.0:
        gain = min(gain, np.sqrt(2.0 * tasks[DECELERATION] / size))
    return feedforward + gain * error


@compiled
def _add_swivel_task(H, f, linear, J_elbow, hand, elbow, shoulder, swivel, weight, tasks):  # type: ignore[no-untyped-def]
    """Rotate the elbow about the line shoulder-hand to the person's; the task fades where either arm is straight."""
    offset, upper = hand - shoulder, elbow - shoulder
    far = np.sqrt(offset @ offset)
    if far < _FULL_SWIVEL:
        return
    axis = offset / far
    along = upper @ axis
    own, wanted = upper - along * axis, swivel - (swivel @ axis) * axis
    radius, size = np.sqrt(own @ own), np.sqrt(wanted @ wanted)
    if radius < _MIN_SWIVEL or size < _MIN_SWIVEL:
        return
    tangent = np.cross(axis, own) / radius
    angle = np.arctan2(wanted @ tangent, wanted @ own / radius)
    rate = min(max(0.5 * tasks[GAIN] * angle, -_MAX_SWIVEL_RATE), _MAX_SWIVEL_RATE)
    w = tasks[SWIVEL] * weight * min(1.0, size / _FULL_SWIVEL) * min(1.0, radius / _FULL_SWIVEL)
    row = tangent @ (_compute_point_jacobian(J_elbow, elbow) - along / far * linear)
    H += w * np.outer(row, row)
    f += w * radius * rate * row
