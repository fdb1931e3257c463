"""The joints of a URDF: checked to be one tree, with links of our names, built into a `pin.Model`; and its lengths.

Links named after segments and points of a table, in our frames, are massless and fixed to those of the URDF. So every
reader of the URDF that comes out finds the segments by their names.

Lengths are measured between points and set by stretching segments. A point is p_W = Σ R_WK (B l + c) over the links K
between the root and the point, with l the lengths: each link contributes a vector that is affine in the lengths and
constant in the link. The joints of a girdle stand at zero here: what they add is in `girdle`.
"""

import pickle
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadModel, one_of
from ..recording import compute_mount
from .table import ROOT, BodyTable, Point
from .urdf import import_yourdfpy

_FAR = 1e6  # [m]
_PARALLEL_TOLERANCE = 1e-6
_MEET_TOLERANCE = 1e-9  # [m]
UNIVERSE = "universe"  # the link of what is rigid with the root
_LENGTH_TOLERANCE = 1e-9  # [m] by which a length may miss what it is set to
_LEAST = 1e-6  # [m] of a length
_DECIMALS = 13  # of a vector [m] and of its change per metre of a length; what is beyond is rounding
# A link between the axes of a spherical joint may have as much mass [kg]; it then moves with the segment. URDFs give
# such links 1e-5 kg, as simulators reject zero. At 0.1 m off the joint a gram weighs 1 mN m.
_LIGHT = 1e-3


class Tree(NamedTuple):
    """The joints of a URDF by the links they join."""

    root: str
    above: Mapping[str, Any]  # link → the joint that moves it; without the root
    below: Mapping[str, list[Any]]  # link → joints that hang on it

    def path(self, link: str) -> list[Any]:
        """Return the joints from the root down to `link`."""
        joints: list[Any] = []
        while link != self.root:
            joints.append(self.above[link])
            link = joints[-1].parent
        return joints[::-1]

    def body(self, link: str) -> str:
        """Return the uppermost link that is rigid with `link`."""
        while link != self.root and self.above[link].type == "fixed":
            link = self.above[link].parent
        return link

    def neutral(self, link: str) -> np.ndarray:
        """Return the placement (4, 4) of `link` in the root link, all joints at zero."""
        return reduce(np.matmul, (joint.origin for joint in self.path(link)), np.eye(4))

    def hanging(self, start: str, others: Collection[str] = ()) -> list[str]:
        """Return `start` and the links below it, without the links `others` and what is below them."""
        links, to_do = [], [start]
        while to_do:
            links.append(link := to_do.pop())
            to_do += [joint.child for joint in self.below[link] if joint.child not in others]
        return links

    def find_above(self, link: str, names: Mapping[str, str]) -> str | None:
        """Find the name of the nearest link between `link` and the root that has one in `names`."""
        return next((names[joint.parent] for joint in reversed(self.path(link)) if joint.parent in names), None)


def parse_tree(robot: Any, where: str) -> Tree:
    """Parse the tree that the joints of `robot` (yourdfpy) form."""
    for items in (robot.links, robot.joints):
        name, times = next(iter(Counter(item.name for item in items).most_common(1)), ("", 0))
        if times > 1:
            raise BadModel(f"{where}: '{name}' occurs {times} times; a name stands for one link and one joint")
    below: dict[str, list[Any]] = {link.name: [] for link in robot.links}
    above: dict[str, Any] = {}
    for joint in robot.joints:
        if joint.parent not in below or joint.child not in below:
            raise BadModel(f"{where}: joint '{joint.name}' names a link that is not there; {one_of(below)}")
        if joint.child in above:
            raise BadModel(f"{where}: link '{joint.child}' hangs on two joints; a body is a tree")
        above[joint.child] = joint
        below[joint.parent].append(joint)
        axis = () if joint.axis is None else joint.axis
        numbers = np.concatenate([np.ravel(joint.origin), np.ravel(axis)]).astype(float)
        if np.shape(joint.origin) != (4, 4) or np.shape(axis) not in ((0,), (3,)) or not (np.abs(numbers) < _FAR).all():
            raise BadModel(f"{where}: joint '{joint.name}': origin or axis is not three numbers each, of m and rad")
    if len(roots := [name for name in below if name not in above]) != 1:
        names = ", ".join(roots) or "none"
        raise BadModel(f"{where}: {len(roots)} links without a joint above them ({names}); a body has one root")
    tree = Tree(roots[0], above, below)
    if lost := set(below).difference(tree.hanging(tree.root)):
        raise BadModel(f"{where}: link '{min(lost)}' hangs in a loop of joints, apart from the root; a body is a tree")
    return tree


