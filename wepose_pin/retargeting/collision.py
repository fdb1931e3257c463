"""Self-collision: pairs of shapes that may collide, their distances, and the Jacobian of these."""

from __future__ import annotations

from itertools import compress, product
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from ..compilation import compiled
from .limits import parse_xml
from .robot import Robot

CLEARANCE = 0.02  # [m] that the controller keeps between hulls
# [m] below which a pair has a constraint: two hands that approach at 2 m/s need it to stop, at the 6 m/s² of joints
# that brake at half of 5 rad/s² each (talos).
NEAR = 0.35
LEAST_SHARE = 0.25  # of the clearance: nearer than that no step leads, not even one to stop
OVERLAP = 0.005  # [m] by which hulls that overlap in the rest posture may overlap more
# Relative, of Coal's search for the nearest points. With its own 1e-6 the distance to a cylinder jumps by a micrometre
# from one posture to the next, however near, and its Jacobian by 0.002 m/rad. At 1e-12 the search fails now and then.
GJK_TOLERANCE = 1e-10
_SAMPLES = 1000  # random configurations that show which pairs collide always, or never; fewer where pairs are many
_MAX_TESTS = 400_000
_GRID_JOINTS = 3  # joints between two shapes that can be sampled on a grid
_GRID = 9  # values of each, with the ends of its range: there links of one arm collide, if anywhere
_ALWAYS = 0.95  # share of the samples in which a pair that always collides does


class NearPairs(NamedTuple):
    """Pairs of hulls within `NEAR`."""

    pairs: np.ndarray  # (m,) int, their indices
    distance: np.ndarray  # (m,) [m]
    jacobian: np.ndarray  # (m, nv) of the distance
    clearance: np.ndarray  # (m,) [m] to keep


