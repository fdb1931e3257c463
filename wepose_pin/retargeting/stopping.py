"""The stop that every step leaves possible: its path, and whether the hulls of the robot's links stay apart on it.

A step is taken only if from the state behind it the robot can stop within its limits, and without self-contact. By
induction there is always such a stop: that of the step before (as braking trajectories in "provably safe" motion:
Fraichard and Asama 2004, inevitable collision states).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from ..compilation import compiled
from .collision import CollisionModel
from .limits import _bound_acceleration, _keeps_bound
from .robot import Robot

STOP_S = 0.06  # [s] time constant with which a low velocity decays; at a higher one joints brake at their limits
STOP_RISES = 1.5  # least time constant, in times that a joint needs to reach its full acceleration
STOP_SHARE = 0.02  # of the velocity that one step can brake: below it the velocity goes to zero at once
STATIC_SPEED = 1e-9  # [rad/s or m/s] below it a joint is at rest
MIN_BRAKING_SHARE = 0.05  # of the acceleration limit, with which a joint brakes that comes to rest with the others
MAX_STOP_S = 5.0  # [s]; a stop that takes longer counts as none


class Stop(NamedTuple):
    """States from one step after the present one to rest; none where it is at rest."""

    position: np.ndarray  # (m, n) [rad or m]
    velocity: np.ndarray  # (m, n)
    acceleration: np.ndarray  # (m, n)
    travel: np.ndarray  # (m, n) [rad or m] that a joint moves at most in each of these steps

    @property
    def ends_at_rest(self) -> bool:
        """Whether the last state is at rest."""
        return not len(self.velocity) or not (self.velocity[-1].any() or self.acceleration[-1].any())


@compiled
def compute_stop(u, v, a, lower, upper, v_max, a_max, j_max, braking, dt):  # type: ignore[no-untyped-def]
    """Return positions, velocities, accelerations, largest travel of each step (m, n): each joint brakes to rest.

    `u`, `v`, `a` (n,) are joint position, velocity and acceleration [rad or m, s]; `dt` [s] is a step.
    Each joint brakes at `braking` (n,), up to `a_max`, and harder where its position limit requires it. They keep the
    limits if the present state does, in the sense of `compute_acceleration_bounds`. No rows: the robot is at rest. The
    last state is not at rest where that takes longer than `MAX_STOP_S`.
    """
    n = len(u)
    steps = int(MAX_STOP_S / dt)
    path, length = np.zeros((4, steps, n)), 0
    for j in range(n):
        place, speed, accel, k = u[j], v[j], a[j], 0
        j_step = j_max[j] * dt
        fade = max(STOP_S, STOP_RISES * a_max[j] / j_max[j])
        peak = abs(speed) + abs(accel) * (dt + 0.5 * abs(accel) / j_max[j])
        far = peak * (2.0 * a_max[j] / j_max[j] + 2.0 * dt + fade) + 0.5 * peak * peak / braking[j]
        free = upper[j] - place > far and place - lower[j] > far  # no limit is near
        while k < steps and (abs(speed) > STATIC_SPEED or abs(accel) > STATIC_SPEED / dt):
            after = -speed / fade
            if abs(speed) < STOP_SHARE * a_max[j] * dt:  # in two steps to zero
                after = -speed / dt - 0.5 * accel
            after = min(max(min(max(after, -braking[j]), braking[j]), accel - j_step), accel + j_step)
            if not free:
                up, down = upper[j] - place, place - lower[j]
                fits = _keeps_bound(False, after, speed, accel, up, v_max[j], a_max[j], j_max[j], dt)
                fits &= _keeps_bound(False, -after, -speed, -accel, down, v_max[j], a_max[j], j_max[j], dt)
                if not fits:
                    high, _ = _bound_acceleration(speed, accel, up, v_max[j], a_max[j], j_max[j], dt)
                    low, _ = _bound_acceleration(-speed, -accel, down, v_max[j], a_max[j], j_max[j], dt)
                    after = min(max(after, -low), high)
            faster = max(abs(speed), abs(speed + 0.5 * dt * (accel + after)))
            path[3, k, j] = dt * (faster + 0.125 * dt * abs(after - accel))
            place += dt * (speed + dt * (accel / 3.0 + after / 6.0))
            speed += 0.5 * dt * (accel + after)
            accel = after
            path[0, k, j], path[1, k, j], path[2, k, j] = place, speed, accel
            k += 1
        length = max(length, k)
        path[0, k:, j] = place
        if k and k < steps:  # below `STATIC_SPEED`
            path[1, k - 1, j] = path[2, k - 1, j] = 0.0
    return path[0, :length], path[1, :length], path[2, :length], path[3, :length]


def balance_braking(v: np.ndarray, a_max: np.ndarray) -> np.ndarray:
    """Return the accelerations (n,) with which joints brake from velocities `v` and come to rest together."""
    duration = np.abs(v) / a_max
    return a_max * np.maximum(duration / max(float(duration.max()), STATIC_SPEED), MIN_BRAKING_SHARE)


class StopCheck:
    """Whether hulls stay apart on the way to rest.

    The way is halved until each part is covered: from the distance of a pair follows how far its joints may move before
    the hulls can meet, by the length of the links between (as in conservative advancement, Mirtich 1996).
    """

    def __init__(self, robot: Robot, collision: CollisionModel) -> None:
        self._robot, self._collision = robot, collision
        self._data: Any = robot.model.createData()

    def find_shortfall(self, distance: np.ndarray, path: np.ndarray, travel: np.ndarray) -> np.ndarray | None:
        """Return how far (pairs,) [m] pairs are below their least distance, at one point of the way; None: nowhere.

        Parameters
        ----------
        distance : (pairs,) [m] at the beginning; a lower bound where a pair is far
        path : (m, n) joint positions, the first after one step
        travel : (m, n) largest way of each joint in each step
        """
        collision = self._collision
        if not len(collision.pairs) or not len(path):
            return None
        approach = np.cumsum(travel @ collision.levers.T, axis=0)  # (m, pairs) [m]
        critical = np.flatnonzero(approach[-1] >= distance - collision.least_distance)
        if not len(critical):
            return None
        # Along the way a pair comes nearer by `approach` at most: enough room at both ends of a part covers the part.
        approach = np.vstack([np.zeros(len(critical)), approach[:, critical]])
        room = {0: (distance - collision.least_distance)[critical]}
        parts = [(0, len(path))]
        while parts:
            begin, end = parts.pop()
            for at in (begin, end):
                if at not in room:
                    room[at] = self._measure_room(path[at - 1], critical)
                    if (room[at] < 0.0).any():
                        shortfall = np.zeros(len(distance))
                        shortfall[critical] = np.maximum(-room[at], 0.0)
                        return shortfall
            covered = approach[end] - approach[begin] < room[begin] + room[end]
            if end - begin > 1 and not covered.all():
                middle = (begin + end) // 2
                parts += [(middle, end), (begin, middle)]
        return None

    def _measure_room(self, position: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Distances [m] of some pairs at joint positions (n,), less their least ones."""
        pin.forwardKinematics(self._robot.model, self._data, self._robot.configuration(position))
        return self._collision.compute_distances(self._data, pairs) - self._collision.least_distance[pairs]
