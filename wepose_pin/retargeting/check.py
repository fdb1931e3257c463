"""What a written trajectory keeps, found without the solver: the table, the URDF's limits, coal on its shapes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.interpolate import CubicHermiteSpline

from .limits import urdf_limits
from .robot import Robot


class Kept(NamedTuple):
    """How far inside its limits a trajectory stays; below zero: outside."""

    position: float  # [rad or m] to the nearest position limit
    velocity: float  # share of the velocity limits that is never used
    acceleration: float  # of the acceleration limits
    jerk: float  # of the jerk limits
    even: bool  # velocities and accelerations are those of one curve through the positions: cubics between samples
    rests: bool  # it begins and ends without velocity and acceleration

    @property
    def all(self) -> bool:
        """Whether every limit is kept."""
        return min(self.position, self.velocity, self.acceleration, self.jerk) >= 0.0 and self.even and self.rests


def kept(
    table: pl.DataFrame, urdf: Path, acceleration: Mapping[str, float], jerk: Mapping[str, float] | None = None
) -> Kept:
    """Limits of a table as in ``trajectory.parquet``, against the URDF and the map's accelerations and jerks.

    Looked at are the samples and ten places between each two, on the cubics through positions and velocities.
    """
    said, time = urdf_limits(urdf), table["time"].to_numpy()
    joints = [name for name in table.columns if name in said]
    q, v, a = (table.select([f"{j}{end}" for j in joints]).to_numpy() for end in ("", "_velocity", "_acceleration"))
    low, high, fast = (np.array([getattr(said[j], key) for j in joints]) for key in ("lower", "upper", "velocity"))
    hard = np.array([acceleration[j] for j in joints])
    sudden = np.array([jerk[j] if jerk else np.inf for j in joints])
    curve = CubicHermiteSpline(time, q, v)
    dense = np.unique(
        np.concatenate([time, (time[:-1, None] + np.diff(time)[:, None] * np.arange(0.1, 1.0, 0.1)).ravel()])
    )
    between, moving = curve(dense), curve(dense, 1)
    cubic, square = 6.0 * curve.c[0], 2.0 * curve.c[1]  # jerk of each step, acceleration at its beginning
    left, right = square, square + cubic * np.diff(time)[:, None]
    steps = np.abs(np.diff(a, axis=0)) / np.diff(time)[:, None]
    return Kept(
        position=float(min((between - low).min(), (high - between).min())),
        velocity=float(1.0 - max((np.abs(v) / fast).max(), (np.abs(moving) / fast).max())),
        acceleration=float(1.0 - max((np.abs(x) / hard).max() for x in (a, left, right))),
        jerk=float(1.0 - max((np.abs(x) / sudden).max() for x in (cubic, steps))),
        even=bool(np.allclose(left, a[:-1], atol=1e-4) and np.allclose(right, a[1:], atol=1e-4)),
        rests=bool(np.abs(np.concatenate([v[[0, -1]], a[[0, -1]]])).max() < 1e-9),
    )


class Touching(NamedTuple):
    """Where a trajectory hits itself."""

    samples: int
    first: str  # which shapes, and when; empty where nothing touches
    pairs: int  # of shapes that were looked at
    left_out: dict[str, list[str]]  # why → which pairs were not


def touching(robot: Robot, time: np.ndarray, u: np.ndarray) -> Touching:
    """Every sample against the robot's own shapes, meshes as they are and not hulls; by a rule of its own for pairs.

    Left out are shapes of one part, or of parts that follow each other; what the robot's SRDF excuses; and what
    touches in the rest posture. The solver's rule, which looks at what can touch at all, has no part in it.
    """
    shapes, left_out = _pairs(robot)
    data, geometry = robot.model.createData(), shapes.createData()
    boxes = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(robot.model, shapes, geometry)
    hits = [k for k in range(len(u)) if pin.computeCollisions(robot.model, data, boxes, robot.q(u[k]), True)]
    first = ""
    if hits:
        pin.computeCollisions(robot.model, data, shapes, geometry, robot.q(u[hits[0]]), True)
        first = _which(shapes, geometry, float(time[hits[0]]))
    return Touching(len(hits), first, len(shapes.collisionPairs), left_out)


def _pairs(robot: Robot) -> tuple[Any, dict[str, list[str]]]:
    """The shapes with the pairs to look at, and those left out by their reason."""
    shapes, parents = pin.GeometryModel(robot.shapes), robot.model.parents
    shapes.addAllCollisionPairs()  # of different parts
    left_out: dict[str, list[str]] = {"excused by the SRDF": [], "next to each other": [], "touch at rest": []}

    def there() -> list[tuple[int, int]]:
        return [(pair.first, pair.second) for pair in shapes.collisionPairs]

    def leave(reason: str, pairs: list[tuple[int, int]]) -> None:
        for a, b in pairs:
            left_out[reason].append(" - ".join(shapes.geometryObjects[i].name for i in (a, b)))
            if shapes.existCollisionPair(pin.CollisionPair(a, b)):
                shapes.removeCollisionPair(pin.CollisionPair(a, b))

    if robot.map.srdf is not None:
        before = there()
        pin.removeCollisionPairs(robot.model, shapes, str(robot.map.srdf))
        leave("excused by the SRDF", sorted(set(before) - set(there())))
    on = [shape.parentJoint for shape in shapes.geometryObjects]
    above = {}
    for joint in on:
        above[joint] = parents[joint]
        while above[joint] > 0 and above[joint] not in on:  # a part without a shape
            above[joint] = parents[above[joint]]
    leave("next to each other", [(a, b) for a, b in there() if on[a] == above[on[b]] or on[b] == above[on[a]]])
    geometry = shapes.createData()
    pin.computeCollisions(robot.model, robot.model.createData(), shapes, geometry, robot.q(robot.rest), False)
    hit = [result.isCollision() for result in geometry.collisionResults]
    leave("touch at rest", [pair for pair, touches in zip(there(), hit, strict=True) if touches])
    return shapes, left_out


def _which(shapes: Any, geometry: Any, time: float) -> str:
    for k, result in enumerate(geometry.collisionResults):
        if result.isCollision():
            pair = shapes.collisionPairs[k]
            a, b = (shapes.geometryObjects[i].name for i in (pair.first, pair.second))
            return f"{a} and {b} at {time:.2f} s"
    return ""