def rename_links(robot: Any, table: BodyTable) -> tuple[Any, BodyTable]:
    """Name links of the robot (yourdfpy) in place after segments and points; return it and its table."""
    tree = parse_tree(robot, table.where)
    places = [(f"segments.{name}", segment.link) for name, segment in table.segments.items()]
    places += [(f"points.{name}", point.link) for name, point in table.points.items()]
    for place, link in [*places, *(("root", link) for link in table.root)]:
        if link not in tree.below:
            raise BadModel(f"{table.where}: {place}: no link '{link}'; {one_of(tree.below, link, 100)}")
    M_WM = np.eye(4)  # M: the root link
    M_WM[:3, :3] = Rotation.from_quat(compute_mount(table.up, table.forward)).as_matrix()
    origin = np.mean([tree.neutral(link)[:3, 3] for link in table.root or (tree.root,)], axis=0)
    M_WM[:3, 3] = -M_WM[:3, :3] @ origin
    M_WK = {link: M_WM @ tree.neutral(link) for link in tree.below}  # K: a link of theirs
    p_W = {name: M_WK[point.link][:3, :3] @ point.at + M_WK[point.link][:3, 3] for name, point in table.points.items()}

    segment_of = {segment.link: name for name, segment in reversed(list(table.segments.items()))}
    R_WL: dict[str, np.ndarray] = {}  # orientation of our segments while their joints are at zero
    for name in sorted(table.segments, key=lambda name: len(tree.path(table.segments[name].link))):
        above = tree.find_above(table.segments[name].link, segment_of)
        R_WL[name] = _neutral_orientation(table, name, M_WK, p_W, np.eye(3) if above is None else R_WL[above])
    # Name → their link, and the placement in W.
    frames = {name: (each.link, R_WL[name], M_WK[each.link][:3, 3]) for name, each in table.segments.items()}
    points: dict[str, Point] = {}
    for name, point in table.points.items():
        begins = None if any(point.at) else segment_of.get(point.link)
        points[name] = Point(begins or name)
        if begins is None and (point.link != name or any(point.at)):  # else the link is there already
            carrier = segment_of.get(point.link) or tree.find_above(point.link, segment_of)
            link = point.link if carrier is None or table.is_mechanism else table.segments[carrier].link
            frames[name] = link, M_WK[link][:3, :3] if carrier is None else R_WL[carrier], p_W[name]
    segments = {name: segment._replace(link=name) for name, segment in table.segments.items()}
    named = replace(table, segments=segments, points=points, up="+z", forward="+x", root=())

    added: dict[str, tuple[str, np.ndarray]] = {}  # name → the link it is fixed to, and its placement there
    for name, (link, R, p) in frames.items():
        M_KL = np.linalg.inv(M_WK[link]) @ pin.SE3(R, p).homogeneous
        if name != link or not np.allclose(M_KL, np.eye(4), atol=1e-12):
            added[name] = link, M_KL
    if not np.allclose(M_WM, np.eye(4), atol=1e-12):
        added["root"] = tree.root, M_WM
    return _add_links(robot, added), named


