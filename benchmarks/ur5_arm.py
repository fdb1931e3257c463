"""A UR5: an arm with its axes, its recordings as sessions, and a simulated one with a sensor on each link."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
import polars as pl
from scipy.spatial.transform import Rotation

from benchmarks.trials import list_ur5, read_ur5
from benchmarks.validation.real import UR5_EXCLUDED
from wepose_pin.body import BodyModel
from wepose_pin.recording import CONFIGURATION, ImuSensor, Recording
from wepose_pin.simulation import MTI_3, ImuNoise

# The axes of a UR5's joints while all are at zero, the arm stretched out along x.
UR5 = {
    "shoulder_pan_joint": ("shoulder_link", "0 0 1", "0 0 0.089"),
    "shoulder_lift_joint": ("upper_arm_link", "0 1 0", "0 0.136 0"),
    "elbow_joint": ("forearm_link", "0 1 0", "0.425 -0.12 0"),
    "wrist_1_joint": ("wrist_1_link", "0 1 0", "0.392 0 0"),
    "wrist_2_joint": ("wrist_2_link", "0 0 -1", "0 0.093 0"),
    "wrist_3_joint": ("wrist_3_link", "0 1 0", "0 0 -0.095"),
}
UPRIGHT = {"shoulder_lift_joint": -np.pi / 2.0, "wrist_1_joint": -np.pi / 2.0}
MARKED = {"radius": "forearm_link", "carpus": "wrist_1_link"}
RUNS = ("circle-100", "circle-250", "triangle-150", "triangle-250")

# The simulated arm: its start pose, what it is made of, and its errors.
RATE, START_S, MOVE_S = 50.0, (0.5, 4.5), 5.0
BENT = {
    "shoulder_pan_joint": 0.0,
    "shoulder_lift_joint": -1.2,
    "elbow_joint": 1.6,
    "wrist_1_joint": -1.0,
    "wrist_2_joint": -1.57,
    "wrist_3_joint": 0.3,
}
TRUE = {"upper_arm": 1.05, "forearm": 0.94}  # times the table's own, whose standard deviation is a tenth
SENSED = ("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")
TABLE = """urdf = "arm.urdf"
kind = "mechanism"
[segments]
{segments}
[points]
base = "upper_arm_link"
elbow = "forearm_link"
wrist = "wrist_1_link"
tip = {{ link = "wrist_3_link", at = [0.0, 0.15, 0.0] }}
[lengths]
upper_arm = {{ segment = "upper_arm_link", from = "base", to = "elbow", std_percent = 10 }}
forearm = {{ segment = "forearm_link", from = "elbow", to = "wrist", std_percent = 10 }}
"""
START_STD = np.deg2rad(0.3)  # [rad] of each joint against the stated start pose
SENSOR_AT = np.array([0.05, 0.03, 0.02])  # [m] in its link
BIAS_STD, ACCEL_BIAS_STD = np.deg2rad(0.2), 0.02  # [rad/s], [m/s²]
AWAY = np.array([0.10, -0.15, 0.08])  # [m] the second point from the first


def write_urdf(folder: Path) -> Path:
    """Write an arm with a UR5's axes, arm.urdf; 1 kg a link."""
    text, parent = '<link name="base_link"/>', "base_link"
    mass = '<inertial><mass value="1"/><inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/></inertial>'
    for name, (child, axis, at) in UR5.items():
        text += (
            f'<link name="{child}">{mass}</link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{at}"/><axis xyz="{axis}"/>'
            f'<limit lower="-6.3" upper="6.3" effort="100" velocity="3"/></joint>'
        )
        parent = child
    file = folder / "arm.urdf"
    file.write_text(f'<robot name="arm">{text}</robot>', encoding="utf-8")
    return file


