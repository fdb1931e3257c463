"""The lengths of a body: measured between its points, and set by stretching its segments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import BadModel
from .table import ROOT, BodyTable, Stretch
from .tree import Tree, copy_robot, parse_tree

_TOLERANCE = 1e-13  # [m]
_MOST_ROUNDS = 50  # one is enough where every point lies on its joint
_LEAST = 1e-6  # [m] of a length


def measure_lengths(robot: Any, table: BodyTable) -> dict[str, float]:
    """The lengths [m] between the points of `robot` (yourdfpy), all joints at zero; the mean where parts share one."""
    at = _points(parse_tree(robot, robot.name), table)
    return {
        name: float(np.mean([np.linalg.norm(_line(at, part)) for part in length.stretches]))
        for name, length in table.lengths.items()
    }


def with_lengths(robot: Any, table: BodyTable, targets: Mapping[str, float]) -> Any:
    """A copy of the robot with these lengths [m], each of which it has.

    A segment stretches along the line of its length, all joints at zero; one of several lengths along each of them.
    """
    robot = copy_robot(robot)
    for _ in range(_MOST_ROUNDS):
        own = measure_lengths(robot, table)
        ratio = {name: value / own[name] for name, value in targets.items() if abs(own[name] - value) > _TOLERANCE}
        if not ratio:
            break
        _stretch(robot, table, ratio)
    return robot


def check_lengths_scale(robot: Any, table: BodyTable) -> None:
    """Raise `BadModel` where a length's points lie in one place, or stretching its segment does not move them apart."""
    own = measure_lengths(robot, table)
    for name, value in own.items():
        if value < _LEAST:
            raise BadModel(f"{table.where}: lengths.{name}: its points lie in one place; it scales nothing")
    for name, value in own.items():
        changed = copy_robot(robot)
        _stretch(changed, table, {name: 1.1})
        if abs(measure_lengths(changed, table)[name] - 1.1 * value) > 0.05 * value:
            segments = " and ".join(part.segment for part in table.lengths[name].stretches)
            raise BadModel(
                f"{table.where}: lengths.{name}: scales nothing: stretching {segments} does not move its points apart; "
                f"name the segment between them"
            )


def _points(tree: Tree, table: BodyTable) -> dict[str, np.ndarray]:
    return {ROOT: np.zeros(3)} | {name: tree.neutral(point.link)[:3, 3] for name, point in table.points.items()}


def _line(at: Mapping[str, np.ndarray], part: Stretch) -> np.ndarray:
    """The line (3,) [m] that a length measures."""
    first, last = (np.sum([at[point] for point in points], axis=0) / len(points) for points in (part.start, part.end))
    return last - first


def _stretch(robot: Any, table: BodyTable, ratio: Mapping[str, float]) -> None:
    """Make the lengths longer by `ratio`.

    To a segment belong all links from its own down to the next segments, to one of the spine also the spine below it,
    down to the next segment or the root, which keep their shape.
    """
    tree = parse_tree(robot, robot.name)
    at = _points(tree, table)
    starts = {name: tree.body(segment.link) for name, segment in table.segments.items()}
    of_link: dict[str, np.ndarray] = {}  # (3, 3) in W
    of_joint: dict[str, np.ndarray] = {}
    for segment, start in starts.items():
        S_W = _segment_stretch(segment, table, at, ratio)
        if S_W is None:
            continue
        links = _links_between(tree, start, set(starts.values()))
        if table.segments[segment].spine:
            below = [joint.parent for joint in tree.path(start)]
            bases = [link for name, link in starts.items() if name != segment and link in below]
            if bases:
                below = below[max(below.index(link) for link in bases) :]
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


def _segment_stretch(
    segment: str, table: BodyTable, at: Mapping[str, np.ndarray], ratio: Mapping[str, float]
) -> np.ndarray | None:
    """The stretch (3, 3) in W of a segment by its lengths; None where none of them changes."""
    lines = [
        (_line(at, part), ratio.get(name, 1.0))
        for name, length in table.lengths.items()
        for part in length.stretches
        if part.segment == segment
    ]
    if all(factor == 1.0 for _, factor in lines):
        return None
    if len(lines) == 1:
        line, factor = lines[0]
        along = line / np.linalg.norm(line)
        return np.eye(3) + (factor - 1.0) * np.outer(along, along)
    directions = np.array([line for line, _ in lines])  # (k, 3)
    if len(lines) == 2:
        directions = np.vstack([directions, np.cross(directions[1], directions[0])])
    if len(lines) > 3 or abs(np.linalg.det(directions)) <= 1e-9 * np.prod(np.linalg.norm(directions, axis=1)):
        names = [name for name, length in table.lengths.items() if any(p.segment == segment for p in length.stretches)]
        raise BadModel(
            f"{table.where}: lengths.{', lengths.'.join(names)}: all of segment '{segment}', which they cannot stretch "
            f"independently; up to three lengths in different directions are possible"
        )
    basis = directions.T
    factors = [factor for _, factor in lines] + [1.0] * (3 - len(lines))
    return basis @ np.diag(factors) @ np.linalg.inv(basis)


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
