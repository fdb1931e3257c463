"""What is written of a trajectory: tables, ROS 2's message, an episode for learning, the summary."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ..diagnostics import ERROR, INFO, Diagnostic, as_json
from ..recording import format_time
from ..writers.result import write_table
from .causes import DRAWN_IN, FAR, causes, possible
from .check import Kept, Touching
from .collision import CLEARANCE
from .person import robot_reach
from .plan import Trajectory

DIGITS = 8  # of angles in text
MOST_MOMENTS = 6  # of those at which the motion was slowed
BENT = 0.03  # [m] from the line shoulder-hand to the elbow: below it the swivel says nothing


def table(trajectory: Trajectory) -> pl.DataFrame:
    """``time``, ``recorded_time`` [s]; then each joint's position, ``_velocity`` and ``_acceleration``."""
    columns: dict[str, np.ndarray] = {"time": trajectory.time, "recorded_time": trajectory.recorded}
    for j, name in enumerate(trajectory.robot.names):
        columns[name] = trajectory.u[:, j]
        columns[f"{name}_velocity"] = trajectory.v[:, j]
        columns[f"{name}_acceleration"] = trajectory.a[:, j]
    return pl.DataFrame(columns)


def write_trajectory(folder: Path, trajectory: Trajectory) -> None:
    """``trajectory.parquet``, ``.csv``, and ``joint_trajectory.json`` and ``.yaml``."""
    whole = table(trajectory)
    write_table(folder / "trajectory.parquet", whole)
    whole.write_csv(folder / "trajectory.csv", float_precision=DIGITS)
    text = joint_trajectory(trajectory)
    (folder / "joint_trajectory.json").write_text(text, encoding="utf-8")
    (folder / "joint_trajectory.yaml").write_text(text, encoding="utf-8")  # YAML holds JSON; a point a line


def joint_trajectory(trajectory: Trajectory) -> str:
    """ROS 2's trajectory_msgs/msg/JointTrajectory; controllers draw a parabola between its points, as we do."""
    rows = []
    for k, time in enumerate(trajectory.time.tolist()):
        seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
        point = {
            "positions": np.round(trajectory.u[k], DIGITS).tolist(),
            "velocities": np.round(trajectory.v[k], DIGITS).tolist(),
            "accelerations": np.round(trajectory.a[k], DIGITS).tolist(),
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


def write_episode(folder: Path, trajectory: Trajectory, task: str) -> None:
    """One episode as LeRobot's data set of version 2.1 holds it: the state, and as action the state one sample on."""
    n, names = len(trajectory.time), list(trajectory.robot.names)
    state = trajectory.u.astype(np.float32)
    action = np.vstack([state[1:], state[-1:]])
    data = pl.DataFrame(
        {
            "observation.state": pl.Series(state.tolist(), dtype=pl.List(pl.Float32)),
            "action": pl.Series(action.tolist(), dtype=pl.List(pl.Float32)),
            "timestamp": trajectory.time.astype(np.float32),
            "frame_index": np.arange(n),
            "episode_index": np.zeros(n, dtype=np.int64),
            "index": np.arange(n),
            "task_index": np.zeros(n, dtype=np.int64),
        }
    )
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    write_table(folder / "data" / "chunk-000" / "episode_000000.parquet", data)
    joints = {"dtype": "float32", "shape": [len(names)], "names": names}
    number = {"dtype": "int64", "shape": [1], "names": None}
    info = {
        "codebase_version": "v2.1",
        "robot_type": trajectory.robot.map.name,
        "total_episodes": 1,
        "total_frames": n,
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": 1,
        "chunks_size": 1000,
        "fps": round(1.0 / float(trajectory.time[1] - trajectory.time[0])),
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
        "features": {
            "observation.state": joints,
            "action": joints,
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), number),
        },
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info, indent=2) + "\n", encoding="utf-8")
    for name, line in (
        ("tasks", {"task_index": 0, "task": task}),
        ("episodes", {"episode_index": 0, "tasks": [task], "length": n}),
    ):
        (folder / "meta" / f"{name}.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")


