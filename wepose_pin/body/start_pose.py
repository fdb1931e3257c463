"""The configuration of a body in its start pose, and its links there."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadSession, one_of
from ..recording import CONFIGURATION, Recording
from .body import BodyModel
from .table import NEUTRAL_POSE, BodyTable, Vector
from .table_file import load_table
from .tree import check_joint_values, parse_tree


def compute_start_configuration(
    model: BodyModel, start_pose: str, joints: Mapping[str, float], where: str
) -> np.ndarray:
    """`q` (nq,) in the start pose.

    Parameters
    ----------
    start_pose : a pose of the body's table, or "configuration"
    joints : joint of the URDF → value [rad or m] in a configuration; those not named are at zero
    where : begins an error's text

    Raises
    ------
    BadSession
        A start pose that the table does not have; a joint that the body does not have, or outside its limits.
    """
    poses = model.table.poses
    if start_pose != CONFIGURATION and start_pose not in poses:
        raise BadSession(
            f"{where}: start_pose = '{start_pose}' is not known; {one_of((*poses, CONFIGURATION), start_pose)}"
        )
    values = joints if start_pose == CONFIGURATION else poses[start_pose]
    check_joint_values(model.robot, values, f"{where}: joints", BadSession)
    q, m, tree = pin.neutral(model.pin), model.pin, parse_tree(model.robot, where)
    for joint in range(1, m.njoints):
        if m.nqs[joint] == 1:
            q[m.idx_qs[joint]] = values.get(m.names[joint], 0.0)
    for link, axes in model.axes.items():  # three joints that are one spherical joint
        angles = np.array([[values.get(joint.name, 0.0)] for joint in tree.path(link)[-3:]])
        first, second, third = Rotation.from_rotvec(angles * axes)
        at = m.idx_qs[model.joints[link]]
        q[at : at + 4] = (first * second * third).as_quat()
    return q


@dataclass(frozen=True)
class StartPose:
    """The links of a body in the start pose, where the frame L' of each equals W.

    Parameters
    ----------
    R_WK : link → its orientation (3, 3); a link that is not named has the frame of W
    table : of the body
    q : (nq,) its configuration; None: not known
    """

    R_WK: Mapping[str, np.ndarray] = field(default_factory=dict)
    table: BodyTable = field(default_factory=load_table)
    q: np.ndarray | None = None

    def std(self, segment: str) -> np.ndarray:
        """Return (3,) [rad], one standard deviation about each axis of a segment's rotation off the start pose."""
        return np.array(self.table.segments[segment].start_std)

    def repeat_std(self, segment: str) -> np.ndarray:
        """Return (3,) [rad], one standard deviation about each axis between two start poses of one person."""
        return np.array(self.table.segments[segment].repeat_std)

    def rotation(self, link: str) -> np.ndarray:
        """Return the orientation (3, 3) of a link."""
        return self.R_WK.get(link, np.eye(3))

    def turn(self, link: str, vector: Collection[float]) -> Vector:
        """Return a vector (3,) of a link's frame, in L'."""
        x, y, z = self.R_WK[link] @ np.array(vector) if link in self.R_WK else vector
        return float(x), float(y), float(z)

    def to_world(self, segment: str, R_LS: Rotation) -> Rotation:
        """Return R_L'S of a mount R_LS: the sensor's orientation in W in the start pose."""
        return Rotation.from_matrix(self.R_WK[segment]) * R_LS if segment in self.R_WK else R_LS

    def to_segment(self, segment: str, R_WS: Rotation) -> Rotation:
        """Return the mount R_LS of a sensor whose orientation in the start pose is R_WS."""
        return Rotation.from_matrix(self.R_WK[segment]).inv() * R_WS if segment in self.R_WK else R_WS


N_POSE = StartPose()


def find_start_pose(body: BodyModel, recording: Recording) -> StartPose:
    """Find the links of a body in the start pose of its recording."""
    q = compute_start_configuration(body, recording.start_pose, recording.joints, recording.where())
    # A person's segment frames equal W in the N-pose, whatever the pose of a body whose joints are at zero.
    is_neutral = recording.start_pose == NEUTRAL_POSE and not body.table.is_mechanism
    return StartPose({} if is_neutral else body.orient_links(q), body.table, q)
