"""Two points that coincide at times, such as joined palms: the gap between them with its Jacobian in headings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..body import BodyModel
from ..body.girdle import PARAMETERS
from ..body.lengths import UNIVERSE
from ..body.mounts import StartPose
from .paths import BodySymbols, express_covariance, express_path, find_girdles, find_path
from .symbols import about_z, evaluate, product, rotate


class GapRows(NamedTuple):
    """What n samples of orientations show of the gap between two points."""

    gap: np.ndarray  # (n, 3) [m] in W, from the second point to the first one
    H: np.ndarray  # (n, 3, k) [m/rad] its slope by the headings
    by_shape: np.ndarray  # (n, 3, m) by the lengths and the girdles' parameters, as in `Subject.shape_covariance`
    by_attitude: np.ndarray  # (n, 3, 3) [m²] its covariance by errors of 1 rad of each orientation about each axis
    off_law: np.ndarray  # (n, 3, 3) [m²] its covariance by shoulders that leave the law of their girdles


class PointPair:
    """Two points of a body that coincide at times.

    Parameters
    ----------
    model, start : the body, with a person's lengths and girdles, and its start pose
    sensors : k segments with sensors
    points : the two

    Attributes
    ----------
    segments : names of those whose vectors lie between the points

    Raises
    ------
    BadSession
        The place of a point is not known.
    """

    def __init__(self, model: BodyModel, start: StartPose, sensors: Sequence[str], points: tuple[str, str]) -> None:
        self.points = points
        between = find_path(model, start, sensors, [(points[0], 1.0), (points[1], -1.0)])
        self.segments = tuple(part.segment for part in between.vectors if part.segment != UNIVERSE)
        table, k, lengths = model.table, len(sensors), len(model.lengths)
        self._shape = np.concatenate([list(model.lengths.values()), *map(model.girdle_parameters, table.girdles)])
        quat, headings, shape = ca.SX.sym("quat", 4 * k), ca.SX.sym("headings", k), ca.SX.sym("shape", len(self._shape))
        parameters = dict(zip(table.girdles, ca.vertsplit(shape[lengths:], len(PARAMETERS)), strict=True))
        body = BodySymbols(
            {name: product(about_z(headings[i]), quat[4 * i : 4 * i + 4]) for i, name in enumerate(sensors)},
            shape[:lengths],
            {term.name: (term, parameters[term.name]) for term in find_girdles(model, start, sensors)},
        )
        gap, vectors = express_path(between, body)
        off_law = ca.SX.zeros(3, 3)
        for name, _ in between.girdles:
            girdle = table.girdles[name]
            for axis, std in zip(start.rotation(girdle.on).T, girdle.residual_std, strict=True):
                off = std * rotate(body.quat_WL[girdle.on], ca.DM(axis))
                off_law += off @ off.T
        by_attitude = express_covariance(vectors, 0.0, dict.fromkeys(vectors, 1.0))
        rows = [gap, ca.jacobian(gap, headings), ca.jacobian(gap, shape), by_attitude, off_law]
        outputs = [ca.densify(each) for each in rows]
        self._gap = ca.Function("rows", [quat, headings, shape], outputs, {"cse": True})

    def linearize(self, quat_WL: np.ndarray, headings: np.ndarray) -> GapRows:
        """Linearize the gap of orientations (n, k, 4) at heading errors (k,) [rad]."""
        gap, *others = evaluate(self._gap, quat_WL.reshape(len(quat_WL), -1), headings, self._shape)
        return GapRows(gap[:, :, 0], *others)
