"""Sources of live samples: one file a kind, one protocol (`base.Source`); pyproject.toml registers the kinds."""

from __future__ import annotations

from collections.abc import Sequence

from ...body import load_table
from ...errors import BadOption, one_of
from ...libraries import find_plugins, load_plugin
from .base import Source, SourceKind, SourceOptions


def open_source(
    spec: str,
    *,
    sensors: Sequence[str] | None = None,
    speed: float | str = 1.0,
    segments: Sequence[str] | None = None,
    any_name: bool = False,
) -> Source:
    """The source that `spec` describes, as the form of its kind says (docs/live-sources.md), not yet opened.

    `segments` are names that sensors of a stream may have, None: the upper body's; the other parameters are those of
    `SourceOptions`. Raises `BadOption` where there is no such kind of source, or what it names, and the `WeposeError`
    of a recording that is replayed.
    """
    name, colon, rest = spec.partition(":")
    names = find_plugins("sources")
    kind: SourceKind | None = load_plugin("sources", name) if name in names and colon else None
    if kind is None or not (rest or name == "slimevr"):
        forms = [load_plugin("sources", each).form for each in names]
        raise BadOption(f"source '{spec}' is none; {one_of(forms, name)}")
    known = tuple(load_table().segments if segments is None else segments)
    options = SourceOptions(spec, None if sensors is None else tuple(sensors), known, any_name, speed)
    if name != "replay":
        for sensor in options.sensors or ():
            options.check_segment(sensor)
    return kind.open_spec(rest, options)
