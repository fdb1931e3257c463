"""The recording of a live session: its inputs and its poses, as MCAP, which Foxglove and others open.

The profile is `PROFILE`. Messages are JSON with JSON schemas (`SCHEMAS`); their log time is that of the newest sample,
on the source's clock. The file is in chunks, so that what was written before a session was killed is readable.

- metadata ``wepose``: the settings before the first sample, as JSON: sensors, stated mounts, subject, method, and the
  sensors with measured `orientations`, each with whether it is the segment's own
- ``/sensors/NAME``: a sample: ``t`` [s], ``gyro`` [rad/s] and ``accel`` [m/s²], or ``orientation`` xyzw. The messages
  of all sensors are in the order of arrival
- ``/events``: ``{"kind": "clock", …}`` when ticks began, ``{"kind": "start", "begin": tick, "end": tick}`` the start
  pose of tracking, ``{"kind": "reset", "tick": tick}`` headings anew before that tick; and what was marked, with times
  in seconds: ``{"kind": "begin", "phase": name, "time": t}`` and ``"end"`` of a phase, ``{"kind": "discard", "phase":
  name}`` what was marked of it so far, ``{"kind": "mark", "text": …, "time": t}`` a text, ``{"kind": "assign",
  "segments": {sensor: segment}}`` segments that differ from the names in the header
- ``/pose``: a live pose: ``tick``, and ``quat_WL``, sensor → xyzw
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..diagnostics import INFO, WARNING, Diagnostic
from ..documents import TomlTable, is_number
from ..errors import BadData, MissingFile
from ..recording import ImuSensor, Intervals, Mark, OrientationSensor, Recording, Sensor, check_recording
from ..recording.arrivals import Arrivals, StreamSynchronizer, Ticks, unpack_orientations
from ..recording.clocks import Clock
from ..recording.gaps import GOOD, LONG, bridge, bridge_quat
from .device import Device, make_table
from .session_file import read_phases

EARLIER = b"WEPOSE-LIVE-1\n"  # a file of an earlier version begins so
MAGIC = b"\x89MCAP0\r\n"
PROFILE = "wepose-live"
HEADER, SENSORS, EVENTS, POSES = "wepose", "/sensors/", "/events", "/pose"  # name of the metadata, and topics
FORMAT = 3  # of the header
LONGEST_RECORD = 1 << 28  # [bytes] longer than any that we write
SAMPLE_BYTES = 57  # of a sample in the file, at least
# Ticks without a sample: with more than in eight hours at 100 Hz, times of samples are wrong.
MOST_SILENT = 3_000_000
MOST_RATE, MOST_WAIT_S = 10_000.0, 10.0
LONGEST_TEXT = 200  # letters of a phase's name, or of a marked text
_EVENTS = {
    "clock": ("rate_hz", "begin", "wait_s"),
    "start": ("begin", "end"),
    "reset": ("tick",),
    "begin": ("phase", "time"),
    "end": ("phase", "time"),
    "discard": ("phase",),
    "mark": ("text", "time"),
    "assign": ("segments",),
}
_VECTOR = {"type": "array", "items": {"type": "number"}}
SCHEMAS: dict[str, dict[str, Any]] = {
    name: {"type": "object", "properties": properties}
    for name, properties in {
        "sample": {"t": {"type": "number"}, "gyro": _VECTOR, "accel": _VECTOR},
        "orientation": {"t": {"type": "number"}, "orientation": _VECTOR},
        "pose": {"tick": {"type": "integer"}, "quat_WL": {"type": "object", "additionalProperties": _VECTOR}},
        "event": {"kind": {"type": "string"}},
    }.items()
}


class Markers:
    """Phases and texts that were marked in a live session, and the segments of its sensors.

    Attributes
    ----------
    texts : marked texts
    segments : sensor → segment, of sensors that were assigned to another segment than their name
    """

    def __init__(self) -> None:
        self.texts: list[Mark] = []
        self.segments: dict[str, str] = {}
        self._spans: dict[str, list[tuple[float, float]]] = {}
        self._open: dict[str, float] = {}

    def add(self, kind: str, event: Mapping[str, Any]) -> None:
        """Add an event; one of another kind changes nothing."""
        if kind == "begin":
            self._open.setdefault(event["phase"], event["time"])
        elif kind == "end" and event["phase"] in self._open:
            self._spans.setdefault(event["phase"], []).append((self._open.pop(event["phase"]), event["time"]))
        elif kind == "discard":
            self._spans.pop(event["phase"], None)
            self._open.pop(event["phase"], None)
        elif kind == "mark":
            self.texts.append(Mark(event["time"], event["text"]))
        elif kind == "assign":
            self.segments = dict(event["segments"])

    def phases(self, first: float, last: float) -> dict[str, Intervals]:
        """Name → intervals [s] of each phase, cut to `first` and `last` [s]; one that was not ended ends there."""
        spans = {name: list(own) for name, own in self._spans.items()}
        for name, begin in self._open.items():
            spans.setdefault(name, []).append((begin, last))
        cut = {name: tuple((max(a, first), min(b, last)) for a, b in own) for name, own in spans.items()}
        cut = {name: tuple(span for span in own if span[0] < span[1]) for name, own in cut.items()}
        return {name: own for name, own in cut.items() if own}


class LiveRecording(NamedTuple):
    """The contents of a live session's recording."""

    recording: Recording  # on its ticks, with its start pose, marked phases and texts, and resets
    header: dict[str, Any]  # as `HEAD`
    first: int  # tick of the first pose
    quat_WL: np.ndarray  # (n, k, 4) xyzw, the live poses, in the order of the header's sensors


