"""The way from the root to each point of a body, link by link: vectors that are affine in the lengths.

A point is p_W = Σ R_WK (B l + c) over the links K between the root and the point, with l the lengths: each link
contributes a vector that is affine in the lengths and constant in the link. The joints of a girdle stand at zero here:
what they add is in `girdle`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from ..errors import BadModel
from .table import BodyTable

UNIVERSE = "universe"  # the link of what is rigid with the root
STRETCHED = 1.25  # ratio by which a length changes while its effect is measured
DECIMALS = 13  # of an effect per metre; what is beyond is rounding
AFFINE_TOLERANCE = 1e-12  # [m] by which an affine map may miss a model of other lengths


class LinkVector(NamedTuple):
    """A link's part of the way from the root to a point, in its frame [m]: ``by_length @ lengths + constant``."""

    by_length: np.ndarray  # (3, k), lengths in the order of the table
    constant: np.ndarray  # (3,) [m]


def measure_reaches(
    table: BodyTable, own: Mapping[str, float], build: Callable[[Mapping[str, float]], pin.Model]
) -> dict[str, dict[str, LinkVector]]:
    """Measure point → link → its part of the way from the root, on the model at two values of each length.

    A link is a segment; what a joint between segments moves has the joint's name and frame, and what is rigid with the
    root is `UNIVERSE`.

    Parameters
    ----------
    own : length → [m], as the model has them
    build : the model with other lengths [m]; those not named stay

    Raises
    ------
    BadModel
        A chain that is not affine in the lengths, or a joint that slides: orientations do not tell where it is.
    """
    lengths = np.array(list(own.values()))
    offsets = _link_offsets(table, build({}))
    stretched = {name: _link_offsets(table, build({name: STRETCHED * own[name]})) for name in own}
    reaches: dict[str, dict[str, LinkVector]] = {}
    for point, way in offsets.items():
        reaches[point] = {}
        for link, offset in way.items():
            columns = [(stretched[k][point][link] - offset) / (STRETCHED * own[k] - own[k]) for k in own]
            by_length = np.round(np.reshape(columns, (len(own), 3)).T, DECIMALS) + 0.0  # no negative zeros
            constant = offset - by_length @ lengths
            constant[np.abs(constant) < AFFINE_TOLERANCE] = 0.0
            if np.any(by_length) or np.any(constant):
                reaches[point][link] = LinkVector(by_length, constant)
    _check_affine(table, own, build, reaches)
    return reaches


_Offsets = dict[str, dict[str, np.ndarray]]  # point → link → (3,) [m] in the link


def _link_offsets(table: BodyTable, m: pin.Model) -> _Offsets:
    """Return point → link → its part (3,) [m] of the way from the root, from the placements of joints and frames."""
    name_of = _name_links(table, m)
    follow = {joint for girdle in table.girdles.values() for joint in girdle.joints}
    offsets: _Offsets = {}
    for point, place in table.points.items():
        frame = m.frames[m.getFrameId(place.link)]
        offsets[point], path = {}, m.supports[frame.parentJoint].tolist()
        for joint in path[1:]:
            if m.joints[joint].shortname().startswith("JointModelP") and m.names[joint] not in follow:
                raise BadModel(f"{m.name}: joint '{m.names[joint]}' slides: orientations do not tell where {point} is")
        steps = [*(m.jointPlacements[joint].translation for joint in path[1:]), frame.placement.translation]
        for joint, translation in zip(path, steps, strict=True):
            name, R_JK = name_of[joint]
            offsets[point][name] = offsets[point].get(name, 0.0) + R_JK.T @ translation
    return offsets


def _name_links(table: BodyTable, m: pin.Model) -> dict[int, tuple[str, np.ndarray]]:
    """Return joint → the link that it moves, by the segment's name if it is one, and its rotation R_JK in the joint."""
    name_of = {joint: (m.names[joint], np.eye(3)) for joint in range(m.njoints)}
    for segment in reversed(list(table.segments)):  # of segments that are rigid with one another the first
        frame = m.frames[m.getFrameId(segment)]
        name_of[frame.parentJoint] = segment, frame.placement.rotation
    return name_of


def _check_affine(
    table: BodyTable,
    own: Mapping[str, float],
    build: Callable[[Mapping[str, float]], pin.Model],
    reaches: Mapping[str, Mapping[str, LinkVector]],
) -> None:
    """Raise `BadModel` where a model with all lengths changed is not what the ways say."""
    ratios = 0.8 + 0.4 * np.arange(len(own)) / max(len(own), 1)
    other = {name: r * own[name] for name, r in zip(own, ratios, strict=True)}
    lengths, m = np.array(list(other.values())), build(other)
    for point, way in _link_offsets(table, m).items():
        for link, offset in way.items():
            part = reaches[point].get(link)
            miss = np.abs(offset - (part.by_length @ lengths + part.constant if part else 0.0)).max()
            if miss > AFFINE_TOLERANCE:
                raise BadModel(
                    f"{m.name}: the part of link {link} in the chain to {point} is not affine in the lengths, "
                    f"off by {1e3 * miss:.2g} mm where they change by a fifth; the calibration cannot estimate them"
                )
