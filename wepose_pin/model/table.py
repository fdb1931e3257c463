"""The table of a body, a TOML file beside its URDF: names and properties of its segments, points and lengths.

`BodyTable` names segments, points, lengths, hinges, poses, pairs, usual places of sensors and what to draw. No other
module of the package names a segment, a point or a length. docs/models.md explains the file.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ..assets import asset
from ..documents import TomlTable, is_number, read_toml, toml_key, toml_string, toml_strings
from ..errors import BadModel, MissingFile, one_of
from ..recording.sensors import AXES, read_axes
from .girdle import Girdle

DEFAULT_BODY = "upper_body"
ROOT = "root"  # the origin of W, as the end of a length
MODEL_TABLE = "model.toml"
PERSON, MECHANISM = "person", "mechanism"
NEUTRAL_POSE = "n_pose"
# Regular expressions of the side in a sensor's name, in English and German.
_SIDES = {"left": "left|lt?|link(s|e[rsmn]?)", "right": "right|rt?|recht(s|e[rsmn]?)"}
_KEYS = ("segments", "points", "lengths", "hinges", "girdles", "poses", "pairs", "sensors", "draw")
_SETTINGS = ("kind", "up", "forward", "root")


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
    """

    std: tuple[float, float, float] = (0.0, 0.0, 0.0)
    relative_to: str = ""
    per_tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    per_twist: float = 0.0
    raised: tuple[str, ...] = ()
    per_raised: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _same(degrees: float) -> tuple[float, float, float]:
    """Return the angle [rad] for each of three axes."""
    angle = float(np.deg2rad(degrees))
    return angle, angle, angle


class Segment(NamedTuple):
    """A segment of a body.

    Parameters
    ----------
    link : its link in the URDF
    up, forward : the link's axes that point up and forward in the N-pose; None: found from the URDF with all joints at
        zero
    along : (3,) unit, its long axis in its own frame, away from the joint to the segment above
    spine : its rotation is shared by all joints between it and the root
    rigid_without_sensor : without a sensor it is rigid with the segment above; False: it is unknown then
    labels : a regular expression of words that mean it in a sensor's name
    joint : the name of the joint to the segment above, where no point names it
    soft_tissue_std : [rad/rad] of the rotation of a sensor by soft tissue per rotation of the segment, in a calibration
    soft_tissue : the same while the body is tracked
    start_mean : (3,) [rad] mean rotation vector, in its axes, of people off the neutral pose
    start_std : (3,) [rad] about its axes, one standard deviation of its rotation off the start pose among people
    repeat_std : (3,) [rad] the same between two start poses of one person
    """

    link: str
    up: str | None = None
    forward: str | None = None
    along: tuple[float, float, float] = (0.0, 0.0, -1.0)
    spine: bool = False
    rigid_without_sensor: bool = False
    labels: str = ""
    joint: str = ""
    soft_tissue_std: float = float(np.deg2rad(0.6))
    soft_tissue: SoftTissue = SoftTissue(_same(1.5))
    start_mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_std: tuple[float, float, float] = _same(4.0)
    repeat_std: tuple[float, float, float] = _same(2.0)

    @classmethod
    def of_mechanism(cls, link: str) -> Segment:
        """Return a segment of a mechanism: no soft tissue, and a start configuration to 0.5° (assumption)."""
        rigid = SoftTissue()
        return cls(
            link,
            rigid_without_sensor=True,
            soft_tissue_std=0.0,
            soft_tissue=rigid,
            start_std=_same(0.5),
            repeat_std=_same(0.5),
        )


class Point(NamedTuple):
    """The link on which a point lies, and where [m] in the link."""

    link: str
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Stretch(NamedTuple):
    """A part of a length, which scales a segment along the line between two places."""

    segment: str
    start: tuple[str, ...]  # a point, or two in whose middle the line begins, with all joints at zero
    end: tuple[str, ...]  # the same of its end


class Length(NamedTuple):
    """A length of a body.

    Parameters
    ----------
    stretches : what it scales; more than one where parts of the body share it
    share : its name among the ratios to stature in ``calibration/anthropometry.toml``; empty: it has none, and the
        prior is the model's own value
    relative_std : standard deviation of the model's own value, as a share of it
    """

    stretches: tuple[Stretch, ...]
    share: str = ""
    relative_std: float = 0.1


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

    on: str
    moves: str
    axis: tuple[float, float, float]
    range: tuple[float, float] = (-np.pi, np.pi)
    softness: float = float(np.deg2rad(2.0))
    common_std: float = float(np.deg2rad(5.0))
    mirror_std: float = float(np.deg2rad(20.0))
    tilt_std: float = float(np.deg2rad(5.0))


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


class SensorPlace(NamedTuple):
    """Where a sensor usually sits, and its axes that point up and forward in the N-pose; None: not stated."""

    place: str = ""  # in words, for pages
    up: str | None = None
    forward: str | None = None


