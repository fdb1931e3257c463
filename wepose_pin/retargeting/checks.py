"""Checks of a written trajectory that share no step with the controller: limits of URDF and map, coal's shapes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.interpolate import CubicHermiteSpline

from .collision import select_pairs
from .maps import RobotMap
from .robot import Robot


class LimitCheck(NamedTuple):
    """Margins of a trajectory to its limits; negative: a limit is exceeded."""

    position: float  # [rad or m] to the nearest position limit
    velocity: float  # share of the velocity limits that is never used
    acceleration: float  # of the acceleration limits
    jerk: float  # of the jerk limits
    consistent: bool  # velocities and accelerations are those of one curve through the positions, cubic in each step
    ends_at_rest: bool  # it begins and ends without velocity and acceleration

    @property
    def passed(self) -> bool:
        """Whether every limit is kept."""
        margins = self.position, self.velocity, self.acceleration, self.jerk
        return min(margins) >= 0.0 and self.consistent and self.ends_at_rest


def check_limits(table: pl.DataFrame, robot: RobotMap) -> LimitCheck:
    """Compare a table as in ``trajectory.parquet`` with the limits of a robot's URDF and map, without any margin.

    Checked at the samples and at ten points between each two, on the cubics through positions and velocities.
    """
    limits, time = robot.read_joint_limits(), table["time"].to_numpy()
    joints = [name for name in table.columns if name in limits]
    q, v, a = (
        table.select([f"{j}{suffix}" for j in joints]).to_numpy() for suffix in ("", "_velocity", "_acceleration")
    )
    low, high, v_max = (np.array([getattr(limits[j], key) for j in joints]) for key in ("lower", "upper", "velocity"))
    a_max, j_max = (np.array([values[j] for j in joints]) for values in (robot.acceleration, robot.jerk))
    dt = np.diff(time)[:, None]
    curve = CubicHermiteSpline(time, q, v)
    dense = np.unique(np.concatenate([time, (time[:-1, None] + dt * np.arange(0.1, 1.0, 0.1)).ravel()]))
    q_between, v_between = curve(dense), curve(dense, 1)
    jerks, left = 6.0 * curve.c[0], 2.0 * curve.c[1]  # of each step, and the acceleration at its beginning
    right = left + jerks * dt
    steps = np.abs(np.diff(a, axis=0)) / dt
    return LimitCheck(
        position=float(min((q_between - low).min(), (high - q_between).min())),
        velocity=float(1.0 - max((np.abs(v) / v_max).max(), (np.abs(v_between) / v_max).max())),
        acceleration=float(1.0 - max((np.abs(x) / a_max).max() for x in (a, left, right))),
        jerk=float(1.0 - max((np.abs(x) / j_max).max() for x in (jerks, steps))),
        consistent=bool(np.allclose(left, a[:-1], atol=1e-4) and np.allclose(right, a[1:], atol=1e-4)),
        ends_at_rest=bool(np.abs(np.concatenate([v[[0, -1]], a[[0, -1]]])).max() < 1e-9),
    )


class SelfCollisions(NamedTuple):
    """Samples of a trajectory at which the robot collides with itself."""

    samples: int
    first: str  # the first pair, and when; empty without a collision
    pairs: int  # of shapes that were checked


def find_self_collisions(robot: Robot, time: np.ndarray, u: np.ndarray) -> SelfCollisions:
    """Check every sample with the robot's own shapes, not their hulls.

    The pairs are those of `select_pairs`; what the controller leaves out of them has no part in it.
    """
    pairs = select_pairs(robot)
    shapes = pin.GeometryModel(robot.geometry)
    for i, j in pairs:
        shapes.addCollisionPair(pin.CollisionPair(i, j))
    data, geometry = robot.model.createData(), shapes.createData()
    boxes = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(robot.model, shapes, geometry)
    hits = [
        k for k in range(len(u)) if pin.computeCollisions(robot.model, data, boxes, robot.configuration(u[k]), True)
    ]
    first = ""
    if hits:
        pin.computeCollisions(robot.model, data, shapes, geometry, robot.configuration(u[hits[0]]), True)
        pair = next(pairs[k] for k, result in enumerate(geometry.collisionResults) if result.isCollision())
        names = " and ".join(shapes.geometryObjects[i].name for i in pair)
        first = f"{names} at {float(time[hits[0]]):.2f} s"
    return SelfCollisions(len(hits), first, len(pairs))
