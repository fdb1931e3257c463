"""What came of a trajectory: checks, errors of the hands and their causes, diagnostics, the summary, and the files.

The checks share no step with the controller: limits are those of URDF and map, shapes those of coal.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation

from ..body.urdf import resolve_meshes
from ..diagnostics import ERROR, INFO, WARNING, Diagnostic, as_json
from ..recording import find_runs, format_span
from ..writers.motion import ROBOT_URDF
from ..writers.result import TRAJECTORY, write_table
from .collision import copy_checked_shapes
from .maps import RobotMap
from .robot import Robot
from .trajectory import Trajectory
from .visuals import place_root

DIGITS = 8  # of angles in text
MAX_MOMENTS = 6  # that a diagnostic names
MIN_SWIVEL = 0.03  # [m] from the line shoulder-hand to the elbow, below which the swivel error is undefined
FAR = 0.02  # [m] off the target: above it the error is attributed
CLAMPED = 1e-3  # [m] by which a target was moved: it was outside the reach
AT_LIMIT = 0.01  # [rad or m] from a position limit: there an active joint is at its position limit
CATCH_UP_S = 0.3  # [s] after a joint was too slow in which its error is attributed to that
CAUSES = ("not measured", "beyond the reach", "self-collision", "joint limit", "too fast", "conflicting tasks")
LOST_M, LOST_S = 0.05, 1.0  # a hand is lost that is farther off for longer
MIN_WEIGHT = 0.5  # of a hand; where its target is more uncertain, its error does not count


class LimitCheck(NamedTuple):
    """Margins of a trajectory to its limits; negative: a limit is exceeded."""

    position: float  # [rad or m] to the nearest position limit
    velocity: float  # share of the velocity limits that is never used
    acceleration: float  # of the acceleration limits
    jerk: float  # of the jerk limits
    consistent: bool  # velocities and accelerations are those of one curve through the positions, cubic in each step
    ends_at_rest: bool  # it begins and ends without velocity and acceleration

    @property
    def passed(self) -> bool:
        """Whether every limit is kept."""
        margins = self.position, self.velocity, self.acceleration, self.jerk
        return min(margins) >= 0.0 and self.consistent and self.ends_at_rest


def check_limits(table: pl.DataFrame, robot: RobotMap) -> LimitCheck:
    """Compare a table as in ``trajectory.parquet`` with the limits of a robot's URDF and map, without any margin.

    Checked at the samples and at ten points between each two, on the cubics through positions and velocities.
    """
    limits, time = robot.read_joint_limits(), table["time"].to_numpy()
    joints = [name for name in table.columns if name in limits]
    q, v, a = (
        table.select([f"{j}{suffix}" for j in joints]).to_numpy() for suffix in ("", "_velocity", "_acceleration")
    )
    low, high, v_max = (np.array([getattr(limits[j], key) for j in joints]) for key in ("lower", "upper", "velocity"))
    a_max, j_max = (np.array([values[j] for j in joints]) for values in (robot.acceleration, robot.jerk))
    dt = np.diff(time)[:, None]
    curve = CubicHermiteSpline(time, q, v)
    dense = np.unique(np.concatenate([time, (time[:-1, None] + dt * np.arange(0.1, 1.0, 0.1)).ravel()]))
    q_between, v_between = curve(dense), curve(dense, 1)
    jerks, left = 6.0 * curve.c[0], 2.0 * curve.c[1]  # of each step, and the acceleration at its beginning
    right = left + jerks * dt
    steps = np.abs(np.diff(a, axis=0)) / dt
    return LimitCheck(
        position=float(min((q_between - low).min(), (high - q_between).min())),
        velocity=float(1.0 - max((np.abs(v) / v_max).max(), (np.abs(v_between) / v_max).max())),
        acceleration=float(1.0 - max((np.abs(x) / a_max).max() for x in (a, left, right))),
        jerk=float(1.0 - max((np.abs(x) / j_max).max() for x in (jerks, steps))),
        consistent=bool(np.allclose(left, a[:-1], atol=1e-4) and np.allclose(right, a[1:], atol=1e-4)),
        ends_at_rest=bool(np.abs(np.concatenate([v[[0, -1]], a[[0, -1]]])).max() < 1e-9),
    )


class SelfCollisions(NamedTuple):
    """Samples of a trajectory at which the robot collides with itself."""

    samples: int
    first: str  # the first pair, and when; empty without a collision
    pairs: int  # of shapes that were checked


def find_self_collisions(robot: Robot, time: np.ndarray, u: np.ndarray) -> SelfCollisions:
    """Check every sample with the robot's own shapes, not their hulls.

    The pairs are those of `copy_checked_shapes`; what the controller leaves out of them has no part in it.
    """
    shapes = copy_checked_shapes(robot)
    data, geometry = robot.model.createData(), shapes.createData()
    boxes = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(robot.model, shapes, geometry)
    hits = [
        k for k in range(len(u)) if pin.computeCollisions(robot.model, data, boxes, robot.configuration(u[k]), True)
    ]
    first = ""
    if hits:
        pin.computeCollisions(robot.model, data, shapes, geometry, robot.configuration(u[hits[0]]), True)
        collides = [result.isCollision() for result in geometry.collisionResults]
        pair = shapes.collisionPairs[collides.index(True)]
        names = " and ".join(shapes.geometryObjects[i].name for i in (pair.first, pair.second))
        first = f"{names} at {float(time[hits[0]]):.2f} s"
    return SelfCollisions(len(hits), first, len(shapes.collisionPairs))


def find_error_causes(trajectory: Trajectory, arm: int) -> np.ndarray:
    """Return the cause (n,) of the error of a hand, its place in `CAUSES`; -1 where the hand is less than `FAR` off.

    The first that applies: a sensor was lost; the target is beyond the reach; links close to each other stop the arm; a
    joint is at its position limit; a joint is at a limit of velocity, acceleration or jerk, or was so shortly before;
    none of these: position, orientation and swivel cannot be met together.
    """
    robot, report = trajectory.robot, trajectory.report
    joints, target = robot.arms[arm].joints, trajectory.targets[arm]
    u = trajectory.joint_position[:, joints]
    at_limit = (u - robot.lower[joints] < AT_LIMIT) | (robot.upper[joints] - u < AT_LIMIT)
    active, half = report.limited[:, joints], round(0.5 * CATCH_UP_S / float(trajectory.time[1]))
    applies = [
        target.lost,
        np.linalg.norm(target.position - target.unclamped, axis=1) > CLAMPED,
        report.near_contact[:, joints].any(axis=1),
        (active & at_limit).any(axis=1),
        maximum_filter1d(active.any(axis=1), 2 * half + 1, origin=half),
        np.ones(len(u), dtype=bool),
    ]
    far = np.linalg.norm(trajectory.p_BH[arm] - target.unclamped, axis=1) > FAR
    return np.where(far, np.argmax(applies, axis=0), -1)


def _find_missed_targets(trajectory: Trajectory, i: int) -> list[tuple[tuple[float, float], float]]:
    """Return the times [s] of the recording in which a hand is off by more than `LOST_M` for longer than `LOST_S`.

    With each, the largest error [m].
    """
    target, least = trajectory.targets[i], round(LOST_S / float(trajectory.time[1]))
    distance = np.linalg.norm(trajectory.p_BH[i] - target.position, axis=1)
    lost = (distance > LOST_M) & (target.weight >= MIN_WEIGHT) & ~target.lost & (trajectory.params.position > 0.0)
    lost[: trajectory.approach_samples] = False
    runs = [(first, end) for first, end in find_runs(lost) if end - first >= least]
    times = trajectory.recorded_time
    return [((float(times[a]), float(times[b - 1])), float(distance[a:b].max())) for a, b in runs]


def diagnose_trajectory(
    trajectory: Trajectory, limits: LimitCheck, collisions: SelfCollisions, slowdown: float | None = None
) -> list[Diagnostic]:
    """Diagnostics of a trajectory; `slowdown`: its duration over that of the recording."""
    name = trajectory.robot.map.name
    diagnostics = []
    for quantity in ("position", "velocity", "acceleration", "jerk"):
        margin = getattr(limits, quantity)
        if margin < 0.0:
            facts = {"quantity": quantity} | ({"variant": "position"} if quantity == "position" else {})
            diagnostics.append(Diagnostic("robot-limits-exceeded", ERROR, name, -margin, 0.0, facts))
    if not (limits.consistent and limits.ends_at_rest):
        diagnostics.append(Diagnostic("robot-limits-exceeded", ERROR, name, facts={"variant": "curve"}))
    if collisions.samples:
        first = {"first": collisions.first}
        diagnostics.append(Diagnostic("robot-self-collision", ERROR, name, collisions.samples, 0.0, first))
    if not collisions.pairs:
        diagnostics.append(Diagnostic("robot-shapes-missing", WARNING, name))
    for i, arm in enumerate(trajectory.robot.arms):
        if missed := _find_missed_targets(trajectory, i):
            facts = {"moments": ", ".join(format_span(span) for span, _ in missed[:MAX_MOMENTS])}
            error = max(error for _, error in missed)
            diagnostics.append(Diagnostic("robot-hand-off-target", WARNING, arm.side, error, LOST_M, facts))
    if (slowest := trajectory.slowest) is not None and slowdown is not None:
        about = {"joint": slowest["joint"], "quantity": slowest["quantity"], "moment": slowest["time"]}
        diagnostics.append(Diagnostic("trajectory-slowed", INFO, name, slowdown - 1.0, facts=about))
    if stopping := int(trajectory.report.stopping.sum()):
        diagnostics.append(Diagnostic("robot-stopped-for-clearance", WARNING, name, stopping))
    return diagnostics


def summarize(trajectory: Trajectory, limits: LimitCheck, collisions: SelfCollisions) -> dict[str, Any]:
    """Contents of ``summary.json``."""
    robot, report = trajectory.robot, trajectory.report
    begin = trajectory.approach_samples
    recorded_s = float(trajectory.recorded_time[-1] - trajectory.recorded_time[begin])
    shown_s = float(trajectory.time[np.argmax(trajectory.recorded_time)] - trajectory.time[begin])
    slowdown = round(shown_s / recorded_s, 3) if recorded_s else None
    nearest = float(report.hull_distance.min())
    R_WB, p_WB = place_root(robot)
    root = (*p_WB.tolist(), *Rotation.from_matrix(R_WB).as_quat().tolist())
    return {
        "robot": robot.map.name,
        "urdf": robot.map.urdf.name,
        "joints": list(robot.names),
        "posture": robot.posture,
        "root": dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), root, strict=True)),
        "description": robot.map.description,
        "rate_hz": round(1.0 / float(trajectory.time[1]), 3),
        "duration_s": round(float(trajectory.time[-1]), 3),
        "approach_s": round(float(trajectory.time[begin]), 3),
        "recorded_s": round(recorded_s, 3),
        "slowdown": slowdown,
        "slowest": trajectory.slowest,
        "arms": {arm.side: _summarize_arm(trajectory, i) for i, arm in enumerate(robot.arms)},
        "within_limits": limits.passed,
        "limit_margins": {
            "position_rad": limits.position,
            "velocity_share": limits.velocity,
            "acceleration_share": limits.acceleration,
            "jerk_share": limits.jerk,
        },
        "self_collisions": {
            "samples": collisions.samples,
            "first": collisions.first or None,
            "pairs": collisions.pairs,
            "min_hull_distance_mm": round(1e3 * nearest, 1) if np.isfinite(nearest) else None,
        },
        "steps": {"stopping_share": _share(report.stopping)},
        "diagnostics": [as_json(each) for each in diagnose_trajectory(trajectory, limits, collisions, slowdown)],
    }


def _summarize_arm(trajectory: Trajectory, i: int) -> dict[str, Any]:
    """Errors of one arm after the approach."""
    arm, target = trajectory.robot.arms[i], trajectory.targets[i]
    moving = slice(trajectory.approach_samples, None)
    inside = np.linalg.norm(target.position - target.unclamped, axis=1)[moving] < CLAMPED
    far = 1e3 * np.linalg.norm(trajectory.p_BH[i] - target.unclamped, axis=1)[moving]
    turn = Rotation.from_matrix(trajectory.R_BH[i, moving]).inv() * Rotation.from_matrix(target.rotation[moving])
    swivels = trajectory.swivel[i, moving], target.swivel[moving]
    sizes = [np.linalg.norm(swivel, axis=1) for swivel in swivels]
    flexed = np.min(sizes, axis=0) > MIN_SWIVEL
    cosine = np.sum(swivels[0] * swivels[1], axis=1)[flexed] / (sizes[0] * sizes[1])[flexed]
    cause = find_error_causes(trajectory, i)[moving]
    return {
        "scale": round(trajectory.scale[arm.side], 4),
        "inside_reach_share": _share(inside),
        "hand_error_mm": _quantiles(far[inside]),
        "hand_error_everywhere_mm": _quantiles(far),
        "error_attribution": {name: _share(cause == k) for k, name in enumerate(CAUSES)},
        "hand_error_deg": _quantiles(np.degrees(turn.magnitude())),
        "swivel_error_deg": _quantiles(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
    }


def _quantiles(values: np.ndarray) -> dict[str, float] | None:
    if not len(values):
        return None
    return {name: round(float(np.percentile(values, q)), 2) for name, q in (("median", 50), ("p90", 90), ("p99", 99))}


def _share(mask: np.ndarray) -> float:
    return round(float(np.mean(mask)), 4)


def build_table(trajectory: Trajectory) -> pl.DataFrame:
    """``time``, ``recorded_time`` [s]; then each joint's position, ``_velocity`` and ``_acceleration``."""
    columns: dict[str, np.ndarray] = {"time": trajectory.time, "recorded_time": trajectory.recorded_time}
    for j, name in enumerate(trajectory.robot.names):
        columns |= {
            name: trajectory.joint_position[:, j],
            f"{name}_velocity": trajectory.joint_velocity[:, j],
            f"{name}_acceleration": trajectory.joint_acceleration[:, j],
        }
    return pl.DataFrame(columns)