def is_live_log(path: Path) -> bool:
    """Return whether the file is the recording of a live session.

    Raises
    ------
    BadData
        It is one of an earlier version.
    """
    if not path.is_file():  # a pipe would block
        return False
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError:
        return False
    if start.startswith(EARLIER):
        raise BadData(
            f"{path}: recorded by an earlier version, whose files are no longer read; record again, to an .mcap"
        )
    # The magic, opcode and length of the header, then the profile with its length.
    return start.startswith(MAGIC) and start[17:].startswith(len(PROFILE).to_bytes(4, "little") + PROFILE.encode())


def read_live_log(path: Path) -> LiveRecording:
    """Read a live session's recording; its ticks are computed from the arrivals, bit-identical to the live ones.

    Raises
    ------
    MissingFile, BadData
        The file is missing, is no such recording, or ends before the start pose.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; `wepose live --record FILE` writes one")
    if not is_live_log(path):
        raise BadData(f"{path}: is not the recording of a live session")
    content = _read_content(path)
    header, markers = content.header, Markers()
    synchronizer: StreamSynchronizer | None = None
    start: tuple[int, int] | None = None
    resets = []
    for kind, event in content.events:
        if kind == "clock":
            clock = event["rate_hz"], event["begin"], event["wait_s"]
            synchronizer = StreamSynchronizer(header["sensors"], *clock, header["orientations"])
        elif kind == "start":
            start = int(event["begin"]), int(event["end"])
        elif kind == "reset":
            resets.append(int(event["tick"]))
        else:
            markers.add(kind, event)
    ticks = [] if synchronizer is None else [_make_ticks(path, synchronizer, content.arrivals)]
    if synchronizer is None or synchronizer.next_tick < 2:
        raise BadData(f"{path}: broke off before the start pose was held; there is nothing to track in it")
    resets = [tick for tick in resets if tick < synchronizer.next_tick]
    if start is not None and synchronizer.next_tick <= start[1] + 1:
        raise BadData(f"{path}: broke off in the start pose; there is nothing to track in it")
    header["sensors"] = _assign_segments(path, header["sensors"], markers.segments)
    ends = synchronizer.begin, synchronizer.begin + (synchronizer.next_tick - 1) / synchronizer.rate_hz
    header["phases"] = {**header["phases"], **markers.phases(*ends)}
    if start is None and not any(end <= ends[1] for _, end in header["phases"].get("start", ())):
        raise BadData(f"{path}: broke off before the start pose was held; there is nothing to track in it")
    recording = check_recording(build_recording(header, synchronizer.rate_hz, ticks, start, path, tuple(resets)))
    recording = replace(recording, marks=tuple(markers.texts))
    if not content.is_complete:
        killed = Diagnostic("live-recording-incomplete", WARNING, path.name, facts={"variant": "killed"})
        recording = replace(recording, diagnostics=(killed,))
    first = content.first if len(content.quat_WL) else start[1] + 1 if start is not None else 0
    return LiveRecording(recording, header, first, content.quat_WL)


def _make_ticks(path: Path, synchronizer: StreamSynchronizer, arrivals: Arrivals) -> Ticks:
    """The ticks of all arrivals, without those whose time is far beyond what the file can hold."""
    end_s = synchronizer.begin + (MOST_SILENT + path.stat().st_size / SAMPLE_BYTES) / synchronizer.rate_hz
    far = arrivals.time > end_s
    if np.count_nonzero(far) > 3:  # as many are a clock that jumped
        raise BadData(f"{path}: samples at {arrivals.time[far][0]:g} s, where the file holds no as long recording")
    return synchronizer.push(Arrivals(*(column[~far] for column in arrivals)) if far.any() else arrivals)


def _assign_segments(path: Path, sensors: Sequence[str], segments: Mapping[str, str]) -> list[str]:
    """The segments of the sensors (k) after those that were assigned to another one."""
    assigned = [segments.get(name, name) for name in sensors]
    if not set(segments) <= set(sensors) or len(set(assigned)) < len(assigned):
        raise BadData(f"{path}: segments = {dict(segments)!r} of sensors {list(sensors)!r}; the file is damaged")
    return assigned


def read_live_device(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a live recording as a device, for a session that names the file and adds phases; lost samples are NaN.

    Raises
    ------
    MissingFile, BadData
        As `read_live_log`; another rate is requested, or what the recording does not hold of all sensors.
    """
    if rate_hz is not None:
        raise BadData(f"{path}: rate_hz = {rate_hz:g}: a live recording has times of its own; leave it out")
    log = read_live_log(path)
    kinds = {"orientation" if isinstance(s, OrientationSensor) else "raw" for s in log.recording.sensors.values()}
    kind = kinds.pop()
    if kinds or use not in (None, kind):
        held = "raw data of some sensors and orientations of others" if kinds else f"'{kind}' of its sensors"
        remedy = "track it as it is" if kinds else "leave it out"
        raise BadData(f"{path}: use = {use!r}: the live recording holds {held}; {remedy}")
    values = {}
    for label, sensor in log.recording.sensors.items():
        lost = np.zeros((len(log.recording), 1), dtype=bool) if sensor.gap is None else sensor.gap[:, None]
        if isinstance(sensor, OrientationSensor):
            signals = {"orientation": sensor.quat_WS}
        else:
            signals = {"gyro": sensor.gyro_S, "accel": sensor.accel_S}
        values[label] = {name: np.where(lost, np.nan, signal) for name, signal in signals.items()}
    mounts = {
        label: sensor.stated_quat_LS
        for label, sensor in log.recording.sensors.items()
        if sensor.stated_quat_LS is not None
    }
    resets = log.recording.resets
    diagnostics = list(log.recording.diagnostics)
    if resets:
        diagnostics.append(Diagnostic("heading-resets-not-repeated", INFO, path.name, len(resets)))
    return Device(
        "wepose_live",
        make_table(log.recording.time, values),
        {label: label for label in values},
        kind,
        aligned=all(sensor.aligned for sensor in log.recording.sensors.values()),
        mounts=mounts,
        diagnostics=tuple(diagnostics),
    )