@dataclass(frozen=True)
class BodyTable:
    """The names and properties of what a body has.

    Parameters
    ----------
    name : of the body, for messages and files
    segments : name → segment; the first one faces x of W in the start pose
    points : name → its link, and its place in it
    lengths : name → what it scales
    hinges : name → joint of nearly one axis
    girdles : shoulder point → the law by which it moves on the trunk as the arm is raised
    poses : name → joint of the URDF → value [rad or m]
    pairs : name on the left → name on the right, of segments, points, lengths and hinges
    sensors : segment → where its sensor usually sits
    limbs : the points of each line that is drawn
    paths : points whose path is drawn
    kind : "person": three revolute joints in a row are one spherical joint, segment frames equal W in the N-pose;
        "mechanism": joints and frames are those of the URDF
    up, forward : the root link's axes that point up and forward while all joints are at zero
    root : the link whose origin is that of W, or links midway between which it is; empty: the root link
    absent : names of lengths that this body lacks, and the one after which it is modelled has
    where : the table's file, for messages
    """

    name: str
    segments: Mapping[str, Segment]
    points: Mapping[str, Point] = field(default_factory=dict)
    lengths: Mapping[str, Length] = field(default_factory=dict)
    hinges: Mapping[str, HingeJoint] = field(default_factory=dict)
    girdles: Mapping[str, Girdle] = field(default_factory=dict)
    poses: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    pairs: Mapping[str, str] = field(default_factory=dict)
    sensors: Mapping[str, SensorPlace] = field(default_factory=dict)
    limbs: tuple[tuple[str, ...], ...] = ()
    paths: tuple[str, ...] = ()
    kind: Literal["person", "mechanism"] = "person"
    up: str = "+z"
    forward: str = "+x"
    root: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()
    where: str = "segments"

    @property
    def is_mechanism(self) -> bool:
        return self.kind == MECHANISM

    @property
    def reference(self) -> str:
        """The segment that faces x of W in the start pose."""
        return next(iter(self.segments))

    @property
    def links(self) -> set[str]:
        """The links of segments, points and root."""
        segments = {segment.link for segment in self.segments.values()}
        return segments | {point.link for point in self.points.values()} | set(self.root)

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
        for name, length in self.lengths.items():
            if len(length.stretches) == 1 and {*length.stretches[0].start, *length.stretches[0].end} == set(points):
                return name
        return None

    def find_limb(self, point: str) -> Limb | None:
        """Return the limb up to a point; None where the point is on none, or is the first one of its limb.

        A line between a point and its counterpart, as between the shoulders, is no limb.
        """
        for line in self.limbs:
            if point in line[1:] and self.counterpart(line[0]) not in line:
                points = line[: line.index(point) + 1]
                break
        else:
            return None
        stretches = [part for length in self.lengths.values() for part in length.stretches]
        between = {(*part.start, *part.end): part.segment for part in stretches}
        own = [between[ends] for ends in pairwise(points) if ends in between]
        above = (part.segment for part in stretches if points[0] in part.start + part.end and part.segment not in own)
        other = self.counterpart(points[0])
        left_first = (points[0], other) if points[0] in self.pairs else (other, points[0])
        origin = tuple(point for point in left_first if point is not None)
        return Limb(points, tuple(dict.fromkeys(own)), next(above, None), origin)

    @property
    def drawn_limbs(self) -> dict[str, Limb]:
        """Point whose path is drawn → its limb."""
        return {point: limb for point in self.paths if (limb := self.find_limb(point)) is not None}

    def ends(self, segment: str) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
        """Return the points at which the length of a segment begins and ends; None where not just one length is its."""
        stretches = [part for length in self.lengths.values() for part in length.stretches if part.segment == segment]
        return (stretches[0].start, stretches[0].end) if len(stretches) == 1 else None

    def check_segments(self, names: Iterable[str], where: str, error: type[Exception]) -> None:
        """Raise an `error` whose text begins with `where` if a name is no segment."""
        for name in names:
            if name not in self.segments:
                others = [body for body in _list_bodies() if name in load_table(body).segments]
                known = f"the body {others[0]} has it" if others else one_of(self.segments, name)
                raise error(f"{where}{name} is no segment of {self.name}; {known}")

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

    def drop(self, segments: Collection[str]) -> BodyTable:
        """Return the table without these segments, and without points, lengths and hinges that need them."""
        kept = {name: segment for name, segment in self.segments.items() if name not in segments}
        links = {self.segments[name].link for name in segments} - {segment.link for segment in kept.values()}
        points = {name: point for name, point in self.points.items() if point.link not in links}
        return _prune(replace(self, segments=kept, points=points))