def write_ur5_session(data: Path, run: str, folder: Path) -> dict[str, Rotation]:
    """Write a run as a session, squarely mounted as the axes say; return its encoders' orientations of the links in W.

    The encoders' frames equal each other at the start, where the arm stands upright; their x is W's y there. That their
    joint angles, taken so, have the tool drawn in a plane to 0.1 mm is what says that the start is `UPRIGHT`.
    """
    sensors = [sensor for of, sensor in list_ur5(data) if of == run and (run, sensor) not in UR5_EXCLUDED]
    trials = {sensor: read_ur5(data, run, sensor) for sensor in sensors}
    table: dict[str, np.ndarray] = {}
    text, truth = "", {}
    for sensor, trial in trials.items():
        for kind, values in (("gyr", trial.gyro_S), ("acc", trial.accel_S)):
            table |= {f"{sensor}_{kind}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
        gyro, accel = (json.dumps([f"{sensor}_{kind}_{axis}" for axis in "xyz"]) for kind in ("gyr", "acc"))
        text += f'[sensors.{MARKED[sensor]}]\ngyro = {gyro}\naccel = {accel}\nmount = {{ up = "-y", forward = "-x" }}\n'
        R_WB = Rotation.from_euler("z", np.pi / 2.0) * Rotation.from_quat(trial.quat_VB)
        start = R_WB[trial.static].mean()
        lift = {"radius": -np.pi / 2.0, "carpus": -np.pi}[sensor]
        truth[MARKED[sensor]] = R_WB * start.inv() * Rotation.from_euler("y", lift)
    trial = next(iter(trials.values()))
    pl.DataFrame(table).write_csv(folder / "ur5.csv")
    head = (
        f'name = "{run}"\nstart_pose = "configuration"\n[data]\nfile = "ur5.csv"\nrate_hz = {trial.rate_hz}\n'
        f'gyro_unit = "rad/s"\naccel_unit = "m/s^2"\n'
        f"[phases]\nstart = [[0.0, {(trial.static.stop - 1) / trial.rate_hz}]]\n[joints]\n"
        + "".join(f"{name} = {value}\n" for name, value in UPRIGHT.items())
    )
    (folder / "session.toml").write_text(head + text, encoding="utf-8")
    return truth


def write_table(urdf: Path) -> Path:
    """Write the table of the simulated arm beside its URDF, arm.toml."""
    file = urdf.with_suffix(".toml")
    file.write_text(TABLE.format(segments="\n".join(f'{link} = "{link}"' for link in SENSED)), encoding="utf-8")
    return file


@dataclass(frozen=True)
class Moved:
    """A recording of the arm, and the truth behind it."""

    recording: Recording
    lengths: dict[str, float]  # [m]
    tip: np.ndarray  # (n, 3) [m]


def move_arm(
    body: BodyModel,
    seed: int,
    *,
    seconds: float = 45.0,
    points: int = 1,
    stated: bool = False,
    start: Mapping[str, float] = BENT,
    ratios: Mapping[str, float] = TRUE,
    start_std: float = START_STD,
    noise: ImuNoise = MTI_3,
) -> Moved:
    """Move the arm, or another chain, its tip on one point, on two one after the other, or free (0).

    Parameters
    ----------
    stated : the session states the mounts
    start : joint → [rad] in the start pose, but for `start_std` [rad]
    ratios : length → the true one over that of the body
    noise : densities of the sensors' white noise
    """
    true = body.with_lengths({name: ratio * body.lengths[name] for name, ratio in ratios.items()})
    model, data, rng = true.pin, true.pin.createData(), np.random.default_rng(seed)
    joints, links = true.pin.nv, tuple(body.table.segments)
    time, tip_frame = np.arange(0.0, seconds, 1.0 / RATE), true.pin.getFrameId("tip")
    end = seconds - 1.0
    change = np.clip((time - 0.5 * (MOVE_S + end)) / 2.0 + 0.5, 0.0, 1.0)[:, None] if points == 2 else 0.0
    rise = np.clip((time - MOVE_S) / 2.0, 0.0, 1.0)
    frequency, phase = rng.uniform(0.05, 0.25, (joints, 3)), rng.uniform(0.0, 2.0 * np.pi, (joints, 3))
    amplitude = rng.uniform(0.1, 0.35, (joints, 3))
    wave = np.sin(2.0 * np.pi * frequency * (time[:, None, None] - MOVE_S) + phase)
    rate = 0.9 * rise[:, None] * (amplitude * wave).sum(axis=2)  # [rad/s]
    q = np.empty((len(time), joints))
    q[0] = [start[name] for name in model.names[1:]] + rng.normal(scale=start_std, size=joints)
    pin.framesForwardKinematics(model, data, q[0])
    target = data.oMf[tip_frame].translation + change * AWAY * np.ones((len(time), 1))
    tip = np.empty((len(time), 3))
    R = {link: np.empty((len(time), 3, 3)) for link in links}
    place = {link: np.empty((len(time), 3)) for link in links}
    frames = {link: model.getFrameId(link) for link in links}
    for k in range(len(time)):
        if k:
            pin.computeJointJacobians(model, data, q[k - 1])
            pin.updateFramePlacements(model, data)
            J = pin.getFrameJacobian(model, data, tip_frame, pin.LOCAL_WORLD_ALIGNED)[:3]
            step = rate[k] / RATE
            if points:
                inverse = J.T @ np.linalg.inv(J @ J.T + 1e-6 * np.eye(3))
                step = step - inverse @ J @ step + inverse @ (target[k] - data.oMf[tip_frame].translation)
            q[k] = q[k - 1] + step
        pin.framesForwardKinematics(model, data, q[k])
        tip[k] = data.oMf[tip_frame].translation
        for link, frame in frames.items():
            R[link][k], place[link][k] = data.oMf[frame].rotation, data.oMf[frame].act(SENSOR_AT)
    sensors = {}
    for link in links:
        mount = Rotation.random(random_state=rng)
        R_WS = Rotation.from_matrix(R[link]) * mount
        gyro = np.zeros((len(time), 3))
        gyro[1:] = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * RATE
        accel_W = np.gradient(np.gradient(place[link], 1.0 / RATE, axis=0), 1.0 / RATE, axis=0)
        accel = R_WS.inv().apply(accel_W + [0.0, 0.0, 9.81])
        gyro += rng.normal(size=3) * BIAS_STD + rng.normal(size=gyro.shape) * noise.gyro_density * np.sqrt(RATE)
        accel += rng.normal(size=3) * ACCEL_BIAS_STD
        accel += rng.normal(size=accel.shape) * noise.accel_density * np.sqrt(RATE)
        in_start_pose = (Rotation.from_matrix(R[link][0]) * mount).as_quat() if stated else None
        sensors[link] = ImuSensor(gyro_S=gyro, accel_S=accel, stated_quat_LS=in_start_pose)
    phases = {"start": (START_S,), "tip": ((MOVE_S + 2.0, end),)}
    if points == 2:
        middle = 0.5 * (MOVE_S + end)
        phases |= {"tip": ((MOVE_S + 2.0, middle - 1.5),), "second": ((middle + 1.5, end),)}
    recording = Recording("arm", time, RATE, sensors, phases=phases, start_pose=CONFIGURATION, joints=start)
    return Moved(recording, {name: true.lengths[name] for name in ratios}, tip)
