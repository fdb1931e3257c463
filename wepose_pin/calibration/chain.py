"""The chains of a body in CasADi: link by link from the root to each point, quaternions xyzw as everywhere.

`measure_reaches` reads them off a model. A point is p_W = Σ R_WK (B l + c) over the links K between the root and the
point, with l the lengths: each link contributes a vector that is affine in the lengths and constant in the link.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from ..errors import BadModel
from ..recording import SEGMENTS
from ..subject import LENGTHS

if TYPE_CHECKING:
    import pinocchio as pin

    from ..model import BodyModel

SIDES = ("left", "right")
ARMS = tuple(f"{side}_{part}" for side in SIDES for part in ("upper_arm", "forearm", "hand"))
CHAIN = ("torso", *ARMS)

STRETCHED = 1.25  # ratio by which a length changes while its effect is measured
DECIMALS = 13  # of an effect per metre; what is beyond is rounding
AFFINE_TOLERANCE = 1e-12  # [m] by which an affine map may miss a model of other lengths


class LinkVector(NamedTuple):
    """A link's part of the way from the root to a point, in its frame [m]: ``by_length @ lengths + constant``."""

    by_length: np.ndarray  # (3, 8), lengths in the order of `LENGTHS`
    constant: np.ndarray  # (3,) [m]


@lru_cache(maxsize=1)
def default_reaches() -> dict[str, dict[str, np.ndarray]]:
    """Point → segment → (3, 8), by which the lengths make the segment's part of the chain from the root.

    They are those of the default model, whose chains have no other links and no constant parts.
    """
    from ..model import load_model

    reaches = measure_reaches(load_model())
    if any(link not in CHAIN or np.any(part.constant) for way in reaches.values() for link, part in way.items()):
        raise BadModel("the default model: a chain has a part that is no segment or that no length scales")
    return {point: {link: part.by_length for link, part in way.items()} for point, way in reaches.items()}


def measure_reaches(model: BodyModel) -> dict[str, dict[str, LinkVector]]:
    """Point → link → its part of the chain from the root, measured on the model at two values of each length.

    A link is a segment; what a joint between segments moves has the joint's name and frame, and what is rigid with the
    root is "universe". A length that the model does not have scales nothing.

    Raises
    ------
    BadModel
        A chain that is not affine in the lengths, or a joint that slides: orientations do not tell where it is.
    """
    own = model.lengths
    lengths = np.array([own.get(name, 0.0) for name in LENGTHS])
    offsets = _link_offsets(model)
    slopes = {
        name: _difference_quotient(offsets, _link_offsets(model.with_lengths({name: STRETCHED * own[name]})), own[name])
        for name in own
    }
    reaches: dict[str, dict[str, LinkVector]] = {}
    for point, way in offsets.items():
        reaches[point] = {}
        for link, offset in way.items():
            columns = [slopes[name][point][link] if name in own else np.zeros(3) for name in LENGTHS]
            by_length = np.round(np.column_stack(columns), DECIMALS) + 0.0  # no negative zeros
            constant = offset - by_length @ lengths
            constant[np.abs(constant) < AFFINE_TOLERANCE] = 0.0
            if np.any(by_length) or np.any(constant):
                reaches[point][link] = LinkVector(by_length, constant)
    _check_affine(model, reaches)
    return reaches


_Offsets = dict[str, dict[str, np.ndarray]]  # point → link → (3,) [m] in the link


def _link_offsets(model: BodyModel) -> _Offsets:
    """Point → link → its part (3,) [m] of the chain from the root, from the placements of joints and frames."""
    from ..model import POINTS

    m, name_of = model.pin, _name_links(model.pin)
    offsets: _Offsets = {}
    for point, link in POINTS.items():
        if not m.existFrame(link):
            continue
        frame = m.frames[m.getFrameId(link)]
        offsets[point], joint, translation = {}, frame.parentJoint, frame.placement.translation
        parts: list[tuple[int, np.ndarray]] = [(joint, translation)]
        while joint:
            if m.joints[joint].shortname().startswith("JointModelP"):
                raise BadModel(f"{m.name}: joint '{m.names[joint]}' slides: orientations do not tell where {point} is")
            translation, joint = m.jointPlacements[joint].translation, m.parents[joint]
            parts.append((joint, translation))
        for joint, translation in reversed(parts):
            name, R_JK = name_of[joint]
            offsets[point][name] = offsets[point].get(name, 0.0) + R_JK.T @ translation
    return offsets


