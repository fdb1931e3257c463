"""Which joints set a segment's orientation; `configuration` gives them their values.

Between a segment and the one above it lie joints. A segment of a limb is set by the joints nearest to it, as many as
make three axes; others above (a clavicle) rest. A segment of the spine is set by all joints in between.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import pinocchio as pin

from .table import BodyTable


class Chain(NamedTuple):
    """The joints that set a segment's orientation, by Pinocchio's numbers, from the root outwards."""

    joints: tuple[int, ...]  # empty where the segment is rigid with the one above
    spherical: int | None  # the one nearest to the segment, which takes what the others leave; None: there is none
    above: str | None  # the segment above; of segments on one joint the later ones are on the first; None: the root

    @property
    def exact(self) -> bool:
        """Whether every orientation can be followed."""
        return self.spherical is not None


def find_chains(model: pin.Model, table: BodyTable) -> dict[str, Chain]:
    """Find segment → its chain, for segments that the model has, in the order of Pinocchio's joints."""
    frames = {name: model.frames[model.getFrameId(name)] for name in table.segments if model.existFrame(name)}
    at: dict[int, str] = {}  # joint → the first of the segments that it carries; the others are rigid with that
    for segment, frame in frames.items():
        at.setdefault(frame.parentJoint, segment)
    paths = {segment: _find_path(model, joint, at) for joint, segment in at.items()}
    # A joint that moves two segments at once rests.
    times = Counter(joint for _, joints in paths.values() for joint in joints)
    chains = {}
    for segment, frame in sorted(frames.items(), key=lambda item: item[1].parentJoint):
        above, joints = paths.get(segment, (at[frame.parentJoint], []))
        free = [j for j in joints if times[j] == 1 and "Prismatic" not in model.joints[j].shortname()]
        while not table.segments[segment].spine and sum(model.nvs[joint] for joint in free[1:]) >= 3:
            del free[0]
        spherical = [joint for joint in free if model.nvs[joint] == 3]
        chains[segment] = Chain(tuple(free), spherical[-1] if spherical else None, above)
    return chains


def _find_path(model: pin.Model, joint: int, at: Mapping[int, str]) -> tuple[str | None, list[int]]:
    """Find the segment above that which `joint` carries, None: the root, and the joints from there down to `joint`."""
    path = model.supports[joint].tolist()
    above = [k for k, other in enumerate(path[:-1]) if other in at]
    return (at[path[above[-1]]], path[above[-1] + 1 :]) if above else (None, path[1:])
