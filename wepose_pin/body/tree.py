"""The joints of a URDF: checked to be one tree, and built into a `pin.Model` with spherical joints."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from ..errors import BadModel, one_of

_TURNS = ("revolute", "continuous")
DEEPEST = 200  # joints in a row; a person has 20
_FAR = 1e6  # [m]
_PARALLEL_TOLERANCE = 1e-6
_MEET_TOLERANCE = 1e-9  # [m]
# A link between the axes of a spherical joint may have as much mass [kg]; it then moves with the segment. URDFs give
# such links 1e-5 kg, as simulators reject zero. At 0.1 m off the joint a gram weighs 1 mN m.
_LIGHT = 1e-3


class Tree(NamedTuple):
    """The joints of a URDF by the links they join."""

    root: str
    above: Mapping[str, Any]  # link → the joint that moves it; without the root
    below: Mapping[str, list[Any]]  # link → joints that hang on it

    def path(self, link: str) -> list[Any]:
        """Joints from the root down to `link`."""
        joints: list[Any] = []
        while link != self.root:
            joints.append(self.above[link])
            link = joints[-1].parent
        return joints[::-1]

    def body(self, link: str) -> str:
        """The uppermost link that is rigid with `link`."""
        while link != self.root and self.above[link].type == "fixed":
            link = self.above[link].parent
        return link

    def neutral(self, link: str) -> np.ndarray:
        """Placement (4, 4) of `link` in the root link, all joints at zero."""
        M = np.eye(4)
        for joint in self.path(link):
            M = M @ joint_placement(joint)
        return M


def copy_robot(robot: Any) -> Any:
    """A deep copy of `robot` (yourdfpy), by pickle: several times as fast as `copy.deepcopy`."""
    return pickle.loads(pickle.dumps(robot, pickle.HIGHEST_PROTOCOL))


def parse_tree(robot: Any, where: str) -> Tree:
    """The tree that the joints of `robot` (yourdfpy) form.

    Raises
    ------
    BadModel
        Names that occur twice, joints on links that are not there, two roots, a loop.
    """
    for kind, items in (("link", robot.links), ("joint", robot.joints)):
        name, times = next(iter(Counter(item.name for item in items).most_common(1)), ("", 0))
        if times > 1:
            raise BadModel(f"{where}: {kind} '{name}' occurs {times} times; a name stands for one {kind}")
    below: dict[str, list[Any]] = {link.name: [] for link in robot.links}
    above: dict[str, Any] = {}
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in below:
                raise BadModel(f"{where}: joint '{joint.name}' names a link '{link}' that is not there")
        if joint.child in above:
            raise BadModel(
                f"{where}: link '{joint.child}' hangs on two joints, '{above[joint.child].name}' and '{joint.name}'; "
                f"a body is a tree"
            )
        above[joint.child] = joint
        below[joint.parent].append(joint)
        axis, place = joint.axis, joint_placement(joint)
        numbers = np.concatenate([place.ravel(), np.ravel(axis) if axis is not None else ()]).astype(float)
        if place.shape != (4, 4) or np.shape(axis) not in ((), (3,)) or not (np.abs(numbers) < _FAR).all():
            raise BadModel(
                f"{where}: joint '{joint.name}': origin or axis is not three numbers each, of metres and rad"
            )
    roots = [name for name in below if name not in above]
    if len(roots) != 1:
        names = ", ".join(roots) if roots else "none"
        raise BadModel(f"{where}: {len(roots)} links without a joint above them ({names}); a body has one root")
    reached, to_do = {roots[0]: 0}, [roots[0]]
    while to_do:
        link = to_do.pop()
        for joint in below[link]:
            reached[joint.child] = reached[link] + 1
            to_do.append(joint.child)
    deepest = max(reached, key=lambda link: reached[link])
    if reached[deepest] > DEEPEST:
        raise BadModel(f"{where}: {reached[deepest]} joints in a row down to '{deepest}'; {DEEPEST} at most are read")
    lost = [name for name in below if name not in reached]
    if lost:
        raise BadModel(f"{where}: link '{lost[0]}' hangs in a loop of joints, apart from the root; a body is a tree")
    return Tree(roots[0], above, below)


def build(robot: Any, where: str, *, spherical: bool = True) -> tuple[pin.Model, dict[str, int], dict[str, np.ndarray]]:
    """The Pinocchio model, depth first as Pinocchio's algorithms need it; one frame a link.

    Second and third: its spherical joints and their axes, as `BodyModel` has them.

    A mimic joint follows the joint it mimics. The limits of joints that stay as they are are the URDF's. Without
    `spherical` triples of revolute joints stay as they are too.

    Raises
    ------
    BadModel
        No tree; a type of joint that is not known; an axis of zero; a mimic joint that cannot follow.
    """
    tree = parse_tree(robot, where)
    links = {link.name: link for link in robot.links}
    mimicked = {joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
    coupled = mimicked | {joint.name for joint in robot.joints if joint.mimic is not None}
    model = pin.Model()
    model.name = robot.name or "body"
    joints: dict[str, int] = {}
    axes: dict[str, np.ndarray] = {}

    def carry(link: str, parent: int, M_JL: pin.SE3) -> None:
        inertial = links[link].inertial
        if inertial is not None and inertial.mass:
            model.appendBodyToJoint(parent, _inertia(inertial, f"{where}: link '{link}'"), M_JL)

    def grow(link: str, parent: int, M_JL: pin.SE3) -> None:
        """Add `link`, placed at `M_JL` on Pinocchio's joint `parent`, and what hangs on it."""
        model.addFrame(pin.Frame(link, parent, 0, M_JL, pin.FrameType.BODY), False)
        carry(link, parent, M_JL)
        for first in tree.below[link]:
            M_Jc = M_JL * pin.SE3(joint_placement(first))
            if first.type == "fixed":
                grow(first.child, parent, M_Jc)
                continue
            triple = _triple(first, tree, links, mimicked) if spherical else None
            if triple is None and first.type != "floating":
                grow(first.child, *_add_single(model, parent, M_Jc, first, coupled, where))
                continue
            child = first.child
            if triple is not None:
                child = triple[-1].child
                axes[child] = _axes(triple)
                for joint in triple[1:]:
                    M_Jc = M_Jc * pin.SE3(joint_placement(joint))
            joints[child] = model.addJoint(parent, pin.JointModelSpherical(), M_Jc, child)
            if triple is not None:
                # The links between the axes, as they stand at zero.
                M_cK = pin.SE3.Identity()
                for joint in triple[:0:-1]:
                    M_cK = M_cK * pin.SE3(joint_placement(joint)).inverse()
                    carry(joint.parent, joints[child], M_cK)
            grow(child, joints[child], pin.SE3.Identity())

    grow(tree.root, 0, pin.SE3.Identity())
    for joint in robot.joints:
        if joint.mimic is not None:
            model = _mimicking(model, joint, where)
    return model, joints, axes


