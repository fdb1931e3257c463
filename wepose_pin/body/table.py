"""The table of a body: names and properties of its segments, points and lengths; `table_file` reads and writes it.

Outside simulation and joint angles no module names a segment, a point or a length. docs/models.md explains the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import numpy as np

from ..documents import Key
from .girdle import Direction, Girdle, SegmentName

DEFAULT_BODY = "upper_body"
ROOT = "root"  # the origin of W, as the end of a length
NEUTRAL_POSE = "n_pose"
KINDS = ("person", "mechanism")
# Regular expressions of the side in a sensor's name, in English and German.
_SIDES = {"left": "left|lt?|link(s|e[rsmn]?)", "right": "right|rt?|recht(s|e[rsmn]?)"}

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
Angle = Annotated[float, Key(unit="deg", least=0.0, most=180.0)]
Angles = Annotated[Vector, Key(unit="deg", least=0.0)]


class SoftTissue(NamedTuple):
    """How far soft tissue rotates a sensor on its segment in motion; standard deviations about x, y, z of the segment.

    Its parts are independent, so that their squares add up.

    Parameters
    ----------
    std : (3,) [rad] in any pose
    relative_to : the segment against which tilt and twist are measured; empty: W
    per_tilt : (3,) [rad/rad] per angle by which the segment's long axis is tilted since the start pose
    per_twist : [rad/rad] about the long axis, per angle by which the segment is rotated about it since the start pose
    raised : segments on which it depends too, such as the arms for a sensor on the torso
    per_raised : (3,) [rad/rad] per mean angle of their long axes off hanging
    mean_per_tilt, mean_per_twist, mean_per_raised : by how much the segment has turned beyond its sensor in the mean of
        people; the standard deviations contain it
    """

    std: Angles = ZERO
    relative_to: str = ""
    per_tilt: Annotated[Vector, Key(least=0.0)] = ZERO
    per_twist: float = 0.0
    raised: tuple[str, ...] = ()
    per_raised: Annotated[Vector, Key(least=0.0, omit_zero=True)] = ZERO
    mean_per_tilt: Annotated[Vector, Key(omit_zero=True)] = ZERO
    mean_per_twist: float = 0.0
    mean_per_raised: Annotated[Vector, Key(omit_zero=True)] = ZERO


def _same(degrees: float) -> tuple[float, float, float]:
    """Return the angle [rad] for each of three axes."""
    angle = float(np.deg2rad(degrees))
    return angle, angle, angle


class Segment(NamedTuple):
    """A segment of a body.

    Parameters
    ----------
    link : its link in the URDF
    up, forward : the link's axes that point up and forward in the N-pose; None: found with all joints at zero
    along : (3,) unit, its long axis in its own frame, away from the joint to the segment above
    spine : its rotation is shared by all joints between it and the root
    rigid_without_sensor : without a sensor it is rigid with the segment above; False: it is unknown then
    labels : a regular expression of words that mean it in a sensor's name
    joint : the name of the joint to the segment above, where no point names it
    foam_std : (3,) [rad/rad] by which a foam under its sensor gives, about its axes, per rotation of the segment
    soft_tissue : how far soft tissue rotates its sensor
    start_mean : (3,) [rad] mean rotation vector, in its axes, of people off the neutral pose
    start_std : (3,) [rad] about its axes, one standard deviation of its rotation off the start pose among people
    repeat_std : (3,) [rad] the same between two start poses of one person
    """

    link: str
    up: Annotated[str | None, Key(of="axes")] = None
    forward: Annotated[str | None, Key(of="axes")] = None
    along: Direction = (0.0, 0.0, -1.0)
    spine: bool = False
    rigid_without_sensor: Annotated[bool, Key("without_sensor", words={"rigid": True, "unknown": False})] = False
    labels: str = ""
    joint: str = ""
    foam_std: Annotated[Vector, Key("foam_deg", "deg", least=0.0, omit_zero=True)] = ZERO
    soft_tissue: SoftTissue = SoftTissue(_same(1.5))
    start_mean: Annotated[Vector, Key(unit="deg")] = ZERO
    start_std: Angles = _same(4.0)
    repeat_std: Angles = _same(2.0)

    @classmethod
    def of_mechanism(cls, link: str, *, rigid: bool) -> Segment:
        """Return a segment of a mechanism: no soft tissue, and a start configuration to 0.5° (assumption)."""
        return cls(
            link, rigid_without_sensor=rigid, soft_tissue=SoftTissue(), start_std=_same(0.5), repeat_std=_same(0.5)
        )


class Point(NamedTuple):
    """The link on which a point lies, and where [m] in the link."""

    link: str
    at: Annotated[Vector, Key("at", "m", -10.0, 10.0, omit_zero=True)] = ZERO


class Length(NamedTuple):
    """A length of a body, which scales a segment along the line between two places.

    Parameters
    ----------
    segment : what it scales
    start, end : a point, or two in whose middle the line begins or ends, with all joints at zero
    share : its name among the ratios to stature in ``calibration/anthropometry.toml``; empty: it has none, and the
        prior is the model's own value
    std_percent : one standard deviation of the model's own value, as a share of it [%]
    """

    segment: SegmentName
    start: Annotated[tuple[str, ...], Key("from", of="points")]
    end: Annotated[tuple[str, ...], Key("to", of="points")]
    share: str = ""
    std_percent: Annotated[float, Key(least=1e-3)] = 10.0


class HingeJoint(NamedTuple):
    """A joint of nearly one axis; standard deviations [rad].

    Parameters
    ----------
    on, moves : segments; the long axis of `moves` stays in the plane of `on` that is normal to the axis
    axis : (3,) unit, in the frame of `on`
    range : [rad] least and largest rotation of `moves` about the axis
    softness : of the angle between the long axis and the plane
    common_std, mirror_std : of the axis's rotation about the long axis of `on`, the part that is equal and the part
        that is opposite on both sides of the body
    tilt_std : of the axis's rotation about the direction across both, the long axis and itself
    """

    on: SegmentName
    moves: SegmentName
    axis: Vector
    range: Annotated[tuple[float, float], Key(unit="deg")] = (-np.pi, np.pi)
    softness: Angle = float(np.deg2rad(2.0))
    common_std: Angle = float(np.deg2rad(6.5))
    mirror_std: Angle = float(np.deg2rad(20.0))
    tilt_std: Angle = float(np.deg2rad(5.0))


class Place(NamedTuple):
    """Where a sensor usually sits, in words."""

    place: str


class Drawing(NamedTuple):
    """What is drawn of a body: lines through points, limb by limb, and the points whose path is drawn."""

    limbs: Annotated[tuple[tuple[str, ...], ...], Key(of="points")] = ()
    paths: Annotated[tuple[str, ...], Key(of="points")] = ()


class Limb(NamedTuple):
    """An arm, a leg or another line of points from the body to a tip.

    Parameters
    ----------
    points : from the one on the body to the tip
    segments : between these points, in that order; only those that have a length
    base : the segment of the body to which it belongs; None: the root
    origin : its first point, with that of the other side where there is one, left before right; distances of the tip
        are from their middle
    """

    points: tuple[str, ...]
    segments: tuple[str, ...]
    base: str | None
    origin: tuple[str, ...]

    @property
    def tip(self) -> str:
        return self.points[-1]


@dataclass(frozen=True)
class BodyTable:
    """The names and properties of what a body has: the content of its file.

    Parameters
    ----------
    name : of the body, for messages and files
    segments : name → segment; the first one faces x of W in the start pose
    urdf : the file beside the table; empty: that of the table's name
    kind : "person": three revolute joints in a row are one spherical joint, segment frames equal W in the N-pose;
        "mechanism": joints and frames are those of the URDF
    up, forward : the root link's axes that point up and forward while all joints are at zero
    root : the link whose origin is that of W, or links midway between which it is; empty: the root link
    points : name → its link, and its place in it
    lengths : name → what it scales
    hinges : name → joint of nearly one axis
    girdles : shoulder point → the law by which it moves on the trunk as the arm is raised
    poses : name → joint of the URDF → value [rad or m]
    pairs : name on the left → name on the right, of segments, points, lengths and hinges
    sensors : segment → where its sensor usually sits
    draw : its lines and paths
    where : the table's file, for messages
    """

    name: Annotated[str, None]
    segments: Mapping[str, Segment]
    urdf: str = ""
    kind: Literal["person", "mechanism"] = "person"
    up: Annotated[str, Key(of="axes")] = "+z"
    forward: Annotated[str, Key(of="axes")] = "+x"
    root: tuple[str, ...] = ()
    points: Mapping[str, Point] = field(default_factory=dict)
    lengths: Mapping[str, Length] = field(default_factory=dict)
    hinges: Mapping[str, HingeJoint] = field(default_factory=dict)
    girdles: Mapping[str, Girdle] = field(default_factory=dict)
    poses: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: {NEUTRAL_POSE: {}})
    pairs: Annotated[Mapping[str, str], Key(of="names")] = field(default_factory=dict)
    sensors: Mapping[str, Place] = field(default_factory=dict)
    draw: Drawing = field(default_factory=Drawing)
    where: Annotated[str, None] = "segments"

    @property
    def is_mechanism(self) -> bool:
        return self.kind == "mechanism"

    @property
    def reference(self) -> str:
        """The segment that faces x of W in the start pose."""
        return next(iter(self.segments))

    @property
    def needed(self) -> tuple[str, ...]:
        """Segments that are unknown without a sensor."""
        return tuple(name for name, segment in self.segments.items() if not segment.rigid_without_sensor)

    @cached_property
    def _counterparts(self) -> dict[str, str]:
        return {**self.pairs, **{right: left for left, right in self.pairs.items()}}

    def counterpart(self, name: str) -> str | None:
        """Return the name of the same thing on the other side; None where there is none."""
        return self._counterparts.get(name)

    def side(self, name: str) -> str:
        """Return the side of a name, "left" or "right"; empty where it has no counterpart."""
        return "left" if name in self.pairs else "right" if name in self._counterparts else ""

    def shared_name(self, name: str) -> str:
        """Return the name without its side, "elbow" of "left_elbow"; the name itself where it has no counterpart."""
        other = set((self.counterpart(name) or name).split("_"))
        return "_".join(word for word in name.split("_") if word in other)

    def joint_name(self, segment: str) -> str:
        """Return the name of the joint to the segment above: `Segment.joint`, else the point at which the segment
        begins, else the segment's name.
        """
        ends = self.ends(segment)
        beginning = ends[0] if ends else ()
        return self.segments[segment].joint or (beginning[0] if len(beginning) == 1 else segment)

    def find_length(self, *points: str) -> str | None:
        """Return the name of the length between these points, or their middles; None: there is none."""
        names = (name for name, length in self.lengths.items() if {*length.start, *length.end} == set(points))
        return next(names, None)

    def find_limb(self, point: str) -> Limb | None:
        """Return the limb up to a point; None where the point is on none, or is the first one of its limb.

        A line between a point and its counterpart, as between the shoulders, is no limb.
        """
        lines = (line for line in self.draw.limbs if point in line[1:] and self.counterpart(line[0]) not in line)
        line = next(lines, None)
        if line is None:
            return None
        points = line[: line.index(point) + 1]
        between = {(*length.start, *length.end): length.segment for length in self.lengths.values()}
        own = dict.fromkeys(between[ends] for ends in pairwise(points) if ends in between)
        above = (segment for ends, segment in between.items() if points[0] in ends and segment not in own)
        origin = [point for point in (points[0], self.counterpart(points[0])) if point is not None]
        return Limb(
            points, tuple(own), next(above, None), tuple(sorted(origin, key=lambda name: name not in self.pairs))
        )

    @property
    def drawn_limbs(self) -> dict[str, Limb]:
        """Point whose path is drawn → its limb."""
        return {point: limb for point in self.draw.paths if (limb := self.find_limb(point)) is not None}

    def ends(self, segment: str) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
        """Return the points at which the length of a segment begins and ends; None where not just one length is its."""
        ends = [(length.start, length.end) for length in self.lengths.values() if length.segment == segment]
        return ends[0] if len(ends) == 1 else None

    def guess_segment(self, label: str) -> str | None:
        """Guess the segment from a label or a file name, as ``humerus_r_imu`` or ``LeftForeArm``; None if unclear."""
        words = re.sub(r"(?<=[a-z])(?=[A-Z])|[^A-Za-z0-9]+|(?<=[a-z])(?=\d)", " ", label).lower()
        sides = {
            side
            for side, written in _SIDES.items()
            if re.search(rf"\b({written})(?=\b|hand|fore|upper|foot|low|wrist|arm|thigh|shank)", words)
        }
        matches = set()
        for name, segment in self.segments.items():
            side = self.side(name)
            pattern = rf"({segment.labels})" if side else rf"\b({segment.labels})\b"
            if segment.labels and (not side or side in sides) and re.search(pattern, words):
                matches.add(name)
        return matches.pop() if len(matches) == 1 else None


def prune_table(table: BodyTable) -> BodyTable:
    """Return the table without what needs segments or points that it lacks."""
    segments, points = set(table.segments), {*table.points, ROOT}
    lengths = {
        name: length
        for name, length in table.lengths.items()
        if length.segment in segments and points.issuperset(length.start + length.end)
    }
    hinges = {name: hinge for name, hinge in table.hinges.items() if {hinge.on, hinge.moves} <= segments}
    girdles = {
        name: girdle
        for name, girdle in table.girdles.items()
        if name in points and {girdle.on, girdle.moves} <= segments
    }
    pruned = {}
    for name, segment in table.segments.items():
        tissue = segment.soft_tissue
        tissue = tissue._replace(raised=tuple(other for other in tissue.raised if other in segments))
        if tissue.relative_to and tissue.relative_to not in segments:
            tissue = tissue._replace(relative_to="", per_tilt=ZERO, per_twist=0.0)
        pruned[name] = segment._replace(soft_tissue=tissue)
    names = {*segments, *points, *lengths, *hinges}
    return replace(
        table,
        segments=pruned,
        lengths=lengths,
        hinges=hinges,
        girdles=girdles,
        pairs={left: right for left, right in table.pairs.items() if {left, right} <= names},
        sensors={name: place for name, place in table.sensors.items() if name in segments},
        draw=Drawing(
            tuple(limb for limb in table.draw.limbs if points.issuperset(limb)),
            tuple(point for point in table.draw.paths if point in points),
        ),
    )
