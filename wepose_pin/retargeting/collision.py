"""Self-collision: which shapes may touch, how far apart the near ones are, and how that changes with the joints."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin

from ..compilation import compiled
from ..errors import BadModel
from .robot import Robot

CLEARANCE = 0.02  # [m] that the solver keeps between hulls
# [m] from where on a pair is watched: what two hands that swing towards each other at 2 m/s need to stop, at the
# 6 m/s² of joints that brake at half of 5 rad/s² each (talos).
NEAR = 0.35
_SAMPLES = 1000  # random configurations that tell what touches always, or never; fewer where pairs are many
_MOST_TESTS = 400_000
_FEW = 3  # joints between two shapes that can be sampled densely
_GRID = 9  # values of each of them, the ends of its range included: there links of one arm touch, if anywhere
_ALWAYS = 0.95  # share of them in which such a pair does


class Near(NamedTuple):
    """Pairs that are near."""

    distance: np.ndarray  # (m,) [m]
    growth: np.ndarray  # (m, nv) of the distance with the joints
    clearance: np.ndarray  # (m,) [m] that is to be kept


class Shapes:
    """What may touch, each shape as its convex hull: quick, and the nearest points move smoothly.

    A pair is left out that cannot come together or always is: on one joint, of links that follow each other, excused by
    the SRDF, touching at rest, touching wherever the joints are, or, few joints apart on one arm, touching nowhere.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.hulls, body = hulls(robot)
        self.pairs = sorted({(min(a, b), max(a, b)) for i, j in allowed_pairs(robot) for a, b in [(body[i], body[j])]})
        for i, j in self.pairs:
            self.hulls.addCollisionPair(pin.CollisionPair(i, j))
        self.data = self.hulls.createData()
        objects = self.hulls.geometryObjects
        for shape in objects:
            shape.geometry.computeLocalAABB()
        self._joint = np.array([shape.parentJoint for shape in objects], dtype=int)
        self._centre = np.array([shape.placement.act(shape.geometry.aabb_center) for shape in objects]).reshape(-1, 3)
        self._radius = np.array([shape.geometry.aabb_radius for shape in objects])
        self._first, self._second = (np.array([pair[k] for pair in self.pairs], dtype=int) for k in (0, 1))
        self._apart = self._radius[self._first] + self._radius[self._second] + NEAR
        self._moves = _supports(robot.model)
        self.clearance = self._clearances()
        self._viewed: Any = None
        self._rotations: list[np.ndarray] = []
        self._translations: list[np.ndarray] = []

    def near(self, data: Any) -> Near:
        """Pairs within `NEAR`; `data` of the model holds the joints' placements and Jacobian."""
        n = self.robot.model.nv
        if not len(self.pairs):
            return Near(np.empty(0), np.empty((0, n)), np.empty(0))
        if data is not self._viewed:  # views into Pinocchio's memory: asking for them anew costs more than the rest
            self._viewed = data
            self._rotations = [placement.rotation for placement in data.oMi]
            self._translations = [placement.translation for placement in data.oMi]
        R, p = np.array(self._rotations), np.array(self._translations)
        centre = np.einsum("kij,kj->ki", R[self._joint], self._centre) + p[self._joint]
        gap = centre[self._first] - centre[self._second]
        close = np.flatnonzero(np.einsum("ki,ki->k", gap, gap) < self._apart**2)
        if not len(close):
            return Near(np.empty(0), np.empty((0, n)), np.empty(0))
        pin.updateGeometryPlacements(self.robot.model, data, self.hulls, self.data)
        found, which = [], []
        for k in close.tolist():
            result = pin.computeDistance(self.hulls, self.data, k)
            d = result.min_distance
            if d < NEAR:
                found.append((d, *result.getNearestPoint1(), *result.getNearestPoint2()))
                which.append(k)
        if not found:
            return Near(np.empty(0), np.empty((0, n)), np.empty(0))
        table = np.array(found)
        distance, a, b = table[:, 0], table[:, 1:4], table[:, 4:7]
        first, second = self._joint[self._first[which]], self._joint[self._second[which]]
        growth = _growth(distance, a, b, data.J, self._moves[first], self._moves[second])
        return Near(distance, growth, self.clearance[which])

    def _clearances(self) -> np.ndarray:
        """(pairs,) [m] `CLEARANCE`; of hulls nearer than that at rest half of what is there, or none."""
        data = self.robot.model.createData()
        pin.forwardKinematics(self.robot.model, data, self.robot.q(self.robot.rest))
        pin.updateGeometryPlacements(self.robot.model, data, self.hulls, self.data)
        found = [pin.computeDistance(self.hulls, self.data, k).min_distance for k in range(len(self.pairs))]
        return np.array([min(CLEARANCE, 0.5 * d if d > 0.0 else d) for d in found])