def joint_placement(joint: Any) -> np.ndarray:
    """Placement (4, 4) of a joint, and so of its child at zero, in its parent link."""
    return np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=float)


def joint_axis(joint: Any) -> np.ndarray:
    """Unit axis (3,) of a joint in its own frame; URDF's default is x."""
    axis = np.asarray(joint.axis if joint.axis is not None else (1.0, 0.0, 0.0), dtype=float)
    norm = np.linalg.norm(axis)
    return axis / norm if norm > 1e-9 else np.zeros(3)


def _triple(first: Any, tree: Tree, links: Mapping[str, Any], mimicked: set[str]) -> tuple[Any, Any, Any] | None:
    """The three revolute joints that begin with `first` and together are a spherical joint, if they are."""
    chain = [first]
    while len(chain) < 3:
        below, link = tree.below[chain[-1].child], links[chain[-1].child]
        heavy = link.inertial is not None and (link.inertial.mass or 0.0) > _LIGHT
        if len(below) != 1 or link.visuals or link.collisions or heavy:
            return None
        chain.append(below[0])
    if any(joint.type not in _TURNS or joint.mimic is not None or joint.name in mimicked for joint in chain):
        return None
    if any(np.linalg.norm(joint_placement(joint)[:3, 3]) > _MEET_TOLERANCE for joint in chain[1:]):
        return None
    axes = _axes(chain)
    if np.abs(axes @ axes.T - np.eye(3)).max() > _PARALLEL_TOLERANCE:
        return None
    return chain[0], chain[1], chain[2]


def _axes(chain: Any) -> np.ndarray:
    """Axes (3, 3), a row each, in the frame of the last joint's child, all joints at zero."""
    rows = []
    for k, joint in enumerate(chain):
        axis = joint_axis(joint)
        for later in chain[k + 1 :]:
            axis = joint_placement(later)[:3, :3].T @ axis
        rows.append(axis)
    return np.array(rows)


def find_bounds(joint: Any, unbounded: float) -> tuple[float, float]:
    """Lower and upper limit of a joint [rad or m]."""
    if joint.type == "continuous" or joint.limit is None:
        return -unbounded, unbounded
    low, high = joint.limit.lower, joint.limit.upper
    return (-unbounded if low is None else float(low)), (unbounded if high is None else float(high))


