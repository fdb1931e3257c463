"""What a robot looks like: triangles for each part that moves, few enough for a page."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from .maps import example_data
from .plan import Trajectory
from .robot import Robot

TRIANGLES = 30_000  # of the whole robot at most
FINEST, COARSER = 0.003, 1.4  # [m] size of the cells in which vertices become one; by how much they grow
BODY, LEFT, RIGHT = (0.80, 0.82, 0.85, 1.0), (0.93, 0.66, 0.50, 1.0), (0.52, 0.70, 0.85, 1.0)
BESIDE = 1.35  # [m] the robot stands to the person's left
FLOOR_BELOW = 0.75  # [m] a robot that reaches so far below its shoulders stands on the ground


class Part(NamedTuple):
    """One part that moves as a whole; vertices (n, 3) [m] in its joint's frame, triangles (m, 3)."""

    joint: int
    vertices: np.ndarray
    triangles: np.ndarray
    rgba: tuple[float, float, float, float]


def parts(robot: Robot) -> list[Part]:
    """What to draw; empty where the URDF shows nothing."""
    folders = [str(folder) for folder in robot.map.urdf.absolute().parents]
    data = example_data()
    if data is not None:
        folders += [str(data), str(data.parent), str(data.parent.parent)]
    whole = pin.buildGeomFromUrdf(robot.full, str(robot.map.urdf), pin.GeometryType.VISUAL, package_dirs=folders)
    moving = set(robot.model.names[1:])
    locked = [robot.full.getJointId(name) for name in robot.full.names[1:] if name not in moving]
    _, shapes = pin.buildReducedModel(robot.full, whole, locked, robot.rest_full)
    by_joint: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for shape in shapes.geometryObjects:
        vertices, triangles = _triangles(shape.geometry)
        if len(triangles):
            placed = vertices @ shape.placement.rotation.T + shape.placement.translation
            by_joint.setdefault(int(shape.parentJoint), []).append((placed, triangles))
    cell = FINEST
    while True:
        found = [
            Part(joint, *_joined([_coarse(*piece, cell) for piece in pieces]), _colour(robot, joint))
            for joint, pieces in sorted(by_joint.items())
        ]
        if sum(len(part.triangles) for part in found) <= TRIANGLES:
            return found
        cell *= COARSER


def stands_at(robot: Robot, drawn: list[Part], shoulder_z: float, floor_z: float) -> tuple[np.ndarray, np.ndarray]:
    """R_WB (3, 3) and p_WB (3,) [m]: the root in the person's world, beside the person and facing the same way."""
    R = robot.R_BT.T
    shoulder = np.mean([arm.shoulder for arm in robot.arms], axis=0)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.q(robot.rest))
    lowest = min(
        (((part.vertices @ data.oMi[part.joint].rotation.T + data.oMi[part.joint].translation) @ R.T)[:, 2].min()
         for part in drawn if part.joint == 0),
        default=0.0,
    )  # fmt: skip
    z = shoulder_z - (R @ shoulder)[2]
    if (R @ shoulder)[2] - lowest > FLOOR_BELOW:
        z = floor_z - lowest
    p = -(R @ shoulder)
    return R, np.array([p[0], p[1] + BESIDE, z])


def placements(
    trajectory: Trajectory, drawn: list[Part], frames: np.ndarray, R: np.ndarray, p: np.ndarray
) -> dict[int, Any]:
    """Joint → (quat_WJ (m, 4) xyzw, p_WJ (m, 3)) at samples `frames`, the root at `R`, `p` in W."""
    robot, joints = trajectory.robot, sorted({part.joint for part in drawn})
    data = robot.model.createData()
    root = pin.SE3(R, p)
    found = {joint: (np.empty((len(frames), 4)), np.empty((len(frames), 3))) for joint in joints}
    for k, at in enumerate(frames.tolist()):
        pin.forwardKinematics(robot.model, data, robot.q(trajectory.u[at]))
        for joint in joints:
            quat_p = pin.SE3ToXYZQUAT(root * data.oMi[joint])
            found[joint][0][k], found[joint][1][k] = quat_p[3:], quat_p[:3]
    return found


def _colour(robot: Robot, joint: int) -> tuple[float, float, float, float]:
    """That of the person's arm whose motion the part follows."""
    while joint > 0:
        for arm in robot.arms:
            if any(robot.names[j] == robot.model.names[joint] for j in arm.joints):
                return LEFT if arm.side == "left" else RIGHT
        joint = robot.model.parents[joint]
    return BODY


def _triangles(geometry: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a mesh, or of a round or square shape."""
    import trimesh

    kind = type(geometry).__name__
    if hasattr(geometry, "num_tris") and hasattr(geometry, "tri_indices"):
        triangles = np.array(
            [[t[0], t[1], t[2]] for t in map(geometry.tri_indices, range(geometry.num_tris))], dtype=int
        )
        return np.asarray(geometry.vertices(), dtype=float), triangles.reshape(-1, 3)
    if kind == "Box":
        made = trimesh.creation.box(2.0 * np.asarray(geometry.halfSide).ravel())
    elif kind == "Cylinder":
        made = trimesh.creation.cylinder(geometry.radius, 2.0 * geometry.halfLength, sections=24)
    elif kind == "Sphere":
        made = trimesh.creation.icosphere(2, geometry.radius)
    else:
        return np.empty((0, 3)), np.empty((0, 3), dtype=int)
    return np.asarray(made.vertices), np.asarray(made.faces)


def _coarse(vertices: np.ndarray, triangles: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of one cell become their mean; triangles that lose a corner go."""
    _, which, count = np.unique(
        np.round(vertices / cell).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    which = which.ravel()
    mean = np.stack([np.bincount(which, vertices[:, k]) for k in range(3)], axis=1) / count[:, None]
    kept = which[triangles]
    whole = (kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 0] != kept[:, 2])
    kept = kept[whole]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    return mean, kept[np.sort(first)]


def _joined(pieces: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    triangles = [triangles + start for (_, triangles), start in zip(pieces, starts, strict=False)]
    return np.vstack([vertices for vertices, _ in pieces]), np.vstack(triangles)
