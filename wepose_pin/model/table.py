"""Which link of a body is which segment: the table, its file, and a URDF that bears our names because of it.

Links named after our segments, in our frames, are added to a body of others as massless links fixed to its own. So all
that follows, and every reader of the URDF that comes out, finds the segments without the table.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..assets import asset
from ..documents import TomlTable, is_number, read_toml
from ..errors import BadModel, one_of
from ..recording import SEGMENTS, compute_mount
from ..recording.segments import guess_segment
from ..recording.sensors import read_axes
from .tree import Tree, parse_tree

# A point is the origin of a link; the link is moved by the joint at that point.
POINTS = {
    f"{side}_{point}": f"{side}_{link}"
    for side in ("left", "right")
    for point, link in (("shoulder", "upper_arm"), ("elbow", "forearm"), ("wrist", "hand"), ("palm", "palm"))
}
NEEDED = SEGMENTS[:5]
MODEL_TABLE = "model.toml"
MOST_LINKS = 100  # that an error lists; a person's body has fewer


class SegmentLink(NamedTuple):
    """The link that is a segment; which of its axes point up and forward in the N-pose, None: found."""

    link: str
    up: str | None = None
    forward: str | None = None


class PointLink(NamedTuple):
    """The link on which a point lies, and where."""

    link: str
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m] in the link


@dataclass(frozen=True)
class LinkTable:
    """Which link of a body is which segment.

    Parameters
    ----------
    segments : segment → its link
    points : point → its link, where it is not the origin of the segment that begins there; the palm (`left_palm`,
        `right_palm`) has none of its own
    up, forward : the root link's axes that point up and forward while all joints are at zero
    root : the link at whose origin W begins, or links whose middle it is; none: the root link
    where : for error texts
    """

    segments: Mapping[str, SegmentLink]
    points: Mapping[str, PointLink] = field(default_factory=dict)
    up: str = "+z"
    forward: str = "+x"
    root: tuple[str, ...] = ()
    where: str = "segments"

    @property
    def links(self) -> set[str]:
        """All links it names."""
        segments = {segment.link for segment in self.segments.values()}
        return segments | {point.link for point in self.points.values()} | set(self.root)


# Reading ----------------------------------------------------------------------------------------------------------


def table_from(values: Mapping[str, Any], where: str) -> LinkTable:
    """The table that a TOML file or keywords spell: ``segments``, ``points``, ``up``, ``forward``, ``root``.

    Raises
    ------
    BadModel
        A key, a segment, a point or an axis that is not known, or a value of the wrong kind.
    """
    top = TomlTable(values, where, error=BadModel)
    top.allow("segments", "points", "up", "forward", "root")
    segments, points = {}, {}
    for name, entry in _entries(top, "segments", SEGMENTS).items():
        entry.allow("link", "up", "forward")
        if ("up" in entry) != ("forward" in entry):
            raise BadModel(f'{entry.where}: up and forward go together, as in up = "+z", forward = "+x"')
        up, forward = read_axes(entry) if "up" in entry else (None, None)
        segments[name] = SegmentLink(entry.values["link"], up, forward)
    for name, entry in _entries(top, "points", POINTS).items():
        entry.allow("link", "at")
        at = entry.values.get("at", (0.0, 0.0, 0.0))
        if not (isinstance(at, list | tuple) and len(at) == 3 and all(is_number(v, 1e3) for v in at)):
            raise BadModel(f"{entry.at('at')} = {at!r}; three numbers [m] in the link are wanted")
        points[name] = PointLink(entry.values["link"], (float(at[0]), float(at[1]), float(at[2])))
    up, forward = read_axes(top, "+z", "+x")
    root = values.get("root") or ()
    root = (root,) if isinstance(root, str) else root
    if not isinstance(root, list | tuple) or not all(isinstance(link, str) for link in root):
        raise BadModel(f"{where}: root = {root!r}; the name of a link is wanted, or a list of names")
    return LinkTable(segments, points, up, forward, tuple(root), where)


def read_table(path: Path) -> tuple[LinkTable, Path | None]:
    """The table in a TOML file and the URDF it names with ``urdf``, None without.

    Raises
    ------
    MissingFile, BadModel
        Not there; no TOML; not a table.
    """
    values = read_toml(path, "a table of links", BadModel)
    urdf = values.pop("urdf", None)
    if urdf is not None and not isinstance(urdf, str):
        raise BadModel(f"{path}: urdf = {urdf!r}; the name of a file is wanted")
    return table_from(values, str(path)), (path.parent / urdf if urdf is not None else None)


def find_table(urdf: Path, links: Iterable[str]) -> LinkTable | None:
    """The table for a URDF that came without: ``model.toml`` beside it that names it, else one of ours that fits.

    None where the links bear our names already, or nothing is found.
    """
    links = set(links)
    own_table = urdf.parent / MODEL_TABLE
    if own_table.is_file():
        table, named = read_table(own_table)
        if named is not None and named.name == urdf.name:
            return table
    if links.issuperset(NEEDED):
        return None
    for path in sorted(asset("urdf", "human_gazebo.toml").parent.glob("*.toml")):
        table, _ = read_table(path)
        if table.links <= links:
            return replace(table, where=f"{urdf}: by {path.name}")
    return None


def _entries(top: TomlTable, key: str, names: Collection[str]) -> dict[str, TomlTable]:
    """Segment or point → the table that names its link; a link's name stands for a table of that alone."""
    entries = top.table(key, {})
    tables = {}
    for name, value in entries.values.items():
        if isinstance(value, SegmentLink | PointLink):
            value = {part: own for part, own in value._asdict().items() if own is not None}
        tables[name] = {"link": value} if isinstance(value, str) else value
        if not isinstance(tables[name], Mapping) or not isinstance(tables[name].get("link"), str):
            raise BadModel(f'{entries.at(name)} = {value!r}; a link\'s name is wanted, or {{ link = "name", … }}')
    return replace(entries, values=tables).tables(names, key.removesuffix("s"))