def check_joint_values(robot: Any, values: Mapping[str, float], place: str, error: type[Exception]) -> None:
    """Raise an `error` where `values` [rad or m] name a joint that does not move, or are outside its limits."""
    joints = {joint.name: joint for joint in robot.joints if joint.type not in ("fixed", "floating")}
    for name, value in values.items():
        if name not in joints:
            raise error(f"{place}.{name} is no joint that moves; {one_of(joints, name)}")
        low, high = find_bounds(joints[name], np.inf)
        if not low - 1e-6 <= value <= high + 1e-6:
            raise error(f"{place}.{name} = {value:g} is outside its limits, {low:g} to {high:g}")


def _add_single(
    model: pin.Model, parent: int, M: pin.SE3, joint: Any, coupled: set[str], where: str
) -> tuple[int, pin.SE3]:
    """Add a joint of one axis with its limits; gives it, and the placement of the child link on it.

    `coupled`: joints that mimic another or are mimicked; Pinocchio couples angles, not the unbounded joint's cosine.
    """
    if joint.type not in ("revolute", "continuous", "prismatic"):
        raise BadModel(
            f"{where}: joint '{joint.name}' is of type '{joint.type}'; known are fixed, revolute, continuous, "
            f"prismatic, floating, and spherical as three revolute joints"
        )
    axis = joint_axis(joint)
    if not axis.any():
        raise BadModel(f"{where}: joint '{joint.name}' has an axis of zero length; three numbers as 0 0 1 are wanted")
    limit = joint.limit
    effort = np.inf if limit is None or limit.effort is None else float(limit.effort)
    velocity = np.inf if limit is None or limit.velocity is None else float(limit.velocity)
    of_rate = np.array([effort]), np.array([velocity])
    if joint.type == "continuous" and joint.name not in coupled:
        # Python cannot give Pinocchio's unbounded joint an axis: its own z is turned onto ours. q: cosine and sine.
        turn = pin.SE3(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix(), np.zeros(3))
        bounds = np.full(2, -1.01), np.full(2, 1.01)
        return model.addJoint(parent, pin.JointModelRUBZ(), M * turn, joint.name, *of_rate, *bounds), turn.inverse()
    kind = pin.JointModelRevoluteUnaligned if joint.type == "revolute" else pin.JointModelPrismaticUnaligned
    low, high = find_bounds(joint, np.inf)
    added = model.addJoint(parent, kind(axis), M, joint.name, *of_rate, np.array([low]), np.array([high]))
    return added, pin.SE3.Identity()


def _mimicking(model: pin.Model, joint: Any, where: str) -> pin.Model:
    """The model in which `joint` follows the one it mimics."""
    leader = joint.mimic.joint or ""
    if not model.existJointName(joint.name) or not model.existJointName(leader) or leader == joint.name:
        raise BadModel(f"{where}: joint '{joint.name}' mimics '{leader}', which is no joint that it could follow")
    leader_id, to = model.getJointId(leader), model.getJointId(joint.name)
    if to < leader_id or model.nvs[to] != 1 or model.nvs[leader_id] != 1:
        raise BadModel(f"{where}: joint '{joint.name}' mimics '{leader}', which must be a joint before it, of one axis")
    ratio = 1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)
    offset = 0.0 if joint.mimic.offset is None else float(joint.mimic.offset)
    try:
        return pin.transformJointIntoMimic(model, leader_id, to, ratio, offset)
    except Exception as error:  # what C++ throws
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadModel(f"{where}: joint '{joint.name}' cannot mimic '{leader}': {reason}") from error


def _inertia(inertial: Any, where: str) -> pin.Inertia:
    placement = pin.SE3.Identity() if inertial.origin is None else pin.SE3(np.asarray(inertial.origin, dtype=float))
    inertia = np.asarray(inertial.inertia if inertial.inertia is not None else np.zeros((3, 3)), dtype=float)
    if not 0.0 < inertial.mass < _FAR or not np.isfinite(placement.homogeneous).all() or not np.isfinite(inertia).all():
        raise BadModel(f"{where}: mass {inertial.mass:g} kg, or its origin or inertia is NaN; a mass is above 0")
    # The constructor refuses what no body can have, as some URDFs state it; Pinocchio's own reader does not, nor do we:
    # `find_impossible_inertia` names it.
    total = pin.Inertia.Zero()
    total.mass, total.lever = float(inertial.mass), placement.translation
    total.inertia = placement.rotation @ inertia @ placement.rotation.T
    return total


def find_impossible_inertia(robot: Any) -> list[str]:
    """Links whose moments of inertia no body can have: one is negative, or larger than the two others together."""
    links = []
    for link in robot.links:
        inertial = link.inertial
        if inertial is not None and inertial.mass and inertial.inertia is not None:
            moments = np.linalg.eigvalsh(np.asarray(inertial.inertia, dtype=float))
            slack = 1e-6 * max(np.abs(moments).max(), 1e-9)  # of numbers that were cut
            if moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
                links.append(link.name)
    return links
