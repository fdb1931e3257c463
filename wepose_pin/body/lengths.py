"""The lengths of a body: measured between its points, set by stretching its segments, and the ways to its points.

A point is p_W = Σ R_WK (B l + c) over the links K between the root and the point, with l the lengths: each link
contributes a vector that is affine in the lengths and constant in the link. The joints of a girdle stand at zero here:
what they add is in `girdle`.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from ..errors import BadModel
from .table import ROOT, BodyTable
from .tree import Tree, joint_placement, parse_tree

UNIVERSE = "universe"  # the link of what is rigid with the root
_TOLERANCE = 1e-9  # [m] by which a length may miss what it is set to
_LEAST = 1e-6  # [m] of a length
_DECIMALS = 13  # of a vector [m] and of its change per metre of a length; what is beyond is rounding


def measure_lengths(robot: Any, table: BodyTable) -> dict[str, float]:
    """The lengths [m] between the points of `robot` (yourdfpy), all joints at zero."""
    return {name: float(np.linalg.norm(v)) for name, v in _find_lines(parse_tree(robot, robot.name), table).items()}


def with_lengths(robot: Any, table: BodyTable, targets: Mapping[str, float]) -> Any:
    """Return a copy of the robot with these lengths [m]: segments stretch along their lines, all joints at zero."""
    robot = pickle.loads(pickle.dumps(robot, pickle.HIGHEST_PROTOCOL))  # several times as fast as `copy.deepcopy`
    tree, own = parse_tree(robot, robot.name), measure_lengths(robot, table)
    of_links, of_joints = _find_stretches(tree, table)
    placed = {link.name: tree.neutral(link.name)[:3, :3] for link in robot.links}

    def stretch(parts: Mapping[str, np.ndarray], R_WK: np.ndarray) -> np.ndarray:
        ratios = {name: targets.get(name, own[name]) / own[name] for name in parts}
        return R_WK.T @ (np.eye(3) + sum((ratios[name] - 1.0) * P for name, P in parts.items())) @ R_WK

    for joint in robot.joints:
        if joint.name in of_joints and joint.origin is not None:
            joint.origin[:3, 3] = stretch(of_joints[joint.name], placed[joint.parent]) @ joint.origin[:3, 3]
    for link in robot.links:
        if link.name in of_links:
            _stretch_link(link, stretch(of_links[link.name], placed[link.name]))
    reached = measure_lengths(robot, table)
    for name, value in targets.items():
        if abs(reached[name] - value) > _TOLERANCE:
            raise BadModel(
                f"{table.where}: lengths.{name}: stretching {table.lengths[name].segment} does not move its points "
                f"apart by as much; name the segment between them"
            )
    return robot


def _find_lines(tree: Tree, table: BodyTable) -> dict[str, np.ndarray]:
    """Length → the line (3,) [m] that it measures."""
    at = {ROOT: np.zeros(3)} | {name: tree.neutral(point.link)[:3, 3] for name, point in table.points.items()}

    def place(points: Sequence[str]) -> np.ndarray:
        return np.asarray(np.sum([at[point] for point in points], axis=0) / len(points))

    return {name: place(length.end) - place(length.start) for name, length in table.lengths.items()}


_Stretches = dict[str, dict[str, np.ndarray]]


def _find_stretches(tree: Tree, table: BodyTable) -> tuple[_Stretches, _Stretches]:
    """Link, and joint, → length → P (3, 3): S_W = 1 + Σ (ratio − 1) P stretches it, all joints at zero.

    What stretches with a segment are the links from its own down to the next segments, to one of the spine also the
    spine below it, down to the next segment or the root, which keep their shape.
    """
    lines, of_links, of_joints = _find_lines(tree, table), _Stretches(), _Stretches()
    starts = {tree.body(segment.link) for segment in table.segments.values()}
    for segment, own in table.segments.items():
        names = [name for name, length in table.lengths.items() if length.segment == segment]
        if not names:
            continue
        basis = np.array([lines[name] / max(np.linalg.norm(lines[name]), _LEAST) for name in names]).T  # (3, k)
        if np.linalg.matrix_rank(basis, tol=1e-6) < len(names):
            raise BadModel(
                f"{table.where}: lengths.{', lengths.'.join(names)}: cannot stretch segment '{segment}' independently; "
                f"up to three lengths in different directions are possible, between points in different places"
            )
        dual = np.linalg.pinv(basis)  # across the lines of one or two lengths nothing changes
        parts = {name: np.outer(basis[:, k], dual[k]) for k, name in enumerate(names)}
        start = tree.body(own.link)
        links, spine = tree.hanging(start, starts), tree.path(start) if own.spine else []
        spine = spine[max((k for k, joint in enumerate(spine) if joint.parent in starts), default=0) :]
        links += [joint.parent for joint in spine[1:]]
        of_links |= dict.fromkeys(links, parts)
        of_joints |= {joint.name: parts for link in links for joint in tree.below[link]}
        of_joints |= {joint.name: parts for joint in spine[:1]}
    return of_links, of_joints


def _stretch_link(link: Any, S: np.ndarray) -> None:
    """Stretch visuals, collisions and inertia of a link by S (3, 3) in its own coordinates."""
    for visual in [*link.visuals, *link.collisions]:
        if visual.origin is None:
            visual.origin = np.eye(4)
        along = np.linalg.norm(S @ visual.origin[:3, :3], axis=0)  # of the visual's own axes
        visual.origin[:3, 3] = S @ visual.origin[:3, 3]
        geometry = visual.geometry
        if geometry.box is not None:
            geometry.box.size = np.asarray(geometry.box.size) * along
        elif geometry.cylinder is not None:
            geometry.cylinder.length *= float(along[2])
        elif geometry.mesh is not None:
            scale = geometry.mesh.scale
            geometry.mesh.scale = (np.ones(3) if scale is None else np.asarray(scale) * np.ones(3)) * along
    inertial = link.inertial
    if inertial is None or not inertial.mass:
        return
    if inertial.origin is None:
        inertial.origin = np.eye(4)
    R, volume = inertial.origin[:3, :3], float(np.linalg.det(S))
    inertial.origin[:3, 3] = S @ inertial.origin[:3, 3]
    inertial.mass *= volume
    if inertial.inertia is not None:
        # The second moments Σ = ½ tr(I) 1 − I stretch as S Σ Sᵀ; mass goes with the volume.
        inertia = R @ inertial.inertia @ R.T
        second = volume * S @ (0.5 * np.trace(inertia) * np.eye(3) - inertia) @ S.T
        inertial.inertia = R.T @ (np.trace(second) * np.eye(3) - second) @ R


def measure_reaches(
    robot: Any, table: BodyTable, model: pin.Model, neutral: Mapping[str, np.ndarray]
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Measure point → link → its part of the way from the root, ``B @ lengths + c`` [m] in the link: B (3, k), c (3,).

    A link is a segment; what a joint between segments moves has the joint's name and frame, and what is rigid with the
    root is `UNIVERSE`. Lengths are in the order of the table.

    Parameters
    ----------
    robot, model : the body, in yourdfpy and in Pinocchio
    neutral : link → its R_WK (3, 3) with all joints at zero
    """
    tree = parse_tree(robot, robot.name)
    own = measure_lengths(robot, table)
    names = {joint: model.names[joint] for joint in range(model.njoints)}
    for segment in reversed(list(table.segments)):  # of segments that are rigid with one another the first
        names[model.frames[model.getFrameId(segment)].parentJoint] = segment
    _, stretches = _find_stretches(tree, table)
    follow = {joint for girdle in table.girdles.values() for joint in girdle.joints}
    reaches: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for point, place in table.points.items():
        sums: dict[str, np.ndarray] = {}  # (3, k + 1) [m] in the link: by each length's ratio, and what is left
        for joint in tree.path(place.link):
            if joint.type == "prismatic" and joint.name not in follow:
                raise BadModel(f"{robot.name}: joint '{joint.name}' slides: orientations do not tell where {point} is")
            if not model.existFrame(joint.parent):
                continue  # between the axes of a spherical joint
            link = names[model.frames[model.getFrameId(joint.parent)].parentJoint]
            step = tree.neutral(joint.parent)[:3, :3] @ joint_placement(joint)[:3, 3]
            parts = stretches.get(joint.name, {})
            columns = [parts[name] @ step if name in parts else np.zeros(3) for name in own]
            vectors = np.column_stack([*columns, step - np.sum(columns, axis=0) if columns else step])
            sums[link] = sums.get(link, 0.0) + neutral[link].T @ vectors
        reaches[point] = {}
        for link, vectors in sums.items():
            by_length = np.round(vectors[:, :-1] / list(own.values()), _DECIMALS) + 0.0  # no negative zeros
            constant = np.round(vectors[:, -1], _DECIMALS) + 0.0
            if by_length.any() or constant.any():
                reaches[point][link] = by_length, constant
    return reaches
