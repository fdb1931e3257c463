"""`Robot`: a URDF with its map as what the solver needs: the arms' joints alone, their points, limits and shapes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from ..errors import BadModel, BadOption, native_stderr_muted, one_of
from .limits import JointLimit, urdf_limits
from .maps import AXES, ArmMap, LinkPoint, RobotMap, example_data

POSITION_MARGIN = 1e-4  # [rad or m] kept from every limit, so that what is written with fewer digits keeps it too
SHARE = 0.999  # of velocity and acceleration limits, for the same reason
REST_OFF_DEG = 60.0  # by which a hand at rest may be off the direction ahead and below, seen from its shoulder
_REACH_STARTS = 8


@dataclass(frozen=True)
class Arm:
    """One arm in the reduced model.

    Parameters
    ----------
    joints : (n,) int, its joints in the robot's order
    shoulder : (3,) [m] in the root
    hand, elbow : Pinocchio's frames; `elbow` −1 without one
    reach : [m] farthest distance of the hand from the shoulder that the joints allow
    """

    side: str
    joints: np.ndarray
    shoulder: np.ndarray
    hand: int
    elbow: int
    reach: float


@dataclass(frozen=True)
class Robot:
    """A robot as the solver sees it: values `u` (n,) of the joints that move by themselves, in the order of `names`.

    Parameters
    ----------
    full, model : Pinocchio's model of the whole robot, and with only the arms' joints
    shapes : what collides, on `model`
    coupling, offset : joints of `model` = coupling @ u + offset; more rows than columns where a joint mimics another
    lower, upper, v_most, a_most, j_most : (n,) limits [rad or m, s], a little inside the URDF's and the map's
    R_BT : turns coordinates of the person's torso into the root's
    """

    map: RobotMap
    names: tuple[str, ...]
    full: Any
    model: Any
    shapes: Any
    coupling: np.ndarray
    offset: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    v_most: np.ndarray
    a_most: np.ndarray
    j_most: np.ndarray
    rest: np.ndarray
    rest_full: np.ndarray
    R_BT: np.ndarray
    arms: tuple[Arm, ...]

    def q(self, u: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration of `model`."""
        values = self.coupling @ u + self.offset
        if self._plain:
            return values
        q = pin.neutral(self.model)
        for k, (at, size) in enumerate(self._places):
            q[at : at + size] = values[k] if size == 1 else (np.cos(values[k]), np.sin(values[k]))
        return q

    @cached_property
    def _places(self) -> list[tuple[int, int]]:
        return [(self.model.idx_qs[j], self.model.nqs[j]) for j in range(1, self.model.njoints)]

    @cached_property
    def _plain(self) -> bool:
        return self.model.nq == self.model.nv


def load(robot: RobotMap, sides: tuple[str, ...] | None = None) -> Robot:
    """The robot of a map, with the arms of `sides`; None: all that it has.

    Raises
    ------
    MissingFile, BadModel, BadOption
        A file, link or joint that is not there; a joint without limits; an arm that the robot has not.
    """
    for side in sides or ():
        if side not in robot.arms:
            raise BadOption(f"--arm {side}: {robot.name} has no {side} arm; {one_of(robot.arms)}")
    chosen = {side: arm for side, arm in robot.arms.items() if sides is None or side in sides}
    said = urdf_limits(robot.urdf)
    try:
        with native_stderr_muted():  # urdfdom says the same once more
            full = pin.buildModelFromUrdf(str(robot.urdf))
    except Exception as error:  # what C++ throws
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadModel(f"{robot.urdf}: Pinocchio cannot build it: {reason}") from error
    joints = [name for arm in chosen.values() for name in arm.joints]
    _check(robot, chosen, full, said)
    followers = [name for name in full.names[1:] if _driven(said[name], joints)]
    moving = [name for name in full.names[1:] if name in joints or name in followers]
    rest_full = _rest(robot, full, said)
    shapes_full = _shapes(robot, full)
    locked = [full.getJointId(name) for name in full.names[1:] if name not in moving]
    model, shapes = pin.buildReducedModel(full, shapes_full, locked, rest_full)
    names = [name for name in model.names[1:] if name in joints and not _driven(said[name], joints)]
    coupling, offset = _coupling(list(model.names[1:]), names, said)
    lower, upper, v_most = _limits(list(model.names[1:]), coupling, offset, said)
    data, q = model.createData(), pin.neutral(model)
    rest = np.clip([robot.rest.get(name, 0.0) for name in names], lower + 0.02, upper - 0.02)
    a_most, j_most = (SHARE * np.array([of[name] for name in names]) for of in (robot.acceleration, robot.jerk))
    made = Robot(
        robot, tuple(names), full, model, shapes, coupling, offset, lower, upper, SHARE * v_most, a_most, j_most, rest,
        rest_full, _turn(robot, full, rest_full), (),
    )  # fmt: skip
    q = made.q(rest)
    pin.framesForwardKinematics(model, data, q)
    arms = []
    for side, arm in chosen.items():
        shoulder = _frame(model, arm.shoulder, f"{side}_shoulder")
        hand = _frame(model, arm.hand, f"{side}_palm", _hand_axes(arm))
        elbow = _frame(model, arm.elbow, f"{side}_elbow") if arm.elbow else -1
        own = np.array([names.index(name) for name in arm.joints if name in names])
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        at = data.oMf[shoulder].translation.copy()
        arms.append(Arm(side, own, at, hand, elbow, _reach(made, own, at, hand)))
        if any(name in robot.rest for name in arm.joints):
            _check_rest(made, arms[-1], data.oMf[hand].translation)
    return replace(made, arms=tuple(arms))