@compiled
def _growth(distance, a, b, J, first, second):  # type: ignore[no-untyped-def]
    """(m, nv) how distances between points `a` and `b` (m, 3) change with the joints `first` and `second` move."""
    growth = np.empty((len(distance), J.shape[1]))
    away = np.empty(3)
    for k in range(len(distance)):
        size = 0.0
        for i in range(3):
            away[i] = a[k, i] - b[k, i]
            size += away[i] ** 2
        size = max(np.sqrt(size), 1e-9) * (-1.0 if distance[k] < 0.0 else 1.0)
        for i in range(3):
            away[i] /= size
        for j in range(J.shape[1]):
            linear = away[0] * J[0, j] + away[1] * J[1, j] + away[2] * J[2, j]
            turn = 0.0  # (a × away) · ω of the one, less (b × away) · ω of the other
            other = 0.0
            for i in range(3):
                y, z = (i + 1) % 3, (i + 2) % 3
                turn += (a[k, y] * away[z] - a[k, z] * away[y]) * J[3 + i, j]
                other += (b[k, y] * away[z] - b[k, z] * away[y]) * J[3 + i, j]
            growth[k, j] = first[k, j] * (linear + turn) - second[k, j] * (linear + other)
    return growth


def hulls(robot: Robot) -> tuple[Any, list[int]]:
    """Convex hulls, and of each shape of the robot which it is in; all that is rigid with a hand is in one."""
    made, body = pin.GeometryModel(), []
    last = {int(robot.model.frames[arm.hand].parentJoint) for arm in robot.arms}
    hand: dict[int, list[Any]] = {}
    for shape in robot.shapes.geometryObjects:
        if shape.parentJoint in last and shape.parentJoint in hand:
            hand[shape.parentJoint].append(shape)
            body.append(made.getGeometryId(f"hand {shape.parentJoint}"))
            continue
        geometry = shape.geometry
        name, placement = shape.name, shape.placement
        if shape.parentJoint in last:
            hand[shape.parentJoint] = [shape]
            name = f"hand {shape.parentJoint}"
        elif hasattr(geometry, "buildConvexHull"):
            geometry.buildConvexHull(True, "Qt")
            geometry = geometry.convex
        body.append(
            made.addGeometryObject(pin.GeometryObject(name, shape.parentJoint, shape.parentFrame, placement, geometry))
        )
    for joint, shapes in hand.items():
        whole = made.geometryObjects[made.getGeometryId(f"hand {joint}")]
        points = np.vstack([_corners(shape) for shape in shapes])
        corners = coal.StdVec_Vec3s()
        corners.extend(list(points))
        whole.geometry = coal.Convex.convexHull(corners, True, "Qt")
        whole.placement = pin.SE3.Identity()
    return made, body


def _corners(shape: Any) -> np.ndarray:
    """Points in the joint's frame whose hull holds the shape; of round ones the box around them."""
    geometry = shape.geometry
    if hasattr(geometry, "buildConvexHull"):
        points = np.asarray(geometry.vertices())
    else:
        geometry.computeLocalAABB()
        box = geometry.aabb_local
        points = np.array(list(product(*zip(box.min_, box.max_, strict=True))))
    return points @ shape.placement.rotation.T + shape.placement.translation


