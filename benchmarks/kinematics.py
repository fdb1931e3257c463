"""Time of forward kinematics over whole recordings, beside a bare loop of Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from wepose_pin.body import load_model
from wepose_pin.body.configuration import solve_configuration
from wepose_pin.body.kinematics import compute_pose
from wepose_pin.body.links import compute_link_poses

from .tables import Column, Section, Table, time_in_turn

RATE_HZ = 100.0
MINUTES, QUICK_MINUTES = 10.0, 1.0
ROUNDS = 5
BARE = "Pinocchio's framesForwardKinematics alone"


def sections(quick: bool) -> dict[str, Section]:
    """Name → a function that measures it."""

    def measure() -> Table:
        return measure_kinematics(QUICK_MINUTES if quick else MINUTES)

    return {"kinematics": measure}


def measure_kinematics(minutes: float) -> Table:
    """Poses of the upper body with sensors on all segments, at 100 Hz."""
    body = load_model()
    n = round(60.0 * minutes * RATE_HZ)
    rng, time = np.random.default_rng(0), np.arange(n) / RATE_HZ
    quat_WL = {name: Rotation.random(n, random_state=rng).as_quat() for name in body.table.segments}
    q, data = solve_configuration(body, quat_WL), body.pin.createData()
    links = [point.link for point in body.table.points.values()]

    def run_bare() -> None:
        for row in q:
            pin.framesForwardKinematics(body.pin, data, row)

    cases = {
        BARE: run_bare,
        "positions and rotations of the points' links": lambda: compute_link_poses(body, q, links),
        "compute_pose: configuration and points": lambda: compute_pose(body, time, quat_WL),
    }
    table = Table(
        f"Forward kinematics: {minutes:g} min at {RATE_HZ:g} Hz",
        (Column("seconds", "time [s]", 2), Column("ratio", "times bare Pinocchio", 2, compared=True)),
    )
    for name, timing in time_in_turn(cases, ROUNDS, BARE).items():
        table.rows[name] = {"seconds": timing.median, "ratio": timing.ratio}
    return table
