"""A robot's motion as tools for humanoids load it: GMR's pickle, BeyondMimic's .npz and .csv.

Joints and bodies have no names in these files, so their order is the format's. GMR and the .csv have that of MuJoCo,
depth first in the URDF; the .npz that of Isaac Lab, breadth first, whose importer also joins links that do not move.
The .npz has the names too, which loaders pass over.

Source: GMR (github.com/YanjieZe/GMR), scripts/bvh_to_robot.py, data_loader.py, batch_gmr_pkl_to_csv.py. BeyondMimic
(github.com/HybridRobotics/whole_body_tracking), scripts/csv_to_npz.py, mdp/commands.py.
"""

from __future__ import annotations

import pickle
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..model.tree import joint_axis
from ..rotations import wxyz_from_xyzw
from .joint_motion import JointMotion, compute_link_poses_W, find_whole_rate

DIGITS = 8  # of the .csv


def write_pickle(path: Path, motion: JointMotion) -> None:
    """Write the motion as GMR saves it; rotations of the root are xyzw."""
    values = {
        "fps": find_whole_rate(motion),
        "root_pos": np.tile(motion.p_WB, (len(motion.time), 1)),
        "root_rot": np.tile(motion.quat_WB, (len(motion.time), 1)),
        "dof_pos": _stack(motion.values, motion.moving),
        "local_body_pos": None,
        "link_body_list": None,
    }
    path.write_bytes(pickle.dumps(values, protocol=4))


def write_motion_csv(path: Path, motion: JointMotion) -> None:
    """Write a row a sample without a header: place and xyzw of the root, then the joints."""
    find_whole_rate(motion)  # the reader is told the rate as a whole number
    root = np.tile(np.concatenate([motion.p_WB, motion.quat_WB]), (len(motion.time), 1))
    np.savetxt(path, np.hstack([root, _stack(motion.values, motion.moving)]), fmt=f"%.{DIGITS}f", delimiter=",")


def write_motion_npz(path: Path, motion: JointMotion) -> None:
    """Write joints and bodies with their velocities; rotations are wxyz."""
    joints = _order_breadth_first(motion)
    poses = compute_link_poses_W(motion)
    bodies = [motion.root, *(joint.child for joint in joints)]
    velocities = _compute_link_velocities(motion, poses)
    names = [joint.name for joint in joints]
    arrays: dict[str, Any] = {
        "fps": np.array([find_whole_rate(motion)]),
        "joint_pos": _stack(motion.values, names),
        "joint_vel": _stack(motion.rates, names),
        "body_pos_w": np.stack([poses[body][1] for body in bodies], axis=1),
        "body_quat_w": np.stack([wxyz_from_xyzw(poses[body][0]) for body in bodies], axis=1),
        "body_lin_vel_w": np.stack([velocities[body][0] for body in bodies], axis=1),
        "body_ang_vel_w": np.stack([velocities[body][1] for body in bodies], axis=1),
    }
    arrays = {name: values.astype(np.float32) if values.ndim > 1 else values for name, values in arrays.items()}
    with path.open("wb") as file:
        np.savez(file, **arrays, joint_names=np.array(names), body_names=np.array(bodies))


def _stack(column: Any, joints: Any) -> np.ndarray:
    return np.stack([column(joint) for joint in joints], axis=1)


def _order_breadth_first(motion: JointMotion) -> list[Any]:
    """The joints of one axis, by how many of these are above them, in the order of the file where as many are."""
    depth = {motion.root: 0}
    levels: dict[int, list[Any]] = defaultdict(list)
    moving = set(motion.moving)
    for joint in motion.ordered:
        depth[joint.child] = depth[joint.parent] + (joint.name in moving)
        if joint.name in moving:
            levels[depth[joint.child]].append(joint)
    return [joint for level in sorted(levels) for joint in levels[level]]


def _compute_link_velocities(
    motion: JointMotion, poses: dict[str, tuple[np.ndarray, np.ndarray]]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Link → velocity of its origin (n, 3) [m/s] and angular velocity (n, 3) [rad/s] in W; the root stands."""
    still = np.zeros((len(motion.time), 3))
    velocities = {motion.root: (still, still)}
    for joint in motion.ordered:
        linear, angular = velocities[joint.parent]
        linear = linear + np.cross(angular, poses[joint.child][1] - poses[joint.parent][1])
        if joint.type != "fixed":
            source, factor = joint.name, 1.0
            if joint.mimic is not None:
                source, factor = joint.mimic.joint, joint.mimic.multiplier or 1.0
            axis_W = Rotation.from_quat(poses[joint.child][0]).apply(joint_axis(joint))
            along = factor * motion.rates(source)[:, None] * axis_W
            linear, angular = (linear + along, angular) if joint.type == "prismatic" else (linear, angular + along)
        velocities[joint.child] = (linear, angular)
    return velocities
