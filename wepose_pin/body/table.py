"""The table of a body: names and properties of its segments, points and lengths, and its file (docs/models.md).

Outside simulation and joint angles no module names a segment, a point or a length.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from ..arguments import check_names
from ..documents import Key, TomlTable, format_record, format_toml, read_record, read_toml
from ..errors import BadModel, BadOption, one_of
from ..libraries import asset
from ..recording import AXES, read_axes
from .girdle import Direction, Girdle, SegmentName

DEFAULT_BODY = "upper_body"
ROOT = "root"  # the origin of W, as the end of a length
NEUTRAL_POSE = "n_pose"
SEXES: tuple[Literal["f", "m"], ...] = ("f", "m")
PRIOR = "calibration", "anthropometry.toml"  # mean and covariance of the lengths of people, from shares of stature
# Regular expressions of the side in a sensor's name, in English and German.
_SIDES = {"left": "left|lt?|link(s|e[rsmn]?)", "right": "right|rt?|recht(s|e[rsmn]?)"}

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
Angle = Annotated[float, Key(unit="deg", least=0.0, most=180.0)]
Angles = Annotated[Vector, Key(unit="deg", least=0.0)]


class SoftTissue(NamedTuple):
    """How far soft tissue rotates a sensor on its segment in motion; standard deviations about x, y, z of the segment.

    Its parts are independent, so that their squares add up; they contain the means, by which the segment has turned
    beyond its sensor in the mean of people.
    """

    std: Angles = ZERO  # [rad] in any pose
    relative_to: str = ""  # the segment against which tilt and twist are measured; empty: W
    per_tilt: Annotated[Vector, Key(least=0.0)] = ZERO  # [rad/rad] per tilt of the long axis since the start pose
    per_twist: float = 0.0  # [rad/rad] about the long axis, per rotation of the segment about it since the start pose
    raised: tuple[str, ...] = ()  # segments on which it depends too, such as the arms for a sensor on the torso
    per_raised: Annotated[Vector, Key(least=0.0)] = ZERO  # [rad/rad] per mean angle of these off hanging
    mean_per_tilt: Vector = ZERO
    mean_per_twist: float = 0.0
    mean_per_raised: Vector = ZERO


def _same(degrees: float) -> Vector:
    """Return the angle [rad] for each of three axes."""
    return (float(np.deg2rad(degrees)),) * 3


class Segment(NamedTuple):
    """A segment of a body; standard deviations are about its axes."""

    link: str  # in the URDF
    # Unit, its long axis in its own frame, away from the joint to the segment above.
    along: Direction = (0.0, 0.0, -1.0)
    spine: bool = False  # its rotation is shared by all joints between it and the root
    # Without a sensor it is rigid with the segment above; False: it is unknown then.
    rigid_without_sensor: Annotated[bool, Key("without_sensor", words={"rigid": True, "unknown": False})] = False
    labels: str = ""  # a regular expression of words that mean it in a sensor's name
    joint: str = ""  # name of the joint to the segment above, where no point names it
    # [rad/rad] by which a foam under its sensor gives, per rotation of the segment.
    foam_std: Annotated[Vector, Key("foam_deg", "deg", least=0.0)] = ZERO
    soft_tissue: SoftTissue = SoftTissue(_same(1.5))
    start_mean: Annotated[Vector, Key(unit="deg")] = ZERO  # [rad] mean rotation vector of people off the neutral pose
    start_std: Angles = _same(4.0)  # [rad] of its rotation off the start pose among people
    repeat_std: Angles = _same(2.0)  # [rad] the same between two start poses of one person


# Of a mechanism: no soft tissue, and a start configuration to 0.5° (assumption).
MECHANISM_SEGMENT = Segment("", soft_tissue=SoftTissue(), start_std=_same(0.5), repeat_std=_same(0.5))


class Point(NamedTuple):
    """The link on which a point lies, and where [m] in the link."""

    link: str
    at: Annotated[Vector, Key("at", "m", -10.0, 10.0)] = ZERO


class Length(NamedTuple):
    """A length of a body, which scales a segment along the line between two places, all joints at zero."""

    segment: SegmentName
    start: Annotated[tuple[str, ...], Key("from", of="points")]  # a point, or two in whose middle the line begins
    end: Annotated[tuple[str, ...], Key("to", of="points")]
    share: str = ""  # its name among the ratios to stature in calibration/anthropometry.toml; empty: the model's value
    std_percent: Annotated[float, Key(least=1e-3)] = 10.0  # of the model's value [%]


class HingeJoint(NamedTuple):
    """A joint of nearly one axis; unit vectors (3,), standard deviations [rad].

    Vectors are in the segments' frames L; of hinges between sensors, as `find_hinges` finds them, in L'.
    """

    on: SegmentName
    moves: SegmentName  # its long axis stays in the plane of `on` that is normal to the axis
    axis: Vector  # in the frame of `on`
    # [rad] of the angle about the axis from the long axis of `on` to that of `moves`
    range: Annotated[tuple[float, float], Key(unit="deg")] = (-np.pi, np.pi)
    softness: Angle = float(np.deg2rad(2.0))  # of the angle between the long axis and the plane
    # Of the axis's rotation about the long axis of `on`: the part that is equal, and opposite, on both sides.
    common_std: Angle = float(np.deg2rad(6.5))
    mirror_std: Angle = float(np.deg2rad(20.0))
    # Of the axis's rotation about the direction across both; means count in a calibration only.
    tilt_mean: Annotated[float, Key(unit="deg")] = 0.0
    tilt_std: Angle = float(np.deg2rad(5.0))
    # [rad/rad] by which `moves` leaves the plane, towards the axis, as it turns about its long axis.
    per_twist_mean: float = 0.0
    per_twist_std: Annotated[float, Key(least=0.0)] = 0.0
    # Of hinges between sensors:
    name: Annotated[str, None] = ""  # of the joint
    per_twist: Annotated[float, None] = 0.0  # [rad/rad] of the person, as calibrated
    along_on: Annotated[Vector, None] = ZERO  # the long axis of `on`
    along: Annotated[Vector, None] = ZERO  # the long axis of `moves`, in its own frame

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


class Drawing(NamedTuple):
    """What is drawn of a body: lines through points, limb by limb, and the points whose path is drawn."""

    limbs: tuple[tuple[str, ...], ...] = ()
    paths: tuple[str, ...] = ()


class Limb(NamedTuple):
    """An arm, a leg or another line of points from the body to a tip."""

    points: tuple[str, ...]  # from the one on the body to the tip
    segments: tuple[str, ...]  # between these points, in that order; only those that have a length
    base: str | None  # the segment of the body to which it belongs; None: the root
    # Its first point, with that of the other side where there is one, left first: distances are from their middle.
    origin: tuple[str, ...]


@dataclass(frozen=True)
class BodyTable:
    """The names and properties of what a body has: the content of its file, whose keys docs/body-tables.md explains."""

    name: Annotated[str, None]  # for messages and files
    segments: Mapping[str, Segment]  # the first one faces x of W in the start pose
    urdf: str = ""  # the file beside the table
    # A person's three revolute joints in a row are one spherical joint, and segment frames equal W in the N-pose; a
    # mechanism's joints and frames are those of the URDF.
    kind: Literal["person", "mechanism"] = "person"
    up: Annotated[str, Key(of="axes")] = "+z"  # the root link's axes that point up and forward, all joints at zero
    forward: Annotated[str, Key(of="axes")] = "+x"
    root: tuple[str, ...] = ()  # the link whose origin is that of W, or links midway between which it is
    points: Mapping[str, Point] = field(default_factory=dict)
    lengths: Mapping[str, Length] = field(default_factory=dict)
    hinges: Mapping[str, HingeJoint] = field(default_factory=dict)
    girdles: Mapping[str, Girdle] = field(default_factory=dict)  # shoulder point → how it moves on the trunk
    # Name → joint of the URDF → value [rad or m].
    poses: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    pairs: Annotated[Mapping[str, str], Key(of="names")] = field(default_factory=dict)  # left → right
    draw: Drawing = field(default_factory=Drawing)
    where: Annotated[str, None] = "segments"  # the table's file, for messages

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
        """Return the name of the joint to the segment above: as stated, or the point at which it begins, or its own."""
        ends = self.ends(segment)
        beginning = ends[0] if ends else ()
        return self.segments[segment].joint or (beginning[0] if len(beginning) == 1 else segment)

    def find_length(self, *points: str) -> str | None:
        """Return the name of the length between these points, or their middles; None: there is none."""
        return next((name for name, each in self.lengths.items() if {*each.start, *each.end} == set(points)), None)

    def find_limb(self, point: str) -> Limb | None:
        """Return the limb up to a point; None: it is on none, or its first one. A line across the body is no limb."""
        lines = (line for line in self.draw.limbs if point in line[1:] and self.counterpart(line[0]) not in line)
        if not (line := next(lines, ())):
            return None
        points = line[: line.index(point) + 1]
        between = {(*length.start, *length.end): length.segment for length in self.lengths.values()}
        own = dict.fromkeys(between[ends] for ends in pairwise(points) if ends in between)
        above = (segment for ends, segment in between.items() if points[0] in ends and segment not in own)
        origin = sorted({points[0], self.counterpart(points[0]) or points[0]}, key=lambda name: name not in self.pairs)
        return Limb(points, tuple(own), next(above, None), tuple(origin))

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
    segments, known = dict(table.segments), {*table.segments, *table.points, ROOT}
    for name, segment in table.segments.items():
        tissue = segment.soft_tissue
        tissue = tissue._replace(raised=tuple(other for other in tissue.raised if other in segments))
        if tissue.relative_to and tissue.relative_to not in segments:
            tissue = tissue._replace(relative_to="", per_tilt=ZERO, per_twist=0.0)
        segments[name] = segment._replace(soft_tissue=tissue)
    lengths = {k: v for k, v in table.lengths.items() if known.issuperset((v.segment, *v.start, *v.end))}
    hinges = {k: v for k, v in table.hinges.items() if known.issuperset((v.on, v.moves))}
    limbs = tuple(limb for limb in table.draw.limbs if known.issuperset(limb))
    return replace(
        table,
        segments=segments,
        lengths=lengths,
        hinges=hinges,
        girdles={k: v for k, v in table.girdles.items() if known.issuperset((k, v.on, v.moves))},
        draw=Drawing(limbs, tuple(point for point in table.draw.paths if point in known)),
        pairs={k: v for k, v in table.pairs.items() if (known | {*lengths, *hinges}).issuperset((k, v))},
    )


MODEL_TABLE = "model.toml"


@lru_cache(maxsize=8)
def load_table(name: str = DEFAULT_BODY) -> BodyTable:
    """Return the table of a body that comes with the package."""
    if name not in _list_bodies():
        raise BadModel(f"no body '{name}' comes with the package; {one_of(_list_bodies(), name)}")
    return read_table(asset("urdf", f"{name}.toml"))


def _list_bodies() -> list[str]:
    """Return the names of the bodies that come with the package."""
    return sorted(path.stem for path in asset("urdf", f"{DEFAULT_BODY}.toml").parent.glob("*.toml"))


def check_segments(table: BodyTable, names: Iterable[str], where: str, error: type[Exception]) -> None:
    """Raise an `error` whose text begins with `where` if a name is no segment of a body."""
    for name in names:
        if name not in table.segments:
            others = [body for body in _list_bodies() if name in load_table(body).segments]
            known = f"the body {others[-1]} has it" if others else one_of(table.segments, name)
            if others and where.endswith("sensors."):
                known += f"; to do without that sensor, write ignore = true in [sensors.{name}]"
            raise error(f"{where}{name} is no segment of {table.name}; {known}")


def read_table(path: Path) -> BodyTable:
    """Read a table from a TOML file.

    With the key ``like`` it is the table of another body, except for what the file states. It then has the segments
    that the file names, or all of the other body where it names none of them.
    """
    top = TomlTable(read_toml(path, "the table of a body", BadModel), str(path), error=BadModel)
    own = {key: top.table(key, {}).values for key in ("segments", "points", "lengths", "hinges")}
    like = load_table(top.choice("like", _list_bodies())) if "like" in top else BodyTable("", {})
    kind: Any = top.choice("kind", ("person", "mechanism"), like.kind)
    new = MECHANISM_SEGMENT if kind == "mechanism" else Segment("")
    segments = {name: like.segments.get(name, new)._replace(link=name) for name in own["segments"]}
    whole = not set(segments) & set(like.segments)  # the same body with more on it
    segments = {**like.segments, **segments} if whole else segments
    begin = {segment.link: name for name, segment in like.segments.items() if name in segments}
    # A point at which a segment begins is there with the segment.
    points = {name: at for name, at in like.points.items() if whole or (at.link in begin and not any(at.at))}
    points |= {name: Point(name) for name in own["points"]}
    file: Any = {"name": path.stem, "where": str(path), "urdf": "", "up": "+z", "forward": "+x", "root": ()}
    poses: Any = {NEUTRAL_POSE: {}}
    base = prune_table(replace(like, **file, kind=kind, segments=segments, points=points, poses=poses))
    known: dict[str, Any] = {key: {**getattr(base, key), **values} for key, values in own.items()}
    known |= {"names": dict.fromkeys(name for each in known.values() for name in each), "axes": AXES}
    table = read_record(BodyTable, top, known | {"points": {**known["points"], ROOT: None}}, base, others=("like",))
    if not table.segments:
        raise BadModel(f'{top.at("segments")} is missing; each segment\'s link is needed, as in torso = "chest_link"')
    points = dict(table.points)
    for name, point in base.points.items():
        if name not in own["points"] and point.link in begin:
            points[name] = Point(table.segments[begin[point.link]].link, point.at)
    table = replace(
        table,
        urdf=table.urdf or path.with_suffix(".urdf").name,
        segments={name: table.segments[name] for name in (*like.segments, *table.segments) if name in table.segments},
        points={name: points[name] for name in (*like.points, *points) if name in points},
        hinges={name: _normalise_hinge(f"{top.at('hinges')}.{name}", each) for name, each in table.hinges.items()},
    )
    _check_table(table, top)
    return table


def _normalise_hinge(place: str, hinge: HingeJoint) -> HingeJoint:
    size = float(np.linalg.norm(hinge.axis))
    if size < 1e-6 or hinge.range[0] >= hinge.range[1] or hinge.on == hinge.moves:
        raise BadModel(f"{place}: two segments, an axis of some length and a range from the least on are needed")
    x, y, z = (v / size for v in hinge.axis)
    return hinge._replace(axis=(x, y, z))


def _check_table(table: BodyTable, top: TomlTable) -> None:
    """Raise `BadModel` on names that the table does not know, parallel axes, and labels that are no expression."""
    names = (*table.segments, *table.points, *table.lengths, *table.hinges)
    check_names(top.at("girdles"), table.girdles, table.points, BadModel)
    check_names(top.at("pairs"), table.pairs, names, BadModel)
    for points in (*table.draw.limbs, table.draw.paths):
        check_names(top.at("draw"), points, table.points, BadModel)
    if any(len(limb) < 2 for limb in table.draw.limbs):
        raise BadModel(f'{top.at("draw.limbs")}: lists of points are wanted, as [["hip", "knee", "ankle"]]')
    read_axes(top, table.up, table.forward)
    for name, segment in table.segments.items():
        try:
            re.compile(segment.labels)
        except re.error as error:
            labels = f"{top.at('segments')}.{name}.labels = {segment.labels!r}"
            raise BadModel(f"{labels} is no regular expression: {error}") from None


def find_table(urdf: Path, links: Iterable[str]) -> BodyTable | None:
    """Return the table for a URDF with these links: one beside it, else one of the package that fits; None: none does.

    Beside it is ``model.toml`` if it names the URDF, or ``<name of the URDF>.toml`` if it is a table. A table of the
    package fits if the URDF has the links of the segments that need a sensor; of several the largest does.
    """
    links, own_table, named_alike = set(links), urdf.parent / MODEL_TABLE, urdf.with_suffix(".toml")
    if own_table.is_file() and Path((table := read_table(own_table)).urdf).name == urdf.name:
        return table
    if named_alike.is_file() and "segments" in read_toml(named_alike, "the table of a body", BadModel):
        return read_table(named_alike)
    order = sorted(map(load_table, _list_bodies()), key=lambda body: (-len(body.segments), body.name != DEFAULT_BODY))
    for table in order:
        if links.issuperset(table.segments[name].link for name in table.needed):
            segments = {name: segment for name, segment in table.segments.items() if segment.link in links}
            points = {name: point for name, point in table.points.items() if point.link in links}
            return prune_table(replace(table, segments=segments, points=points, where=f"{urdf}: by {table.name}.toml"))
    return None


def format_table(table: BodyTable, urdf: str) -> str:
    """Return the text of a table's file that names `urdf`, a URDF beside it."""
    return "\n".join(format_toml(format_record(replace(table, urdf=urdf)))) + "\n"


