"""The file of a body's table: reading, checking and writing it, and finding the one of a URDF."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..assets import asset
from ..documents import TomlTable, format_record, read_record, read_toml
from ..errors import BadModel, one_of
from ..recording.sensors import AXES, read_axes
from .table import DEFAULT_BODY, KINDS, ROOT, BodyTable, HingeJoint, Point, Segment, prune_table

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
            known = f"the body {others[0]} has it" if others else one_of(table.segments, name)
            if others and where.endswith("sensors."):
                known += f"; to do without that sensor, write ignore = true in [sensors.{name}]"
            raise error(f"{where}{name} is no segment of {table.name}; {known}")


def read_table(path: Path) -> BodyTable:
    """Read a table from a TOML file.

    With the key ``like`` it is the table of another body, except for what the file states. It then has the segments
    that the file names, or all of the other body where it names none of them.
    """
    top = TomlTable(read_toml(path, "the table of a body", BadModel), str(path), error=BadModel)
    own = {key: top.table(key, {}) for key in ("segments", "points", "lengths", "hinges")}
    like = load_table(top.choice("like", _list_bodies())) if "like" in top else BodyTable("", {})
    kind: Any = top.choice("kind", KINDS, like.kind)
    new = Segment.of_mechanism("", rigid=False) if kind == KINDS[1] else Segment("")
    segments = {
        name: like.segments.get(name, new)._replace(link=name, up=None, forward=None) for name in own["segments"].values
    }
    whole = not set(segments) & set(like.segments)  # the same body with more on it
    segments = {**like.segments, **segments} if whole else segments
    begin = {segment.link: name for name, segment in like.segments.items() if name in segments}
    # A point at which a segment begins is there with the segment.
    points = {name: at for name, at in like.points.items() if whole or (at.link in begin and not any(at.at))}
    points |= {name: Point(name) for name in own["points"].values}
    base = BodyTable(path.stem, segments, kind=kind, points=points, where=str(path))
    names = ("lengths", "hinges", "girdles", "pairs", "sensors", "draw")
    base = prune_table(replace(base, **{name: getattr(like, name) for name in names}))

    known = {key: {**getattr(base, key), **table.values} for key, table in own.items()}
    known |= {
        "names": {name: None for each in known.values() for name in each},
        "points": {**known["points"], ROOT: None},
    }
    table = read_record(BodyTable, top, {**known, "axes": AXES}, base, others=("like",))
    if not table.segments:
        raise BadModel(f'{top.at("segments")} is missing; each segment\'s link is needed, as in torso = "chest_link"')
    points = dict(table.points)
    for name, point in base.points.items():
        if name not in own["points"].values and point.link in begin:
            points[name] = Point(table.segments[begin[point.link]].link, point.at)
    table = replace(
        table,
        urdf=table.urdf or path.with_suffix(".urdf").name,
        segments={name: table.segments[name] for name in (*like.segments, *table.segments) if name in table.segments},
        points={name: points[name] for name in (*like.points, *points) if name in points},
        hinges={name: _check_hinge(f"{top.at('hinges')}.{name}", hinge) for name, hinge in table.hinges.items()},
    )
    _check_table(table, top)
    return table


def _check_hinge(place: str, hinge: HingeJoint) -> HingeJoint:
    """Return the hinge with an axis of unit length."""
    size = float(np.linalg.norm(hinge.axis))
    if size < 1e-6 or hinge.range[0] >= hinge.range[1] or hinge.on == hinge.moves:
        raise BadModel(f"{place}: two segments, an axis of some length and a range from the least on are needed")
    x, y, z = (v / size for v in hinge.axis)
    return hinge._replace(axis=(x, y, z))


def _check_table(table: BodyTable, top: TomlTable) -> None:
    """Raise `BadModel` on names that the table does not know, parallel axes, and labels that are no expression."""
    names = (*table.segments, *table.points, *table.lengths, *table.hinges)
    drawn = [*(point for limb in table.draw.limbs for point in limb), *table.draw.paths]
    for key, used, known in (
        ("girdles", table.girdles, table.points),
        ("sensors", table.sensors, table.segments),
        ("pairs", table.pairs, names),
        ("draw", drawn, table.points),
    ):
        for name in used:
            if name not in known:
                raise BadModel(f"{top.at(key)}: '{name}' is not known; {one_of(known, name)}")
    if any(len(limb) < 2 for limb in table.draw.limbs):
        raise BadModel(f'{top.at("draw.limbs")}: lists of points are wanted, as [["hip", "knee", "ankle"]]')
    read_axes(top, table.up, table.forward)
    for name, segment in table.segments.items():
        place = f"segments.{name}."
        if segment.up is not None or segment.forward is not None:
            read_axes(replace(top, values={"up": segment.up, "forward": segment.forward}, place=place))
        try:
            re.compile(segment.labels)
        except re.error as error:
            labels = f"{top.at(place)}labels = {segment.labels!r}"
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
    return "\n".join(format_record(replace(table, urdf=urdf))) + "\n"
