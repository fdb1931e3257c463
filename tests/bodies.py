"""Names of the upper body, and how well a body follows orientations."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin import BodyModel, load_model
from wepose_pin.body.kinematics import compute_link_poses

TABLE = load_model().table
SEGMENTS = tuple(TABLE.segments)
LENGTHS = tuple(TABLE.lengths)
POINTS = {name: point.link for name, point in TABLE.points.items()}
# Girdles of a person whose shoulders do not move on the torso, as those of ideal and mild simulated people: no law.
GIRDLE_ROWS = tuple(  # of a subject's covariance
    f"girdles.{name}.{parameter}"
    for name in TABLE.girdles
    for parameter in ("law", "rest_x", "rest_y", "rest_z", "raised_x", "raised_y", "raised_z")
)
RIGID_SHOULDERS = {name: np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]) for name in TABLE.girdles}


def mount_rows(*segments: str) -> tuple[str, ...]:
    """Names of the mounts' rows of a subject's covariance."""
    return tuple(f"mounts.{segment}.{axis}" for segment in segments for axis in "xyz")


def measure_residuals(body: BodyModel, q: np.ndarray, quat_WL: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Segment → angle (n,) [rad] between an orientation and that of the body in the configurations q (n, nq)."""
    R_WL, _ = compute_link_poses(body, q, list(quat_WL))
    return {
        name: (Rotation.from_matrix(R_WL[:, k]).inv() * Rotation.from_quat(quat)).magnitude()
        for k, (name, quat) in enumerate(quat_WL.items())
    }
