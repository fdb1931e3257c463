"""The file of a body's table: reading, checking and writing it, and finding the one of a URDF."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..assets import asset
from ..documents import TomlTable, is_number, read_toml, toml_key, toml_string, toml_strings
from ..errors import BadModel, MissingFile, one_of
from ..recording.sensors import AXES, read_axes
from .girdle import Girdle
from .table import (
    DEFAULT_BODY,
    MECHANISM,
    NEUTRAL_POSE,
    PERSON,
    ROOT,
    BodyTable,
    HingeJoint,
    Length,
    Point,
    Segment,
    SensorPlace,
    SoftTissue,
    Stretch,
    prune_table,
)

MODEL_TABLE = "model.toml"
MOST_METRES = 10.0  # that a point may be off its link's origin
_KEYS = ("segments", "points", "lengths", "hinges", "girdles", "poses", "pairs", "sensors", "draw")
_SETTINGS = ("kind", "up", "forward", "root")


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


def list_bodies_with(segment: str) -> list[str]:
    """Return the names of the bodies of the package that have a segment of this name."""
    return [body for body in _list_bodies() if segment in load_table(body).segments]


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
        table = prune_table(replace(table, poses={}))
        _check_ends(table, base)
    lengths = {**table.lengths, **_read_lengths(top, table)}
    table = replace(table, lengths=lengths)
    hinges = {**table.hinges, **_read_hinges(top, table)}
    girdles = {**table.girdles, **_read_girdles(top, table)}
    table = replace(table, hinges=hinges, girdles=girdles, poses=_read_poses(top))
    names = [*table.segments, *table.points, *table.lengths, *table.hinges]
    pairs = top.table("pairs", {})
    for left, right in pairs.values.items():
        if left == right:
            raise BadModel(f"{pairs.at(left)}: '{right}' is its own counterpart; the name on the other side is needed")
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
    for limb in limbs:
        if len(set(limb)) < 2:
            raise BadModel(f"{draw.at('limbs')}: {limb} is no line; two different points or more are needed")
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
        soft, start, repeat = (
            _read_angles(entry, key, value)
            for key, value in (
                ("soft_tissue_deg", segment.soft_tissue_std),
                ("start_std_deg", segment.start_std),
                ("repeat_std_deg", segment.repeat_std),
            )
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
        if not (isinstance(at, list | tuple) and len(at) == 3 and all(is_number(v, MOST_METRES) for v in at)):
            raise BadModel(
                f"{entry.at('at')} = {at!r}; three numbers [m] in the link are wanted, of {MOST_METRES:g} m at most"
            )
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
        return prune_table(replace(default.drop(lacking), points=there, where=str(urdf)))
    return fitting[0] if fitting else None


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
        lines.append(f"soft_tissue_deg = {np.degrees(segment.soft_tissue_std).round(6).tolist()}")
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