class _Content(NamedTuple):
    """The messages of a file, in their order."""

    header: dict[str, Any]
    arrivals: Arrivals
    events: list[tuple[str, dict[str, Any]]]
    first: int  # tick of the first pose
    quat_WL: np.ndarray  # (n, k, 4) xyzw
    is_complete: bool  # nothing is missing at its end


def read_messages(path: Path) -> Iterator[tuple[str, bytes]]:
    """Iterate over topic and content of each message, the header first; an empty topic ends a file that is complete."""
    from mcap.records import Channel, Footer, Message, Metadata
    from mcap.stream_reader import StreamReader

    topics: dict[int, str] = {}
    with path.open("rb") as file:
        records = iter(StreamReader(file, validate_crcs=True, record_size_limit=LONGEST_RECORD).records)
        while True:
            try:
                record = next(records)
            except Exception:  # cut off or damaged: the library raises errors of many kinds
                return
            if isinstance(record, Message):
                yield topics.get(record.channel_id, HEADER), record.data
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata) and record.name == HEADER:
                yield HEADER, record.metadata.get("json", "").encode()
            elif isinstance(record, Footer):
                yield "", b""
                return


def _read_content(path: Path) -> _Content:
    header: dict[str, Any] | None = None
    events, is_complete = [], False
    samples, poses = array("d"), array("d")  # eight numbers a sample, and a tick with four numbers a sensor
    for topic, text in read_messages(path):
        if not topic:
            is_complete = True
        elif topic == HEADER:
            header = header or _header(path, text)
        elif header is None:
            raise BadData(f"{path}: begins without a header; the file is damaged")
        elif topic == EVENTS:
            events.append(_event(path, text))
        else:
            message = _json(path, text)
            try:
                if topic == POSES:
                    poses.extend(_list_pose(message, header["sensors"]))
                else:
                    samples.extend(_list_sample(message, header["sensors"].index(topic.removeprefix(SENSORS))))
            except (ValueError, TypeError, KeyError, OverflowError) as error:
                raise BadData(f"{path}: a message {text[:80]!r} of {topic}: {error!r}; the file is damaged") from None
    if header is None:
        raise BadData(f"{path}: broke off before the start pose was held; there is nothing to track in it")
    which, time, gyro, accel = np.split(np.array(samples).reshape(-1, 8), [1, 2, 5], axis=1)
    arrivals = Arrivals(which[:, 0].astype(np.uint8), time[:, 0].copy(), gyro.copy(), accel.copy())
    count = len(header["sensors"])
    rows = np.array(poses).reshape(-1, 1 + 4 * count)
    first = int(rows[0, 0]) if len(rows) else 0
    return _Content(header, arrivals, events, first, rows[:, 1:].reshape(-1, count, 4).copy(), is_complete)