def _check(robot: RobotMap, arms: dict[str, ArmMap], full: Any, said: dict[str, JointLimit]) -> None:
    """Names that exist, limits that are there."""
    links = [frame.name for frame in full.frames if frame.type == pin.FrameType.BODY]
    for side, arm in arms.items():
        where = f"{robot.where}: arms.{side}"
        for key, point in (("shoulder", arm.shoulder), ("elbow", arm.elbow), ("hand", arm.hand)):
            if point is not None and point.link not in links:
                raise BadModel(
                    f"{where}.{key}: no link '{point.link}' in {robot.urdf.name}; {one_of(links, point.link)}"
                )
        for name in arm.joints:
            if name not in said:
                raise BadModel(
                    f"{where}.joints: no joint '{name}' that moves in {robot.urdf.name}; {one_of(said, name)}"
                )
            other = _not_of_the_arm(full, name, arm.hand.link)
            if other:
                raise BadModel(
                    f"{where}.joints: '{name}' is no joint of the arm: it {other}; leave it out, it stays where `rest` "
                    f"has it"
                )
            limit = said[name]
            if limit.kind != "continuous" and not limit.lower < limit.upper:
                raise BadModel(
                    f"{robot.urdf}: joint '{name}' has no position limits (lower {limit.lower:g}, upper "
                    f'{limit.upper:g}); write <limit lower="…" upper="…" velocity="…"/>'
                )
            if not 0.0 < limit.velocity < np.inf:
                raise BadModel(
                    f"{robot.urdf}: joint '{name}' has no velocity limit ({limit.velocity:g}); "
                    'write <limit velocity="…"/>'
                )
            if not _driven(limit, [name for arm in arms.values() for name in arm.joints]):
                for key, values, unit in (
                    ("acceleration", robot.acceleration, "rad/s²"),
                    ("jerk", robot.jerk, "rad/s³"),
                ):
                    value = values.get(name)
                    if value is None or not value > 0.0:
                        said_value = "has none" if value is None else f"is {value:g}"
                        raise BadModel(
                            f"{robot.where}: limits.{key}: joint '{name}' {said_value}; no URDF holds it, "
                            f"a number above 0 is needed [{unit}]"
                        )
    for name in robot.rest:
        if name not in said:
            raise BadModel(
                f"{robot.where}: rest.{name}: no joint that moves in {robot.urdf.name}; {one_of(said, name)}"
            )
    if robot.base and robot.base not in links:
        raise BadModel(f"{robot.where}: base: no link '{robot.base}' in {robot.urdf.name}; {one_of(links, robot.base)}")


def _not_of_the_arm(full: Any, name: str, hand: str) -> str:
    """Why a joint is none between the root and the hand's link; empty where it is one."""
    joint = full.getJointId(name)
    above = full.frames[full.getFrameId(hand)].parentJoint
    while above > joint:
        above = full.parents[above]
    if above != joint:
        return f"does not move the hand's link '{hand}'"
    beside = [k for k in range(1, full.njoints) if k != joint and full.parents[k] == full.parents[joint]]
    slides = [full.joints[k].shortname().startswith("JointModelP") for k in (joint, *beside)]
    if slides[0] and any(slides[1:]):
        return f"slides beside '{full.names[beside[slides.index(True, 1) - 1]]}' as a gripper's fingers do"
    return ""


def _check_rest(robot: Robot, arm: Arm, hand: np.ndarray) -> None:
    """The stated rest is one for this mount: the hand, at `hand` (3,) [m] in the root, is below or ahead."""
    offset = robot.R_BT.T @ (hand - arm.shoulder)
    off = np.degrees(np.arccos((offset[0] - offset[2]) / np.sqrt(2.0) / max(np.linalg.norm(offset), 1e-9)))
    if off > REST_OFF_DEG:
        x, y, z = offset
        raise BadModel(
            f"{robot.map.where}: rest: the {arm.side} hand is {x:+.2f} m ahead of its shoulder, {y:+.2f} m to the left "
            f"and {z:+.2f} m up, with base, up and forward as they are: {off:.0f} deg off ahead and below, at most "
            f"{REST_OFF_DEG:g}; give a rest for this mount, the arm hanging, the forearm ahead, or none"
        )


def _driven(limit: JointLimit, joints: list[str]) -> bool:
    return limit.mimic is not None and limit.mimic[0] in joints


