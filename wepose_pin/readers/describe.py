"""What a file is, for `wepose info`. For data a session is proposed, and read: what is said of it was seen in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..body import BodyTable, load_table
from ..data_tables import FORMATS as TABLES
from ..data_tables import read_names
from ..diagnostics import Diagnostic
from ..documents import is_number, read_toml
from ..errors import BadData, MissingFile
from ..recording import ImuSensor, Recording, format_span, format_time
from ..recording.gaps import find_runs
from ..recording.sensors import compute_rate
from .arrays import ArrayFile, is_array_file
from .propose import Proposal, find_static_intervals, format_session, propose_from_device, propose_from_names
from .reference import read_reference
from .registry import detect_format
from .session import read_session


class Description(NamedTuple):
    """The description of a file for `wepose info`."""

    what: str  # one line
    facts: tuple[str, ...] = ()  # one line each
    sensors: tuple[tuple[str, ...], ...] = ()  # segment, its name in the file, signals, rate, time, gaps
    session: str | None = None  # the proposed session file, for data
    then: str = ""  # advice on that session
    diagnostics: tuple[Diagnostic, ...] = ()


def find_file(path: Path, body: BodyTable | None = None) -> Path:
    """Find what is described of a path: the session or subject in a folder, or the first recording in it.

    A file, a result, and a folder that is one recording are returned as they are.

    Raises
    ------
    MissingFile
        The folder holds nothing that is known.
    """
    if not path.is_dir() or (path / "pose.parquet").is_file():
        return path
    named = next((path / name for name in ("session.toml", "subject.toml") if (path / name).is_file()), None)
    if named is not None or detect_format(path) is not None:
        return named or path
    files = [file for file in sorted(path.iterdir()) if file.is_file()]
    data = [file for file in files if file.suffix.lower() in TABLES or is_array_file(file) or detect_format(file)]
    if not data:
        raise MissingFile(f"{path}: a folder without session.toml, and without a recording in it; name a file")
    body = body or load_table()
    return next((file for file in data if body.guess_segment(file.stem)), data[0])


def describe_file(
    path: Path, folder: Path | None = None, body: BodyTable | None = None, model: Path | None = None
) -> Description:
    """Describe a file or folder, as `find_file` returns it.

    Parameters
    ----------
    folder : for which a session is proposed; None: that of the file
    body : that carries the sensors; None: the upper body
    model : its file, or its name in the package, as the session is to name it

    Raises
    ------
    WeposeError
        The file is missing, damaged, or of an unknown kind.
    """
    if not path.exists():
        raise MissingFile(f"{path}: no such file or folder")
    suffix = path.suffix.lower()
    if path.is_dir() and (path / "pose.parquet").is_file():
        return Description(f"{path}: a result of `wepose track`", (f"look at it: wepose view {path}",))
    if suffix == ".toml":
        return _describe_toml(path)
    if suffix in (".c3d", ".trc"):
        return _describe_reference(path)
    folder, body = folder or path.absolute().parent, body or load_table()
    if format := detect_format(path):
        return _describe_data(propose_from_device(path, folder, format, body), model)
    if is_array_file(path):
        return _describe_data(propose_from_names(path, folder, body, ArrayFile(path)), model)
    names = read_names(path)[0] if suffix in TABLES else []
    if len(names) <= (suffix == ".txt"):  # a text that is no table has one column
        raise BadData(f"{path}: is nothing that is known here; docs/formats.md lists the files that are read")
    if any(f"{point}_x" in names for point in body.points):
        return Description(f"{path}: a pose, as `wepose track` writes it: {len(names)} columns")
    return _describe_data(propose_from_names(path, folder, body, None), model)


def _describe_data(proposal: Proposal, model: Path | None) -> Description:
    """Describe data by what a proposed session reads, with this session."""
    recording = proposal.read() if proposal.sensors else None
    about = Description(f"{proposal.path}: {proposal.title}", tuple(proposal.facts))
    if not proposal.sensors:
        return about
    about = about._replace(session=format_session(proposal, model, recording), then="mend what cannot be read")
    if recording is None:
        return about
    # A sensor on an unknown segment has its name in the file.
    read = (replace(each, place=each.place.removeprefix("?")) for each in recording.diagnostics)
    then = (
        "add the seconds of clasp to [phases] and wepose calibrate SESSION -o subject; "
        "or state the mounts and wepose track SESSION -o result"
    )
    if all(sensor.aligned or sensor.stated_quat_LS is not None for sensor in recording.sensors.values()):
        then = "wepose track SESSION -o result"
    if not set(recording.sensors) <= set(proposal.body.segments):
        then = f"take the # off the lines of each sensor with ? and write its segment in place of SEGMENT; then {then}"
    return about._replace(
        facts=(*about.facts, *_list_facts(recording)),
        sensors=_list_sensors(recording, proposal.sensors),
        then=then,
        diagnostics=tuple(read),
    )


def _describe_reference(path: Path) -> Description:
    reference = read_reference(path)
    rate_hz = (len(reference.time) - 1) / float(reference.time[-1] - reference.time[0])
    facts = [f"{len(reference.time)} samples at {rate_hz:.6g} Hz, {format_span(reference.time[[0, -1]])}"]
    for name, known in (("joints", reference.points), ("segments", reference.quat_VT)):
        facts.append(f"{name}: {', '.join(known) or 'none'}")
    facts.append(f"compare a result with it: wepose evaluate RESULT {path}")
    what = "rotations" if reference.own_frames else "markers"
    return Description(f"{path}: {what}, a reference for `wepose evaluate`", tuple(facts))


def _describe_toml(path: Path) -> Description:
    values = read_toml(path, "a session or a subject")
    if "data" in values or "sensors" in values:
        recording = read_session(path, gaps=True)
        facts, rows = _list_facts(recording), _list_sensors(recording, {})
        return Description(f"{path}: a session, '{recording.name}'", facts, rows, diagnostics=recording.diagnostics)
    if isinstance(values.get("lengths"), dict):
        lengths = {name: length for name, length in values["lengths"].items() if is_number(length)}
        facts = ("lengths [mm]: " + ", ".join(f"{name} {1e3 * length:.0f}" for name, length in lengths.items()),)
        mounts = ", ".join(values.get("mounts") or ())
        facts += (f"mounts: {mounts}" if mounts else "no calibrated mounts",)
        return Description(f"{path}: a subject, '{values.get('name', '')}'", facts)
    raise BadData(f"{path}: TOML, but neither a session ([data], [sensors.…]) nor a subject ([lengths])")


def _list_facts(recording: Recording) -> tuple[str, ...]:
    facts = [f"{len(recording)} samples at {recording.rate_hz:g} Hz, {format_span(recording.time[[0, -1]])}"]
    static = find_static_intervals(recording)
    listed = ", ".join(f"{a:.1f} to {b:.1f}" for a, b in static[:8]) + (" …" if len(static) > 8 else "")
    facts.append(f"all sensors static [s]: {listed}" if static else "all sensors are never static for a second")
    for name, spans in recording.phases.items():
        listed = ", ".join(f"{format_time(a)} to {format_time(b)}" for a, b in spans)
        facts.append(f"phase {name} [s]: {listed or 'none'}")
    return tuple(facts)


def _list_sensors(recording: Recording, keys: Mapping[str, Mapping[str, Any]]) -> tuple[tuple[str, ...], ...]:
    rows = []
    for segment, sensor in recording.sensors.items():
        fastest = np.degrees(np.linalg.norm(compute_rate(sensor, recording.rate_hz), axis=1).max())
        holds, gravity = "segment's orientation" if sensor.aligned else "orientation", ""
        if isinstance(sensor, ImuSensor):
            holds, gravity = "gyro, accel", f"{np.median(np.linalg.norm(sensor.accel_S, axis=1)):.2f} m/s²"
        lost = [b - a for a, b in find_runs(sensor.gap)] if sensor.gap is not None else []
        gaps = f"{len(lost)}, up to {max(lost) / recording.rate_hz:.2f} s" if lost else "none"
        unknown, own = segment.startswith("?"), keys.get(segment, {})
        label = own.get("label") or own.get("file") or (segment[1:] if unknown else "")
        rows.append(("?" if unknown else segment, label, holds, f"{fastest:.0f} deg/s", gravity, gaps))
    return tuple(rows)