def _neutral_orientation(
    table: BodyTable, name: str, M_WK: Mapping[str, np.ndarray], p_W: Mapping[str, np.ndarray], R_above: np.ndarray
) -> np.ndarray:
    """Return R_WL (3, 3) of a segment while all joints are at zero; `R_above`: of the segment above.

    A mechanism's segments have their links' frames, and so have those of a URDF whose links bear the segments' names.
    Else every segment frame equals W in the N-pose. At zero of its joints a body may stand otherwise, in a T-pose say.
    There segments of the spine are upright. Others lie along the line between the points of their length, by the
    shortest rotation of their long axis; a segment without a length is as the segment above.
    """
    segment, ends = table.segments[name], table.ends(name)
    if table.is_mechanism or all(each.link == key for key, each in table.segments.items()):
        return M_WK[segment.link][:3, :3]
    if segment.spine or ends is None or not set(ends[0] + ends[1]) <= set(p_W):
        return np.eye(3) if segment.spine else R_above
    first, last = (np.mean([p_W[point] for point in points], axis=0) for points in ends)
    along, length = last - first, np.linalg.norm(last - first)
    cosine = float(np.dot(segment.along, along) / max(length, 1e-6))
    if length < 1e-6 or cosine < 1e-6 - 1.0:
        raise BadModel(
            f"{table.where}: segments.{name}: {' and '.join(ends[0] + ends[1])} lie in one place, or opposite to its "
            f"direction in the N-pose; name other links"
        )
    return Rotation.from_quat([*np.cross(segment.along, along / length), 1.0 + cosine]).as_matrix()


def _add_links(robot: Any, added: Mapping[str, tuple[str, np.ndarray]]) -> Any:
    """Fix massless links to those of the robot, ``root`` above its own; a link that has such a name gets ``_link``."""
    library, own = import_yourdfpy(), {link.name for link in robot.links}
    renamed = {name: f"{name}_link" for name in added if name in own}
    for link in robot.links:
        link.name = renamed.get(link.name, link.name)
    for joint in robot.joints:
        joint.parent, joint.child = (renamed.get(end, end) for end in (joint.parent, joint.child))
    joints = {joint.name for joint in robot.joints}
    for name, (link, M) in added.items():
        ends, joint_name = (renamed.get(link, link), name), f"{name}_fixed"
        while joint_name in joints:
            joint_name += "_"
        robot.links.append(library.Link(name=name))
        robot.joints.append(library.Joint(joint_name, "fixed", *(ends[::-1] if name == "root" else ends), origin=M))
    return robot


def build(robot: Any, where: str, *, spherical: bool) -> tuple[pin.Model, dict[str, np.ndarray]]:
    """Build the Pinocchio model, depth first as Pinocchio's algorithms need it; one frame a link.

    Second: the axes of its spherical joints, as `BodyModel` has them. Other joints have the URDF's limits.
    Without `spherical` triples of revolute joints stay as they are.
    """
    tree, links = parse_tree(robot, where), {link.name: link for link in robot.links}
    model, axes = pin.Model(), dict[str, np.ndarray]()
    model.name = robot.name or "body"

    def carry(link: str, parent: int, M_JL: pin.SE3) -> None:
        inertial = links[link].inertial
        if inertial is None or not inertial.mass:
            return
        placement = pin.SE3(inertial.origin)
        inertia = np.asarray(inertial.inertia if inertial.inertia is not None else np.zeros((3, 3)), dtype=float)
        # The constructor refuses what no body can have, as some URDFs state it; Pinocchio's own reader does not.
        total = pin.Inertia.Zero()
        total.mass, total.lever = float(inertial.mass), placement.translation
        total.inertia = placement.rotation @ inertia @ placement.rotation.T
        model.appendBodyToJoint(parent, total, M_JL)

    def grow(link: str, parent: int, M_JL: pin.SE3) -> None:
        """Add `link`, placed at `M_JL` on Pinocchio's joint `parent`, and what hangs on it."""
        model.addFrame(pin.Frame(link, parent, 0, M_JL, pin.FrameType.BODY), False)
        carry(link, parent, M_JL)
        for first in tree.below[link]:
            M_Jc = M_JL * pin.SE3(first.origin)
            triple, own_axes = _find_triple(first, tree, links) if spherical else ([], None)
            child = [first, *triple][-1].child
            if first.type == "fixed":
                grow(child, parent, M_Jc)
            elif not triple and first.type != "floating":
                grow(child, _add_single(model, parent, M_Jc, first, where), pin.SE3.Identity())
            else:
                for joint in triple[1:]:
                    M_Jc = M_Jc * pin.SE3(joint.origin)
                joined = model.addJoint(parent, pin.JointModelSpherical(), M_Jc, child)
                if own_axes is not None:
                    axes[child] = own_axes
                # The links between the axes, as they stand at zero.
                M_cK = pin.SE3.Identity()
                for joint in triple[:0:-1]:
                    M_cK = M_cK * pin.SE3(joint.origin).inverse()
                    carry(joint.parent, joined, M_cK)
                grow(child, joined, pin.SE3.Identity())

    grow(tree.root, 0, pin.SE3.Identity())
    return model, axes


