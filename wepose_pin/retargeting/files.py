"""Files of a trajectory: tables, ROS 2's message, the robot, the summary; and what writers of other formats take."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..body.urdf import resolve_meshes
from ..diagnostics import ERROR, INFO, WARNING, Diagnostic, as_json
from ..recording import format_span
from ..writers.joint_motion import ROBOT_URDF, TRAJECTORY
from ..writers.result import write_table
from .checks import LimitCheck, SelfCollisions
from .collision import CLEARANCE
from .error_attribution import CLAMPED, LOST_M, MissedTarget, attribute_errors, find_missed_targets
from .placement import place_root
from .targets import compute_target_reach
from .trajectory import Trajectory

DIGITS = 8  # of angles in text
MAX_MOMENTS = 6  # that a diagnostic names
MIN_SWIVEL = 0.03  # [m] from the line shoulder-hand to the elbow, below which the swivel error is undefined


def build_table(trajectory: Trajectory) -> pl.DataFrame:
    """``time``, ``recorded_time`` [s]; then each joint's position, ``_velocity`` and ``_acceleration``."""
    run = trajectory.run
    columns: dict[str, np.ndarray] = {"time": trajectory.time, "recorded_time": trajectory.recorded_time}
    for j, name in enumerate(trajectory.robot.names):
        columns |= {
            name: run.joint_position[:, j],
            f"{name}_velocity": run.joint_velocity[:, j],
            f"{name}_acceleration": run.joint_acceleration[:, j],
        }
    return pl.DataFrame(columns)


def write_trajectory(folder: Path, trajectory: Trajectory) -> None:
    """Write ``trajectory.parquet`` and ``.csv``, ``joint_trajectory.json``, and ``robot.urdf``."""
    table = build_table(trajectory)
    (folder / ROBOT_URDF).write_text(resolve_meshes(trajectory.robot.map.urdf), encoding="utf-8")
    write_table(folder / TRAJECTORY, table)
    table.write_csv(folder / "trajectory.csv", float_precision=DIGITS)
    (folder / "joint_trajectory.json").write_text(_format_joint_trajectory(trajectory), encoding="utf-8")


def _format_joint_trajectory(trajectory: Trajectory) -> str:
    """ROS 2's trajectory_msgs/msg/JointTrajectory."""
    rows, run = [], trajectory.run
    for k, time in enumerate(trajectory.time.tolist()):
        seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
        point = {
            "positions": np.round(run.joint_position[k], DIGITS).tolist(),
            "velocities": np.round(run.joint_velocity[k], DIGITS).tolist(),
            "accelerations": np.round(run.joint_acceleration[k], DIGITS).tolist(),
            "effort": [],
            "time_from_start": {"sec": seconds, "nanosec": nanoseconds},
        }
        rows.append(json.dumps(point, separators=(", ", ": ")))
    head = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    points = ",\n".join(rows)
    return (
        f'{{"header": {json.dumps(head)},\n"joint_names": {json.dumps(list(trajectory.robot.names))},\n'
        f'"points": [\n{points}\n]}}\n'
    )


def summarize(trajectory: Trajectory, limits: LimitCheck, collisions: SelfCollisions) -> dict[str, Any]:
    """Contents of ``summary.json``."""
    robot, begin, run = trajectory.robot, trajectory.approach_samples, trajectory.run
    arms = {arm.side: _summarize_arm(trajectory, i) for i, arm in enumerate(robot.arms)}
    dt = float(trajectory.time[1] - trajectory.time[0])
    recorded_time, limiting = trajectory.recorded_time, trajectory.limiting_joint
    recorded_s = float(recorded_time[-1] - recorded_time[begin])
    shown_s = float(trajectory.time[np.argmax(recorded_time)] - trajectory.time[begin])
    slowdown = shown_s / recorded_s if recorded_s else None
    nearest = float(run.report.hull_distance.min())
    missed = find_missed_targets(trajectory)
    R_WB, p_WB = place_root(robot)
    root = (*p_WB.tolist(), *Rotation.from_matrix(R_WB).as_quat().tolist())
    return {
        "robot": robot.map.name,
        "urdf": robot.map.urdf.name,
        "joints": list(robot.names),
        "posture": robot.posture,
        "root": dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), root, strict=True)),
        "description": robot.map.description,
        "rate_hz": round(1.0 / dt, 3),
        "duration_s": round(float(trajectory.time[-1]), 3),
        "approach_s": round(float(trajectory.time[begin]), 3),
        "recorded_s": round(recorded_s, 3),
        "slowdown": None if slowdown is None else round(slowdown, 3),
        "slowest": None if limiting is None else limiting._asdict(),
        "contact_times_s": trajectory.contact_times,
        "missed_targets": [target._asdict() for target in missed],
        "arms": arms,
        "within_limits": limits.passed,
        "speed_scale": robot.margins.speed_scale,
        "limit_margin_rad": robot.margins.limit_margin,
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
            "clearance_mm": 1e3 * CLEARANCE,
        },
        "steps": {
            "all": len(trajectory.time),
            "stopping_share": _share(run.report.stopping),
        },
        "diagnostics": [
            as_json(diagnostic) for diagnostic in diagnose_trajectory(trajectory, limits, collisions, missed, slowdown)
        ],
    }


