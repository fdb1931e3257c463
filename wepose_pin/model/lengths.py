"""The lengths of a body: measured between its points, and set by stretching its segments."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..recording import SEGMENTS
from ..subject import LENGTHS
from .table import POINTS
from .tree import Tree, parse_tree

_TOLERANCE = 1e-13  # [m]
_MOST_ROUNDS = 50  # one is enough where every point lies on its joint

# Lengths of an arm's segments: from the first point to the second, which is where the next segment begins.
ENDS = {
    f"{side}_{part}": (f"{side}_{first}", f"{side}_{last}")
    for side in ("left", "right")
    for part, first, last in (
        ("upper_arm", "shoulder", "elbow"),
        ("forearm", "elbow", "wrist"),
        ("hand", "wrist", "palm"),
    )
}


def lengths(robot: Any) -> dict[str, float]:
    """The lengths [m] between the points of `robot` (yourdfpy), all joints at zero; those that it has."""
    at = _points(parse_tree(robot, robot.name))
    measured = {name: float(np.linalg.norm(at[b] - at[a])) for name, (a, b) in ENDS.items() if a in at and b in at}
    if "left_shoulder" in at and "right_shoulder" in at:
        measured["shoulder_width"] = float(np.linalg.norm(at["left_shoulder"] - at["right_shoulder"]))
        measured["trunk"] = float(np.linalg.norm(at["left_shoulder"] + at["right_shoulder"]) / 2.0)
    return {name: measured[name] for name in LENGTHS if name in measured}


def with_lengths(robot: Any, targets: Mapping[str, float]) -> Any:
    """A copy of the robot with these lengths [m], each of which it has.

    An arm's segment stretches along the line between its ends, the trunk along the lines from W's origin to the middle
    of the shoulders and from shoulder to shoulder, all joints at zero.
    """
    robot = copy.deepcopy(robot)
    for _ in range(_MOST_ROUNDS):
        own = lengths(robot)
        ratio = {name: value / own[name] for name, value in targets.items() if abs(own[name] - value) > _TOLERANCE}
        if not ratio:
            break
        _stretch(robot, ratio)
    return robot


def _points(tree: Tree) -> dict[str, np.ndarray]:
    return {point: tree.neutral(link)[:3, 3] for point, link in POINTS.items() if link in tree.below}


def _stretch(robot: Any, ratio: Mapping[str, float]) -> None:
    """Make the lengths longer by `ratio`.

    To a segment belong all links from its own down to the next segments, to the torso also the spine below it, down to
    the pelvis or the root, which keep their shape.
    """
    tree = parse_tree(robot, robot.name)
    at = _points(tree)
    starts = {segment: tree.body(segment) for segment in SEGMENTS if segment in tree.below}
    of_link: dict[str, np.ndarray] = {}  # (3, 3) in W
    of_joint: dict[str, np.ndarray] = {}
    for segment, start in starts.items():
        S_W = _torso_stretch(at, ratio) if segment == "torso" else _arm_stretch(segment, at, ratio)
        if S_W is None:
            continue
        links = _links_between(tree, start, set(starts.values()))
        if segment == "torso":
            below = [joint.parent for joint in tree.path(start)]
            if starts.get("pelvis") in below:
                below = below[below.index(starts["pelvis"]) :]
            of_joint |= {joint.name: S_W for joint in tree.path(start) if joint.parent in below}
            links += below[1:]
        of_link |= dict.fromkeys(links, S_W)
        of_joint |= {joint.name: S_W for link in links for joint in tree.below[link]}
    for joint in robot.joints:
        if joint.name in of_joint and joint.origin is not None:
            joint.origin[:3, 3] = _rotate_to_link(tree, joint.parent, of_joint[joint.name]) @ joint.origin[:3, 3]
    for link in robot.links:
        if link.name in of_link:
            _stretch_link(link, _rotate_to_link(tree, link.name, of_link[link.name]))


def _arm_stretch(segment: str, at: Mapping[str, np.ndarray], ratio: Mapping[str, float]) -> np.ndarray | None:
    if segment not in ratio:
        return None
    first, last = ENDS[segment]
    along = (at[last] - at[first]) / np.linalg.norm(at[last] - at[first])
    return np.eye(3) + (ratio[segment] - 1.0) * np.outer(along, along)


def _torso_stretch(at: Mapping[str, np.ndarray], ratio: Mapping[str, float]) -> np.ndarray | None:
    if "trunk" not in ratio and "shoulder_width" not in ratio:
        return None
    up, across = at["left_shoulder"] + at["right_shoulder"], at["left_shoulder"] - at["right_shoulder"]
    basis = np.column_stack([np.cross(across, up), across, up])
    scale = np.diag([1.0, ratio.get("shoulder_width", 1.0), ratio.get("trunk", 1.0)])
    return basis @ scale @ np.linalg.inv(basis)


def _links_between(tree: Tree, start: str, others: set[str]) -> list[str]:
    """`start` and the links below it, without the links `others` and what is below them."""
    links, to_do = [], [start]
    while to_do:
        links.append(link := to_do.pop())
        to_do += [joint.child for joint in tree.below[link] if joint.child not in others]
    return links


def _rotate_to_link(tree: Tree, link: str, S_W: np.ndarray) -> np.ndarray:
    R_WK = tree.neutral(link)[:3, :3]
    return R_WK.T @ S_W @ R_WK


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