# Naming -----------------------------------------------------------------------------------------------------------


def rename_links(robot: Any, table: LinkTable) -> Any:
    """A copy of the robot (yourdfpy) with links named after our segments and points, in our frames.

    Every segment frame equals W in the N-pose. At zero of its joints a body may stand otherwise, in a T-pose say. There

    - torso, pelvis and head are upright: their frames are W's;
    - an upper arm and a forearm point from joint to joint, a hand to its palm (without one: as its forearm). The
      shortest rotation that carries the arm of the N-pose, −z, there is the segment's orientation;
    - `up` and `forward` of a `SegmentLink` are taken in place of that.

    Raises
    ------
    BadModel
        A link that is not there; no wrist; an arm that points straight up, so that no rotation is the shortest.
    """
    where = table.where
    tree = parse_tree(robot, where)
    _check_links(table, tree)
    R_WM = Rotation.from_quat(compute_mount(table.up, table.forward)).as_matrix()  # M: the root link
    M_WM = np.eye(4)
    M_WM[:3, :3] = R_WM
    M_WM[:3, 3] = -R_WM @ np.mean([tree.neutral(link)[:3, 3] for link in table.root or (tree.root,)], axis=0)
    M_WK = {link: M_WM @ tree.neutral(link) for link in table.links}  # K: a link of theirs

    R_WL: dict[str, np.ndarray] = {}  # orientation of our segments while their joints are at zero
    p_W = {}
    for point, link in _points(table).items():
        p_W[point] = M_WK[link.link][:3, :3] @ link.at + M_WK[link.link][:3, 3]
    for segment, own in table.segments.items():
        if own.up is not None and own.forward is not None:
            R_LK = Rotation.from_quat(compute_mount(own.up, own.forward)).as_matrix()
            R_WL[segment] = M_WK[own.link][:3, :3] @ R_LK.T
    for segment in (*table.segments, "left_hand", "right_hand"):
        if segment not in R_WL:
            R_WL[segment] = _neutral_orientation(segment, p_W, R_WL, where)

    # Our frames on their links; wrists and palms lie on the hand, else on the forearm.
    frames: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}  # name → their link, R_WL, p_W
    for segment, own in table.segments.items():
        frames[segment] = own.link, R_WL[segment], M_WK[own.link][:3, 3]
    for point, name in POINTS.items():
        side, part = point.split("_", 1)
        segment = name if part != "palm" else f"{side}_hand"
        if point in p_W:
            on = table.segments.get(segment, table.segments[f"{side}_forearm"]).link
            frames[name] = on, R_WL[segment], p_W[point]

    return _with_links(robot, tree.root, M_WM, M_WK, frames)