def joint_axis(joint: Any) -> np.ndarray:
    """Return the unit axis (3,) of a joint in its own frame; URDF's default is x."""
    axis = np.asarray(joint.axis if joint.axis is not None else (1.0, 0.0, 0.0), dtype=float)
    norm = np.linalg.norm(axis)
    return axis / norm if norm > 1e-9 else np.zeros(3)


def _find_triple(first: Any, tree: Tree, links: Mapping[str, Any]) -> tuple[list[Any], np.ndarray | None]:
    """Find the three revolute joints that begin with `first` and together are a spherical joint; none: they are not.

    Second: their axes (3, 3), a row each, in the frame of the last one's child, all joints at zero.
    """
    chain, axes = [first], np.zeros((3, 3))
    while len(chain) < 3:
        below, link = tree.below[chain[-1].child], links[chain[-1].child]
        is_heavy = link.inertial is not None and (link.inertial.mass or 0.0) > _LIGHT
        if len(below) != 1 or link.visuals or link.collisions or is_heavy:
            return [], None
        chain.append(below[0])
    for k, joint in enumerate(chain):
        axes[:k] = axes[:k] @ joint.origin[:3, :3]
        axes[k] = joint_axis(joint)
    turn = all(joint.type in ("revolute", "continuous") for joint in chain)
    meet = all(np.linalg.norm(joint.origin[:3, 3]) <= _MEET_TOLERANCE for joint in chain[1:])
    is_triple = turn and meet and np.abs(axes @ axes.T - np.eye(3)).max() <= _PARALLEL_TOLERANCE
    return (chain, axes) if is_triple else ([], None)


def _find_bounds(joint: Any) -> tuple[float, float]:
    """Return the lower and upper limit of a joint [rad or m]; a continuous one has none."""
    limit = None if joint.type == "continuous" else joint.limit
    low, high = getattr(limit, "lower", None), getattr(limit, "upper", None)
    return (-np.inf if low is None else float(low)), (np.inf if high is None else float(high))


def check_joint_values(robot: Any, values: Mapping[str, float], place: str, error: type[Exception]) -> None:
    """Raise an `error` where `values` [rad or m] name a joint that does not move, or are outside its limits."""
    joints = {joint.name: joint for joint in robot.joints if joint.type not in ("fixed", "floating")}
    for name, value in values.items():
        if name not in joints:
            raise error(f"{place}.{name} is no joint that moves; {one_of(joints, name)}")
        low, high = _find_bounds(joints[name])
        if not low - 1e-6 <= value <= high + 1e-6:
            raise error(f"{place}.{name} = {value:g} is outside its limits, {low:g} to {high:g}")


def _add_single(model: pin.Model, parent: int, M: pin.SE3, joint: Any, where: str) -> int:
    """Add a joint of one axis with its limits."""
    kinds = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
    kinds["continuous"] = kinds["revolute"]
    axis = joint_axis(joint)
    if joint.type not in kinds or not axis.any():
        raise BadModel(
            f"{where}: joint '{joint.name}' is of type '{joint.type}', axis {axis.tolist()}; fixed, floating, or "
            f"{', '.join(kinds)} about an axis are known"
        )
    most = [getattr(joint.limit, name, None) for name in ("effort", "velocity")]
    limits = [np.inf if number is None else float(number) for number in most]
    bounds = (np.array([number]) for number in (*limits, *_find_bounds(joint)))
    return int(model.addJoint(parent, kinds[joint.type](axis), M, joint.name, *bounds))


