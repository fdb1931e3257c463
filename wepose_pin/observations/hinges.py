"""A hinge: the long axis of the segment below stays in the plane across the axis, within a range of angles.

With n the axis in the frame of the segment O above, and e the long axis of the segment M below, n · R_WOᵀ R_WM e = 0.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..body import BodyModel
from ..body.mounts import StartPose
from ..body.table import Vector
from .symbols import about_z, evaluate, product, rotate, rotate_back

LEAST_IN_PLANE = 0.1  # squared length of e's part in the plane, below which the slope of its angle grows no more


class HingePlane(NamedTuple):
    """A hinge between two segments with sensors, the segments `on` above and `moves` below; unit vectors (3,) in L'."""

    name: str  # of the joint
    on: str
    moves: str
    axis: Vector  # in the frame of `on`
    along_on: Vector  # the long axis of `on`
    along: Vector  # the long axis of `moves`, in its own frame
    range: tuple[float, float]  # [rad] of the angle about the axis from the long axis of `on` to that of `moves`

    @property
    def across(self) -> np.ndarray:
        """(3,) by which the axis changes as it turns about the long axis of `on`."""
        return np.cross(self.along_on, self.axis)

    @property
    def tilted(self) -> np.ndarray:
        """(3,) by which the axis changes as it turns about the direction across both."""
        return -np.array(self.along_on)

    @property
    def side(self) -> np.ndarray:
        """(3,) the direction to which `moves` bends."""
        return np.asarray(-np.sign(sum(self.range)) * self.across)

    def deviation(self, quat_on: ca.SX, quat_moves: ca.SX, error: ca.SX) -> ca.SX:
        """Return the sine of the angle by which `moves` leaves the plane; the axis is off by `error` (2,) [rad].

        The error is along `across` and `tilted`.
        """
        along = rotate_back(quat_on, rotate(quat_moves, self.along))
        axis = ca.DM(self.axis) + ca.horzcat(ca.DM(self.across), ca.DM(self.tilted)) @ error
        return ca.dot(axis, along) / ca.norm_2(axis)


def linearize_hinge(
    hinge: HingePlane, quat_on: np.ndarray, quat_moves: np.ndarray, headings: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Linearize a hinge of orientations (n, 4) at heading errors (2,) [rad] of `moves` and `on`.

    Returns
    -------
    r : (n,) [rad] out of the hinge's plane
    H : (n, 4) its slope by the headings of `moves` and `on`, and by the axis along `across` and `tilted`
    excess : (n,) [rad] beyond the hinge's range, signed
    slope : (n,) of that by the heading of `moves`; by the heading of `on` it is the negative
    """
    r, H, excess, slope = evaluate(_linearization(hinge), quat_on, quat_moves, headings)
    return r[:, 0, 0], H[:, 0], excess[:, 0, 0], slope[:, 0, 0]


@lru_cache(maxsize=128)
def _linearization(hinge: HingePlane) -> ca.Function:
    """Return the rows of a sample as a function of both quaternions and both headings."""
    on, moves = ca.SX.sym("on", 4), ca.SX.sym("moves", 4)
    headings, error = ca.SX.sym("headings", 2), ca.SX.sym("error", 2)
    quat_on, quat_moves = product(about_z(headings[1]), on), product(about_z(headings[0]), moves)
    r = hinge.deviation(quat_on, quat_moves, error)
    H = ca.jacobian(r, ca.vertcat(headings, error))
    r, H = ca.substitute([r, H], [error], [ca.DM.zeros(2)])
    along = rotate_back(quat_on, rotate(quat_moves, hinge.along))
    sine, cosine = -ca.dot(ca.DM(hinge.across), along), ca.dot(ca.DM(hinge.along_on), along)
    middle, half = 0.5 * (hinge.range[0] + hinge.range[1]), 0.5 * (hinge.range[1] - hinge.range[0])
    off = ca.atan2(sine, cosine) - middle
    off -= 2.0 * np.pi * ca.floor(off / (2.0 * np.pi) + 0.5)
    excess = ca.sign(off) * ca.fmax(ca.fabs(off) - half, 0.0)
    by_sine, by_cosine = (ca.jacobian(part, headings[0]) for part in (sine, cosine))
    squared = sine**2 + cosine**2
    slope = (by_sine * cosine - by_cosine * sine) / ca.fmax(squared, LEAST_IN_PLANE)
    rows = [ca.densify(value) for value in (r, H, excess, slope)]
    return ca.Function("hinge", [on, moves, headings], rows, {"cse": True})


def find_hinges(model: BodyModel, start: StartPose, sensors: Collection[str]) -> tuple[HingePlane, ...]:
    """Find the hinges of the body whose two segments both have sensors, with the axes of its table."""
    return tuple(
        HingePlane(
            name,
            hinge.on,
            hinge.moves,
            start.turn(hinge.on, hinge.axis),
            start.turn(hinge.on, model.table.segments[hinge.on].along),
            start.turn(hinge.moves, model.table.segments[hinge.moves].along),
            hinge.range,
        )
        for name, hinge in model.table.hinges.items()
        if {hinge.on, hinge.moves} <= set(sensors)
    )
