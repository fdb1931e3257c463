"""Self-collision: pairs of shapes that may collide, their distances with Jacobian, whether a way to rest is clear."""

from itertools import product
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin

from ..body.kinematics import find_columns
from ..compilation import compiled
from ..errors import BadModel
from .robot import TABLE_NAME, Robot

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
_END_SHARE = 0.3  # of the joints in them that are at an end of their range: there links of one arm collide, if anywhere
_FEW_JOINTS = 3  # between two links of an arm, of which the samples show all that matters
_ALWAYS = 0.95  # share of the samples in which a pair that always collides does


class NearPairs(NamedTuple):
    """Pairs of hulls within `NEAR`."""

    pairs: np.ndarray  # (m,) int, their indices
    distance: np.ndarray  # (m,) [m]
    jacobian: np.ndarray  # (m, n) of the distance
    clearance: np.ndarray  # (m,) [m] to keep


class CollisionModel:
    """The robot's shapes, each as its convex hull: fast, and the nearest points move smoothly.

    Its `pairs` of hulls are those of `copy_checked_shapes`, less those that collide in almost any posture, or, few
    joints apart on one arm, in none. Tasks leave the `clearance` (pairs,) [m]; no step and no stop goes below
    `least_distance`.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.hulls, hull_of = _build_hulls(robot)
        pairs = _leave_out_always_and_never(robot, copy_checked_shapes(robot))
        self.pairs = sorted({tuple(sorted((hull_of[i], hull_of[j]))) for i, j in pairs})
        for i, j in self.pairs:
            self.hulls.addCollisionPair(pin.CollisionPair(i, j))
        self.data, self._path_data = self.hulls.createData(), robot.model.createData()
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
        self._supports = np.zeros((robot.model.njoints, robot.model.nv))  # 1: the joint moves by that velocity
        for joint in range(1, robot.model.njoints):
            self._supports[joint, find_columns(robot.model, robot.model.supports[joint].tolist()[1:])] = 1.0
        # Hulls closer than the clearance in the rest posture keep half of their distance there, or their overlap.
        rest = self.compute_distances(robot.rest, np.arange(len(self.pairs)))
        self.clearance = np.minimum(CLEARANCE, np.where(rest > 0.0, 0.5 * rest, rest))
        overlapping = self.clearance <= 0.0
        self.least_distance = np.where(overlapping, self.clearance - OVERLAP, LEAST_SHARE * self.clearance)
        self.levers = self._compute_levers(radius)
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
        for k in (close != self._active).nonzero()[0].tolist():  # Pinocchio computes the distances of active pairs
            (self.data.activateCollisionPair if close[k] else self.data.deactivateCollisionPair)(k)
        self._active = close
        if not close.any():
            return self._none
        pin.updateGeometryPlacements(self.robot.model, data, self.hulls, self.data)
        pin.computeDistances(self.hulls, self.data)
        results = self.data.distanceResults
        near = [(k, result) for k in close.nonzero()[0].tolist() if (result := results[k]).min_distance < NEAR]
        if not near:
            return self._none
        indices = np.array([k for k, _ in near])
        distance = np.array([result.min_distance for _, result in near])
        a = np.concatenate([result.getNearestPoint1() for _, result in near]).reshape(-1, 3)
        b = np.concatenate([result.getNearestPoint2() for _, result in near]).reshape(-1, 3)
        first, second = self._joint[self._first[indices]], self._joint[self._second[indices]]
        J = np.ascontiguousarray(data.J)
        jacobian = _compute_distance_jacobian(distance, a, b, J, self._supports[first], self._supports[second])
        return NearPairs(indices, distance, jacobian, self.clearance[indices])

    def is_path_clear(self, distance: np.ndarray, path: np.ndarray, travel: np.ndarray) -> bool:
        """Return whether all pairs keep their least distance on a way to rest.

        The way is halved until each part is covered: from the distance of a pair follows how far its joints may move
        before the hulls can meet, by the length of the links between (as in conservative advancement, Mirtich 1996).
        `distance` (pairs,) [m] is at the beginning, a lower bound where a pair is far; `path` (m, n) are joint
        positions, the first after one step, and `travel` (m, n) the largest way of each joint in each step.
        """
        room_before = distance - self.least_distance
        critical = (self.levers @ travel.sum(axis=0) >= room_before).nonzero()[0]
        if not len(critical):
            return True
        # Along the way a pair comes nearer by `approach` at most: enough room at both ends of a part covers the part.
        approach = np.vstack([np.zeros(len(critical)), np.cumsum(travel @ self.levers[critical].T, axis=0)])
        room = {0: room_before[critical]}
        parts = [(0, len(path))]
        while parts:
            begin, end = parts.pop()
            for at in (begin, end):
                if at not in room:
                    room[at] = self.compute_distances(path[at - 1], critical) - self.least_distance[critical]
                    if (room[at] < 0.0).any():
                        return False
            covered = approach[end] - approach[begin] < room[begin] + room[end]
            if end - begin > 1 and not covered.all():
                middle = (begin + end) // 2
                parts += [(middle, end), (begin, middle)]
        return True

    def compute_distances(self, position: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Distances [m] of some `pairs` (indices) at joint positions (n,)."""
        pin.forwardKinematics(self.robot.model, self._path_data, self.robot.configuration(position))
        pin.updateGeometryPlacements(self.robot.model, self._path_data, self.hulls, self.data)
        return np.array([pin.computeDistance(self.hulls, self.data, k).min_distance for k in pairs.tolist()])

    def _compute_levers(self, radius: np.ndarray) -> np.ndarray:
        """(pairs, n) [m per rad or m] by which a pair's distance changes at most where a joint moves.

        That is the length of the links from the joint to the far end of the shape, in whatever posture.
        """
        model = self.robot.model
        largest = np.maximum(*np.abs(self.robot.bounds))  # [m] of a joint that slides
        slides = [model.joints[k].shortname().startswith("JointModelP") for k in range(model.njoints)]
        levers = np.zeros((len(radius), model.nv))
        for shape, joint in enumerate(self._joint.tolist()):
            length = float(np.linalg.norm(self._centre[shape]) + radius[shape])
            while joint > 0:
                v = model.idx_vs[joint]
                levers[shape, v] = 1.0 if slides[joint] else length
                length += float(np.linalg.norm(model.jointPlacements[joint].translation))
                length += largest[v] if slides[joint] else 0.0
                joint = model.parents[joint]
        first, second = levers[self._first], levers[self._second]
        return np.where((first > 0.0) & (second > 0.0), 0.0, first + second)  # a joint that carries both changes none


