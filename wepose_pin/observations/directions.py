"""A direction in which a segment points, and an axis about which it bends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from ..body.table import Vector
from .symbols import rotate, rotate_back


@dataclass(frozen=True)
class Pointing:
    """The long axis `along` (3,) of a segment points along `direction` (3,) of another; to within `std` [rad]."""

    segment: str
    reference: str
    along: Vector
    direction: Vector
    std: float

    def residual(self, quat_WL: Mapping[str, ca.SX]) -> ca.SX:
        """Return by how much the segment is off its direction (3,), in units of `std`."""
        along_W = rotate(quat_WL[self.segment], self.along)
        return (rotate_back(quat_WL[self.reference], along_W) - ca.DM(self.direction)) / self.std


@dataclass(frozen=True)
class Level:
    """The segment bends about `axis` (3,), level in the start pose; people bend about one within `std` [rad] of it."""

    segment: str
    axis: Vector
    std: float

    def residual(self, quat_WL: Mapping[str, ca.SX], start: ca.SX) -> ca.SX:
        """Return how far the axis has risen since `start` (4,), its `quat_WL` before it bent, in units of `std`."""
        return (rotate(quat_WL[self.segment], self.axis) - rotate(start, self.axis))[2] / self.std