def _check_links(table: LinkTable, tree: Tree) -> None:
    where = table.where
    for key, entries in (("segments", table.segments), ("points", table.points)):
        for name, entry in entries.items():
            if entry.link not in tree.below:
                raise BadModel(
                    f"{where}: {key}.{name}: no link '{entry.link}'; {one_of(tree.below, entry.link, MOST_LINKS)}"
                )
    for link in table.root:
        if link not in tree.below:
            raise BadModel(f"{where}: root: no link '{link}'; {one_of(tree.below, link, MOST_LINKS)}")
    lacking = [segment for segment in NEEDED if segment not in table.segments]
    if lacking:
        raise BadModel(
            f"{where}: no link for segment {format_closest_links(lacking, tree.below)}; name it in segments; "
            f"{one_of(tree.below, most=MOST_LINKS)}"
        )
    handless = [side for side in ("left", "right") if f"{side}_wrist" not in _points(table)]
    if handless:
        names = " and ".join(f"segments.{side}_hand or points.{side}_wrist" for side in handless)
        raise BadModel(f"{where}: no wrist; name a link in {names}")


def format_closest_links(segments: Iterable[str], links: Iterable[str]) -> str:
    """Segments that have no link, each with the links whose names speak of it or come closest."""
    links = list(links)
    names = []
    for segment in segments:
        close = [link for link in links if guess_segment(link) == segment]
        others = [link for link in links if guess_segment(link) is None]
        close = close or get_close_matches(segment, others, n=3, cutoff=0.5)
        names.append(f"'{segment}'" + (f" (maybe {' or '.join(close[:4])})" if close else ""))
    return ", ".join(names)


def _points(table: LinkTable) -> dict[str, PointLink]:
    """Points with their links: the table's own, else where their segment begins."""
    begin = {point: table.segments[name] for point, name in POINTS.items() if name in table.segments}
    return {point: PointLink(segment.link) for point, segment in begin.items()} | dict(table.points)


def _neutral_orientation(
    segment: str, p_W: Mapping[str, np.ndarray], R_WL: Mapping[str, np.ndarray], where: str
) -> np.ndarray:
    """Orientation R_WL (3, 3) of a segment while all joints are at zero."""
    side, _, part = segment.partition("_")
    ends = {"upper_arm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"), "hand": ("wrist", "palm")}.get(part)
    if ends is None:
        return np.eye(3)
    first, last = (f"{side}_{end}" for end in ends)
    if last not in p_W:
        return R_WL[f"{side}_forearm"]
    along = p_W[last] - p_W[first]
    length = np.linalg.norm(along)
    if length < 1e-6:
        raise BadModel(f"{where}: {first} and {last} lie in one place; name the links at both ends of {segment}")
    x, y, z = along / length
    if z > 1.0 - 1e-6:
        raise BadModel(f"{where}: segments.{segment}: points straight up; state its up and forward axes of the N-pose")
    # From (0, 0, −1) to (x, y, z): the axis is their cross product (y, −x, 0).
    return Rotation.from_quat([y, -x, 0.0, 1.0 - z]).as_matrix()


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
    import yourdfpy

    robot = copy.deepcopy(robot)
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
    renamed = {name: _make_unique(f"{name}_link", own) for name in added if name in own}
    for link in robot.links:
        link.name = renamed.get(link.name, link.name)
    for joint in robot.joints:
        joint.parent = renamed.get(joint.parent, joint.parent)
        joint.child = renamed.get(joint.child, joint.child)
    joints = {joint.name for joint in robot.joints}
    for name, (link, M) in added.items():
        ends = (name, renamed.get(link, link)) if name == "root" else (renamed.get(link, link), name)
        robot.links.append(yourdfpy.Link(name=name))
        robot.joints.append(yourdfpy.Joint(_make_unique(f"{name}_fixed", joints), "fixed", *ends, origin=M))
    return robot


def _make_unique(name: str, used: Iterable[str]) -> str:
    """`name`, made longer until it is not `taken`."""
    while name in used:
        name += "_"
    return name
