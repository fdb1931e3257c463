"""Which joints set a segment's orientation; `configuration` gives them their values.

Between a segment and the one above it lie joints. A segment of a limb is set by the joints nearest to it, as many as
make three axes; others above (a clavicle) rest. A segment of the spine is set by all joints in between.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from ..errors import BadModel
from .table import BodyTable


class Chain(NamedTuple):
    """The joints that set a segment's orientation, by Pinocchio's numbers, from the root outwards."""

    joints: tuple[int, ...]  # empty where the segment is rigid with the one above
    spherical: int | None  # the one nearest to the segment, which takes what the others leave; None: there is none

    @property
    def exact(self) -> bool:
        """Whether every orientation can be followed."""
        return self.spherical is not None


def find_chains(model: pin.Model, table: BodyTable) -> dict[str, Chain]:
    """Find segment → its chain, for segments that the model has, in the order of Pinocchio's joints.

    Raises
    ------
    BadModel
        A mimic joint lies between two segments.
    """
    frames = _find_frames(model, table)
    at = _first_segments(frames)
    between = {segment: _joints_below(model, joint, set(at)) for joint, segment in at.items()}
    for segment, joints in between.items():
        for joint in joints:
            if "Mimic" in model.joints[joint].shortname():
                raise BadModel(
                    f"{model.name}: joint '{model.names[joint]}' mimics another and carries '{segment}'; it must be "
                    f"free or fixed for the segment to be followed"
                )
    # A joint that moves two segments at once rests.
    times = Counter(joint for joints in between.values() for joint in joints)
    chains = {}
    for segment, _ in sorted(frames.items(), key=lambda item: item[1].parentJoint):
        free = [j for j in between.get(segment, []) if times[j] == 1 and "Prismatic" not in model.joints[j].shortname()]
        if not table.segments[segment].spine:
            free = _take_nearest_three(model, free)
        spherical = [joint for joint in free if model.nvs[joint] == 3]
        chains[segment] = Chain(tuple(free), spherical[-1] if spherical else None)
    return chains


def find_parents(model: pin.Model, table: BodyTable) -> dict[str, str | None]:
    """Find segment → the segment above it, None for the first; of segments on one joint the later are on the first."""
    frames = _find_frames(model, table)
    at = _first_segments(frames)
    parents: dict[str, str | None] = {}
    for segment, frame in frames.items():
        joint = frame.parentJoint
        if at[joint] != segment:
            parents[segment] = at[joint]
            continue
        above = [j for j in reversed(model.supports[joint].tolist()) if j != joint and j in at]
        parents[segment] = at[above[0]] if above else None
    return parents


def axis_in_joint(model: pin.Model, joint: int) -> np.ndarray:
    """Return the axis (3,) of a joint of one axis in its own frame."""
    moved = model.joints[joint]
    data = moved.createData()  # of this joint alone: of the whole model it takes fifty times as long
    moved.calc(data, pin.neutral(model))
    return np.asarray(data.S)[3:].copy()


def _find_frames(model: pin.Model, table: BodyTable) -> dict[str, pin.Frame]:
    return {name: model.frames[model.getFrameId(name)] for name in table.segments if model.existFrame(name)}


def _first_segments(frames: Mapping[str, pin.Frame]) -> dict[int, str]:
    """Return joint → the first of the segments that it carries; the others are rigid with that."""
    at: dict[int, str] = {}
    for segment, frame in frames.items():
        at.setdefault(frame.parentJoint, segment)
    return at


def _joints_below(model: pin.Model, joint: int, stops: set[int]) -> list[int]:
    """Return the joints from below the next one that carries a segment, or from the root, down to `joint`."""
    path = model.supports[joint].tolist()[1:]
    carrying = [k for k, above in enumerate(path[:-1]) if above in stops]
    return path[carrying[-1] + 1 :] if carrying else path


def _take_nearest_three(model: pin.Model, joints: list[int]) -> list[int]:
    """Return the joints nearest to the segment, as many as make three axes, or all."""
    axes = 0
    for k, joint in enumerate(reversed(joints)):
        axes += model.nvs[joint]
        if axes >= 3:
            return joints[len(joints) - 1 - k :]
    return joints
