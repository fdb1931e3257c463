"""How a robot is drawn: triangles for each moving part, few enough for a page, and where its root is in W."""

from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from ..body.urdf import find_mesh, package_folders, reduce_triangles, triangulate
from .collision import list_corners
from .robot import Robot

BODY, LEFT, RIGHT = (0.80, 0.82, 0.85, 1.0), (0.93, 0.66, 0.50, 1.0), (0.52, 0.70, 0.85, 1.0)
SIDE_DISTANCE = 1.35  # [m] of the robot to the left of the person
STANDING_HEIGHT = 0.75  # [m] of the shoulders above the lowest point, from which on the robot stands on the floor


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
    robot: Robot, joint_position: np.ndarray, parts: list[MeshPart], R_WB: np.ndarray, p_WB: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name of a part → (quat_WJ (m, 4) xyzw, p_WJ (m, 3)) at `joint_position` (m, joints)."""
    data, root = robot.model.createData(), pin.SE3(R_WB, p_WB)
    names = {part.joint: part.link for part in parts}
    placed = {joint: np.empty((len(joint_position), 7)) for joint in names}
    for k, position in enumerate(joint_position):
        pin.forwardKinematics(robot.model, data, robot.configuration(position))
        for joint, placement in placed.items():
            placement[k] = pin.SE3ToXYZQUAT(root * data.oMi[joint])
    return {names[joint]: (placement[:, 3:], placement[:, :3]) for joint, placement in placed.items()}


def place_root(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """R_WB (3, 3) and p_WB (3,) [m] of the root in W: where a standing robot is on the floor, else at its origin."""
    R_WB, data, p_WB = robot.R_BT.T, robot.model.createData(), np.zeros(3)
    pin.forwardKinematics(robot.model, data, robot.configuration(robot.rest))
    lowest = [
        (R_WB @ data.oMi[shape.parentJoint].act(corner))[2]
        for shape in robot.geometry.geometryObjects
        for corner in list_corners(shape)
    ]
    if lowest and _find_shoulder(robot)[2] - min(lowest) > STANDING_HEIGHT:
        p_WB[2] = -min(lowest)
    return R_WB, p_WB


def _find_shoulder(robot: Robot) -> np.ndarray:
    """(3,) [m] the middle of the shoulders, from the root along the axes of W."""
    return np.asarray(robot.R_BT.T @ np.mean([arm.shoulder for arm in robot.arms], axis=0))


def place_beside_person(robot: Robot, shoulder_z: float, floor_z: float) -> tuple[np.ndarray, np.ndarray]:
    """R_WB (3, 3) and p_WB (3,) [m]: the root in W, beside the person and facing the same way."""
    (R_WB, (_, _, height)), shoulder = place_root(robot), _find_shoulder(robot)
    z = floor_z + height if height else shoulder_z - shoulder[2]
    return R_WB, np.array([-shoulder[0], SIDE_DISTANCE - shoulder[1], z])


def _choose_colour(robot: Robot, joint: int) -> tuple[float, float, float, float]:
    """The colour of the arm that moves a joint."""
    carriers = reversed(robot.model.supports[joint].tolist())
    sides = [arm.side for carrier in carriers for arm in robot.arms if carrier - 1 in arm.joints]
    return BODY if not sides else LEFT if sides[0] == "left" else RIGHT


def _join(meshes: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    triangles = [triangles + start for (_, triangles), start in zip(meshes, starts, strict=False)]
    return np.vstack([vertices for vertices, _ in meshes]), np.vstack(triangles)