class CollisionModel:
    """The robot's shapes, each as its convex hull: fast, and the nearest points move smoothly.

    Pairs are left out that cannot collide or always do: on one joint, of adjacent links, disabled in the SRDF, in
    collision in the rest posture or in almost any posture, or, few joints apart on one arm, in none.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.hulls, hull_of = build_hulls(robot)
        self.pairs = sorted({tuple(sorted((hull_of[i], hull_of[j]))) for i, j in find_collision_pairs(robot)})
        for i, j in self.pairs:
            self.hulls.addCollisionPair(pin.CollisionPair(i, j))
        self.data = self.hulls.createData()
        for request in self.data.distanceRequests:
            request.gjk_tolerance = GJK_TOLERANCE
        self._active = np.ones(len(self.pairs), dtype=bool)
        objects = self.hulls.geometryObjects
        for shape in objects:
            shape.geometry.computeLocalAABB()
        self._joint = np.array([shape.parentJoint for shape in objects], dtype=int)
        self._centre = np.array([shape.placement.act(shape.geometry.aabb_center) for shape in objects]).reshape(-1, 3)
        radius = np.array([shape.geometry.aabb_radius for shape in objects])
        self._first, self._second = (np.array([pair[k] for pair in self.pairs], dtype=int) for k in (0, 1))
        self._range = radius[self._first] + radius[self._second] + NEAR
        self._supports = _find_supporting_joints(robot.model)
        self.clearance = self._compute_clearances()
        self.least_distance = np.where(
            self.clearance > 0.0, LEAST_SHARE * self.clearance, self.clearance - OVERLAP
        )  # (pairs,) [m]
        self.levers = self._compute_levers(self._centre, radius)
        self._none = NearPairs(np.empty(0, dtype=int), np.empty(0), np.empty((0, robot.model.nv)), np.empty(0))
        self._viewed: Any = None
        self._rotations: list[np.ndarray] = []
        self._translations: list[np.ndarray] = []

    def find_near_pairs(self, data: Any) -> NearPairs:
        """Pairs within `NEAR`; `data` of the model holds joint placements and Jacobians."""
        if not len(self.pairs):
            return self._none
        if data is not self._viewed:  # views into Pinocchio's memory: to create them costs more than all the rest
            self._viewed = data
            self._rotations = [placement.rotation for placement in data.oMi]
            self._translations = [placement.translation for placement in data.oMi]
        R, p = np.array(self._rotations), np.array(self._translations)
        close = _find_close(R, p, self._joint, self._centre, self._first, self._second, self._range)
        if not close.any():
            return self._none
        self._activate(close)
        pin.updateGeometryPlacements(self.robot.model, data, self.hulls, self.data)
        pin.computeDistances(self.hulls, self.data)
        results = self.data.distanceResults
        near = [(k, result) for k in np.flatnonzero(close).tolist() if (result := results[k]).min_distance < NEAR]
        if not near:
            return self._none
        indices = np.array([k for k, _ in near])
        distance = np.array([result.min_distance for _, result in near])
        a = np.concatenate([result.getNearestPoint1() for _, result in near]).reshape(-1, 3)
        b = np.concatenate([result.getNearestPoint2() for _, result in near]).reshape(-1, 3)
        first, second = self._joint[self._first[indices]], self._joint[self._second[indices]]
        jacobian = _distance_jacobian(distance, a, b, data.J, self._supports[first], self._supports[second])
        return NearPairs(indices, distance, jacobian, self.clearance[indices])

    def _activate(self, pairs: np.ndarray) -> None:
        """Let Pinocchio compute the distances of these pairs (pairs,) bool only."""
        for k in np.flatnonzero(pairs != self._active).tolist():
            (self.data.activateCollisionPair if pairs[k] else self.data.deactivateCollisionPair)(k)
        self._active = pairs

    def name_pair(self, pair: int) -> str:
        """The names of the two shapes of a pair."""
        return " and ".join(self.hulls.geometryObjects[shape].name for shape in self.pairs[pair])

    def compute_distances(self, data: Any, pairs: np.ndarray) -> np.ndarray:
        """Distances [m] of some `pairs` (indices); `data` of the model holds joint placements."""
        pin.updateGeometryPlacements(self.robot.model, data, self.hulls, self.data)
        return np.array([pin.computeDistance(self.hulls, self.data, k).min_distance for k in pairs.tolist()])

    def _compute_clearances(self) -> np.ndarray:
        """(pairs,) [m] `CLEARANCE`; for hulls closer in the rest posture half of their distance, or their overlap."""
        data = self.robot.model.createData()
        pin.forwardKinematics(self.robot.model, data, self.robot.configuration(self.robot.rest))
        distances = self.compute_distances(data, np.arange(len(self.pairs)))
        return np.array([min(CLEARANCE, 0.5 * d if d > 0.0 else d) for d in distances])

    def _compute_levers(self, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """(pairs, n) [m per rad or m] by which a pair's distance changes at most where a joint moves.

        That is the length of the links from the joint to the far end of the shape, in whatever posture.
        """
        model, robot = self.robot.model, self.robot
        moves = np.abs(robot.coupling)
        largest = np.abs(robot.coupling) @ np.maximum(np.abs(robot.bounds[0]), np.abs(robot.bounds[1]))
        largest += np.abs(robot.offset)  # [m] of a joint that slides
        slides = np.array([model.joints[k].shortname().startswith("JointModelP") for k in range(model.njoints)])
        levers = np.zeros((2, len(self.pairs), model.nv))
        for end, shapes in enumerate((self._first, self._second)):
            for row, shape in enumerate(shapes.tolist()):
                joint, length = int(self._joint[shape]), float(np.linalg.norm(centre[shape]) + radius[shape])
                while joint > 0:
                    v = model.idx_vs[joint]
                    levers[end, row, v] = 1.0 if slides[joint] else length
                    length += float(np.linalg.norm(model.jointPlacements[joint].translation))
                    length += largest[v] if slides[joint] else 0.0
                    joint = model.parents[joint]
        common = (levers[0] > 0.0) & (levers[1] > 0.0)  # carries both shapes
        return np.where(common, 0.0, levers.sum(axis=0)) @ moves


@compiled
def _find_close(R, p, joint, centre, first, second, reach):  # type: ignore[no-untyped-def]
    """(pairs,) bool: the spheres around two shapes overlap; `reach` (pairs,) [m] is the sum of both radii.

    `R` (njoints, 3, 3) and `p` (njoints, 3) place the joints, `centre` (shapes, 3) is that of a sphere in its `joint`'s
    frame.
    """
    placed = np.empty(centre.shape)
    for k in range(len(centre)):
        for i in range(3):
            placed[k, i] = p[joint[k], i]
            for j in range(3):
                placed[k, i] += R[joint[k], i, j] * centre[k, j]
    close = np.empty(len(first), dtype=np.bool_)
    for k in range(len(first)):
        square = 0.0
        for i in range(3):
            square += (placed[first[k], i] - placed[second[k], i]) ** 2
        close[k] = square < reach[k] ** 2
    return close


@compiled
def _distance_jacobian(distance, a, b, J, first, second):  # type: ignore[no-untyped-def]
    """(m, nv) of distances between points `a` and `b` (m, 3), moved by the joints `first` and `second` (m, nv)."""
    jacobian = np.empty((len(distance), J.shape[1]))
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
            angular = 0.0  # (a × away) · ω of the first, minus (b × away) · ω of the second
            other = 0.0
            for i in range(3):
                y, z = (i + 1) % 3, (i + 2) % 3
                angular += (a[k, y] * away[z] - a[k, z] * away[y]) * J[3 + i, j]
                other += (b[k, y] * away[z] - b[k, z] * away[y]) * J[3 + i, j]
            jacobian[k, j] = first[k, j] * (linear + angular) - second[k, j] * (linear + other)
    return jacobian


def build_hulls(robot: Robot) -> tuple[Any, list[int]]:
    """Convex hulls, and the index of its hull for each shape; all shapes rigid with a hand share one hull."""
    model, hull_of = pin.GeometryModel(), []
    hand_joints = {int(robot.model.frames[arm.hand].parentJoint) for arm in robot.arms}
    hands: dict[int, list[Any]] = {}
    for shape in robot.geometry.geometryObjects:
        joint, geometry, name = shape.parentJoint, shape.geometry, shape.name
        if joint in hand_joints:
            name = f"hand {joint}"
            hands.setdefault(joint, []).append(shape)
            if len(hands[joint]) > 1:
                hull_of.append(model.getGeometryId(name))
                continue
        elif hasattr(geometry, "buildConvexHull"):
            geometry.buildConvexHull(True, "Qt")
            geometry = geometry.convex
        hull_of.append(
            model.addGeometryObject(pin.GeometryObject(name, joint, shape.parentFrame, shape.placement, geometry))
        )
    for joint, shapes in hands.items():
        hull = model.geometryObjects[model.getGeometryId(f"hand {joint}")]
        corners = coal.StdVec_Vec3s()
        corners.extend(list(np.vstack([list_corners(shape) for shape in shapes])))
        hull.geometry = coal.Convex.convexHull(corners, True, "Qt")
        hull.placement = pin.SE3.Identity()
    return model, hull_of


def list_corners(shape: Any) -> np.ndarray:
    """Return points (n, 3) [m] in the joint's frame whose hull contains a shape; of a round one its box's corners."""
    geometry = shape.geometry
    if hasattr(geometry, "buildConvexHull"):
        points = np.asarray(geometry.vertices())
    else:
        geometry.computeLocalAABB()
        box = geometry.aabb_local
        points = np.array(list(product(*zip(box.min_, box.max_, strict=True))))
    return points @ shape.placement.rotation.T + shape.placement.translation


def find_collision_pairs(robot: Robot) -> list[tuple[int, int]]:
    """Pairs of shapes that must not collide."""
    objects, full = robot.geometry.geometryObjects, robot.full
    links = [full.frames[full.getFrameId(_link_name(shape.name))].name for shape in objects]
    excluded = _find_adjacent_links(full, set(links))
    if robot.map.srdf is not None:
        excluded |= _read_disabled_pairs(robot.map.srdf)
    candidates = [
        (i, j)
        for i in range(len(objects))
        for j in range(i + 1, len(objects))
        if objects[i].parentJoint != objects[j].parentJoint and frozenset((links[i], links[j])) not in excluded
    ]
    if not candidates:
        return []
    shapes = pin.GeometryModel(robot.geometry)
    for i, j in candidates:
        shapes.addCollisionPair(pin.CollisionPair(i, j))
    data, geometry = robot.model.createData(), shapes.createData()

    def find_hits(u: np.ndarray) -> np.ndarray:
        pin.computeCollisions(robot.model, data, shapes, geometry, robot.configuration(u), False)
        return np.array([result.isCollision() for result in geometry.collisionResults])

    rng = np.random.default_rng(0)
    hits, samples = np.zeros(len(candidates)), min(_SAMPLES, _MAX_TESTS // len(candidates))
    for _ in range(samples):
        hits += find_hits(rng.uniform(*robot.bounds))
    checked = (hits < _ALWAYS * samples) & ~find_hits(robot.rest)
    seldom = {pair for pair, count in zip(candidates, hits, strict=True) if count == 0}
    never = _find_never_colliding(robot, shapes, seldom.intersection(compress(candidates, checked)))
    return [pair for pair, check in zip(candidates, checked, strict=True) if check and pair not in never]


def _find_never_colliding(robot: Robot, shapes: Any, pairs: set[tuple[int, int]]) -> set[tuple[int, int]]:
    """Pairs with few joints of one arm between them that collide in no posture on a grid of these joints."""
    by_joints: dict[tuple[int, ...], set[tuple[int, int]]] = {}
    for pair in pairs:
        joints = _find_joints_between(robot, *sorted(int(shapes.geometryObjects[k].parentJoint) for k in pair))
        if joints is not None:
            by_joints.setdefault(joints, set()).add(pair)
    low, high = robot.bounds
    data, geometry = robot.model.createData(), shapes.createData()
    for joints, clear in by_joints.items():
        indices = {pair: shapes.findCollisionPair(pin.CollisionPair(*pair)) for pair in clear}
        u = robot.rest.copy()
        for values in product(*(np.linspace(low[j], high[j], _GRID) for j in joints)):
            u[list(joints)] = values
            pin.updateGeometryPlacements(robot.model, data, shapes, geometry, robot.configuration(u))
            clear -= {pair for pair in clear if pin.computeCollision(shapes, geometry, indices[pair])}
            if not clear:
                break
    return set().union(*by_joints.values())


def _find_joints_between(robot: Robot, a: int, b: int) -> tuple[int, ...] | None:
    """The joints (of `Robot.names`) between two joints of the model; None where these are not on one arm, or many."""
    between, count = np.zeros(len(robot.names), dtype=bool), 0
    while b > a:
        between |= robot.coupling[robot.model.idx_vs[b]] != 0.0
        b, count = robot.model.parents[b], count + 1
    return tuple(np.flatnonzero(between).tolist()) if b == a and count <= _GRID_JOINTS else None


def _link_name(shape: str) -> str:
    """Pinocchio names a shape after its link: LINK_0, LINK_1, …"""
    return shape.rpartition("_")[0]


def _find_adjacent_links(full: Any, shaped: set[str]) -> set[frozenset[str]]:
    """Pairs of adjacent links: only joints between them, and links without a shape (`shaped` have one)."""
    links_of: dict[int, list[str]] = {}
    for frame in full.frames:
        if frame.type == pin.FrameType.BODY and frame.name in shaped:
            links_of.setdefault(frame.parentJoint, []).append(frame.name)
    pairs = set()
    for joint in range(1, full.njoints):
        top, parent = joint, full.parents[joint]
        while parent > 0 and parent not in links_of:
            top, parent = parent, full.parents[parent]
        parents = links_of[parent] if parent > 0 else [full.frames[_find_root_link(full, top)].name]
        pairs |= {frozenset((a, b)) for a in links_of.get(joint, []) for b in parents}
    return pairs


def _find_root_link(full: Any, joint: int) -> int:
    """The link of the root that carries a joint."""
    frame = full.frames[full.getFrameId(full.names[joint])].parentFrame
    while full.frames[frame].type != pin.FrameType.BODY:
        frame = full.frames[frame].parentFrame
    return int(frame)


def _read_disabled_pairs(srdf: Path) -> set[frozenset[str]]:
    root = parse_xml(srdf)
    return {frozenset((pair.get("link1", ""), pair.get("link2", ""))) for pair in root.iter("disable_collisions")}


def _find_supporting_joints(model: Any) -> np.ndarray:
    """(njoints, nv): 1 where the placement of a joint depends on a velocity."""
    supports = np.zeros((model.njoints, model.nv))
    for joint in range(1, model.njoints):
        supports[joint] = supports[model.parents[joint]]
        supports[joint, model.idx_vs[joint] : model.idx_vs[joint] + model.nvs[joint]] = 1.0
    return supports
