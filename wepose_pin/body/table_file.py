"""The file of a body's table: reading, checking and writing it, and finding the one of a URDF."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..assets import asset
from ..documents import (
    TomlTable,
    format_record,
    is_number,
    read_record,
    read_toml,
    toml_key,
    toml_string,
    toml_strings,
)
from ..errors import BadModel, MissingFile, one_of
from ..recording.sensors import read_axes
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
    Stretch,
    prune_table,
)

MODEL_TABLE = "model.toml"
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


def check_segments(table: BodyTable, names: Iterable[str], where: str, error: type[Exception]) -> None:
    """Raise an `error` whose text begins with `where` if a name is no segment of a body."""
    for name in names:
        if name not in table.segments:
            others = [body for body in _list_bodies() if name in load_table(body).segments]
            known = f"the body {others[0]} has it" if others else one_of(table.segments, name)
            if others and where.endswith("sensors."):
                known += f"; to do without that sensor, write ignore = true in [sensors.{name}]"
            raise error(f"{where}{name} is no segment of {table.name}; {known}")


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
        root=top.texts("root"),
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
    for point in (*(point for limb in limbs for point in limb), *draw.texts("paths")):
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
        paths=(*table.paths, *draw.texts("paths")),
    )


def _read_segments(top: TomlTable, base: BodyTable, kind: str) -> dict[str, Segment]:
    segments = {}
    new = Segment.of_mechanism("")._replace(rigid_without_sensor=False) if kind == MECHANISM else Segment("")
    for name, entry in _read_links(top, "segments"):
        segment = read_record(
            Segment, entry, base=base.segments.get(name, new)._replace(link=name, up=None, forward=None)
        )
        if (segment.up is None) != (segment.forward is None):
            raise BadModel(f'{entry.where}: up and forward go together, as in up = "+z", forward = "+x"')
        if segment.up is not None:
            read_axes(entry)
        try:
            re.compile(segment.labels)
        except re.error as error:
            raise BadModel(f"{entry.at('labels')} = {segment.labels!r} is no regular expression: {error}") from None
        segments[name] = segment
    if base.segments and (not segments or not set(segments) & set(base.segments)):
        return {**base.segments, **segments}  # the same body with more on it
    lacking = [name for name in base.segments if name not in segments]
    for name in segments:
        close = [] if name in base.segments else get_close_matches(name, lacking, n=1, cutoff=0.85)
        if close:
            raise BadModel(f"{top.at('segments')}.{name}: did you mean '{close[0]}'? {base.name} has that")
    order = [*base.segments, *segments]
    return dict(sorted(segments.items(), key=lambda item: order.index(item[0])))


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
        points[name] = read_record(Point, entry, base=Point(name))
    order = [*base.points, *points]
    return dict(sorted(points.items(), key=lambda item: order.index(item[0])))


def _read_lengths(top: TomlTable, table: BodyTable) -> dict[str, Length]:
    entries, lengths = top.table("lengths", {}), {}
    known = {"segments": table.segments, "points": (*table.points, ROOT)}
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
            stretch = read_record(Stretch, entry, known, others=("share", "std_percent"))
            if not stretch.start or not stretch.end or stretch.start == stretch.end:
                raise BadModel(
                    f"{entry.where}: from = {list(stretch.start)}, to = {list(stretch.end)} scales nothing; two "
                    f"different points are needed"
                )
            stretches.append(stretch)
            if "share" in entry or "std_percent" in entry:
                settings = entry
        percent = settings.number("std_percent", 10.0, positive=True) or 10.0
        lengths[name] = Length(tuple(stretches), settings.text("share", None) or "", percent / 100.0)
    return lengths


def _read_hinges(top: TomlTable, table: BodyTable) -> dict[str, HingeJoint]:
    hinges = {}
    for name, entry in _read_tables(top, "hinges"):
        hinge = read_record(HingeJoint, entry, {"segments": table.segments})
        size = float(np.linalg.norm(hinge.axis))
        if size < 1e-6 or hinge.on == hinge.moves:
            raise BadModel(
                f"{entry.where}: on = {hinge.on!r}, moves = {hinge.moves!r}, axis = {list(hinge.axis)} is no hinge; "
                f"two different segments and an axis of some length are needed"
            )
        if hinge.range[0] >= hinge.range[1]:
            raise BadModel(f"{entry.at('range_deg')}: the first number must be below the second")
        x, y, z = (v / size for v in hinge.axis)
        if abs(np.dot((x, y, z), table.segments[hinge.on].along)) > 0.7:
            raise BadModel(
                f"{entry.at('axis')} = {list(hinge.axis)} lies along the segment '{hinge.on}', about which no hinge "
                f"bends; an axis across it is needed"
            )
        hinges[name] = hinge._replace(axis=(x, y, z))
    return hinges


def _read_girdles(top: TomlTable, table: BodyTable) -> dict[str, Girdle]:
    girdles = {}
    for name, entry in _read_tables(top, "girdles"):
        if name not in table.points:
            raise BadModel(f"{entry.where}: '{name}' is no point; {one_of(table.points, name)}")
        girdle = read_record(Girdle, entry, {"segments": table.segments, "lengths": table.lengths})
        if girdle.on == girdle.moves:
            raise BadModel(f"{entry.at('moves')} = '{girdle.on}' is what it is on; two different segments are needed")
        girdles[name] = girdle
    return girdles


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
        sensors[name] = read_record(SensorPlace, entry)
        if "up" in entry or "forward" in entry:
            read_axes(entry)
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
    records = {"segments": table.segments, "hinges": table.hinges, "girdles": table.girdles, "sensors": table.sensors}
    for key, entries in records.items():
        for name, record in entries.items():
            lines += ["", f"[{key}.{toml_key(name)}]", *format_record(record)]
    lines += ["", "[points]"]
    lines += [f"{toml_key(name)} = {{ {', '.join(format_record(point))} }}" for name, point in table.points.items()]
    lines += ["", "[lengths]"]
    for name, length in table.lengths.items():
        prior = [f"share = {toml_string(length.share)}"] if length.share else []
        prior.append(f"std_percent = {100.0 * length.relative_std:.6g}")
        parts = [f"{{ {', '.join(format_record(part) + prior)} }}" for part in length.stretches]
        lines.append(f"{toml_key(name)} = [{', '.join(parts)}]")
    for name, joints in table.poses.items():
        if name == NEUTRAL_POSE and not joints:
            continue  # reading adds it
        lines += ["", f"[poses.{toml_key(name)}]"]
        lines += [f"{toml_key(joint)} = {value!r}" for joint, value in joints.items()]
    lines += ["", "[pairs]"]
    lines += [f"{toml_key(left)} = {toml_string(right)}" for left, right in table.pairs.items()]
    lines += ["", "[draw]", f"limbs = [{', '.join(toml_strings(limb) for limb in table.limbs)}]"]
    lines.append(f"paths = {toml_strings(table.paths)}")
    return "\n".join(lines) + "\n"
