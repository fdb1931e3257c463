"""Recordings of rerun (.rrd), of a person or a robot: shapes on their links, and joints as curves.

Entities: ``body/LINK`` with its transform in W and the link's shapes, or the bones to the next links where the URDF has
meshes; ``joints/JOINT`` [rad or m].

Source: rerun-sdk 0.41.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BadOption, how_to_install
from ..model.visuals import Visual, visuals
from .joint_motion import JointMotion, compute_link_poses_W, compute_link_transforms

TIMELINE = "time"
BONE_RADIUS_M = 0.012
APPLICATION = "wepose"


def write_rrd(path: Path, motion: JointMotion) -> None:
    """Write the recording.

    Raises
    ------
    BadOption
        rerun-sdk is not installed.
    """
    try:
        import rerun as rr
    except ImportError:
        raise BadOption(f"--format rrd: needs rerun: {how_to_install('rerun-sdk')}") from None
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{motion.name} {motion.time[0]:g}", send_properties=False)
    recording.save(path)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    index = [rr.TimeColumn(TIMELINE, duration=motion.time)]
    shapes = visuals(motion.robot)
    for link, (quat, p) in compute_link_poses_W(motion).items():
        entity = f"body/{rr.escape_entity_path_part(link)}"
        recording.send_columns(entity, indexes=index, columns=rr.Transform3D.columns(translation=p, quaternion=quat))
        for k, shape in enumerate(each for each in shapes if each.link == link and each.kind != "mesh"):
            recording.log(f"{entity}/{k}", _draw(rr, shape), static=True)
    with_mesh = {shape.link for shape in shapes if shape.kind == "mesh"}
    for link, transform in compute_link_transforms(motion).items():
        if transform.parent in with_mesh and np.linalg.norm(transform.p[0]) > BONE_RADIUS_M:
            entity = f"body/{rr.escape_entity_path_part(transform.parent)}/bone_to_{rr.escape_entity_path_part(link)}"
            bone = rr.LineStrips3D([[np.zeros(3), transform.p[0]]], radii=BONE_RADIUS_M)
            recording.log(entity, bone, static=True)
    for joint in motion.moving:
        entity = f"joints/{rr.escape_entity_path_part(joint)}"
        recording.send_columns(entity, indexes=index, columns=rr.Scalars.columns(scalars=motion.values(joint)))
    recording.flush()
    recording.disconnect()


def _draw(rr: Any, shape: Visual) -> Any:
    """A box, cylinder or sphere."""
    colour = [round(255 * value) for value in shape.rgba]
    place = {"centers": [shape.p_LV], "quaternions": [rr.Quaternion(xyzw=shape.quat_LV)], "colors": [colour]}
    if shape.kind == "box":
        return rr.Boxes3D(sizes=[shape.size], fill_mode="solid", **place)
    if shape.kind == "cylinder":
        return rr.Cylinders3D(radii=[shape.size[0]], lengths=[shape.size[1]], fill_mode="solid", **place)
    return rr.Ellipsoids3D(radii=[shape.size[0]], fill_mode="solid", **place)
