"""A pose as the live page draws it: the placement of each visible link, as bytes."""

from __future__ import annotations

import math
import secrets
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from ..angles import joint_angles
from ..body import BodyModel
from ..body.kinematics import KinematicsSolver, Pose
from ..body.links import find_known_links
from ..errors import WeposeError
from ..report.viewer import Mesh, find_floor, visible
from ..retargeting.placement import place_beside_person
from ..retargeting.robot import Robot
from ..retargeting.targets import find_person_arm
from ..retargeting.visuals import build_parts
from .state import LivePose, StreamInfo, round_finite

CURVE_RATE_HZ = 20.0  # of joint angles
MAX_CURVE_POSES = 200  # that wait for a browser


class RobotFigure:
    """A robot drawn beside the person, at the joint positions that `position` gives now; None: those at rest."""

    def __init__(self, robot: Robot, model: BodyModel, position: Callable[[], np.ndarray | None]) -> None:
        parts = build_parts(robot)
        data = place_n_pose(model)
        shoulders = [find_person_arm(model.table, arm.side).points[0] for arm in robot.arms]
        heights = [data.oMf[model.pin.getFrameId(model.point_frames[point])].translation[2] for point in shoulders]
        self._robot, self._position = robot, position
        self._root = pin.SE3(*place_beside_person(robot, float(np.mean(heights)), find_floor(model)))
        self._joints = sorted({part.joint for part in parts})
        self._data = robot.model.createData()
        self.links = tuple(f"robot {joint}" for joint in self._joints)  # one for each moving part, and its mesh
        self.meshes = [Mesh(f"robot {part.joint}", part.vertices, part.triangles, part.rgba) for part in parts]

    def points(self) -> np.ndarray:
        """Some points (n, 3) [m] of its surface in W."""
        placed = dict(zip(self.links, self.place(), strict=True))
        at = [(mesh.vertices, placed[mesh.link]) for mesh in self.meshes]
        return np.concatenate([vertices @ row[:9].reshape(3, 3).T + row[9:] for vertices, row in at])[::50]

    def place(self) -> np.ndarray:
        position = self._position()
        configuration = self._robot.configuration(self._robot.rest if position is None else position)
        pin.forwardKinematics(self._robot.model, self._data, configuration)
        return _stack([self._root * self._data.oMi[joint] for joint in self._joints])


class PoseEncoder:
    """Encodes poses for the page, with the robot beside the person if there is one."""

    def __init__(self, model: BodyModel, robot: RobotFigure | None = None) -> None:
        self.identity = secrets.token_hex(8)  # of the page that draws its frames
        self.visuals, self.robot = visible(model.visuals), robot
        self.body_links = tuple(dict.fromkeys(visual.link for visual in self.visuals))
        self.links = self.body_links + (() if robot is None else robot.links)  # in the order of the frames
        self.newest: LivePose | None = None  # to draw; None: the N-pose
        self.info: StreamInfo | None = None  # of the poses; None before the start
        self._model, self._lock = model, threading.Lock()  # the page encodes in a thread of its own
        self._frames = [model.pin.getFrameId(link) for link in self.body_links]
        data = place_n_pose(model)
        self._neutral = _stack([data.oMf[frame] for frame in self._frames])
        self._known = np.ones(len(self._frames), dtype=bool)
        self._curve_poses, self._curve_due = deque[LivePose](maxlen=MAX_CURVE_POSES), -math.inf

    def start(self, info: StreamInfo) -> None:
        model, kinematics = self._model, KinematicsSolver(self._model, info.segments)
        known = find_known_links(model, info.segments)
        moved = {chain.joints[-1]: segment for segment, chain in model.chains.items() if chain.joints}
        sensors = []  # of each link the row of the sensor that places it; -1: none
        for frame in self._frames:
            joint = model.pin.frames[frame].parentJoint
            while joint and moved.get(joint) not in info.segments:
                joint = model.pin.parents[joint]
            sensors.append(info.segments.index(moved[joint]) if joint else -1)
        with self._lock:
            self._kinematics, self._placed = kinematics, [kinematics.data.oMf[frame] for frame in self._frames]
            self._known = np.array([link in known for link in self.body_links], dtype=bool)
            self._sensors = np.array(sensors, dtype=int)
            self._paths = [info.points.index(point) if point in info.points else -1 for point in model.table.draw.paths]
            self.newest, self.info = None, info  # the newest one may be of another stream
            self._curve_poses.clear()

    def show(self, pose: LivePose) -> None:
        """Take the newest pose, also for the joint angles unless it is within a step of `CURVE_RATE_HZ`."""
        self.newest = pose
        if pose.time >= self._curve_due:
            self._curve_due = pose.time + 1.0 / CURVE_RATE_HZ
            self._curve_poses.append(pose)

    def encode(self, pose: LivePose | None) -> bytes:
        """The frame of a pose, None: the N-pose, as `page` describes it; NaN is what is not known."""
        time, placements, lost = math.nan, self._neutral, np.zeros(len(self.links), dtype=bool)
        points = np.full((len(self._model.table.draw.paths), 3), np.nan, "<f4")
        with self._lock:
            if pose is not None and self.info is not None and len(pose.quat_WL) == len(self.info.segments):
                self._kinematics.compute_points(pose.quat_WL)
                time, placements = pose.time, _stack(self._placed)
                for k, row in enumerate(self._paths):
                    points[k] = pose.points[row] if row >= 0 else np.nan
                lost[: len(self._sensors)] = (self._sensors >= 0) & pose.lost[self._sensors]
            placements = np.where(self._known[:, None], placements, np.float32(np.nan))
        if self.robot is not None:
            placements = np.concatenate([placements, self.robot.place()])
        return np.array(time, "<f8").tobytes() + placements.tobytes() + points.tobytes() + lost.tobytes()

    def take_angles(self) -> dict[str, Any] | None:
        """Times [s], and joint → angle → values [deg], of the poses since the last call; None: there are none."""
        poses = [self._curve_poses.popleft() for _ in range(len(self._curve_poses))]
        if not poses or self.info is None:
            return None
        time = np.array([pose.time for pose in poses])
        quat_WL = {name: np.array([pose.quat_WL[k] for pose in poses]) for k, name in enumerate(self.info.segments)}
        try:
            joints = joint_angles(Pose(time, quat_WL, {})).joints
        except WeposeError:  # no two segments make a joint
            return None
        curves = {
            name: {
                angle: [round_finite(value, 1) for value in np.degrees(joint.values[:, k])]
                for k, angle in enumerate(joint.names)
            }
            for name, joint in joints.items()
        }
        return {"time": np.round(time, 3).tolist(), "joints": curves}


def place_n_pose(model: BodyModel) -> pin.Data:
    """Pinocchio's data with the frames of the N-pose."""
    data = model.pin.createData()
    pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
    return data


def _stack(placements: Sequence[Any]) -> np.ndarray:
    rows = np.empty((len(placements), 12), dtype="<f4")
    for k, placement in enumerate(placements):
        rows[k, :9] = placement.rotation.ravel()
        rows[k, 9:] = placement.translation
    return rows