@compiled
def _find_close(R, p, joint, centre, first, second, reach):  # type: ignore[no-untyped-def]
    """(pairs,) bool: the spheres around two shapes overlap; `reach` (pairs,) [m] is the sum of both radii.

    `R` (njoints, 3, 3) and `p` (njoints, 3) place the joints, `centre` (shapes, 3) is that of a sphere in its `joint`'s
    frame.
    """
    placed = np.empty(centre.shape)
    for k in range(len(centre)):
        placed[k] = R[joint[k]] @ centre[k] + p[joint[k]]
    close = np.empty(len(first), dtype=np.bool_)
    for k in range(len(first)):
        away = placed[first[k]] - placed[second[k]]
        close[k] = away @ away < reach[k] ** 2
    return close


@compiled
def _compute_distance_jacobian(distance, a, b, J, first, second):  # type: ignore[no-untyped-def]
    """(m, nv) of distances between points `a` and `b` (m, 3), moved by the joints `first` and `second` (m, nv)."""
    jacobian = np.empty((len(distance), J.shape[1]))
    for k in range(len(distance)):
        away = a[k] - b[k]
        away /= max(np.sqrt(away @ away), 1e-9) * (-1.0 if distance[k] < 0.0 else 1.0)
        linear = away @ J[:3]
        jacobian[k] = first[k] * (linear + np.cross(a[k], away) @ J[3:])
        jacobian[k] -= second[k] * (linear + np.cross(b[k], away) @ J[3:])
    return jacobian


def _build_hulls(robot: Robot) -> tuple[Any, dict[int, int]]:
    """Convex hulls, and the index of its hull for each shape; all shapes rigid with a hand share one hull."""
    hands = {int(robot.model.frames[arm.hand].parentJoint) for arm in robot.arms}
    shapes, groups = list(robot.geometry.geometryObjects), dict[tuple[bool, str], list[int]]()
    for k, shape in enumerate(shapes):
        is_hand = shape.parentJoint in hands
        groups.setdefault((is_hand, f"hand {shape.parentJoint}" if is_hand else shape.name), []).append(k)
    model, hull_of = pin.GeometryModel(), dict[int, int]()
    for (is_hand, name), own in groups.items():
        shape = shapes[own[0]]
        geometry, placement = shape.geometry, shape.placement
        if is_hand:
            corners = coal.StdVec_Vec3s()
            corners.extend(list(np.vstack([list_corners(shapes[k]) for k in own])))
            geometry, placement = coal.Convex.convexHull(corners, True, "Qt"), pin.SE3.Identity()
        elif hasattr(geometry, "buildConvexHull"):
            geometry.buildConvexHull(True, "Qt")
            geometry = geometry.convex
        hull = pin.GeometryObject(name, shape.parentJoint, shape.parentFrame, placement, geometry)
        hull_of |= dict.fromkeys(own, model.addGeometryObject(hull))
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


