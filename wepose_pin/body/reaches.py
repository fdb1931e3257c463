"""The way from the root to each point of a body, link by link: vectors that are affine in the lengths.

A point is p_W = Σ R_WK (B l + c) over the links K between the root and the point, with l the lengths: each link
contributes a vector that is affine in the lengths and constant in the link. The joints of a girdle stand at zero here:
what they add is in `girdle`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import BadModel

if TYPE_CHECKING:
    from .body import BodyModel

UNIVERSE = "universe"  # the link of what is rigid with the root
STRETCHED = 1.25  # ratio by which a length changes while its effect is measured
DECIMALS = 13  # of an effect per metre; what is beyond is rounding
AFFINE_TOLERANCE = 1e-12  # [m] by which an affine map may miss a model of other lengths


class LinkVector(NamedTuple):
    """A link's part of the way from the root to a point, in its frame [m]: ``by_length @ lengths + constant``."""

    by_length: np.ndarray  # (3, k), lengths in the order of the table
    constant: np.ndarray  # (3,) [m]


def measure_reaches(model: BodyModel) -> dict[str, dict[str, LinkVector]]:
    """Point → link → its part of the chain from the root, measured on the model at two values of each length.

    A link is a segment; what a joint between segments moves has the joint's name and frame, and what is rigid with the
    root is `UNIVERSE`.

    Raises
    ------
    BadModel
        A chain that is not affine in the lengths, or a joint that slides: orientations do not tell where it is.
    """
    own = model.lengths
    lengths = np.array(list(own.values()))
    offsets = _link_offsets(model)
    stretched = {name: _link_offsets(model.with_lengths({name: STRETCHED * own[name]})) for name in own}
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
    _check_affine(model, reaches)
    return reaches


_Offsets = dict[str, dict[str, np.ndarray]]  # point → link → (3,) [m] in the link


def _link_offsets(model: BodyModel) -> _Offsets:
    """Point → link → its part (3,) [m] of the chain from the root, from the placements of joints and frames."""
    m, name_of = model.pin, _name_links(model)
    follow = {joint for girdle in model.table.girdles.values() for joint in girdle.joints}
    offsets: _Offsets = {}
    for point, link in model.point_frames.items():
        frame = m.frames[m.getFrameId(link)]
        offsets[point], path = {}, m.supports[frame.parentJoint].tolist()
        for joint in path[1:]:
            if m.joints[joint].shortname().startswith("JointModelP") and m.names[joint] not in follow:
                raise BadModel(f"{m.name}: joint '{m.names[joint]}' slides: orientations do not tell where {point} is")
        steps = [*(m.jointPlacements[joint].translation for joint in path[1:]), frame.placement.translation]
        for joint, translation in zip(path, steps, strict=True):
            name, R_JK = name_of[joint]
            offsets[point][name] = offsets[point].get(name, 0.0) + R_JK.T @ translation
    return offsets


def _name_links(model: BodyModel) -> dict[int, tuple[str, np.ndarray]]:
    """Joint → the link that it moves, by the segment's name where it is one, and its rotation R_JK in the joint."""
    m = model.pin
    name_of = {joint: (m.names[joint], np.eye(3)) for joint in range(m.njoints)}
    for segment in reversed(list(model.table.segments)):  # of segments that are rigid with one another the first
        frame = m.frames[m.getFrameId(segment)]
        name_of[frame.parentJoint] = segment, frame.placement.rotation
    return name_of


def _check_affine(model: BodyModel, reaches: Mapping[str, Mapping[str, LinkVector]]) -> None:
    """Raises `BadModel` where a model with all lengths changed is not what the chains say."""
    own = model.lengths
    ratios = 0.8 + 0.4 * np.arange(len(own)) / max(len(own), 1)
    other = model.with_lengths({name: r * own[name] for name, r in zip(own, ratios, strict=True)})
    lengths = np.array(list(other.lengths.values()))
    for point, way in _link_offsets(other).items():
        for link, offset in way.items():
            part = reaches[point].get(link)
            miss = np.abs(offset - (part.by_length @ lengths + part.constant if part else 0.0)).max()
            if miss > AFFINE_TOLERANCE:
                raise BadModel(
                    f"{model.pin.name}: the part of link {link} in the chain to {point} is not affine in the lengths, "
                    f"off by {1e3 * miss:.2g} mm where they change by a fifth; the calibration cannot estimate them"
                )