def _name_links(m: pin.Model) -> dict[int, tuple[str, np.ndarray]]:
    """Joint → the link that it moves, by the segment's name where it is one, and its rotation R_JK in the joint."""
    name_of = {joint: (m.names[joint], np.eye(3)) for joint in range(m.njoints)}
    for segment in reversed(SEGMENTS):  # of segments that are rigid with one another the first
        if m.existFrame(segment):
            frame = m.frames[m.getFrameId(segment)]
            name_of[frame.parentJoint] = segment, frame.placement.rotation
    return name_of


def _difference_quotient(offsets: _Offsets, stretched: _Offsets, length: float) -> _Offsets:
    step = STRETCHED * length - length
    return {
        point: {link: (stretched[point][link] - offset) / step for link, offset in way.items()}
        for point, way in offsets.items()
    }


def _check_affine(model: BodyModel, reaches: Mapping[str, Mapping[str, LinkVector]]) -> None:
    """Raises `BadModel` where a model with all lengths changed is not what the chains say."""
    ratios = 0.8 + 0.4 * np.arange(len(LENGTHS)) / len(LENGTHS)
    own = model.lengths
    other = model.with_lengths({name: r * own[name] for name, r in zip(LENGTHS, ratios, strict=True) if name in own})
    lengths = np.array([other.lengths.get(name, 0.0) for name in LENGTHS])
    for point, way in _link_offsets(other).items():
        for link, offset in way.items():
            part = reaches[point].get(link)
            miss = np.abs(offset - (part.by_length @ lengths + part.constant if part else 0.0)).max()
            if miss > AFFINE_TOLERANCE:
                raise BadModel(
                    f"{model.pin.name}: the part of link {link} in the chain to {point} is not affine in the lengths, "
                    f"off by {1e3 * miss:.2g} mm where they change by a fifth; the calibration cannot estimate them"
                )


def point_position(lengths: Any, quat_WK: Mapping[str, Any], way: Mapping[str, LinkVector]) -> Any:
    """The place (3,) [m] of a point in W, in CasADi, from the orientations of the links on its way."""
    vectors = links(lengths, quat_WK, {link: part.by_length for link, part in way.items()})
    place = ca.SX.zeros(3)
    for link, part in way.items():
        place += vectors[link]
        if np.any(part.constant):
            place += rotate(quat_WK[link], ca.DM(part.constant))
    return place


def links(lengths: Any, quat_WL: Mapping[str, Any], way: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Segment → its part (3,) [m] of a chain, in W; `way` holds the (3, 8) of each segment, as `default_reaches`."""
    return {
        name: rotate(quat_WL[name], ca.vertcat(*(_combined(row, lengths) for row in rows)))
        for name, rows in way.items()
    }


def _combined(row: np.ndarray, lengths: Any) -> Any:
    """``row · lengths`` without the zeros of the row."""
    return sum((row[i] * lengths[i] for i in map(int, np.flatnonzero(row))), start=ca.SX(0.0))


def rotate(quat: Any, v: Any) -> Any:
    """``R v`` of a unit quaternion (4,) xyzw and a vector (3,), in CasADi."""
    u = quat[:3]
    t = 2.0 * ca.cross(u, v)
    return v + quat[3] * t + ca.cross(u, t)


def inverse(quat: Any) -> Any:
    """The unit quaternion (4,) xyzw of the inverse rotation, in CasADi."""
    return ca.vertcat(-quat[:3], quat[3])


def product(a: Any, b: Any) -> Any:
    """``a ⊗ b`` of quaternions (4,) xyzw, in CasADi."""
    return ca.vertcat(a[3] * b[:3] + b[3] * a[:3] + ca.cross(a[:3], b[:3]), a[3] * b[3] - ca.dot(a[:3], b[:3]))


def about_z(angle: Any) -> Any:
    """The unit quaternion (4,) xyzw of a turn about z [rad], in CasADi."""
    return ca.vertcat(0.0, 0.0, ca.sin(angle / 2.0), ca.cos(angle / 2.0))


def small_turn(rotvec: Any) -> Any:
    """The unit quaternion (4,) xyzw of a turn by about `rotvec` (3,) [rad], in CasADi: to third order of its size."""
    half = rotvec / 2.0
    return ca.vertcat(half, 1.0) / ca.sqrt(1.0 + ca.sumsqr(half))
