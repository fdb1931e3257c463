"""A URDF that bears the names of its table: links named after segments and points, in our frames.

They are massless links fixed to those of the URDF. So all that follows, and every reader of the URDF that comes out,
finds the segments by their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import BadModel, one_of
from ..recording import compute_mount
from .table import BodyTable, Point
from .tree import Tree, copy_robot, parse_tree
from .urdf import import_yourdfpy

MOST_LINKS = 100  # that an error lists; a person's body has fewer


def rename_links(robot: Any, table: BodyTable) -> tuple[Any, BodyTable]:
    """A copy of the robot (yourdfpy) with links named after segments and points, and the table of these names.

    A mechanism's segments have their links' frames, and so have those of a URDF whose links bear the segments' names.
    Else every segment frame equals W in the N-pose. At zero of its joints a body may stand otherwise, in a T-pose say.
    There

    - segments of the spine are upright: their frames are W's;
    - others lie along the line between the points of their length. The shortest rotation that carries their long axis
      there is their orientation; a segment without a length has that of the segment above;
    - `up` and `forward` of a segment are taken in place of that.

    Raises
    ------
    BadModel
        A link that is not there; points in one place; a segment so far off that no rotation is the shortest.
    """
    tree = parse_tree(robot, table.where)
    places = [(f"segments.{name}", segment.link) for name, segment in table.segments.items()]
    places += [(f"points.{name}", point.link) for name, point in table.points.items()]
    for place, link in [*places, *(("root", link) for link in table.root)]:
        if link not in tree.below:
            raise BadModel(f"{table.where}: {place}: no link '{link}'; {one_of(tree.below, link, MOST_LINKS)}")
    R_WM = Rotation.from_quat(compute_mount(table.up, table.forward)).as_matrix()  # M: the root link
    M_WM = np.eye(4)
    M_WM[:3, :3] = R_WM
    M_WM[:3, 3] = -R_WM @ np.mean([tree.neutral(link)[:3, 3] for link in table.root or (tree.root,)], axis=0)
    M_WK = {link: M_WM @ tree.neutral(link) for link in tree.below}  # K: a link of theirs
    p_W = {name: M_WK[point.link][:3, :3] @ point.at + M_WK[point.link][:3, 3] for name, point in table.points.items()}

    segment_of = {segment.link: name for name, segment in reversed(list(table.segments.items()))}
    R_WL: dict[str, np.ndarray] = {}  # orientation of our segments while their joints are at zero
    for name in sorted(table.segments, key=lambda name: len(tree.path(table.segments[name].link))):
        above = _segment_above(tree, table.segments[name].link, segment_of)
        R_WL[name] = _neutral_orientation(table, name, M_WK, p_W, np.eye(3) if above is None else R_WL[above])

    frames: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}  # name → their link, R_WL, p_W
    points: dict[str, Point] = {}
    for name, segment in table.segments.items():
        frames[name] = segment.link, R_WL[name], M_WK[segment.link][:3, 3]
    for name, point in table.points.items():
        begins = segment_of.get(point.link)
        if begins is not None and not any(point.at):
            points[name] = Point(begins)
            continue
        points[name] = Point(name)
        if point.link == name and not any(point.at):
            continue  # the link is there already
        carrier = begins or _segment_above(tree, point.link, segment_of)
        link = point.link if carrier is None or table.is_mechanism else table.segments[carrier].link
        frames[name] = link, M_WK[link][:3, :3] if carrier is None else R_WL[carrier], p_W[name]
    segments = {name: segment._replace(link=name, up=None, forward=None) for name, segment in table.segments.items()}
    named = replace(table, segments=segments, points=points, up="+z", forward="+x", root=())
    return _with_links(robot, tree.root, M_WM, M_WK, frames), named


def _segment_above(tree: Tree, link: str, segment_of: Mapping[str, str]) -> str | None:
    """The nearest segment between a link and the root."""
    above = [segment_of[joint.parent] for joint in tree.path(link) if joint.parent in segment_of]
    return above[-1] if above else None


def _neutral_orientation(
    table: BodyTable, name: str, M_WK: Mapping[str, np.ndarray], p_W: Mapping[str, np.ndarray], R_above: np.ndarray
) -> np.ndarray:
    """Orientation R_WL (3, 3) of a segment while all joints are at zero; `R_above`: of the segment above."""
    segment = table.segments[name]
    R_WK = M_WK[segment.link][:3, :3]
    if segment.up is not None and segment.forward is not None:
        return R_WK @ Rotation.from_quat(compute_mount(segment.up, segment.forward)).as_matrix().T
    if table.is_mechanism or all(each.link == key for key, each in table.segments.items()):
        return R_WK
    if segment.spine:
        return np.eye(3)
    ends = table.ends(name)
    if ends is None or not set(ends[0] + ends[1]) <= set(p_W):
        return R_above
    first, last = (np.mean([p_W[point] for point in points], axis=0) for points in ends)
    along = last - first
    length = np.linalg.norm(along)
    cosine = float(np.dot(segment.along, along) / max(length, 1e-6))
    if length < 1e-6 or cosine < 1e-6 - 1.0:
        raise BadModel(
            f"{table.where}: segments.{name}: {' and '.join(ends[0] + ends[1])} lie in one place, or opposite to its "
            f"direction in the N-pose; name other links, or state its up and forward axes of the N-pose"
        )
    return Rotation.from_quat([*np.cross(segment.along, along / length), 1.0 + cosine]).as_matrix()


def _with_links(
    robot: Any,
    root: str,
    M_WM: np.ndarray,
    M_WK: Mapping[str, np.ndarray],
    frames: Mapping[str, tuple[str, np.ndarray, np.ndarray]],
) -> Any:
    """A copy of the robot with the links `frames` (name → the link it is fixed to, R_WL, p_WL), on a root that is W.

    A link of theirs that bears such a name and stands elsewhere becomes ``<name>_link``.
    """
    yourdfpy = import_yourdfpy()
    robot = copy_robot(robot)
    added = {}
    for name, (link, R, p) in frames.items():
        M_WL = np.eye(4)
        M_WL[:3, :3], M_WL[:3, 3] = R, p
        M_KL = np.linalg.inv(M_WK[link]) @ M_WL
        if name != link or not np.allclose(M_KL, np.eye(4), atol=1e-12):
            added[name] = link, M_KL
    if not np.allclose(M_WM, np.eye(4), atol=1e-12):
        added["root"] = root, M_WM
    own = {link.name for link in robot.links}
    renamed = {name: f"{name}_link" for name in added if name in own}
    for link in robot.links:
        link.name = renamed.get(link.name, link.name)
    for joint in robot.joints:
        joint.parent = renamed.get(joint.parent, joint.parent)
        joint.child = renamed.get(joint.child, joint.child)
    joints = {joint.name for joint in robot.joints}
    for name, (link, M) in added.items():
        ends, joint_name = (renamed.get(link, link), name), f"{name}_fixed"
        while joint_name in joints:
            joint_name += "_"
        robot.links.append(yourdfpy.Link(name=name))
        robot.joints.append(yourdfpy.Joint(joint_name, "fixed", *(ends[::-1] if name == "root" else ends), origin=M))
    return robot