def _prune(table: BodyTable) -> BodyTable:
    """Return the table without lengths, hinges, girdles, pairs, sensors and lines whose segments or points it lacks."""
    points = {*table.points, ROOT}
    lengths = {
        name: length
        for name, length in table.lengths.items()
        if all(part.segment in table.segments and points.issuperset(part.start + part.end) for part in length.stretches)
    }
    hinges = {name: hinge for name, hinge in table.hinges.items() if {hinge.on, hinge.moves} <= set(table.segments)}
    girdles = {
        name: girdle
        for name, girdle in table.girdles.items()
        if name in table.points and {girdle.on, girdle.moves} <= set(table.segments)
    }
    names = {*table.segments, *table.points, *lengths, *hinges}
    limbs = tuple(limb for limb in table.limbs if set(limb) <= set(table.points))
    return replace(
        table,
        lengths=lengths,
        absent=tuple(name for name in (*table.absent, *table.lengths) if name not in lengths),
        hinges=hinges,
        girdles=girdles,
        pairs={left: right for left, right in table.pairs.items() if {left, right} <= names},
        sensors={name: place for name, place in table.sensors.items() if name in table.segments},
        limbs=limbs,
        paths=tuple(point for point in table.paths if point in table.points),
    )


# Reading ----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def load_table(name: str = DEFAULT_BODY) -> BodyTable:
    """Return the table of a body that comes with the package.

    Raises
    ------
    BadModel
        There is none of that name.
    """
    if name not in _list_bodies():
        raise BadModel(f"no body '{name}' comes with the package; {one_of(_list_bodies(), name)}")
    return read_table(asset("urdf", f"{name}.toml"))[0]


def _list_bodies() -> list[str]:
    """Return the names of the bodies that come with the package."""
    return sorted(path.stem for path in asset("urdf", f"{DEFAULT_BODY}.toml").parent.glob("*.toml"))


def read_table(path: Path, *, needs_urdf: bool = False) -> tuple[BodyTable, Path | None]:
    """Read a table from a TOML file; return it and its URDF: the one that it names, else that beside it; None: neither.

    With `needs_urdf` a table without a URDF is an error.

    Raises
    ------
    MissingFile, BadModel
        The file is not there, is not TOML, or is not the table of a body.
    """
    values = read_toml(path, "the table of a body", BadModel)
    urdf = values.pop("urdf", None)
    if urdf is not None and not isinstance(urdf, str):
        raise BadModel(f"{path}: urdf = {urdf!r}; the name of a file is wanted")
    beside = path.with_suffix(".urdf")
    file = path.parent / urdf if urdf is not None else beside if beside.is_file() else None
    if needs_urdf and file is None:
        raise BadModel(f'{path}: names no URDF; urdf = "body.urdf" is wanted, a file beside this one')
    if urdf is not None and needs_urdf and file is not None and not file.is_file():
        raise MissingFile(f"{path}: urdf = {urdf!r}: no such file beside it; the name of a URDF is wanted")
    return parse_table(values, str(path), path.stem), file


def parse_table(values: Mapping[str, Any], where: str, name: str) -> BodyTable:
    """Return the table of the parsed TOML file, or of the arguments of `load_model`.

    With the key ``like`` the table is that of another body, except for what `values` state. It then has the segments
    that `values` name, or all where they name none of them.

    Raises
    ------
    BadModel
        An unknown key, name or axis, or a value of the wrong type.
    """
    top = TomlTable(values, where, error=BadModel)
    top.allow("like", *_SETTINGS, *_KEYS)
    like = top.text("like", None)
    known = _list_bodies()
    if like is not None and like not in known:
        raise BadModel(f"{top.at('like')} = {like!r}: no such body comes with the package; {one_of(known, like)}")
    base = load_table(like) if like is not None else BodyTable(name, {}, where=where)
    new = like is None
    kind: Any = top.choice("kind", (PERSON, MECHANISM), base.kind)
    segments = _read_segments(top, base, kind)
    if not segments:
        raise BadModel(f'{where}: [segments] is missing; each segment\'s link is needed, as in torso = "chest_link"')
    up, forward = read_axes(top, base.up if new else "+z", base.forward if new else "+x")
    table = replace(
        base,
        name=name,
        segments=segments,
        points=_read_points(top, base, segments),
        kind=kind,
        up=up,
        forward=forward,
        root=_read_names(top, "root"),
        where=where,
    )
    if like is not None:
        table = _prune(replace(table, poses={}))
        _check_ends(table, base)
    lengths = {**table.lengths, **_read_lengths(top, table)}
    table = replace(table, lengths=lengths)
    hinges = {**table.hinges, **_read_hinges(top, table)}
    girdles = {**table.girdles, **_read_girdles(top, table)}
    table = replace(table, hinges=hinges, girdles=girdles, poses=_read_poses(top))
    names = {*table.segments, *table.points, *table.lengths, *table.hinges}
    pairs = top.table("pairs", {})
    for left, right in pairs.values.items():
        for each in (left, right):
            if each not in names:
                raise BadModel(
                    f"{pairs.at(left)}: '{each}' is no segment, point, length or hinge; {one_of(names, each)}"
                )
    draw = top.table("draw", {})
    draw.allow("limbs", "paths")
    limbs = draw.values.get("limbs", [])
    if not isinstance(limbs, list) or not all(isinstance(limb, list) for limb in limbs):
        raise BadModel(f'{draw.at("limbs")} = {limbs!r}; lists of points are wanted, as [["hip", "knee", "ankle"]]')
    for point in (*(point for limb in limbs for point in limb), *_read_names(draw, "paths")):
        if point not in table.points:
            raise BadModel(f"{draw.where}: '{point}' is no point; {one_of(table.points, str(point))}")
    table = _prune_soft_tissue(table)
    return replace(
        table,
        pairs={**table.pairs, **pairs.values},
        sensors={**table.sensors, **_read_sensors(top, table)},
        limbs=(*table.limbs, *(tuple(limb) for limb in limbs)),
        paths=(*table.paths, *_read_names(draw, "paths")),
    )


