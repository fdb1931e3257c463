"""Recordings of rerun (.rrd), of a person or a robot: shapes on their links, and joints as curves.

Entities: ``body/LINK`` with its transform in W and the link's shapes; ``joints/JOINT`` [rad or m].

Source: rerun-sdk 0.41.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ..body.urdf import Mesh, Visual, list_visuals, package_folders, reduce_triangles, triangulate
from ..errors import BadOption, how_to_install, native_stderr_muted
from .motion import ROBOT_URDF, JointMotion, compute_link_poses_W

TIMELINE = "time"
APPLICATION = "wepose"


def write_rrd(path: Path, motion: JointMotion) -> None:
    """Write the recording."""
    try:
        import rerun as rr
    except ImportError:
        raise BadOption(f"--format rrd: needs rerun: {how_to_install('rerun-sdk')}") from None
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{motion.name} {motion.time[0]:g}", send_properties=False)
    recording.save(path)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    index = [rr.TimeColumn(TIMELINE, duration=motion.time)]
    shapes = list_visuals(motion.robot)
    for link, (quat, p) in compute_link_poses_W(motion).items():
        entity = f"body/{rr.escape_entity_path_part(link)}"
        if np.ptp(p, axis=0).any() or np.ptp(quat, axis=0).any():
            columns = rr.Transform3D.columns(translation=p, quaternion=quat)
            recording.send_columns(entity, indexes=index, columns=columns)
        else:
            place = rr.Transform3D(translation=p[0], quaternion=rr.Quaternion(xyzw=quat[0]))
            recording.log(entity, place, static=True)
        for k, shape in enumerate(each for each in shapes if each.link == link and each.kind != "mesh"):
            recording.log(f"{entity}/{k}", _draw(rr, shape), static=True)
    meshes = _load_meshes(motion) if any(shape.kind == "mesh" for shape in shapes) else []
    for k, (link, (vertices, triangles), rgba) in enumerate(meshes):
        mesh = rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=rgba)
        recording.log(f"body/{rr.escape_entity_path_part(link)}/mesh_{k}", mesh, static=True)
    for joint in motion.moving:
        entity = f"joints/{rr.escape_entity_path_part(joint)}"
        recording.send_columns(entity, indexes=index, columns=rr.Scalars.columns(scalars=motion.values(joint)))
    recording.flush()
    recording.disconnect()


def _load_meshes(motion: JointMotion) -> list[tuple[str, Mesh, np.ndarray]]:
    """Link, mesh in its frame and colour; empty where a file of a mesh is not found."""
    folders, kind = package_folders(Path(motion.where) / ROBOT_URDF), pin.GeometryType.VISUAL
    try:
        with native_stderr_muted():
            model = pin.buildModelFromXML(motion.urdf)
            shapes = pin.buildGeomFromUrdfString(model, motion.urdf, kind, package_dirs=folders).geometryObjects
    except (ValueError, RuntimeError):
        return []
    links, meshes = [], []
    for shape in (each for each in shapes if each.meshPath not in ("", "BOX", "CYLINDER", "SPHERE", "CAPSULE")):
        frame = model.frames[shape.parentFrame]
        placed = frame.placement.inverse() * shape.placement
        vertices, triangles = triangulate(shape.geometry)
        links.append((frame.name, np.asarray(shape.meshColor).ravel()))
        meshes.append((vertices @ placed.rotation.T + placed.translation, triangles))
    return [(link, mesh, rgba) for (link, rgba), mesh in zip(links, reduce_triangles(meshes), strict=True)]


def _draw(rr: Any, shape: Visual) -> Any:
    """A box, cylinder or sphere."""
    colour = [round(255 * value) for value in shape.rgba]
    place = {"centers": [shape.p_LV], "quaternions": [rr.Quaternion(xyzw=shape.quat_LV)], "colors": [colour]}
    if shape.kind == "box":
        return rr.Boxes3D(sizes=[shape.size], fill_mode="solid", **place)
    if shape.kind == "cylinder":
        return rr.Cylinders3D(radii=[shape.size[0]], lengths=[shape.size[1]], fill_mode="solid", **place)
    return rr.Ellipsoids3D(radii=[shape.size[0]], fill_mode="solid", **place)
