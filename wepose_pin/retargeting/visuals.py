"""Visual meshes of a robot: triangles for each moving part, few enough for a page."""

from __future__ import annotations

from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ..body.urdf import find_mesh, package_folders, reduce_triangles, triangulate
from .robot import Robot
from .trajectory import Trajectory

BODY, LEFT, RIGHT = (0.80, 0.82, 0.85, 1.0), (0.93, 0.66, 0.50, 1.0), (0.52, 0.70, 0.85, 1.0)


class MeshPart(NamedTuple):
    """One rigid part; vertices (n, 3) [m] in its joint's frame, triangles (m, 3)."""

    joint: int
    vertices: np.ndarray
    triangles: np.ndarray
    rgba: tuple[float, float, float, float]

    @property
    def link(self) -> str:
        """Its name on a page."""
        return f"robot {self.joint}"


def build_parts(robot: Robot) -> list[MeshPart]:
    """Parts to draw; empty where the URDF has no visual shapes."""
    root = ElementTree.fromstring(robot.map.urdf.read_bytes())
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is not None and find_mesh(mesh.get("filename", ""), robot.map.urdf) is None:
                link.remove(visual)  # there is no such file
    text, folders = ElementTree.tostring(root, encoding="unicode"), package_folders(robot.map.urdf)
    whole = pin.buildGeomFromUrdfString(robot.full, text, pin.GeometryType.VISUAL, package_dirs=folders)
    locked = [robot.full.getJointId(name) for name in robot.full.names[1:] if name not in robot.names]
    _, shapes = pin.buildReducedModel(robot.full, whole, locked, robot.rest_full)
    parts: dict[int, list[int]] = {}  # joint → its meshes
    meshes: list[tuple[np.ndarray, np.ndarray]] = []
    for shape in shapes.geometryObjects:
        vertices, triangles = triangulate(shape.geometry)
        if len(triangles):
            parts.setdefault(int(shape.parentJoint), []).append(len(meshes))
            meshes.append((vertices @ shape.placement.rotation.T + shape.placement.translation, triangles))
    reduced = reduce_triangles(meshes)
    return [
        MeshPart(joint, *_join([reduced[k] for k in own]), _choose_colour(robot, joint))
        for joint, own in sorted(parts.items())
    ]


def compute_placements(
    trajectory: Trajectory, parts: list[MeshPart], frames: np.ndarray, R: np.ndarray, p: np.ndarray
) -> dict[int, Any]:
    """Joint → (quat_WJ (m, 4) xyzw, p_WJ (m, 3)) at samples `frames`, with the root at `R`, `p` in W."""
    robot, joints = trajectory.robot, sorted({part.joint for part in parts})
    data = robot.model.createData()
    root = pin.SE3(R, p)
    placements = {joint: (np.empty((len(frames), 4)), np.empty((len(frames), 3))) for joint in joints}
    for k, frame in enumerate(frames.tolist()):
        pin.forwardKinematics(robot.model, data, robot.configuration(trajectory.joint_position[frame]))
        for joint, (quat, position) in placements.items():
            p_quat = pin.SE3ToXYZQUAT(root * data.oMi[joint])
            quat[k], position[k] = p_quat[3:], p_quat[:3]
    return placements


def _choose_colour(robot: Robot, joint: int) -> tuple[float, float, float, float]:
    """The colour of the arm that moves a joint."""
    while joint > 0:
        for arm in robot.arms:
            if any(robot.names[j] == robot.model.names[joint] for j in arm.joints):
                return LEFT if arm.side == "left" else RIGHT
        joint = robot.model.parents[joint]
    return BODY


def _join(meshes: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    triangles = [triangles + start for (_, triangles), start in zip(meshes, starts, strict=False)]
    return np.vstack([vertices for vertices, _ in meshes]), np.vstack(triangles)