def _list_sample(message: Mapping[str, Any], sensor: int) -> tuple[float, ...]:
    """The sensor's number, the time and six numbers of a sample, an orientation packed."""
    if "orientation" in message:
        x, y, z, w = message["orientation"]
        return sensor, message["t"], x, y, z, w, 0.0, 0.0
    (gx, gy, gz), (ax, ay, az) = message["gyro"], message["accel"]
    return sensor, message["t"], gx, gy, gz, ax, ay, az


def _list_pose(message: Mapping[str, Any], sensors: Sequence[str]) -> list[float]:
    """The tick, and four numbers of each sensor."""
    row = [float(int(message["tick"]))]
    for name in sensors:
        x, y, z, w = message["quat_WL"][name]
        row += x, y, z, w
    return row


def _header(path: Path, payload: bytes) -> dict[str, Any]:
    header = _json(path, payload)
    sensors = header.get("sensors")
    named = isinstance(sensors, list) and sensors and all(isinstance(name, str) for name in sensors)
    if header.get("format") != FORMAT or not named or len(set(sensors or ())) < len(sensors or ()):
        raise BadData(
            f"{path}: format {header.get('format')!r} with sensors {sensors!r}; this version reads format {FORMAT}"
        )
    texts = [header.get(key) for key in ("name", "start_pose", "method")]
    mounts, phases = header.get("mounts"), header.get("phases")
    well = isinstance(header.get("subject") or "", str) and isinstance(header.get("remounted"), bool)
    if not (well and all(isinstance(text, str) for text in texts)):
        raise BadData(f"{path}: its header lacks name, start_pose, remounted or method; the file is damaged")
    if not (isinstance(mounts, dict) and all(_is_quat(mount) for mount in mounts.values())):
        raise BadData(f"{path}: mounts = {mounts!r} in its header; a unit quaternion x, y, z, w each is needed")
    read_phases(TomlTable(phases if isinstance(phases, dict) else {"phases": phases}, str(path), "phases."))
    joints, model = header.get("joints", {}), header.get("model", "")
    if not isinstance(model, str) or not isinstance(joints, dict) or not all(map(is_number, joints.values())):
        raise BadData(f"{path}: joints = {joints!r}, model = {model!r} in its header; the file is damaged")
    orientations = header.get("orientations", {})
    if not isinstance(orientations, dict) or not set(orientations) <= set(sensors or ()):
        raise BadData(f"{path}: orientations = {orientations!r} in its header; the file is damaged")
    return {"subject": None, "joints": {}, "model": "", "orientations": {}, **header}


def _is_quat(value: Any) -> bool:
    numbers = isinstance(value, list) and len(value) == 4 and all(is_number(v, 2.0) for v in value)
    return numbers and abs(float(np.linalg.norm(value)) - 1.0) < 1e-6


def _json(path: Path, payload: bytes) -> dict[str, Any]:
    try:
        content = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise BadData(f"{path}: holds JSON that is none: {error}; the file is damaged") from error
    if not isinstance(content, dict):
        raise BadData(f"{path}: holds {str(content)[:40]!r} in place of an object; the file is damaged")
    return content


