"""A pose as the live page draws it: the placement of each visible link, as bytes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin

from ..angles import joint_angles
from ..body import BodyModel
from ..body.kinematics import KinematicsSolver, Pose
from ..body.links import find_known_links
from ..errors import WeposeError
from ..report.viewer import Mesh, find_floor, visible
from ..retargeting.robot import Robot
from ..retargeting.targets import find_person_arm
from ..retargeting.visuals import build_parts, place_beside_person
from .state import LivePose, StreamInfo, round_finite

CURVE_RATE_HZ = 20.0  # of joint angles
MAX_CURVE_POSES = 200  # that wait for a browser


class RobotFigure:
    """A robot drawn beside the person.

    Parameters
    ----------
    position : its joint positions now; None: those at rest

    Attributes
    ----------
    links, meshes : a link and its mesh for each moving part
    """

    def __init__(self, robot: Robot, model: BodyModel, position: Callable[[], np.ndarray | None]) -> None:
        parts = build_parts(robot)
        data = pin.Data(model.pin)
        pin.framesForwardKinematics(model.pin, data, pin.neutral(model.pin))
        shoulders = [find_person_arm(model.table, arm.side).points[0] for arm in robot.arms]
        heights = [data.oMf[model.pin.getFrameId(model.point_frames[point])].translation[2] for point in shoulders]
        self._robot, self._position = robot, position
        self._root = pin.SE3(*place_beside_person(robot, float(np.mean(heights)), find_floor(model)))
        self._joints = sorted({part.joint for part in parts})
        self._data = robot.model.createData()
        self.links = tuple(f"robot {joint}" for joint in self._joints)
        self.meshes = [Mesh(f"robot {part.joint}", part.vertices, part.triangles, part.rgba) for part in parts]

    def points(self) -> np.ndarray:
        """Points (n, 3) [m] in W that it has now, for the camera."""
        placed = dict(zip(self.links, self.place(), strict=True))
        at = [(mesh.vertices, placed[mesh.link]) for mesh in self.meshes]
        return np.concatenate([vertices @ row[:9].reshape(3, 3).T + row[9:] for vertices, row in at])[::50]

    def place(self) -> np.ndarray:
        """Placements (m, 12) of the links."""
        position = self._position()
        configuration = self._robot.configuration(self._robot.rest if position is None else position)
        pin.forwardKinematics(self._robot.model, self._data, configuration)
        return _stack([self._root * self._data.oMi[joint] for joint in self._joints])


class PoseEncoder:
    """Encodes poses for the page.

    Parameters
    ----------
    robot : drawn beside the person; None: there is none

    Attributes
    ----------
    links : visible links, in the order of the frames: `body_links`, then those of the robot
    newest : the pose to draw; None: the N-pose
    measured : the links that the sensors determine; None before the start
    """

    def __init__(self, model: BodyModel, robot: RobotFigure | None = None) -> None:
        self.visuals, self.robot = visible(model.visuals), robot
        self.body_links = tuple(dict.fromkeys(visual.link for visual in self.visuals))
        self.links = self.body_links + (() if robot is None else robot.links)
        self.newest: LivePose | None = None
        self.measured: MeasuredLinks | None = None
        self.angles = AngleCurves()
        self._model = model

    def points(self, segments: tuple[str, ...]) -> tuple[str, ...]:
        """The points that sensors on these segments determine."""
        return KinematicsSolver(self._model, segments).points

    def start(self, info: StreamInfo) -> None:
        self.newest = None  # it may be of another stream
        self.measured = MeasuredLinks(self._model, self.body_links, info)
        self.angles = AngleCurves(info.segments)

    def encode(self, pose: LivePose | None) -> bytes:
        """Little endian: time (float64, NaN before the start), of each link R_WL row by row and p_WL (12 float32),
        points whose paths are drawn (3 float32 each), of each link whether its sensor is lost (1 byte). NaN: not known.
        """
        measured = self.measured
        if pose is None or measured is None or len(pose.quat_WL) != len(measured.segments):
            data = pin.Data(self._model.pin)
            pin.framesForwardKinematics(self._model.pin, data, pin.neutral(self._model.pin))
            placements = _stack([data.oMf[self._model.pin.getFrameId(link)] for link in self.body_links])
            if measured is not None:
                placements[~measured.known] = np.nan
            paths = np.full((len(self._model.table.paths), 3), np.nan)
            return self._pack(math.nan, placements, paths, np.zeros(len(placements), dtype=bool))
        placements, points = measured.place(pose.quat_WL), measured.find_path_points(pose.points)
        return self._pack(pose.time, placements, points, measured.lost(pose.lost))

    def _pack(self, time: float, placements: np.ndarray, points: np.ndarray, lost: np.ndarray) -> bytes:
        """A frame of the body's links, followed by those of the robot."""
        if self.robot is not None:
            robot = self.robot.place()
            placements = np.concatenate([placements, robot])
            lost = np.concatenate([lost, np.zeros(len(robot), dtype=bool)])
        return np.array(time, "<f8").tobytes() + placements.tobytes() + points.astype("<f4").tobytes() + lost.tobytes()