def write_trajectory(folder: Path, trajectory: Trajectory) -> None:
    """Write ``trajectory.parquet`` and ``.csv``, ``joint_trajectory.json``, and ``robot.urdf``."""
    table = build_table(trajectory)
    (folder / ROBOT_URDF).write_text(resolve_meshes(trajectory.robot.map.urdf), encoding="utf-8")
    write_table(folder / TRAJECTORY, table)
    with (folder / "trajectory.csv").open("wb") as file:  # polars takes only a path in UTF-8
        table.write_csv(file, float_precision=DIGITS)
    (folder / "joint_trajectory.json").write_text(_format_joint_trajectory(trajectory), encoding="utf-8")


def _format_joint_trajectory(trajectory: Trajectory) -> str:
    """ROS 2's trajectory_msgs/msg/JointTrajectory."""
    states = trajectory.joint_position, trajectory.joint_velocity, trajectory.joint_acceleration
    points = []
    for time, *state in zip(trajectory.time.tolist(), *(np.round(x, DIGITS).tolist() for x in states), strict=True):
        moment = dict(zip(("sec", "nanosec"), divmod(round(1e9 * time), 10**9), strict=True))
        point = dict(zip(("positions", "velocities", "accelerations"), state, strict=True))
        points.append(point | {"effort": [], "time_from_start": moment})
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return json.dumps({"header": header, "joint_names": list(trajectory.robot.names), "points": points}) + "\n"