def allowed_pairs(robot: Robot) -> list[tuple[int, int]]:
    """Pairs of shapes that must not touch."""
    objects, full = robot.shapes.geometryObjects, robot.full
    links = [full.frames[full.getFrameId(_link(shape.name))].name for shape in objects]
    excused = _excused(robot.map.srdf) if robot.map.srdf else set()
    after = _following(full, set(links))
    candidates = [
        (i, j)
        for i in range(len(objects))
        for j in range(i + 1, len(objects))
        if objects[i].parentJoint != objects[j].parentJoint
        and frozenset((links[i], links[j])) not in excused
        and frozenset((links[i], links[j])) not in after
    ]
    if not candidates:
        return []
    shapes = pin.GeometryModel(robot.shapes)
    for i, j in candidates:
        shapes.addCollisionPair(pin.CollisionPair(i, j))
    data, geometry = robot.model.createData(), shapes.createData()
    rng = np.random.default_rng(0)
    low, high = np.clip(robot.lower, -np.pi, np.pi), np.clip(robot.upper, -np.pi, np.pi)
    touching, samples = np.zeros(len(candidates)), min(_SAMPLES, _MOST_TESTS // len(candidates))
    for _ in range(samples):
        pin.computeCollisions(robot.model, data, shapes, geometry, robot.q(rng.uniform(low, high)), False)
        touching += [result.isCollision() for result in geometry.collisionResults]
    pin.computeCollisions(robot.model, data, shapes, geometry, robot.q(robot.rest), False)
    at_rest = [result.isCollision() for result in geometry.collisionResults]
    return [
        pair
        for pair, often, rests in zip(candidates, touching, at_rest, strict=True)
        if often < _ALWAYS * samples and not rests and not (often == 0 and _never_touch(robot, shapes, pair))
    ]


def _never_touch(robot: Robot, shapes: Any, pair: tuple[int, int]) -> bool:
    """Whether at most `_FEW` joints lie between the shapes, on one arm, and a grid of their values has no contact."""
    objects, model = shapes.geometryObjects, robot.model
    a, b = sorted(int(objects[k].parentJoint) for k in pair)
    moving = np.zeros(len(robot.names), dtype=bool)
    joints = 0
    while b > a:
        moving |= robot.coupling[model.idx_vs[b]] != 0.0
        b, joints = model.parents[b], joints + 1
    if b < a or joints > _FEW:
        return False
    low, high = np.clip(robot.lower, -np.pi, np.pi), np.clip(robot.upper, -np.pi, np.pi)
    data, geometry, u = model.createData(), shapes.createData(), robot.rest.copy()
    k = shapes.findCollisionPair(pin.CollisionPair(*pair))
    for values in product(*(np.linspace(low[j], high[j], _GRID) for j in np.flatnonzero(moving))):
        u[moving] = values
        pin.updateGeometryPlacements(model, data, shapes, geometry, robot.q(u))
        if pin.computeCollision(shapes, geometry, k):
            return False
    return True


def _link(shape: str) -> str:
    """Pinocchio names a shape after its link: LINK_0, LINK_1, …"""
    return shape.rpartition("_")[0]


def _following(full: Any, shaped: set[str]) -> set[frozenset[str]]:
    """Links that follow each other: only joints between them, and links without a shape (`shaped` have one)."""
    on: dict[int, list[str]] = {}
    for frame in full.frames:
        if frame.type == pin.FrameType.BODY and frame.name in shaped:
            on.setdefault(frame.parentJoint, []).append(frame.name)
    found = set()
    for joint in range(1, full.njoints):
        top, above = joint, full.parents[joint]
        while above > 0 and above not in on:
            top, above = above, full.parents[above]
        before = on[above] if above > 0 else [full.frames[_root_side(full, top)].name]
        found |= {frozenset((a, b)) for a in on.get(joint, []) for b in before}
    return found


def _root_side(full: Any, joint: int) -> int:
    """The link that carries a joint of the root's."""
    frame = full.frames[full.getFrameId(full.names[joint])].parentFrame
    while full.frames[frame].type != pin.FrameType.BODY:
        frame = full.frames[frame].parentFrame
    return int(frame)


def _excused(srdf: Path) -> set[frozenset[str]]:
    try:
        root = ElementTree.parse(srdf).getroot()
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BadModel(f"{srdf}: not valid XML: {error}") from error
    return {frozenset((pair.get("link1", ""), pair.get("link2", ""))) for pair in root.iter("disable_collisions")}


def _supports(model: Any) -> np.ndarray:
    """(njoints, nv): 1 where a joint's placement depends on a velocity."""
    found = np.zeros((model.njoints, model.nv))
    for joint in range(1, model.njoints):
        found[joint] = found[model.parents[joint]]
        found[joint, model.idx_vs[joint] : model.idx_vs[joint] + model.nvs[joint]] = 1.0
    return found