def _summarize_arm(trajectory: Trajectory, i: int) -> dict[str, Any]:
    """One arm's errors."""
    robot, begin, run = trajectory.robot, trajectory.approach_samples, trajectory.run
    arm, target = robot.arms[i], trajectory.targets[i]
    inside = np.linalg.norm(target.position - target.unclamped, axis=1)[begin:] < CLAMPED
    far = 1e3 * np.linalg.norm(run.hand[i] - target.unclamped, axis=1)[begin:]
    error = Rotation.from_matrix(run.rotation[i, begin:]).inv() * Rotation.from_matrix(target.rotation[begin:])
    swivel, wanted = run.swivel[i, begin:], target.swivel[begin:]
    size, wanted_size = np.linalg.norm(swivel, axis=1), np.linalg.norm(wanted, axis=1)
    flexed = (size > MIN_SWIVEL) & (wanted_size > MIN_SWIVEL)
    cosine = np.sum(swivel[flexed] * wanted[flexed], axis=1) / (size[flexed] * wanted_size[flexed])
    return {
        "scale": round(trajectory.arm_targets.scale[arm.side], 4),
        "reach_m": round(compute_target_reach(robot, arm), 4),
        "farthest_reach_m": round(arm.reach, 4),
        "inside_reach_share": _share(inside),
        "hand_error_mm": _quantiles(far[inside]),
        "hand_error_everywhere_mm": _quantiles(far),
        "error_attribution": attribute_errors(trajectory, i),
        "hand_error_deg": _quantiles(np.degrees(error.magnitude())),
        "swivel_error_deg": _quantiles(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        "lost_share": _share(target.lost[begin:]),
    }


def diagnose_trajectory(
    trajectory: Trajectory,
    limits: LimitCheck,
    collisions: SelfCollisions,
    missed: list[MissedTarget],
    slowdown: float | None = None,
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
    for side in dict.fromkeys(target.side for target in missed):
        spans = [format_span((target.begin, target.end)) for target in missed if target.side == side]
        error = max(target.error for target in missed if target.side == side)
        moments = ", ".join(spans[:MAX_MOMENTS])
        diagnostics.append(Diagnostic("robot-hand-off-target", WARNING, side, error, LOST_M, {"moments": moments}))
    limiting = trajectory.limiting_joint
    if limiting is not None and slowdown is not None:
        moment: dict[str, float | str] = {
            "joint": limiting.joint,
            "moment": limiting.time,
            "quantity": limiting.quantity,
        }
        diagnostics.append(Diagnostic("trajectory-slowed", INFO, name, slowdown, facts=moment))
    if stopping := int(trajectory.run.report.stopping.sum()):
        diagnostics.append(Diagnostic("robot-stopped-for-clearance", WARNING, name, stopping))
    return diagnostics


def _quantiles(values: np.ndarray) -> dict[str, float] | None:
    if not len(values):
        return None
    return {name: round(float(np.percentile(values, q)), 2) for name, q in (("median", 50), ("p90", 90), ("p99", 99))}


def _share(mask: np.ndarray) -> float:
    return round(float(np.mean(mask)), 4)