def summary(trajectory: Trajectory, held: Kept, touched: Touching) -> dict[str, Any]:
    """Numbers and words for ``summary.json``."""
    robot, begin = trajectory.robot, trajectory.approach
    arms: dict[str, Any] = {}
    frames, reached = possible(trajectory)
    for i, (arm, target) in enumerate(zip(robot.arms, trajectory.targets, strict=True)):
        side = arm.side
        inside = np.linalg.norm(target.position - target.wish, axis=1)[begin:] < DRAWN_IN
        far = 1e3 * np.linalg.norm(trajectory.hand[side] - target.wish, axis=1)[begin:]
        turn = Rotation.from_matrix(trajectory.turn[side][begin:]).inv() * Rotation.from_matrix(target.rotation[begin:])
        bend, asked = trajectory.bend[side][begin:], target.bend[begin:]
        size, wanted = np.linalg.norm(bend, axis=1), np.linalg.norm(asked, axis=1)
        bent = (size > BENT) & (wanted > BENT)
        cosine = np.sum(bend[bent] * asked[bent], axis=1) / (size[bent] * wanted[bent])
        arms[side] = {
            "scale": round(trajectory.wish.scale[side], 4),
            "reach_m": round(robot_reach(robot, arm), 4),
            "farthest_reach_m": round(arm.reach, 4),
            "inside_reach_share": _share(inside),
            "hand_error_mm": _quantiles(far[inside]),
            "hand_error_everywhere_mm": _quantiles(far),
            "possible": _possible(far[frames - begin], 1e3 * reached[:, i]),
            "causes": causes(trajectory, i),
            "hand_error_deg": _quantiles(np.degrees(turn.magnitude())),
            "swivel_error_deg": _quantiles(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
            "lost_share": _share(target.lost[begin:]),
        }
    ms, dt = 1e3 * trajectory.solve_s, float(trajectory.time[1] - trajectory.time[0])
    counts, steps = trajectory.counts, max(trajectory.counts.steps, 1)
    recorded_s = float(trajectory.recorded[-1] - trajectory.recorded[begin])
    shown_s = float(trajectory.time[np.argmax(trajectory.recorded)] - trajectory.time[begin])
    slow = trajectory.slowest
    nearest = float(trajectory.closest.min())
    jerk = np.abs(np.diff(trajectory.a, axis=0)) / dt
    slowed = shown_s / recorded_s if recorded_s else None
    return {
        "robot": robot.map.name,
        "urdf": robot.map.urdf.name,
        "joints": list(robot.names),
        "about": robot.map.about,
        "rate_hz": round(1.0 / dt, 3),
        "duration_s": round(float(trajectory.time[-1]), 3),
        "approach_s": round(float(trajectory.time[begin]), 3),
        "recorded_s": round(recorded_s, 3),
        "slowed": None if slowed is None else round(slowed, 3),
        "slowest": None if slow is None else slow._asdict(),
        "slowed_for_contact_s": list(trajectory.tight),
        "arms": arms,
        "limits_kept": held.all,
        "limit_margins": {
            "position_rad": held.position,
            "velocity_share": held.velocity,
            "acceleration_share": held.acceleration,
            "jerk_share": held.jerk,
        },
        "jerk_rad_s3": {"rms": round(float(np.sqrt(np.mean(jerk**2))), 2), "largest": round(float(jerk.max()), 1)},
        "self_collision": {
            "samples_touching": touched.samples,
            "first": touched.first or None,
            "pairs": touched.pairs,
            "pairs_left_out": {why: len(pairs) for why, pairs in touched.left_out.items()},
            "touch_at_rest": touched.left_out["touch at rest"],
            "closest_hulls_mm": round(1e3 * nearest, 1) if np.isfinite(nearest) else None,
            "kept_clear_mm": 1e3 * CLEARANCE,
        },
        "steps": {
            "all": counts.steps,
            "singular_share": round(counts.singular / (steps * len(robot.arms)), 4),
            "near_itself_share": round(counts.near / steps, 4),
            "no_solution_share": round(counts.held / steps, 4),
        },
        "solve_ms": {f"p{q}": round(float(np.percentile(ms, q)), 3) for q in (50, 99)},
        "diagnostics": [
            as_json(diagnostic) for diagnostic in trajectory_diagnostics(trajectory, held, touched, slowed)
        ],
    }


def trajectory_diagnostics(
    trajectory: Trajectory, held: Kept, touched: Touching, slowed: float | None = None
) -> list[Diagnostic]:
    """What to know before a robot runs the trajectory; `slowed`: how many times as long as the recording it takes."""
    name = trajectory.robot.map.name
    found = []
    margins = {key: getattr(held, key) for key in ("position", "velocity", "acceleration", "jerk")}
    for quantity, margin in margins.items():
        if margin < 0.0:
            facts = {"quantity": quantity} | ({"variant": "position"} if quantity == "position" else {})
            found.append(Diagnostic("robot-limits-exceeded", ERROR, name, -margin, 0.0, facts))
    if not (held.even and held.rests):
        found.append(Diagnostic("robot-limits-exceeded", ERROR, name, facts={"variant": "curve"}))
    if touched.samples:
        found.append(Diagnostic("robot-self-collision", ERROR, name, touched.samples, 0.0, {"first": touched.first}))
    slow = trajectory.slowest
    if slow is not None and slowed is not None:
        slowest: dict[str, float | str] = {"joint": slow.joint, "moment": slow.time, "quantity": slow.what}
        found.append(Diagnostic("trajectory-slowed", INFO, name, slowed, facts=slowest))
    if trajectory.tight:
        moments = ", ".join(map(format_time, trajectory.tight[:MOST_MOMENTS]))
        found.append(Diagnostic("trajectory-slowed-for-contact", INFO, name, facts={"moments": f"{moments} s"}))
    return found


def _possible(far: np.ndarray, reached: np.ndarray) -> dict[str, Any]:
    """How much of the hand's error [mm] is the robot's form, at some of the samples; see `causes.possible`."""
    known = np.isfinite(reached)
    far, reached = far[known], reached[known]
    within = reached < 1e3 * FAR
    return {
        "samples": len(far),
        "hand_error_mm": _quantiles(reached),
        "reachable_share": _share(within),
        "hand_error_where_reachable_mm": _quantiles(far[within]),
        "hand_error_above_mm": _quantiles(np.maximum(far - reached, 0.0)),
    }


def _quantiles(values: np.ndarray) -> dict[str, float] | None:
    if not len(values):
        return None
    return {name: round(float(np.percentile(values, q)), 2) for name, q in (("median", 50), ("p90", 90), ("p99", 99))}


def _share(which: np.ndarray) -> float:
    return round(float(np.mean(which)), 4)
