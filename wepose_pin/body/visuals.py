"""The visuals of a body's links."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation


class Visual(NamedTuple):
    """A visual of a link; sizes as in URDF."""

    link: str
    kind: str  # "box" | "cylinder" | "sphere" | "mesh"
    size: tuple[float, ...]  # box: x, y, z; cylinder: radius, length along z; sphere: radius [m]; mesh: scale x, y, z
    quat_LV: np.ndarray  # (4,) xyzw, visual to link
    p_LV: np.ndarray  # (3,) [m]
    rgba: tuple[float, float, float, float]
    file: str | None = None  # of a mesh, as the URDF names it


def visuals(robot: Any) -> list[Visual]:
    """The visuals of all links that have a geometry."""
    colours = {m.name: m.color.rgba for m in robot.materials if m.color is not None}
    shapes = []
    for link in robot.links:
        for visual in link.visuals:
            geometry, origin = visual.geometry, np.eye(4) if visual.origin is None else visual.origin
            size: tuple[float, ...]
            file = None
            if geometry.box is not None:
                kind, size = "box", tuple(float(v) for v in geometry.box.size)
            elif geometry.cylinder is not None:
                kind, size = "cylinder", (float(geometry.cylinder.radius), float(geometry.cylinder.length))
            elif geometry.sphere is not None:
                kind, size = "sphere", (float(geometry.sphere.radius),)
            elif geometry.mesh is not None:
                scale = np.ones(3) if geometry.mesh.scale is None else np.asarray(geometry.mesh.scale) * np.ones(3)
                kind, size, file = "mesh", tuple(float(v) for v in scale), geometry.mesh.filename
            else:
                continue
            rgba = np.array([0.7, 0.7, 0.7, 1.0])
            if visual.material is not None:
                own = visual.material.color
                rgba = own.rgba if own is not None else colours.get(visual.material.name, rgba)
            r, g, b, a = (float(v) for v in rgba)
            quat = Rotation.from_matrix(origin[:3, :3]).as_quat()
            shapes.append(Visual(link.name, kind, size, quat, origin[:3, 3].copy(), (r, g, b, a), file))
    return shapes