class AngleCurves:
    """Joint angles of the poses since they were last taken, together: one by one they cost ten times as much.

    Parameters
    ----------
    segments : of the poses
    """

    def __init__(self, segments: tuple[str, ...] = ()) -> None:
        self._segments = segments
        self._poses: deque[LivePose] = deque(maxlen=MAX_CURVE_POSES)
        self._due = -math.inf

    def push(self, pose: LivePose) -> None:
        """Add a pose, unless the last one was less than a step of `CURVE_RATE_HZ` before."""
        if not self._due - 1.0 < pose.time < self._due:
            self._due = pose.time + 1.0 / CURVE_RATE_HZ
            self._poses.append(pose)

    def take(self) -> dict[str, Any] | None:
        """Times [s], and joint → angle → values [deg], of the poses since the last call; None: there are none."""
        poses = [self._poses.popleft() for _ in range(len(self._poses))]
        poses = [pose for pose, after in pairwise(poses) if pose.time < after.time] + poses[-1:]
        if not poses:
            return None
        time = np.array([pose.time for pose in poses])
        quat_WL = {name: np.array([pose.quat_WL[k] for pose in poses]) for k, name in enumerate(self._segments)}
        try:
            joints = joint_angles(Pose(time, quat_WL, {})).joints
        except WeposeError:  # no two segments make a joint
            return None
        return {
            "time": np.round(time, 3).tolist(),
            "joints": {
                name: {
                    angle: [round_finite(value, 1) for value in np.degrees(joint.values[:, k])]
                    for k, angle in enumerate(joint.names)
                }
                for name, joint in joints.items()
            },
        }


class MeasuredLinks:
    """The visible links of a body of which some segments are measured."""

    def __init__(self, model: BodyModel, links: tuple[str, ...], info: StreamInfo) -> None:
        self.segments = info.segments
        self._kinematics = KinematicsSolver(model, info.segments)
        frames = [model.pin.getFrameId(link) for link in links]
        self._views = [self._kinematics.data.oMf[frame] for frame in frames]
        known = set(find_known_links(model, info.segments))
        self.known = np.array([link in known for link in links], dtype=bool)
        self._paths = [info.points.index(point) if point in info.points else -1 for point in model.table.paths]
        moved = {chain.joints[-1]: segment for segment, chain in model.chains.items() if chain.joints}
        self._rows = []  # of each link the sensor that places it; -1: none
        for frame in frames:
            joint = model.pin.frames[frame].parentJoint
            while joint and moved.get(joint) not in info.segments:
                joint = model.pin.parents[joint]
            self._rows.append(info.segments.index(moved[joint]) if joint else -1)

    def place(self, quat_WL: np.ndarray) -> np.ndarray:
        """Placements (m, 12) of the links; NaN where not known."""
        self._kinematics.compute_points(quat_WL)
        placements = _stack(self._views)
        placements[~self.known] = np.nan
        return placements

    def find_path_points(self, points: np.ndarray) -> np.ndarray:
        """Points (p, 3) [m] whose paths are drawn; NaN where not known."""
        return np.array([points[k] if k >= 0 else [np.nan] * 3 for k in self._paths]).reshape(-1, 3)

    def lost(self, lost: np.ndarray) -> np.ndarray:
        """(m,) bool: the sensor that places a link is lost."""
        return np.array([row >= 0 and bool(lost[row]) for row in self._rows], dtype=bool)


def _stack(views: list[Any]) -> np.ndarray:
    """(m, 12): R_WL row by row, p_WL."""
    placements = np.empty((len(views), 12), dtype="<f4")
    for k, view in enumerate(views):
        placements[k, :9] = view.rotation.ravel()
        placements[k, 9:] = view.translation
    return placements