def _rest(robot: RobotMap, full: Any, said: dict[str, JointLimit]) -> np.ndarray:
    q = pin.neutral(full)
    for name in full.names[1:]:
        joint = full.getJointId(name)
        value = robot.rest.get(name, 0.0)
        limit = said.get(name)
        if limit is None or full.nvs[joint] != 1:
            continue
        if limit.mimic is not None:
            value = limit.mimic[1] * robot.rest.get(limit.mimic[0], 0.0) + limit.mimic[2]
        elif name in robot.rest and not limit.lower - 1e-6 <= value <= limit.upper + 1e-6:
            raise BadModel(
                f"{robot.where}: rest.{name} = {value:g} is outside its limits, {limit.lower:g} to {limit.upper:g}"
            )
        elif limit.lower <= limit.upper:
            value = float(np.clip(value, limit.lower, limit.upper))
        at = full.idx_qs[joint]
        q[at : at + full.nqs[joint]] = value if full.nqs[joint] == 1 else (np.cos(value), np.sin(value))
    return q


def _shapes(robot: RobotMap, full: Any) -> Any:
    """What collides; none where the URDF has none."""
    data = example_data()
    folders = [str(folder) for folder in robot.urdf.absolute().parents]
    if data is not None:
        folders += [str(data), str(data.parent), str(data.parent.parent)]
    try:
        return pin.buildGeomFromUrdf(full, str(robot.urdf), pin.GeometryType.COLLISION, package_dirs=folders)
    except Exception as error:  # what C++ throws
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadModel(f"{robot.urdf}: its collision shapes cannot be read: {reason}") from error


def _coupling(of: list[str], free: list[str], said: dict[str, JointLimit]) -> tuple[np.ndarray, np.ndarray]:
    coupling, offset = np.zeros((len(of), len(free))), np.zeros(len(of))
    for k, name in enumerate(of):
        mimic = said[name].mimic
        if name in free:
            coupling[k, free.index(name)] = 1.0
        else:
            assert mimic is not None
            coupling[k, free.index(mimic[0])], offset[k] = mimic[1], mimic[2]
    return coupling, offset


def _limits(
    of: list[str], coupling: np.ndarray, offset: np.ndarray, said: dict[str, JointLimit]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Limits of the free joints, those of what mimics them kept too."""
    n = coupling.shape[1]
    lower, upper, velocity = np.full(n, -np.inf), np.full(n, np.inf), np.full(n, np.inf)
    for k, name in enumerate(of):
        j = int(np.argmax(np.abs(coupling[k])))
        factor = coupling[k, j]
        if factor == 0.0:
            continue
        ends = sorted((value - offset[k]) / factor for value in (said[name].lower, said[name].upper))
        lower[j], upper[j] = max(lower[j], ends[0] + POSITION_MARGIN), min(upper[j], ends[1] - POSITION_MARGIN)
        if said[name].velocity > 0.0:
            velocity[j] = min(velocity[j], said[name].velocity / abs(factor))
    return lower, upper, velocity


def _turn(robot: RobotMap, full: Any, rest_full: np.ndarray) -> np.ndarray:
    up, forward = AXES[robot.up], AXES[robot.forward]
    R_LT = np.column_stack([forward, np.cross(up, forward), up])
    if not robot.base:
        return R_LT
    data = full.createData()
    pin.framesForwardKinematics(full, data, rest_full)
    return data.oMf[full.getFrameId(robot.base)].rotation @ R_LT


def _hand_axes(arm: ArmMap) -> np.ndarray:
    """R_LH: the hand as a person's, x to the thumb's side and −z along the fingers when it hangs."""
    up, thumb = -AXES[arm.fingers], AXES[arm.thumb]
    return np.column_stack([thumb, np.cross(up, thumb), up])


def _frame(model: Any, point: LinkPoint, name: str, R: np.ndarray | None = None) -> int:
    link = model.frames[model.getFrameId(point.link)]
    inside = pin.SE3(np.eye(3) if R is None else R, np.array(point.at))
    return int(
        model.addFrame(pin.Frame(f"wepose_{name}", link.parentJoint, link.placement * inside, pin.FrameType.OP_FRAME))
    )


def _reach(robot: Robot, own: np.ndarray, shoulder: np.ndarray, hand: int) -> float:
    """Farthest of many climbs from random places: the arm need not be straight where its joints stop before."""
    rng, data = np.random.default_rng(0), robot.model.createData()
    low, high = (np.clip(limit[own], -np.pi, np.pi) for limit in (robot.lower, robot.upper))
    u = robot.rest.copy()

    def distance(part: np.ndarray) -> tuple[float, np.ndarray]:
        u[own] = part
        pin.computeJointJacobians(robot.model, data, robot.q(u))
        p = pin.updateFramePlacement(robot.model, data, hand).translation - shoulder
        far = float(np.linalg.norm(p))
        J = pin.getFrameJacobian(robot.model, data, hand, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3]
        return -far, -(p / far) @ J @ robot.coupling[:, own]

    starts = rng.uniform(low, high, (_REACH_STARTS, len(own)))
    best = [
        minimize(distance, x, jac=True, bounds=list(zip(low, high, strict=True)), method="L-BFGS-B") for x in starts
    ]
    return -min(float(found.fun) for found in best)
