"""`Robot`: a URDF and its map, reduced to the joints of the arms, with their points, limits and collision geometry."""

from dataclasses import dataclass, replace
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from ..body.urdf import package_folders
from ..errors import BadModel, WrongOption, native_stderr_muted, one_of, reason
from ..recording import AXES
from .maps import ArmMap, HandPoint, JointLimit, LinkPoint, RobotMap, find_map

MIN_LIMIT_MARGIN = 1e-4  # [rad or m] inside every limit, so that a trajectory written with fewer digits keeps it too
MAX_SPEED_SCALE = 0.999  # of velocity, acceleration and jerk limits, for the same reason
TABLE_NAME = "universe_table"  # of its shape: of the root, as Pinocchio names it
TABLE_SIZE = (4.0, 4.0, 0.2)  # [m] of the box below the robot that stands for a table; the last is its thickness
SLIDE_M_PER_RAD = 0.1  # of a limit margin: 0.05 rad of a joint that rotates are 5 mm of one that slides
REST_MARGIN = 0.02  # [rad or m] of the rest posture inside the position limits
MAX_REST_ANGLE_DEG = 60.0  # between the hand in the rest posture and the direction ahead and below its shoulder
_REACH_STARTS = 8


@dataclass(frozen=True)
class Arm:
    """One arm of the reduced model."""

    side: str
    joints: np.ndarray  # (n,) int, indices of its joints in `Robot.names`
    shoulder: np.ndarray  # (3,) [m] in B
    hand: int  # frame of `Robot.model`
    elbow: int  # the same; -1 for an arm without one
    reach: float  # [m] largest distance of the hand from the shoulder that the joints allow