def copy_checked_shapes(robot: Robot) -> Any:
    """Return the robot's shapes with the pairs of them that must not collide.

    Left out are shapes of one part, pairs that the SRDF disables, adjacent links, and what collides in the rest
    posture.

    Raises
    ------
    BadModel
        A part is in the table in the rest posture; the SRDF is not XML.
    """
    shapes = pin.GeometryModel(robot.geometry)
    shapes.addAllCollisionPairs()  # of different parts
    names = [shape.name for shape in shapes.geometryObjects]
    links = [name.rpartition("_")[0] for name in names]  # Pinocchio names a shape after its link: LINK_0, LINK_1, …
    disabled = set() if robot.map.srdf is None else read_disabled_pairs(robot.map.srdf)
    adjacent = _find_adjacent_links(robot.full, set(links))
    data, q = shapes.createData(), robot.configuration(robot.rest)
    pin.computeCollisions(robot.model, robot.model.createData(), shapes, data, q, False)
    pairs = []
    for pair, result in zip(shapes.collisionPairs, data.collisionResults, strict=True):
        own = (names[pair.first], names[pair.second])
        ends = frozenset((links[pair.first], links[pair.second]))
        if result.isCollision() and TABLE_NAME in own:
            raise BadModel(
                f"{robot.map.where}: rest, table: {own[own[0] == TABLE_NAME]} is in the table in the rest posture; "
                "give a rest above it, or another table"
            )
        if ends not in disabled and ends not in adjacent and not result.isCollision():
            pairs.append(pin.CollisionPair(pair.first, pair.second))
    shapes.removeAllCollisionPairs()
    for pair in pairs:
        shapes.addCollisionPair(pair)
    return shapes


def _leave_out_always_and_never(robot: Robot, shapes: Any) -> list[tuple[int, int]]:
    """The shapes' pairs without those that collide in almost any posture, or, few joints apart on one arm, in none."""
    pairs = [(pair.first, pair.second) for pair in shapes.collisionPairs]
    if not pairs:
        return []
    data, geometry = robot.model.createData(), shapes.createData()
    rng, ends, n = np.random.default_rng(0), np.array(robot.bounds), len(robot.names)
    hits, samples = np.zeros(len(pairs)), min(_SAMPLES, _MAX_TESTS // len(pairs))
    for _ in range(samples):
        at_end = ends[rng.integers(0, 2, n), np.arange(n)]
        u = np.where(rng.random(n) < _END_SHARE, at_end, rng.uniform(*ends))
        pin.computeCollisions(robot.model, data, shapes, geometry, robot.configuration(u), False)
        hits += [result.isCollision() for result in geometry.collisionResults]
    kept = []
    for (i, j), count in zip(pairs, hits.tolist(), strict=True):
        first, last = sorted(shapes.geometryObjects[k].parentJoint for k in (i, j))
        for _ in range(_FEW_JOINTS):  # towards the root
            last = robot.model.parents[last] if last > first else last
        if count < _ALWAYS * samples and (count > 0 or last != first):
            kept.append((i, j))
    return kept


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
        if parent > 0:
            parents = links_of[parent]
        else:  # of the root only the link that carries the joint
            frame = full.frames[full.getFrameId(full.names[top], pin.FrameType.JOINT)]
            while frame.type != pin.FrameType.BODY:
                frame = full.frames[frame.parentFrame]
            parents = [frame.name]
        pairs |= {frozenset((a, b)) for a in links_of.get(joint, []) for b in parents}
    return pairs


def read_disabled_pairs(srdf: Path) -> set[frozenset[str]]:
    """Read the pairs of links that an SRDF leaves out of collisions."""
    try:
        root = ElementTree.parse(srdf).getroot()
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BadModel(f"{srdf}: not valid XML: {error}") from error
    return {frozenset((pair.get("link1", ""), pair.get("link2", ""))) for pair in root.iter("disable_collisions")}