def _read_segments(top: TomlTable, base: BodyTable, kind: str) -> dict[str, Segment]:
    segments = {}
    new = Segment.of_mechanism("")._replace(rigid_without_sensor=False) if kind == MECHANISM else Segment("")
    for name, entry in _read_links(top, "segments"):
        entry.allow(
            *("link", "up", "forward", "along", "spine", "without_sensor", "labels", "joint"),
            *("soft_tissue_deg", "soft_tissue", "start_mean_deg", "start_std_deg", "repeat_std_deg"),
        )
        own = base.segments.get(name)
        if ("up" in entry) != ("forward" in entry):
            raise BadModel(f'{entry.where}: up and forward go together, as in up = "+z", forward = "+x"')
        up, forward = read_axes(entry) if "up" in entry else (None, None)
        segment = (own or new)._replace(link=entry.text("link", name) or name, up=up, forward=forward)
        if "along" in entry:
            x, y, z = (float(v) for v in AXES[entry.choice("along", AXES)])
            segment = segment._replace(along=(x, y, z))
        if "spine" in entry:
            segment = segment._replace(spine=entry.flag("spine"))
        if "without_sensor" in entry:
            rigid = entry.choice("without_sensor", ("rigid", "unknown")) == "rigid"
            segment = segment._replace(rigid_without_sensor=rigid)
        labels = entry.text("labels", segment.labels or None) or ""
        try:
            re.compile(labels)
        except re.error as error:
            raise BadModel(f"{entry.at('labels')} = {labels!r} is no regular expression: {error}") from None
        joint = entry.text("joint", segment.joint or None) or ""
        soft = _read_angle(entry, "soft_tissue_deg", segment.soft_tissue_std)
        start, repeat = (
            _read_angles(entry, key, value)
            for key, value in (("start_std_deg", segment.start_std), ("repeat_std_deg", segment.repeat_std))
        )
        segments[name] = segment._replace(
            labels=labels,
            joint=joint,
            soft_tissue_std=soft,
            soft_tissue=_read_soft_tissue(entry, segment.soft_tissue),
            start_mean=_read_start_mean(entry, segment.start_mean),
            start_std=start,
            repeat_std=repeat,
        )
    if base.segments and (not segments or not set(segments) & set(base.segments)):
        return {**base.segments, **segments}  # the same body with more on it
    lacking = [name for name in base.segments if name not in segments]
    for name in segments:
        close = [] if name in base.segments else get_close_matches(name, lacking, n=1, cutoff=0.85)
        if close:
            raise BadModel(f"{top.at('segments')}.{name}: did you mean '{close[0]}'? {base.name} has that")
    order = [*base.segments, *segments]
    return dict(sorted(segments.items(), key=lambda item: order.index(item[0])))


