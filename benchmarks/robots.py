"""The real upper-body recording on every robot of the package: offline as `wepose retarget`, live tick by tick."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from wepose_pin.body.kinematics import Pose
from wepose_pin.commands.recordings import track
from wepose_pin.commands.retarget import retarget
from wepose_pin.errors import BadOption
from wepose_pin.retargeting import (
    ROBOTS,
    ArmObserver,
    Command,
    CommandStream,
    Robot,
    check_limits,
    find_map,
    find_self_collisions,
    load_robot,
)
from wepose_pin.writers import load_result, select_pose

from .tables import Column, Section, Table

SESSION = Path("upper_body") / "session.toml"
QUICK_INTERVAL = (60.0, 70.0)  # [s] work at a table, the most agile of the recording
MARGINS = (
    Column("position", "pos.", 3),
    Column("velocity", "vel.", 1),
    Column("acceleration", "acc.", 1),
    Column("jerk", "jerk", 1),
    Column("collisions", "contact", 0),
)
ERRORS = (Column("hand", "median", 1), Column("hand_90", "90 %", 1), Column("infeasible", "unsolved", 3))
NOTE = (
    "Hands against their targets inside the reach [mm]; steps without a solution [%]; margins to the limits of URDF "
    "and map: position [rad], others [%]; samples in self-contact, by the robot's own shapes."
    " minute: processor time of a minute of the recording."
)


def sections(quick: bool, data: Path | None, robots: Sequence[str] = ()) -> list[Section]:
    """List the functions that measure; `robots`: those of the package without any."""
    if data is None or not (data / SESSION).is_file():
        raise BadOption(f"--data {data}: robots follow the recording {SESSION}, which is not there")
    interval = QUICK_INTERVAL if quick else None
    names = tuple(robots) or ROBOTS
    return [partial(measure, data / SESSION, names, interval) for measure in (measure_offline, measure_live)]


def measure_offline(session: Path, robots: Sequence[str], interval: tuple[float, float] | None) -> Table:
    """Measure `wepose retarget` with its default options, the page left out."""
    columns = (
        *ERRORS, Column("closest", "hulls [mm]", 0), *MARGINS, Column("slowdown", "slowed", 2),
        Column("wall", "minute [s]", 1),
    )  # fmt: skip
    table = Table("The upper-body recording retargeted", columns, notes=[NOTE])
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result"
        with contextlib.redirect_stdout(io.StringIO()):
            track(session, out=result, view=False, report=False)
        for name in robots:
            begin = time.process_time()
            with contextlib.redirect_stdout(io.StringIO()):
                summary = retarget(result, robot=name, out=Path(folder) / name, interval=interval, view=False).result
            wall = time.process_time() - begin
            margins = summary["limit_margins"]
            common = {key: 100.0 * margins[f"{key}_share"] for key in ("velocity", "acceleration", "jerk")} | {
                "position": margins["position_rad"],
                "infeasible": 100.0 * summary["steps"]["stopping_share"],
                "closest": summary["self_collisions"]["min_hull_distance_mm"] or np.nan,
                "collisions": summary["self_collisions"]["samples"],
                "slowdown": summary["slowdown"],
                "wall": 60.0 * wall / summary["recorded_s"],
            }
            for side, arm in summary["arms"].items():
                error = arm["hand_error_mm"]
                table.rows[f"{name} {side}"] = {"hand": error["median"], "hand_90": error["p90"]} | common
    return table


def measure_live(session: Path, robots: Sequence[str], interval: tuple[float, float] | None) -> Table:
    """Measure the commands of `wepose live --robot` at one a sample of the causally tracked recording."""
    columns = (
        *ERRORS, *MARGINS, Column("step", "step [ms]", 2), Column("step_99", "99 %", 2),
    )  # fmt: skip
    table = Table(
        "The upper-body recording followed live, one command a sample; errors against the low-passed target",
        columns,
        notes=[NOTE],
    )
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "result"
        with contextlib.redirect_stdout(io.StringIO()):
            track(session, out=result, causal=True, view=False, report=False)
        pose = select_pose(load_result(result), interval, None)
    for name in robots:
        robot = load_robot(find_map(name))
        stream, commands, steps = follow_pose(robot, pose)
        check, collisions = check_commands(robot, commands)
        error = 1e3 * np.array([command.error[:, 0] for command in commands if command.state in ("follow", "slow")])
        for i, arm in enumerate(robot.arms):
            table.rows[f"{name} {arm.side}"] = check | {
                "hand": float(np.median(error[:, i])),
                "hand_90": float(np.quantile(error[:, i], 0.9)),
                "infeasible": 100.0 * stream.stopping / len(commands),
                "collisions": collisions,
                "step": 1e3 * float(np.median(steps)),
                "step_99": 1e3 * float(np.quantile(steps, 0.99)),
            }
    return table


def follow_pose(robot: Robot, pose: Pose) -> tuple[CommandStream, list[Command], list[float]]:
    """Return the stream, its commands, and the duration [s] of each; the session ends with the pose."""
    stream = CommandStream(robot)
    observer = ArmObserver(robot, list(pose.quat_WL), list(pose.points))
    quat = np.stack(list(pose.quat_WL.values()), axis=1)
    points = np.stack(list(pose.points.values()), axis=1)
    std = np.stack([np.sqrt(np.trace(pose.segment_cov[name], axis1=1, axis2=2) / 3.0) for name in pose.quat_WL], axis=1)
    lost = np.zeros(quat.shape[1], dtype=bool)
    commands, steps = [], []
    for k, now in enumerate(pose.time.tolist()):
        stream.push(now, observer.observe(quat[k], points[k], std[k], lost))
        begin = time.perf_counter()
        commands.append(stream.step(now, 0.0))
        steps.append(time.perf_counter() - begin)
    stream.end("the recording has ended")
    while commands[-1].state != "stopped":
        commands.append(stream.step(float(pose.time[-1]), 0.0))
    return stream, commands, steps


def check_commands(robot: Robot, commands: Sequence[Command]) -> tuple[dict[str, float], int]:
    """Return the margins to the limits of URDF and map, and the number of commands in self-contact."""
    clock = np.array([command.clock for command in commands])
    u, v, a = (np.array([getattr(command, key) for command in commands]) for key in ("u", "v", "a"))
    columns: dict[str, Any] = {"time": clock}
    for j, name in enumerate(robot.names):
        columns |= {name: u[:, j], f"{name}_velocity": v[:, j], f"{name}_acceleration": a[:, j]}
    check = check_limits(pl.DataFrame(columns), robot.map)
    shares = {key: 100.0 * getattr(check, key) for key in ("velocity", "acceleration", "jerk")}
    return {"position": check.position} | shares, find_self_collisions(robot, clock, u).samples
