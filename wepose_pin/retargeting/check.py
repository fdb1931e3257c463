"""What a written trajectory keeps, found without the solver: the table, the URDF's limits, coal on its shapes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import polars as pl

from .collision import allowed_pairs
from .limits import urdf_limits
from .robot import Robot


class Kept(NamedTuple):
    """How far inside its limits a trajectory stays; below zero: outside."""

    position: float  # [rad or m] to the nearest position limit
    velocity: float  # share of the velocity limits that is never used
    acceleration: float  # of the acceleration limits, from second differences of the positions too
    even: bool  # each sample follows from the one before by its own velocity and acceleration
    jerk: float  # [rad/s³ or m/s³] the largest step of an acceleration over its time

    @property
    def all(self) -> bool:
        """Whether every limit is kept."""
        return min(self.position, self.velocity, self.acceleration) >= 0.0 and self.even


def kept(table: pl.DataFrame, urdf: Path, acceleration: Mapping[str, float]) -> Kept:
    """Limits of a table as in ``trajectory.parquet``, against the URDF and the map's accelerations."""
    said, time = urdf_limits(urdf), table["time"].to_numpy()
    joints = [name for name in table.columns if name in said]
    dt = np.diff(time)[:, None]
    q, v, a = (table.select([f"{j}{end}" for j in joints]).to_numpy() for end in ("", "_velocity", "_acceleration"))
    low, high, fast = (np.array([getattr(said[j], key) for j in joints]) for key in ("lower", "upper", "velocity"))
    hard = np.array([acceleration[j] for j in joints])
    mean = np.diff(q, axis=0) / dt
    seen = np.abs(np.diff(mean, axis=0) / dt[1:])
    return Kept(
        position=float(min((q - low).min(), (high - q).min())),
        velocity=float(1.0 - max((np.abs(v) / fast).max(), (np.abs(mean) / fast).max())),
        acceleration=float(1.0 - max((np.abs(a) / hard).max(), (seen / hard).max(initial=0.0))),
        even=bool(
            np.allclose(v[1:], v[:-1] + dt * a[:-1], atol=1e-6)
            and np.allclose(q[1:], q[:-1] + 0.5 * dt * (v[1:] + v[:-1]), atol=1e-6)
        ),
        jerk=float((np.abs(np.diff(a, axis=0)) / dt).max(initial=0.0)) if len(a) > 2 else 0.0,
    )


class Touching(NamedTuple):
    """Where a trajectory hits itself."""

    samples: int
    first: str  # which shapes, and when; empty where nothing touches


def touching(robot: Robot, time: np.ndarray, u: np.ndarray) -> Touching:
    """Every sample against the robot's own shapes (meshes as they are, not hulls)."""
    shapes = pin.GeometryModel(robot.shapes)
    for i, j in allowed_pairs(robot):
        shapes.addCollisionPair(pin.CollisionPair(i, j))
    data, geometry = robot.model.createData(), shapes.createData()
    boxes = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(robot.model, shapes, geometry)
    hits = [k for k in range(len(u)) if pin.computeCollisions(robot.model, data, boxes, robot.q(u[k]), True)]
    if not hits:
        return Touching(0, "")
    pin.computeCollisions(robot.model, data, shapes, geometry, robot.q(u[hits[0]]), True)
    return Touching(len(hits), _which(shapes, geometry, float(time[hits[0]])))


def _which(shapes: Any, geometry: Any, time: float) -> str:
    for k, result in enumerate(geometry.collisionResults):
        if result.isCollision():
            pair = shapes.collisionPairs[k]
            a, b = (shapes.geometryObjects[i].name for i in (pair.first, pair.second))
            return f"{a} and {b} at {time:.2f} s"
    return ""