def _read_start_mean(entry: TomlTable, default: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = np.deg2rad(_read_numbers(entry, "start_mean_deg", 3, np.degrees(default).tolist())).tolist()
    return x, y, z


def _read_soft_tissue(entry: TomlTable, default: SoftTissue) -> SoftTissue:
    if "soft_tissue" not in entry:
        return default
    table = entry.table("soft_tissue")
    table.allow("std_deg", "relative_to", "per_tilt", "per_twist", "raised", "per_raised")
    tilt, raised = (
        _read_triple(table, key, value)
        for key, value in (("per_tilt", default.per_tilt), ("per_raised", default.per_raised))
    )
    return SoftTissue(
        _read_angles(table, "std_deg", default.std),
        table.text("relative_to", default.relative_to or None) or "",
        tilt,
        table.number("per_twist", default.per_twist) or 0.0,
        _read_names(table, "raised") or default.raised,
        raised,
    )


def _prune_soft_tissue(table: BodyTable) -> BodyTable:
    """Return the table without terms of soft tissue by segments that the body lacks, and one that it is like has."""
    segments = {}
    for name, segment in table.segments.items():
        tissue = segment.soft_tissue
        raised = tuple(other for other in tissue.raised if other in table.segments)
        if tissue.relative_to and tissue.relative_to not in table.segments:
            tissue = tissue._replace(relative_to="", per_tilt=(0.0, 0.0, 0.0), per_twist=0.0)
        segments[name] = segment._replace(soft_tissue=tissue._replace(raised=raised))
    return replace(table, segments=segments)


def _check_ends(table: BodyTable, base: BodyTable) -> None:
    """Raise `BadModel` where a segment of another body has lost its length, and its direction cannot be found."""
    for name, segment in table.segments.items():
        ends = base.ends(name)
        if ends is None or segment.spine or segment.rigid_without_sensor or segment.up is not None or table.ends(name):
            continue
        lacking = [point for point in ends[0] + ends[1] if point not in table.points]
        raise BadModel(
            f"{table.where}: segments.{name} has no {' and no '.join(lacking)}; name a link in points.{lacking[0]}, or "
            f"the segment that begins there"
        )


def _read_points(top: TomlTable, base: BodyTable, segments: Mapping[str, Segment]) -> dict[str, Point]:
    points: dict[str, Point] = {}
    by_link = {segment.link: name for name, segment in base.segments.items()}
    for name, point in base.points.items():
        # A point where a segment begins is there with the segment.
        begins = by_link.get(point.link)
        if begins is not None and begins in segments and not any(point.at):
            points[name] = Point(segments[begins].link)
        elif all(segments.get(each) == own for each, own in base.segments.items()):
            points[name] = point
    for name, entry in _read_links(top, "points"):
        entry.allow("link", "at")
        at = entry.values.get("at", (0.0, 0.0, 0.0))
        if not (isinstance(at, list | tuple) and len(at) == 3 and all(is_number(v, 1e3) for v in at)):
            raise BadModel(f"{entry.at('at')} = {at!r}; three numbers [m] in the link are wanted")
        points[name] = Point(entry.text("link", name) or name, (float(at[0]), float(at[1]), float(at[2])))
    order = [*base.points, *points]
    return dict(sorted(points.items(), key=lambda item: order.index(item[0])))


def _read_lengths(top: TomlTable, table: BodyTable) -> dict[str, Length]:
    entries, lengths = top.table("lengths", {}), {}
    for name, value in entries.values.items():
        parts = value if isinstance(value, list) else [value]
        if not parts or not all(isinstance(part, Mapping) for part in parts):
            raise BadModel(
                f'{entries.at(name)} = {value!r}; what it scales is wanted, as {{ segment = "forearm", '
                f'from = "elbow", to = "wrist" }}, or a list of that'
            )
        stretches, settings = [], TomlTable({}, top.file, error=BadModel)
        for part in parts:
            entry = replace(entries, values=part, place=f"{entries.place}{name}.")
            entry.allow("segment", "from", "to", "share", "std_percent")
            start, end = (_read_names(entry, key) for key in ("from", "to"))
            for point in start + end:
                if point not in table.points and point != ROOT:
                    raise BadModel(f"{entry.where}: '{point}' is no point; {one_of((*table.points, ROOT), point)}")
            if not start or not end or start == end:
                raise BadModel(
                    f"{entry.where}: from = {list(start)}, to = {list(end)} scales nothing; two different points are "
                    f"needed"
                )
            stretches.append(Stretch(entry.choice("segment", table.segments), start, end))
            if "share" in entry or "std_percent" in entry:
                settings = entry
        percent = settings.number("std_percent", 10.0, positive=True) or 10.0
        lengths[name] = Length(tuple(stretches), settings.text("share", None) or "", percent / 100.0)
    return lengths


def _read_hinges(top: TomlTable, table: BodyTable) -> dict[str, HingeJoint]:
    hinges = {}
    for name, entry in _read_tables(top, "hinges"):
        keys = ("softness_deg", "common_std_deg", "mirror_std_deg", "tilt_std_deg")
        entry.allow("on", "moves", "axis", "range_deg", *keys)
        on, moves = (entry.choice(key, table.segments) for key in ("on", "moves"))
        axis = _read_numbers(entry, "axis", 3, None)
        size = float(np.linalg.norm(axis))
        if size < 1e-6 or on == moves:
            raise BadModel(
                f"{entry.where}: on = {on!r}, moves = {moves!r}, axis = {entry.values.get('axis')} is no hinge; two "
                f"different segments and an axis of some length are needed"
            )
        x, y, z = (float(v) / size for v in axis)
        low, high = np.deg2rad(_read_numbers(entry, "range_deg", 2, [-180.0, 180.0])).tolist()
        if low >= high:
            raise BadModel(f"{entry.at('range_deg')}: the first number must be below the second")
        defaults = HingeJoint(on, moves, (x, y, z), (low, high))
        softness, common, mirror, tilt = (
            _read_angle(entry, key, value)
            for key, value in zip(
                keys, (defaults.softness, defaults.common_std, defaults.mirror_std, defaults.tilt_std), strict=True
            )
        )
        if abs(np.dot((x, y, z), table.segments[on].along)) > 0.7:
            raise BadModel(
                f"{entry.at('axis')} = {entry.values['axis']} lies along the segment '{on}', about which no hinge "
                f"bends; an axis across it is needed"
            )
        hinges[name] = defaults._replace(softness=softness, common_std=common, mirror_std=mirror, tilt_std=tilt)
    return hinges


def _read_girdles(top: TomlTable, table: BodyTable) -> dict[str, Girdle]:
    girdles = {}
    for name, entry in _read_tables(top, "girdles"):
        spreads = ("rest_std_mm", "raised_std_mm", "residual_std_mm")
        law = ("up_mm", "middle_mm", "back_mm", "back_angle_deg")
        entry.allow("on", "moves", "joints", "outward", *law, "scaled_by", "scale", "law_std", "alike", *spreads)
        if name not in table.points:
            raise BadModel(f"{entry.where}: '{name}' is no point; {one_of(table.points, name)}")
        on, moves = (entry.choice(key, table.segments) for key in ("on", "moves"))
        joints = _read_names(entry, "joints")
        if len(joints) != 3 or on == moves:
            raise BadModel(
                f"{entry.where}: on = {on!r}, moves = {moves!r}, joints = {list(joints)}; two different segments and "
                f"three joints of the URDF are needed, which slide along x, y and z of '{on}'"
            )
        x, y, z = (float(v) for v in AXES[entry.choice("outward", AXES)])
        up, middle, back = (tuple(_read_millimetres(entry, key, 2, None)) for key in law[:3])
        stds = [tuple(_read_millimetres(entry, key, 3, [0.0, 0.0, 0.0], least=0.0)) for key in spreads]
        scaled_by = entry.choice("scaled_by", table.lengths) if "scaled_by" in entry else ""
        scale, angle = entry.number("scale", 1.0, positive=True), entry.number("back_angle_deg", None, positive=True)
        alike, law_std = entry.number("alike", 0.0) or 0.0, entry.number("law_std", 0.0) or 0.0
        if angle is None or not -1.0 < alike < 1.0 or law_std < 0.0:
            raise BadModel(
                f"{entry.where}: back_angle_deg = {angle}, alike = {alike:g}, law_std = {law_std:g}; an angle, a "
                f"correlation between -1 and 1, and a share from 0 on are needed"
            )
        girdles[name] = Girdle(
            on,
            moves,
            joints=(joints[0], joints[1], joints[2]),
            outward=(x, y, z),
            up=(up[0], up[1]),
            middle=(middle[0], middle[1]),
            back=(back[0], back[1]),
            back_angle=float(np.deg2rad(angle)),
            scaled_by=scaled_by,
            scale=scale or 1.0,
            law_std=law_std,
            rest_std=stds[0],
            raised_std=stds[1],
            alike=alike,
            residual_std=stds[2],
        )
    return girdles


def _read_millimetres(
    table: TomlTable, key: str, count: int, default: Sequence[float] | None, least: float = -1e3
) -> list[float]:
    """Return the numbers [m] of a key in millimetres."""
    values = _read_numbers(table, key, count, default)
    if min(values) < least:
        raise BadModel(f"{table.at(key)} = {values}; numbers of at least {least:g} mm are needed")
    return [1e-3 * v for v in values]


def _read_poses(top: TomlTable) -> dict[str, dict[str, float]]:
    poses: dict[str, dict[str, float]] = {NEUTRAL_POSE: {}}
    for name, entry in _read_tables(top, "poses"):
        for joint, value in entry.values.items():
            if not is_number(value, 1e3):
                raise BadModel(f"{entry.at(joint)} = {value!r}; a number is wanted [rad, or m of a joint that slides]")
        poses[name] = {joint: float(value) for joint, value in entry.values.items()}
    return poses


def _read_sensors(top: TomlTable, table: BodyTable) -> dict[str, SensorPlace]:
    sensors = {}
    for name, entry in top.table("sensors", {}).tables(table.segments, "segment").items():
        entry.allow("place", "up", "forward")
        up, forward = read_axes(entry) if "up" in entry or "forward" in entry else (None, None)
        sensors[name] = SensorPlace(entry.text("place", None) or "", up, forward)
    return sensors


def _read_tables(top: TomlTable, key: str) -> Iterator[tuple[str, TomlTable]]:
    """Iterate over name and table of each entry of a key."""
    entries = top.table(key, {})
    for name in entries.values:
        yield name, entries.table(name)


def _read_links(top: TomlTable, key: str) -> Iterator[tuple[str, TomlTable]]:
    """Iterate over name and table of each segment or point; a string in place of the table is the name of its link."""
    entries = top.table(key, {})
    for name, value in entries.values.items():
        if isinstance(value, Segment | Point):
            value = {part: own for part, own in value._asdict().items() if part in ("link", "up", "forward", "at")}
            value = {part: own for part, own in value.items() if own is not None}
        if isinstance(value, str):
            value = {"link": value}
        if not isinstance(value, Mapping) or not isinstance(value.get("link", name), str):
            raise BadModel(f'{entries.at(name)} = {value!r}; a link\'s name is wanted, or {{ link = "name", … }}')
        yield name, replace(entries, values=value, place=f"{entries.place}{name}.")


def _read_names(table: TomlTable, key: str) -> tuple[str, ...]:
    """Return the names of a key: a string, or a list of strings; empty without the key."""
    value = table.values.get(key) or ()
    value = (value,) if isinstance(value, str) else value
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise BadModel(f"{table.at(key)} = {value!r}; a name is wanted, or a list of names")
    return tuple(value)


def _read_numbers(table: TomlTable, key: str, count: int, default: Sequence[float] | None) -> list[float]:
    """Return `count` numbers of a key; `default` None: the key is needed."""
    value = table.values.get(key, default)
    if not isinstance(value, list) or len(value) != count or not all(is_number(v, 1e6) for v in value):
        raise BadModel(f"{table.at(key)} = {value!r}; {count} numbers are wanted")
    return [float(v) for v in value]


def _read_triple(table: TomlTable, key: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return three numbers of at least 0."""
    x, y, z = _read_numbers(table, key, 3, list(default))
    if min(x, y, z) < 0.0:
        raise BadModel(f"{table.at(key)} = {[x, y, z]}; numbers from 0 on are needed")
    return x, y, z


def _read_angles(table: TomlTable, key: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return three angles [rad] of a key in degrees."""
    if key not in table:
        return default
    x, y, z = np.deg2rad(_read_triple(table, key, default)).tolist()
    return x, y, z


def _read_angle(table: TomlTable, key: str, default: float) -> float:
    """Return an angle [rad] of a key in degrees."""
    value = table.number(key, None)
    if value is None:
        return default
    if not 0.0 <= value <= 180.0:
        raise BadModel(f"{table.at(key)} = {value:g}; between 0 and 180 degrees are wanted")
    return float(np.deg2rad(value))


def find_table(urdf: Path, links: Iterable[str]) -> BodyTable | None:
    """Return the table for a URDF with these links: one beside it, else one of the package that fits; None: none does.

    Beside it is ``model.toml`` if it names the URDF, or ``<name of the URDF>.toml`` if it is a table. A table of the
    package fits if the URDF has its links.
    """
    links = set(links)
    own_table = urdf.parent / MODEL_TABLE
    if own_table.is_file():
        table, named = read_table(own_table)
        if named is not None and named.name == urdf.name:
            return table
    beside = urdf.with_suffix(".toml")
    if beside.is_file() and "segments" in read_toml(beside, "the table of a body", BadModel):
        return read_table(beside)[0]
    default = load_table()
    others = [load_table(body) for body in _list_bodies() if body != DEFAULT_BODY]
    fitting = [replace(table, where=f"{urdf}: by {table.name}.toml") for table in others if table.links <= links]
    more = [table for table in fitting if len(table.segments) > len(default.segments)]
    if more:
        return more[0]
    if links.issuperset(default.segments[name].link for name in default.needed):
        lacking = [name for name, segment in default.segments.items() if segment.link not in links]
        there = {name: point for name, point in default.points.items() if point.link in links}
        return _prune(replace(default.drop(lacking), points=there, where=str(urdf)))
    return fitting[0] if fitting else None


# Writing ----------------------------------------------------------------------------------------------------------


def format_table(table: BodyTable, urdf: str) -> str:
    """Return the text of a table's file that names `urdf`, a URDF beside it."""
    lines = [f"urdf = {toml_string(urdf)}", f"kind = {toml_string(table.kind)}"]
    lines += [f"up = {toml_string(table.up)}", f"forward = {toml_string(table.forward)}"]
    if table.root:
        lines.append(f"root = {toml_strings(table.root)}")
    axes = {tuple(float(v) for v in axis): name for name, axis in AXES.items()}
    for name, segment in table.segments.items():
        lines += ["", f"[segments.{toml_key(name)}]", f"link = {toml_string(segment.link)}"]
        if segment.up is not None and segment.forward is not None:
            lines += [f"up = {toml_string(segment.up)}", f"forward = {toml_string(segment.forward)}"]
        lines.append(f"along = {toml_string(axes[segment.along])}")
        lines += ["spine = true"] if segment.spine else []
        lines += ['without_sensor = "rigid"'] if segment.rigid_without_sensor else []
        lines += [f"labels = {toml_string(segment.labels)}"] if segment.labels else []
        lines += [f"joint = {toml_string(segment.joint)}"] if segment.joint else []
        lines.append(f"soft_tissue_deg = {np.degrees(segment.soft_tissue_std):.6g}")
        lines.append(f"start_mean_deg = {np.degrees(segment.start_mean).round(6).tolist()}")
        lines.append(f"start_std_deg = {np.degrees(segment.start_std).round(6).tolist()}")
        lines.append(f"repeat_std_deg = {np.degrees(segment.repeat_std).round(6).tolist()}")
        tissue = segment.soft_tissue
        parts = [f"std_deg = {np.degrees(tissue.std).round(6).tolist()}", f"per_tilt = {list(tissue.per_tilt)}"]
        parts += [f"per_twist = {tissue.per_twist!r}"]
        parts += [f"relative_to = {toml_string(tissue.relative_to)}"] if tissue.relative_to else []
        parts += (
            [f"raised = {toml_strings(tissue.raised)}", f"per_raised = {list(tissue.per_raised)}"]
            if tissue.raised
            else []
        )
        lines.append(f"soft_tissue = {{ {', '.join(parts)} }}")
    lines += ["", "[points]"]
    for name, point in table.points.items():
        at = f", at = {list(point.at)}" if any(point.at) else ""
        lines.append(f"{toml_key(name)} = {{ link = {toml_string(point.link)}{at} }}")
    lines += ["", "[lengths]"]
    for name, length in table.lengths.items():
        prior = f", share = {toml_string(length.share)}" if length.share else ""
        prior += f", std_percent = {100.0 * length.relative_std:.6g}"
        parts = [
            f"{{ segment = {toml_string(part.segment)}, from = {toml_strings(part.start)}, "
            f"to = {toml_strings(part.end)}{prior} }}"
            for part in length.stretches
        ]
        lines.append(f"{toml_key(name)} = [{', '.join(parts)}]")
    for name, hinge in table.hinges.items():
        lines += ["", f"[hinges.{toml_key(name)}]", f"on = {toml_string(hinge.on)}"]
        lines += [f"moves = {toml_string(hinge.moves)}", f"axis = {list(hinge.axis)}"]
        lines.append(f"range_deg = {np.degrees(hinge.range).round(6).tolist()}")
        for key, value in (
            ("softness_deg", hinge.softness),
            ("common_std_deg", hinge.common_std),
            ("mirror_std_deg", hinge.mirror_std),
            ("tilt_std_deg", hinge.tilt_std),
        ):
            lines.append(f"{key} = {np.degrees(value):.6g}")
    for name, girdle in table.girdles.items():
        lines += ["", f"[girdles.{toml_key(name)}]", f"on = {toml_string(girdle.on)}"]
        lines += [f"moves = {toml_string(girdle.moves)}", f"joints = {toml_strings(girdle.joints)}"]
        lines.append(f"outward = {toml_string(axes[girdle.outward])}")
        lines += [
            f"{key}_mm = {np.round(1e3 * np.array(getattr(girdle, key)), 6).tolist()}"
            for key in ("up", "middle", "back", "rest_std", "raised_std", "residual_std")
        ]
        lines.append(f"back_angle_deg = {np.degrees(girdle.back_angle):.6g}")
        lines += [f"scaled_by = {toml_string(girdle.scaled_by)}"] if girdle.scaled_by else []
        lines += [f"scale = {girdle.scale!r}", f"law_std = {girdle.law_std!r}", f"alike = {girdle.alike!r}"]
    for name, joints in table.poses.items():
        if name == NEUTRAL_POSE and not joints:
            continue  # reading adds it
        lines += ["", f"[poses.{toml_key(name)}]"]
        lines += [f"{toml_key(joint)} = {value!r}" for joint, value in joints.items()]
    lines += ["", "[pairs]"]
    lines += [f"{toml_key(left)} = {toml_string(right)}" for left, right in table.pairs.items()]
    for name, sensor in table.sensors.items():
        lines += ["", f"[sensors.{toml_key(name)}]"]
        lines += [f"place = {toml_string(sensor.place)}"] if sensor.place else []
        if sensor.up is not None and sensor.forward is not None:
            lines += [f"up = {toml_string(sensor.up)}", f"forward = {toml_string(sensor.forward)}"]
    lines += ["", "[draw]", f"limbs = [{', '.join(toml_strings(limb) for limb in table.limbs)}]"]
    lines.append(f"paths = {toml_strings(table.paths)}")
    return "\n".join(lines) + "\n"