# Lengths -------------------------------------------------------------------------------------------------------------


def measure_lengths(robot: Any, table: BodyTable) -> dict[str, float]:
    """The lengths [m] between the points of `robot` (yourdfpy), all joints at zero."""
    return {name: float(np.linalg.norm(v)) for name, v in _find_lines(parse_tree(robot, robot.name), table).items()}


def stretch_robot(robot: Any, table: BodyTable, targets: Mapping[str, float]) -> Any:
    """Return a copy of the robot with these lengths [m]: segments stretch along their lines, all joints at zero."""
    robot = pickle.loads(pickle.dumps(robot, pickle.HIGHEST_PROTOCOL))  # several times as fast as `copy.deepcopy`
    tree, own = parse_tree(robot, robot.name), measure_lengths(robot, table)
    of_links, of_joints = _find_stretches(tree, table)
    placed = {link.name: tree.neutral(link.name)[:3, :3] for link in robot.links}

    def stretch(parts: Mapping[str, np.ndarray], R_WK: np.ndarray) -> np.ndarray:
        ratios = {name: targets.get(name, own[name]) / own[name] for name in parts}
        return R_WK.T @ (np.eye(3) + sum((ratios[name] - 1.0) * P for name, P in parts.items())) @ R_WK

    for joint in robot.joints:
        if joint.name in of_joints:
            joint.origin[:3, 3] = stretch(of_joints[joint.name], placed[joint.parent]) @ joint.origin[:3, 3]
    for link in robot.links:
        if link.name in of_links:
            _stretch_link(link, stretch(of_links[link.name], placed[link.name]))
    reached = measure_lengths(robot, table)
    for name, value in targets.items():
        if abs(reached[name] - value) > _LENGTH_TOLERANCE:
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

    What stretches with a segment are the links from its own down to the next segments, and with one of the spine also
    the spine below it, down to the next segment or the root, across what stretches these already.
    """
    lines, of_links, of_joints, of_spines = _find_lines(tree, table), _Stretches(), _Stretches(), list[Any]()
    links_of = {name: segment.link for name, segment in table.segments.items()}
    starts: dict[str, str] = {}  # segment → its uppermost link, or its own where a segment above is rigid with it
    for name in sorted(links_of, key=lambda name: len(tree.path(links_of[name]))):
        start = tree.body(links_of[name])
        starts[name] = links_of[name] if start in starts.values() else start
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
        links = tree.hanging(starts[segment], starts.values())
        spine = tree.path(starts[segment]) if own.spine else []
        spine = spine[max((k for k, joint in enumerate(spine) if joint.parent in starts.values()), default=0) :]
        of_links |= dict.fromkeys(links, parts)
        of_joints |= {joint.name: parts for link in links for joint in tree.below[link]}
        links = [joint.parent for joint in spine[1:]]
        joints = {joint.name for link in links for joint in tree.below[link]} | {joint.name for joint in spine[:1]}
        of_spines += [(of_links, links, parts), (of_joints, joints, parts)]
    for stretches, names, parts in of_spines:
        for name in names:
            before = stretches.get(name, {})
            across = np.eye(3) - sum(before.values())
            stretches[name] = before | {length: P @ across for length, P in parts.items()}
    return of_links, of_joints


def _stretch_link(link: Any, S: np.ndarray) -> None:
    """Stretch visuals, collisions and inertia of a link by S (3, 3) in its own coordinates."""
    for visual in [*link.visuals, *link.collisions]:
        geometry, along = visual.geometry, np.linalg.norm(S @ visual.origin[:3, :3], axis=0)  # of the visual's own axes
        visual.origin[:3, 3] = S @ visual.origin[:3, 3]
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
            step = tree.neutral(joint.parent)[:3, :3] @ joint.origin[:3, 3]
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
