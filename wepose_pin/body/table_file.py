"""The file of a body's table: reading, checking and writing it, and finding the one of a URDF."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..assets import asset
from ..documents import TomlTable, format_record, read_record, read_toml, toml_key, toml_string, toml_strings
from ..errors import BadModel, one_of
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
    prune_table,
)

MODEL_TABLE = "model.toml"
_TABLES = ("segments", "points", "lengths", "hinges", "girdles", "poses", "pairs", "sensors", "draw")


@lru_cache(maxsize=8)
def load_table(name: str = DEFAULT_BODY) -> BodyTable:
    """Return the table of a body that comes with the package."""
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


def read_table(path: Path) -> tuple[BodyTable, Path]:
    """Read a table from a TOML file; return it and its URDF: the one that it names, else that of its name."""
    values = read_toml(path, "the table of a body", BadModel)
    urdf = TomlTable(values, str(path), error=BadModel).text("urdf", path.with_suffix(".urdf").name) or ""
    return _parse_table(values, str(path), path.stem), path.parent / urdf


def _parse_table(values: Mapping[str, Any], where: str, name: str) -> BodyTable:
    """Return the table of the parsed TOML file.

    With the key ``like`` the table is that of another body, except for what `values` state. It then has the segments
    that `values` name, or all where they name none of them.
    """
    top = TomlTable(values, where, error=BadModel)
    top.allow("like", "urdf", "kind", "up", "forward", "root", *_TABLES)
    base = load_table(top.choice("like", _list_bodies())) if "like" in top else BodyTable(name, {})
    kind: Any = top.choice("kind", (PERSON, MECHANISM), base.kind)
    up, forward = read_axes(top, "+z", "+x")
    segments = _read_segments(top, base, kind)
    poses = {
        name: {joint: entry.number(joint, None) or 0.0 for joint in entry.values}
        for name, entry in _read_tables(top, "poses")
    }
    table = replace(
        base,
        name=name,
        segments=segments,
        points=_read_points(top, base, segments),
        poses={NEUTRAL_POSE: {}, **poses},
        kind=kind,
        up=up,
        forward=forward,
        root=top.texts("root"),
        where=where,
    )
    if "like" in top:
        table = prune_table(table)
    known = {"segments": table.segments, "points": (*table.points, ROOT)}
    lengths = {name: read_record(Length, entry, known) for name, entry in _read_tables(top, "lengths")}
    lengths = {**table.lengths, **lengths}
    known |= {"lengths": tuple(lengths)}
    hinges = {**table.hinges}
    for joint, entry in _read_tables(top, "hinges"):
        hinge = read_record(HingeJoint, entry, known)
        size = float(np.linalg.norm(hinge.axis))
        if size < 1e-6 or hinge.range[0] >= hinge.range[1] or hinge.on == hinge.moves:
            raise BadModel(
                f"{entry.where}: two segments, an axis of some length and a range from the least on are needed"
            )
        x, y, z = (v / size for v in hinge.axis)
        hinges[joint] = hinge._replace(axis=(x, y, z))
    girdles = {name: read_record(Girdle, entry, known) for name, entry in _read_tables(top, "girdles")}
    _check_names(top.at("girdles"), girdles, table.points)
    pairs, draw = top.table("pairs", {}), top.table("draw", {})
    names = (*table.segments, *table.points, *lengths, *hinges)
    _check_names(pairs.where, [*pairs.values, *pairs.values.values()], names)
    draw.allow("limbs", "paths")
    limbs, paths = draw.values.get("limbs", []), draw.texts("paths")
    if not isinstance(limbs, list) or not all(isinstance(limb, list) and limb for limb in limbs):
        raise BadModel(f'{draw.at("limbs")} = {limbs!r}; lists of points are wanted, as [["hip", "knee", "ankle"]]')
    _check_names(draw.where, [*(point for limb in limbs for point in limb), *paths], table.points)
    places = {name: entry.text("place", None) or "" for name, entry in _read_tables(top, "sensors")}
    _check_names(top.at("sensors"), places, table.segments)
    return replace(
        table,
        lengths=lengths,
        hinges=hinges,
        girdles={**table.girdles, **girdles},
        pairs={**table.pairs, **pairs.values},
        sensors={**table.sensors, **places},
        limbs=(*table.limbs, *(tuple(limb) for limb in limbs)),
        paths=(*table.paths, *paths),
    )


def _check_names(where: str, names: Iterable[Any], known: Iterable[str]) -> None:
    """Raise `BadModel` where one of the names is not known."""
    for name in names:
        if name not in known:
            raise BadModel(f"{where}: '{name}' is not known; {one_of(known, str(name))}")


def _read_segments(top: TomlTable, base: BodyTable, kind: str) -> dict[str, Segment]:
    segments = {}
    new = Segment.of_mechanism("")._replace(rigid_without_sensor=False) if kind == MECHANISM else Segment("")
    for name, entry in _read_tables(top, "segments", "link"):
        defaults = base.segments.get(name, new)._replace(link=name, up=None, forward=None)
        segments[name] = segment = read_record(Segment, entry, base=defaults)
        if segment.up is not None or segment.forward is not None:
            read_axes(entry)
        try:
            re.compile(segment.labels)
        except re.error as error:
            raise BadModel(f"{entry.at('labels')} = {segment.labels!r} is no regular expression: {error}") from None
    if not set(segments) & set(base.segments):
        segments = {**base.segments, **segments}  # the same body with more on it
    if not segments:
        raise BadModel(f'{top.at("segments")} is missing; each segment\'s link is needed, as in torso = "chest_link"')
    return {name: segments[name] for name in (*base.segments, *segments) if name in segments}


def _read_points(top: TomlTable, base: BodyTable, segments: Mapping[str, Segment]) -> dict[str, Point]:
    points: dict[str, Point] = {}
    by_link = {segment.link: name for name, segment in base.segments.items()}
    for name, point in base.points.items():
        begins = by_link.get(point.link)
        if begins is not None and begins in segments and not any(point.at):
            points[name] = Point(segments[begins].link)  # it is there with the segment
        elif all(segments.get(each) == own for each, own in base.segments.items()):
            points[name] = point
    for name, entry in _read_tables(top, "points", "link"):
        points[name] = read_record(Point, entry, base=Point(name))
    return {name: points[name] for name in (*base.points, *points) if name in points}


def _read_tables(top: TomlTable, key: str, short: str = "") -> list[tuple[str, TomlTable]]:
    """Return name and table of each entry of a key; a text in place of the table is the value of its key `short`."""
    entries = top.table(key, {})
    values = {
        name: {short: value} if short and isinstance(value, str) else value for name, value in entries.values.items()
    }
    entries = replace(entries, values=values)
    return [(name, entries.table(name)) for name in values]


def find_table(urdf: Path, links: Iterable[str]) -> BodyTable | None:
    """Return the table for a URDF with these links: one beside it, else one of the package that fits; None: none does.

    Beside it is ``model.toml`` if it names the URDF, or ``<name of the URDF>.toml`` if it is a table. A table of the
    package fits if the URDF has the links of the segments that need a sensor; of several the largest does.
    """
    links, own_table, beside = set(links), urdf.parent / MODEL_TABLE, urdf.with_suffix(".toml")
    if own_table.is_file():
        table, named = read_table(own_table)
        if named.name == urdf.name:
            return table
    if beside.is_file() and "segments" in read_toml(beside, "the table of a body", BadModel):
        return read_table(beside)[0]
    order = sorted(map(load_table, _list_bodies()), key=lambda body: (-len(body.segments), body.name != DEFAULT_BODY))
    for table in order:
        if links.issuperset(table.segments[name].link for name in table.needed):
            lacking = [name for name, segment in table.segments.items() if segment.link not in links]
            points = {name: point for name, point in table.points.items() if point.link in links}
            where = f"{urdf}: by {table.name}.toml"
            return prune_table(replace(table.drop(lacking), points=points, where=where))
    return None


def format_table(table: BodyTable, urdf: str) -> str:
    """Return the text of a table's file that names `urdf`, a URDF beside it."""
    tops = {"urdf": urdf, "kind": table.kind, "up": table.up, "forward": table.forward}
    lines = [f"{key} = {toml_string(value)}" for key, value in tops.items()]
    if table.root:
        lines.append(f"root = {toml_strings(table.root)}")
    records = {"segments": table.segments, "hinges": table.hinges, "girdles": table.girdles}
    for key, entries in records.items():
        for name, record in entries.items():
            lines += ["", f"[{key}.{toml_key(name)}]", *format_record(record)]
    for name, place in table.sensors.items():
        lines += ["", f"[sensors.{toml_key(name)}]", f"place = {toml_string(place)}"]
    lines += ["", "[points]"]
    lines += [f"{toml_key(name)} = {{ {', '.join(format_record(point))} }}" for name, point in table.points.items()]
    lines += ["", "[lengths]"]
    lines += [f"{toml_key(name)} = {{ {', '.join(format_record(length))} }}" for name, length in table.lengths.items()]
    for name, joints in table.poses.items():
        if name != NEUTRAL_POSE or joints:  # reading adds the neutral one
            lines += ["", f"[poses.{toml_key(name)}]"]
            lines += [f"{toml_key(joint)} = {value!r}" for joint, value in joints.items()]
    lines += ["", "[pairs]"]
    lines += [f"{toml_key(left)} = {toml_string(right)}" for left, right in table.pairs.items()]
    lines += ["", "[draw]", f"limbs = [{', '.join(toml_strings(limb) for limb in table.limbs)}]"]
    lines.append(f"paths = {toml_strings(table.paths)}")
    return "\n".join(lines) + "\n"
