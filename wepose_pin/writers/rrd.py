"""Recordings of rerun (.rrd), of a person or a robot: shapes on their links, and joints as curves.

Entities: ``body/LINK`` with its transform in W and the link's shapes; ``joints/JOINT`` [rad or m].

Source: rerun-sdk 0.41.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from ..body.urdf import Mesh, package_folders, reduce_triangles, triangulate
from ..errors import BadOption, native_stderr_muted
from .motion import ROBOT_URDF, JointMotion, compute_link_poses_W

TIMELINE = "time"
APPLICATION = "wepose"


def write_rrd(path: Path, motion: JointMotion) -> None:
    """Write the recording."""
    try:
        import rerun as rr
    except ImportError:
        raise BadOption("--format rrd: needs rerun: pip install rerun-sdk") from None
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{motion.name} {motion.time[0]:g}", send_properties=False)
    recording.save(path)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    index = [rr.TimeColumn(TIMELINE, duration=motion.time)]
    for link, (quat, p) in compute_link_poses_W(motion).items():
        entity = f"body/{rr.escape_entity_path_part(link)}"
        if np.ptp(p, axis=0).any() or np.ptp(quat, axis=0).any():
            columns = rr.Transform3D.columns(translation=p, quaternion=quat)
            recording.send_columns(entity, indexes=index, columns=columns)
        else:
            place = rr.Transform3D(translation=p[0], quaternion=rr.Quaternion(xyzw=quat[0]))
            recording.log(entity, place, static=True)
    for k, (link, (vertices, triangles), rgba) in enumerate(_load_meshes(motion)):
        mesh = rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=rgba)
        recording.log(f"body/{rr.escape_entity_path_part(link)}/{k}", mesh, static=True)
    for joint in motion.moving:
        entity = f"joints/{rr.escape_entity_path_part(joint)}"
        recording.send_columns(entity, indexes=index, columns=rr.Scalars.columns(scalars=motion.values(joint)))
    recording.flush()
    recording.disconnect()


def _load_meshes(motion: JointMotion) -> list[tuple[str, Mesh, np.ndarray]]:
    """Load link, mesh in its frame and colour of all shapes; none where a file of a mesh is not found."""
    folders, kind = package_folders(Path(motion.where) / ROBOT_URDF), pin.GeometryType.VISUAL
    try:
        with native_stderr_muted():
            model = pin.buildModelFromXML(motion.urdf)
            shapes = pin.buildGeomFromUrdfString(model, motion.urdf, kind, package_dirs=folders).geometryObjects
    except (ValueError, RuntimeError):
        return []
    links, meshes = [], []
    for shape in shapes:
        frame = model.frames[shape.parentFrame]
        placed = frame.placement.inverse() * shape.placement
        vertices, triangles = triangulate(shape.geometry)
        links.append((frame.name, np.asarray(shape.meshColor).ravel()))
        meshes.append((vertices @ placed.rotation.T + placed.translation, triangles))
    return [(link, mesh, rgba) for (link, rgba), mesh in zip(links, reduce_triangles(meshes), strict=True)]
