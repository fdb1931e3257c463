"""The scripts of docs/play.md, run as they stand there on a trajectory."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from arms import JOINTS
from test_export_robot import find_lerobot, place_by_pinocchio, write_trajectory_folder

from wepose_pin import export

PAGE = Path(__file__).resolve().parents[1] / "docs" / "play.md"
SCRIPTS = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL))
# What of rclpy and of ROS 2's messages the script uses; messages are rosbags' own, and what is published is serialised.
FAKE_RCLPY = """
import sys, types
import numpy as np
from rosbags.typesys import Stores, get_typestore
store = get_typestore(Stores.ROS2_HUMBLE)
T = store.types
def Duration(sec=0, nanosec=0): return T["builtin_interfaces/msg/Duration"](sec=sec, nanosec=nanosec)
def JointTrajectoryPoint(positions=(), velocities=(), accelerations=(), effort=(), time_from_start=None):
    arrays = [np.array(each, dtype=float) for each in (positions, velocities, accelerations, effort)]
    return T["trajectory_msgs/msg/JointTrajectoryPoint"](*arrays, time_from_start or Duration())
def JointTrajectory(joint_names=()):
    stamp = T["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    header = T["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    return T["trajectory_msgs/msg/JointTrajectory"](header=header, joint_names=list(joint_names), points=[])
class Publisher:
    asked = 0
    def get_subscription_count(self): self.asked += 1; return self.asked // 3
    def publish(self, message):
        with open("sent.cdr", "wb") as file:
            file.write(store.serialize_cdr(message, "trajectory_msgs/msg/JointTrajectory"))
class Node:
    def __init__(self, name): pass
    def create_publisher(self, kind, topic, depth): return Publisher()
def module(name, **names):
    made = types.ModuleType(name)
    made.__dict__.update(names)
    sys.modules[name] = made
module("rclpy", init=lambda: None, spin_once=lambda node, timeout_sec: None)
module("rclpy.node", Node=Node)
module("builtin_interfaces"); module("builtin_interfaces.msg", Duration=Duration)
module("trajectory_msgs")
module("trajectory_msgs.msg", JointTrajectory=JointTrajectory, JointTrajectoryPoint=JointTrajectoryPoint)
"""


def run(script: str, folder: Path, *arguments: object, python: str = sys.executable, before: str = "") -> str:
    (folder / script).write_text(before + SCRIPTS[script], encoding="utf-8")
    words = [python, "-W", "ignore", script, *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    ran = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_the_page_has_a_script_of_each() -> None:
    assert {name: len(text.splitlines()) <= 26 for name, text in SCRIPTS.items()} == dict.fromkeys(
        ("play_mujoco.py", "send_trajectory.py", "clone.py"), True
    )


@pytest.mark.peer
def test_mujoco_plays_it(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    folder = write_trajectory_folder(tmp_path / "arm", seconds=2.4)
    compiler = '<mujoco><compiler balanceinertia="true" boundmass="0.1" boundinertia="0.1"/></mujoco>'
    text = (folder / "robot.urdf").read_text().replace('<robot name="arm">', f'<robot name="arm">{compiler}')
    spec = mujoco.MjSpec.from_string(text)
    spec.compile()
    (tmp_path / "arm.xml").write_text(spec.to_xml(), encoding="utf-8")
    printed = run("play_mujoco.py", tmp_path, folder, tmp_path / "arm.xml")
    assert printed.startswith("7 joints, 120 samples; the last body at [")
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d+(?:e-\d+)?", printed.partition("[")[2])]
    np.testing.assert_allclose(numbers, place_by_pinocchio(folder, -1, pin.SE3.Identity())["hand"][:3, 3], atol=1e-6)


def test_a_controller_gets_the_trajectory(tmp_path: Path) -> None:
    """Against rosbags, which serialises the message and reads it back."""
    typesys = pytest.importorskip("rosbags.typesys")
    point = {"positions": [0.25] * 7, "velocities": [1.0] * 7, "accelerations": [-2.0] * 7, "effort": []}
    points = [point | {"time_from_start": {"sec": k // 2, "nanosec": 500_000_000 * (k % 2)}} for k in range(5)]
    trajectory = {"header": {}, "joint_names": list(JOINTS), "points": points}
    (tmp_path / "joint_trajectory.json").write_text(json.dumps(trajectory), encoding="utf-8")
    printed = run("send_trajectory.py", tmp_path, ".", "/controller/joint_trajectory", before=FAKE_RCLPY)
    assert printed == "sent 5 points for 7 joints to /controller/joint_trajectory\n"
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    sent = store.deserialize_cdr((tmp_path / "sent.cdr").read_bytes(), "trajectory_msgs/msg/JointTrajectory")
    assert sent.joint_names == list(JOINTS)
    assert [(each.time_from_start.sec, each.time_from_start.nanosec) for each in sent.points][-2:] == [
        (1, 5 * 10**8),
        (2, 0),
    ]
    np.testing.assert_array_equal(sent.points[3].accelerations, [-2.0] * 7)


@pytest.mark.peer
def test_lerobot_learns_from_it(tmp_path: Path) -> None:
    python = find_lerobot()
    folders = [write_trajectory_folder(tmp_path / f"reach_{seed}", seed=seed, seconds=4.0) for seed in (1, 2)]
    export(folders, tmp_path / "data", "lerobot", rate_hz=25.0, instruction="reach for the cup")
    printed = run("clone.py", tmp_path, tmp_path / "data", python=python)
    assert printed.startswith("2 episodes, 200 frames at 25 Hz: reach for the cup\n")
    losses = [float(number) for number in re.findall(r"epoch \d: ([\d.]+)", printed)]
    assert losses[2] < 0.7 * losses[0]
