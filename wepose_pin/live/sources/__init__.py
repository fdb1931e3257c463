"""Sources of live samples: one file a kind, one protocol (`base.Source`); pyproject.toml registers the kinds."""

from __future__ import annotations

from collections.abc import Sequence

from ...assets import find_plugins, load_plugin
from ...body import load_table
from ...errors import BadOption, one_of
from .base import Source, SourceOptions

REMOVED = {  # kind → what to do instead
    "mvn": "export the trial of MVN as .mvnx, which `wepose track` reads",
    "ximu3": "send its samples to udp:PORT, or read the CSV of the x-IMU3 GUI",
}


def open_source(
    spec: str,
    *,
    sensors: Sequence[str] | None = None,
    speed: float | str = 1.0,
    baud: int = 115200,
    wait_s: float = 10.0,
    segments: Sequence[str] | None = None,
    any_name: bool = False,
) -> Source:
    """The source that `spec` describes, not yet opened.

    Parameters
    ----------
    spec : as the form of a kind says, such as ``replay:PATH`` (a session.toml or its folder) or ``udp:PORT``;
        docs/live-sources.md says what each takes
    sensors : to take; None: all that the source has. A UDP or LSL source waits for its sensors in `open`
    segments : names that sensors of a stream may have, those of the body; None: the upper body's. A replay has its own
    speed, baud, wait_s, any_name : as in `SourceOptions`

    Raises
    ------
    BadOption
        No such kind of source, or it names what does not exist; WeposeErrors of the recording that is replayed.
    """
    kind, colon, rest = spec.partition(":")
    if kind in REMOVED:
        raise BadOption(f"source '{spec}' is none any more: {REMOVED[kind]}")
    kinds = find_plugins("sources")
    if kind not in kinds or not colon or not (rest or kind == "slimevr"):
        forms = [load_plugin("sources", name).form for name in kinds]
        raise BadOption(f"source '{spec}' is none; {one_of(forms, kind)}")
    names = tuple(load_table().segments if segments is None else segments)
    chosen = None if sensors is None else tuple(sensors)
    options = SourceOptions(spec, chosen, names, any_name, speed, baud, wait_s)
    if kind != "replay":
        for name in chosen or ():
            options.check_segment(name)
    source: Source = load_plugin("sources", kind).open_spec(rest, options)
    return source
