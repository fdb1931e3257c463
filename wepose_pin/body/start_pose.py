"""The configuration of a body in its start pose, and its links there."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from ..errors import BadSession, one_of
from ..recording import CONFIGURATION, Recording
from .body import BodyModel
from .table import NEUTRAL_POSE, BodyTable, Vector
from .table_file import load_table
from .tree import check_joint_values, joint_axis, joint_placement, parse_tree


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
    q, m = pin.neutral(model.pin), model.pin
    tree = parse_tree(model.robot, where)
    spherical = {joint: link for link, joint in model.joints.items()}
    for joint in range(1, m.njoints):
        first = m.idx_qs[joint]
        if joint in spherical:
            R = _rotate_triple(tree.path(spherical[joint])[-3:], values) if spherical[joint] in model.axes else None
            if R is not None:
                q[first : first + 4] = Rotation.from_matrix(R).as_quat()
            continue
        value = values.get(m.names[joint], 0.0)
        if m.nqs[joint] == 1:
            q[first] = value
        else:  # without limits: cosine and sine
            q[first], q[first + 1] = np.cos(value), np.sin(value)
    return q


def _rotate_triple(joints: list[Any], values: Mapping[str, float]) -> np.ndarray:
    """Rotation (3, 3) of three joints that are one spherical joint, out of zero."""
    zero = turned = np.eye(3)
    for k, joint in enumerate(joints):
        placement = joint_placement(joint)[:3, :3] if k else np.eye(3)
        axis = joint_axis(joint) * values.get(joint.name, 0.0)
        zero, turned = zero @ placement, turned @ placement @ Rotation.from_rotvec(axis).as_matrix()
    return zero.T @ turned


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
    """Find the links of a body in the start pose of its recording.

    Raises
    ------
    BadSession
        A start pose or a joint that the body does not have.
    """
    q = compute_start_configuration(body, recording.start_pose, recording.joints, recording.where())
    # A person's segment frames equal W in the N-pose, whatever the pose of a body whose joints are at zero.
    is_neutral = recording.start_pose == NEUTRAL_POSE and not body.table.is_mechanism
    return StartPose({} if is_neutral else body.orient_links(q), body.table, q)