# Lengths of people -----------------------------------------------------------------------------------------------


def check_stature(stature: float | None) -> None:
    """Raise `BadOption` where a stature is not between 1.0 and 2.5 m."""
    if stature is not None and not 1.0 <= stature <= 2.5:
        raise BadOption(f"stature {stature:g} is not a body height in metres; between 1.0 and 2.5")


def compute_population_lengths(
    table: BodyTable, stature: float | None = None, sex: str | None = None
) -> tuple[dict[str, float], np.ndarray, str]:
    """Compute the lengths [m] that name a share of stature, their covariance (k, k) [m²], and whose they are.

    Lengths share the stature's spread where it is not given, left and right share the person's shape; numbers and
    sources stand in ``calibration/anthropometry.toml``.
    """
    check_stature(stature)
    numbers = read_toml(asset(*PRIOR), "a prior")
    height = stature if stature is not None else numbers["stature"]["mean"]
    height_std = 0.0 if stature is not None else numbers["stature"]["std"] / numbers["stature"]["mean"]
    of_sexes = [numbers[{"f": "female", "m": "male"}[s]] for s in ([sex] if sex else SEXES)]

    shares = {name: length.share for name, length in table.lengths.items() if length.share}
    for name, share in shares.items():
        if share not in numbers["shape_std"]:
            place = f"{table.where}: lengths.{name}.share"
            raise BadModel(f"{place} = '{share}' is not known; {one_of(numbers['shape_std'], share)}")
    mean = np.array([height * np.mean([each[share] for each in of_sexes]) for share in shares.values()])
    # Relative errors: one of stature common to all, one of shape common to left and right, one of each side.
    shape = np.array([numbers["shape_std"][share] for share in shares.values()])
    same = np.array([[a == b for a in shares.values()] for b in shares.values()], dtype=float)
    sided = np.array([bool(table.side(name)) for name in shares], dtype=float)
    relative = height_std**2 + same * np.outer(shape, shape) + np.diag(sided * numbers["asymmetry_std"]["all"] ** 2)
    note = f"population prior (stature {height:g} m{'' if stature else ' assumed'}, sex {sex or 'not given'})"
    return dict(zip(shares, mean.tolist(), strict=True)), np.outer(mean, mean) * relative, note


def list_breadths(table: BodyTable) -> dict[str, tuple[str, float, float]]:
    """Breadth → the length between joint centres that it gives, its ratio to the breadth, and the ratio's std."""
    of_share = {length.share: name for name, length in table.lengths.items()}
    return {
        name: (of_share[entry["share"]], entry["ratio"], entry["std"])
        for name, entry in read_toml(asset(*PRIOR), "a prior")["breadths"].items()
        if entry["share"] in of_share
    }


def convert_breadths(
    measured: Mapping[str, float], table: BodyTable, measured_std: float
) -> dict[str, tuple[float, float]]:
    """Convert measured breadths to lengths, each [m] with its standard deviation; `BadOption`: both are measured."""
    breadths, converted = list_breadths(table), {}
    for name, metres in measured.items():
        length, ratio, std = breadths.get(name, (name, 1.0, 0.0))
        if length != name and length in measured:
            raise BadOption(f"measured {name} and {length}: one follows from the other; give one of them")
        converted[length] = (ratio * metres, float(np.hypot(std * metres, ratio * measured_std)))
    return converted