@dataclass(frozen=True)
class Robot:
    """A robot as the controller needs it: values `u` (n,) of the joints of its arms, in the order of `names`."""

    map: RobotMap
    names: tuple[str, ...]
    full: Any  # Pinocchio's model of the whole robot
    model: Any  # and of its arms' joints only
    geometry: Any  # collision geometry on `model`
    lower: np.ndarray  # (n,) limits [rad or m, s], these five, inside those of URDF and map
    upper: np.ndarray
    v_max: np.ndarray
    a_max: np.ndarray
    j_max: np.ndarray
    rest: np.ndarray  # (n,) rest posture
    rest_full: np.ndarray  # the same as a configuration of `full`
    R_BT: np.ndarray  # maps coordinates in the person's torso to B
    arms: tuple[Arm, ...]
    speed_scale: float  # share of the limits of velocity, acceleration and jerk that is used
    limit_margin: float  # [rad] to each position limit; of a joint that slides a tenth of it in metres

    def configuration(self, u: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration `q` of `model`: a continuous joint has cosine and sine there."""
        return u if self.model.nq == self.model.nv else pin.integrate(self.model, pin.neutral(self.model), u)

    @property
    def posture(self) -> dict[str, float]:
        """Joint that does not move → its value in the rest posture [rad or m]."""
        full, value = self.full, pin.difference(self.full, pin.neutral(self.full), self.rest_full)
        joints = {name: full.getJointId(name) for name in full.names[1:] if name not in self.names}
        return {name: float(value[full.idx_vs[joint]]) for name, joint in joints.items() if full.nvs[joint] == 1}

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Position limits (n,), (n,) within a turn to each side, for sampling."""
        return np.clip(self.lower, -np.pi, np.pi), np.clip(self.upper, -np.pi, np.pi)


def load_robot(
    robot: RobotMap | str, sides: tuple[str, ...] | None = None, speed_scale: float = 0.9, limit_margin: float = 0.05
) -> Robot:
    """Build the robot of a map, or of a name as of `find_map`, with the arms of `sides`, None: all.

    The other parameters are those of `retarget`.

    Raises
    ------
    MissingFile, BadModel, WrongOption
        A file, link or joint that does not exist; a joint without limits, or with a range that the margin uses up; an
        arm that the robot does not have.
    """
    if not 0.0 < speed_scale <= 1.0:
        raise WrongOption("speed_scale", f"{speed_scale:g}", "above 0, up to 1, the robot's full limits")
    if not 0.0 <= limit_margin < np.pi:
        raise WrongOption("limit_margin", f"{limit_margin:g}", "radians, at least 0, are needed")
    robot = robot if isinstance(robot, RobotMap) else find_map(robot)
    for side in sides or ():
        if side not in robot.arms:
            raise WrongOption("arm", side, f"{robot.name} has no {side} arm; {one_of(robot.arms)}")
    maps = {side: arm for side, arm in robot.arms.items() if sides is None or side in sides}
    limits = robot.read_joint_limits()
    try:
        with native_stderr_muted():  # urdfdom repeats the exception's text
            full = pin.buildModelFromUrdf(str(robot.urdf))
    except Exception as error:  # what C++ throws
        raise BadModel(f"{robot.urdf}: Pinocchio cannot build it: {reason(error)}") from error
    links = {frame.name for frame in full.frames if frame.type == pin.FrameType.BODY}
    for frame in full.frames:  # Pinocchio finds frames by name, and a fixed joint may have that of a link
        if frame.type == pin.FrameType.FIXED_JOINT and frame.name in links:
            frame.name = f"{frame.name} (fixed joint)"
    _check_map(robot, maps, full, limits)
    rest_full = _build_rest_configuration(robot, full, limits)
    base, data = pin.SE3.Identity(), full.createData()
    if robot.base:
        pin.framesForwardKinematics(full, data, rest_full)
        base = data.oMf[full.getFrameId(robot.base)]
    R_BT = np.asarray(base.rotation @ _build_rotation(AXES[robot.forward], AXES[robot.up]))
    try:
        folders = package_folders(robot.urdf)
        geometry = pin.buildGeomFromUrdf(full, str(robot.urdf), pin.GeometryType.COLLISION, package_dirs=folders)
    except Exception as error:  # what C++ throws
        raise BadModel(f"{robot.urdf}: its collision shapes cannot be read: {reason(error)}") from error
    if robot.table is not None:  # a box whose upper side is so far above the base's origin
        below = pin.SE3(np.eye(3), np.array([0.0, 0.0, robot.table - 0.5 * TABLE_SIZE[2]]))
        box = coal.Box(*TABLE_SIZE)
        geometry.addGeometryObject(pin.GeometryObject(TABLE_NAME, 0, 0, pin.SE3(R_BT, base.translation) * below, box))
    joints = {name for arm in maps.values() for name in arm.joints}
    locked = [full.getJointId(name) for name in full.names[1:] if name not in joints]
    model, geometry = pin.buildReducedModel(full, geometry, locked, rest_full)
    names = tuple(model.names[1:])
    lower, upper = np.array([_narrow_range(name, limits[name], limit_margin) for name in names]).T
    largest = [(limits[name].velocity, robot.acceleration[name], robot.jerk[name]) for name in names]
    v_max, a_max, j_max = min(speed_scale, MAX_SPEED_SCALE) * np.array(largest).T
    rest = np.clip([robot.rest.get(name, 0.0) for name in names], lower + REST_MARGIN, upper - REST_MARGIN)
    limited = lower, upper, v_max, a_max, j_max
    built = Robot(robot, names, full, model, geometry, *limited, rest, rest_full, R_BT, (), speed_scale, limit_margin)
    return replace(built, arms=tuple(_build_arm(built, side, arm) for side, arm in maps.items()))


def _check_map(robot: RobotMap, arms: dict[str, ArmMap], full: Any, limits: dict[str, JointLimit]) -> None:
    """Raise `BadModel` for a link or joint that the URDF lacks, and for a joint without limits."""
    links = [frame.name for frame in full.frames if frame.type == pin.FrameType.BODY]
    for side, arm in arms.items():
        where = f"arms.{side}.joints"
        for key, point in arm._asdict().items():
            if isinstance(point, LinkPoint | HandPoint):
                robot.check_name(f"arms.{side}.{key}", "link", point.link, links)
        hand = full.frames[full.getFrameId(arm.hand.link)].parentJoint
        chain = {full.names[joint] for joint in full.supports[hand].tolist()}
        for name in arm.joints:
            robot.check_name(where, "moving joint", name, limits)
            mimics = {joint: limit.mimic[0] for joint, limit in limits.items() if limit.mimic is not None}
            if name not in chain or name in mimics or name in mimics.values():
                copies = f"copies '{mimics[name]}'" if name in mimics else "is copied by another joint"
                state = copies if name in chain else f"does not move the hand's link '{arm.hand.link}'"
                text = f"'{name}' is no joint of the arm: it {state}"
                raise BadModel(f"{robot.where}: {where}: {text}; leave it out, it stays where 'rest' has it")
            _check_limits(robot, name, limits[name])
    for name in robot.rest:
        robot.check_name("rest", "moving joint", name, limits)
    if robot.base:
        robot.check_name("base", "link", robot.base, links)


def _check_limits(robot: RobotMap, name: str, limit: JointLimit) -> None:
    """Raise `BadModel` where the URDF or the map lacks a limit of a joint."""
    lacking = ["position limits"] * (limit.kind != "continuous" and not limit.lower < limit.upper)
    lacking += ["velocity limit"] * (not 0.0 < limit.velocity < np.inf)
    if lacking:
        raise BadModel(f"{robot.urdf}: joint '{name}' has no {lacking[0]}; write it into the map's [limits]")
    for key, values in (("acceleration", robot.acceleration), ("jerk", robot.jerk)):
        if not values.get(name, 0.0) > 0.0:
            state = f"is {values[name]:g}" if name in values else "has none"
            raise BadModel(f"{robot.where}: limits.{key}: joint '{name}' {state}; a number above 0 is needed")


def _build_rest_configuration(robot: RobotMap, full: Any, limits: dict[str, JointLimit]) -> np.ndarray:
    values = np.zeros(full.nv)
    for joint, name in enumerate(full.names):
        limit, value = limits.get(name), robot.rest.get(name, 0.0)
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
        values[full.idx_vs[joint]] = value
    return np.asarray(pin.integrate(full, pin.neutral(full), values))


def _narrow_range(name: str, limit: JointLimit, limit_margin: float) -> tuple[float, float]:
    """Return the position limits of a joint, less its margin [rad or m]."""
    scale = SLIDE_M_PER_RAD if limit.kind == "prismatic" else 1.0
    margin = max(scale * limit_margin, MIN_LIMIT_MARGIN)
    lower, upper = limit.lower + margin, limit.upper - margin
    if upper - lower < 2.0 * REST_MARGIN:
        text = f"joint '{name}' moves from {limit.lower:g} to {limit.upper:g} only"
        raise WrongOption("limit_margin", f"{limit_margin:g}", text)
    return lower, upper


def _build_arm(robot: Robot, side: str, arm: ArmMap) -> Arm:
    """An arm, whose points become frames of the robot's model."""
    model = robot.model
    shoulder = _add_frame(model, arm.shoulder, f"shoulder {side}")
    # The hand's frame as a person's: x to the side of the thumb and -z along the fingers.
    hand = _add_frame(model, arm.hand, f"hand {side}", _build_rotation(AXES[arm.hand.thumb], -AXES[arm.hand.fingers]))
    elbow = _add_frame(model, arm.elbow, f"elbow {side}") if arm.elbow else -1
    joints = np.array([robot.names.index(name) for name in arm.joints])
    data = model.createData()
    pin.framesForwardKinematics(model, data, robot.configuration(robot.rest))
    p_shoulder = data.oMf[shoulder].translation.copy()
    if any(name in robot.map.rest for name in arm.joints):
        _check_rest(robot, side, robot.R_BT.T @ (data.oMf[hand].translation - p_shoulder))
    reach = _find_reach(robot, joints, p_shoulder, hand)
    if (arm.reach or 0.0) > reach:
        raise BadModel(f"{robot.map.where}: arms.{side}.reach = {arm.reach:g}: the joints allow {reach:.2f} m at most")
    return Arm(side, joints, p_shoulder, hand, elbow, reach)


def _build_rotation(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The rotation with these first and third columns."""
    return np.column_stack([x, np.cross(z, x), z])


def _add_frame(model: Any, point: LinkPoint | HandPoint, name: str, R: np.ndarray | None = None) -> int:
    link = model.frames[model.getFrameId(point.link)]
    placement = link.placement * pin.SE3(np.eye(3) if R is None else R, np.array(point.offset))
    return int(model.addFrame(pin.Frame(f"wepose_{name}", link.parentJoint, placement, pin.FrameType.OP_FRAME)))


def _check_rest(robot: Robot, side: str, offset: np.ndarray) -> None:
    """Raise `BadModel` where the hand, `offset` (3,) [m] from its shoulder in T, is neither below nor ahead at rest."""
    x, y, z = offset
    angle = np.degrees(np.arccos((x - z) / np.sqrt(2.0) / max(np.linalg.norm(offset), 1e-9)))
    if angle > MAX_REST_ANGLE_DEG:
        raise BadModel(
            f"{robot.map.where}: rest: the {side} hand is {x:+.2f} m ahead of its shoulder, {y:+.2f} m to the left and "
            f"{z:+.2f} m up by base, up and forward; give a rest for this mount, the arm hanging, the forearm ahead"
        )


def _find_reach(robot: Robot, joints: np.ndarray, shoulder: np.ndarray, hand: int) -> float:
    """[m] largest of several local maxima from random postures: joint limits may keep an arm from being straight."""
    rng, data, u = np.random.default_rng(0), robot.model.createData(), robot.rest.copy()
    low, high = (limit[joints] for limit in robot.bounds)

    def compute_distance(values: np.ndarray) -> tuple[float, np.ndarray]:
        u[joints] = values
        pin.computeJointJacobians(robot.model, data, robot.configuration(u))
        p = pin.updateFramePlacement(robot.model, data, hand).translation - shoulder
        far = float(np.linalg.norm(p))
        J = pin.getFrameJacobian(robot.model, data, hand, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3]
        return -far, -(p / far) @ J[:, joints]

    starts = rng.uniform(low, high, (_REACH_STARTS, len(joints)))
    bounds = list(zip(low, high, strict=True))
    return -min(float(minimize(compute_distance, x, jac=True, bounds=bounds, method="L-BFGS-B").fun) for x in starts)