def _event(path: Path, payload: bytes) -> tuple[str, dict[str, Any]]:
    """Read kind and values of an event; an unknown kind has none."""
    event = _json(path, payload)
    kind = str(event.get("kind"))
    values = {name: event.get(name) for name in _EVENTS.get(kind, ())}
    if not _is_event(kind, values):
        raise BadData(f"{path}: an event '{kind}' with {values!r}; the file is damaged")
    return kind, values


def _is_event(kind: str, values: Mapping[str, Any]) -> bool:
    """Whether the values are such as an event of this kind has."""
    texts = [values[name] for name in ("phase", "text") if name in values]
    if not all(isinstance(text, str) and 0 < len(text) <= LONGEST_TEXT for text in texts):
        return False
    if "segments" in values:
        segments = values["segments"]
        return isinstance(segments, dict) and all(isinstance(segment, str) for segment in segments.values())
    numbers = [value for name, value in values.items() if name not in ("phase", "text")]
    if not all(is_number(value, 1e12) for value in numbers):
        return False
    if kind == "clock":
        return bool(0.1 <= values["rate_hz"] <= MOST_RATE and 0.0 <= values["wait_s"] <= MOST_WAIT_S)
    if kind in ("start", "reset"):
        ticks = [int(value) for value in numbers if value == int(value)]
        return len(ticks) == len(numbers) and ticks == sorted(set(ticks)) and min(ticks, default=0) >= 0
    return True


def _cut_spans(phase: str, spans: Sequence[Sequence[float]], time: np.ndarray) -> Intervals:
    """The intervals [s] of a phase within the times (n,) [s]; one that goes on ends there, if it need not be whole."""
    inside = [(float(a), float(b)) for a, b in spans if time[0] <= a < time[-1]]
    if phase in ("start", "static"):
        return tuple((a, b) for a, b in inside if b <= time[-1])
    return tuple((a, min(b, float(time[-1]))) for a, b in inside)


def build_recording(
    header: Mapping[str, Any],
    rate_hz: float,
    ticks: Sequence[Ticks],
    start: tuple[int, int] | None,
    source: Path | None = None,
    resets: tuple[int, ...] = (),
    last: int | None = None,
) -> Recording:
    """Build a recording from consecutive ticks, up to the tick `last`; lost samples are bridged and marked.

    Parameters
    ----------
    header : name, sensors, mounts, phases, start_pose, remounted, joints, model, as in `HEAD`
    start : first and last tick of the start pose; None: that of the header's phases
    resets : ticks before which the headings were reset

    Raises
    ------
    BadData
        A sensor never sent a sample.
    """
    ticks = [t for t in ticks if len(t.time)]
    first = ticks[0].first
    count = sum(len(t.time) for t in ticks) if last is None else last + 1 - first
    time = np.concatenate([t.time for t in ticks])[:count]
    gyro, accel = (np.concatenate([getattr(t, part) for t in ticks])[:count] for part in ("gyro_S", "accel_S"))
    clock = Clock(time, np.arange(count), 1.0 / rate_hz)
    sensors: dict[str, Sensor] = {}
    for i, name in enumerate(header["sensors"]):
        lost = ~np.isfinite(gyro[:, i]).all(axis=1)
        if lost.all():
            raise BadData(f"{source or header['name']}: sensors.{name} never sent a sample")
        marks = np.where(lost, LONG, GOOD).astype(np.int8)  # the live session bridged short gaps
        stated = header["mounts"].get(name)
        if name in header["orientations"]:
            sensors[name] = OrientationSensor(
                bridge_quat(unpack_orientations(gyro[:, i], accel[:, i]), marks, clock),
                None if stated is None else np.array(stated),
                lost if lost.any() else None,
                header["orientations"][name],
            )
            continue
        sensors[name] = ImuSensor(
            gyro_S=bridge(np.ascontiguousarray(gyro[:, i]), marks, clock, rate=True),
            accel_S=bridge(np.ascontiguousarray(accel[:, i]), marks, clock),
            stated_quat_LS=None if stated is None else np.array(stated),
            gap=lost if lost.any() else None,
        )
    phases = {name: _cut_spans(name, spans, time) for name, spans in header["phases"].items()}
    if start is not None:
        phases["start"] = ((float(time[start[0] - first]), float(time[start[1] - first])),)
    return Recording(
        header["name"],
        time,
        rate_hz,
        sensors,
        phases,
        header["start_pose"],
        header["remounted"],
        source=source,
        resets=tuple(tick - first for tick in resets),
        joints=header["joints"],
        model=header["model"],
    )
