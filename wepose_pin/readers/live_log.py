"""The recording of a live session: its inputs and its poses, as MCAP, which Foxglove and others open.

Messages are JSON with JSON schemas; their log time is that of the newest sample, on the source's clock. The
file is in chunks, so that what was written before a session was killed is readable.

docs/live.md lists the topics. Events are ``clock`` when ticks began, ``start`` (``begin``, ``end``: ticks) the start
pose of tracking, ``reset`` (``tick``) headings anew before that tick; and what was marked, in seconds: ``begin`` and
``end`` of a phase (``phase``, ``time``), ``discard`` what was marked of it so far.
"""

import json
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..diagnostics import INFO, WARNING, Diagnostic
from ..errors import BadData
from ..libraries import check_file, library_errors
from ..recording import ImuSensor, Intervals, OrientationSensor, Recording, Sensor
from ..recording.arrivals import Arrivals, StreamSynchronizer, Ticks, unpack_orientations
from ..recording.clocks import bridge
from .device import Device, DeviceSensor

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "wepose-live"
HEADER, SENSORS, EVENTS, POSES = "wepose", "/sensors/", "/events", "/pose"  # name of the metadata, and topics
FORMAT = 4  # of the header
LONGEST_RECORD = 1 << 28  # [bytes] longer than any that we write
MOST_RATE = 10_000.0
KIND = "a recording of wepose live"


class Markers:
    """Phases that were marked in a live session."""

    def __init__(self) -> None:
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

    def phases(self, first: float, last: float) -> dict[str, Intervals]:
        """Name → intervals [s] of each phase, cut to `first` and `last` [s]; one that was not ended ends there."""
        spans = {name: list(own) for name, own in self._spans.items()}
        for name, begin in self._open.items():
            spans.setdefault(name, []).append((begin, last))
        cut = {name: [(max(a, first), min(b, last)) for a, b in own] for name, own in spans.items()}
        inside = {name: tuple(span for span in own if span[0] < span[1]) for name, own in cut.items()}
        return {name: own for name, own in inside.items() if own}


class LiveRecording(NamedTuple):
    """The contents of a live session's recording."""

    recording: Recording  # on its ticks, with its start pose, marked phases, and resets
    header: dict[str, Any]  # the settings before the first sample
    first: int  # tick of the first pose
    quat_WL: np.ndarray  # (n, k, 4) xyzw, the live poses, in the order of the header's sensors


def is_live_log(path: Path) -> bool:
    """Return whether the file is the recording of a live session."""
    if not path.is_file():  # a pipe would block
        return False
    with library_errors(path, KIND), path.open("rb") as file:
        start = file.read(64)
    # The magic, opcode and length of the header, then the profile with its length.
    return start.startswith(MAGIC) and start[17:].startswith(len(PROFILE).to_bytes(4, "little") + PROFILE.encode())


def read_live_log(path: Path) -> LiveRecording:
    """Read a live session's recording; its ticks are computed from the arrivals, bit-identical to the live ones.

    `MissingFile` or `BadData` is raised where the file is missing, is no such recording, or ends before the start pose.
    """
    check_file(path, f"{KIND}, as --record writes one,")
    if not is_live_log(path):
        raise BadData(f"{path}: is not the recording of a live session")
    broke_off = BadData(f"{path}: broke off before the start pose was held; there is nothing to track in it")
    with library_errors(path, KIND):
        header, arrivals, events, poses, is_complete = _read_content(path)
        by_kind = {event["kind"]: event for event in events}  # the last of each
        if not header or "clock" not in by_kind:
            raise broke_off
        clock, start = by_kind["clock"], None
        if not 0.1 <= clock["rate_hz"] <= MOST_RATE:
            raise BadData(f"{path}: ticks at {clock['rate_hz']:g} Hz; the file is damaged")
        begin, orientations = clock["begin"], header["orientations"]
        synchronizer = StreamSynchronizer(header["sensors"], clock["rate_hz"], begin, orientations)
        ticks = [*synchronizer.push(arrivals)]
        if "start" in by_kind:
            start = int(by_kind["start"]["begin"]), int(by_kind["start"]["end"])
        if synchronizer.next_tick < (start[1] + 2 if start else 2):
            raise broke_off
        markers = Markers()
        for event in events:
            markers.add(event["kind"], event)
        ends = synchronizer.begin, synchronizer.begin + (synchronizer.next_tick - 1) / synchronizer.rate_hz
        header["phases"] = {**header["phases"], **markers.phases(*ends)}
        if start is None and not any(end <= ends[1] for _, end in header["phases"].get("start", ())):
            raise broke_off
        ticks_of_resets = (int(event["tick"]) for event in events if event["kind"] == "reset")
        resets = tuple(tick for tick in ticks_of_resets if tick < synchronizer.next_tick)
        recording = build_recording(header, synchronizer.rate_hz, ticks, start, path, resets)
    recording = recording.check()
    if not is_complete:
        recording = replace(recording, diagnostics=(Diagnostic("file-incomplete", WARNING, path.name),))
    first = int(poses[0, 0]) if len(poses) else start[1] + 1 if start is not None else 0
    return LiveRecording(recording, header, first, poses[:, 1:].reshape(len(poses), len(header["sensors"]), 4).copy())


def read_live_device(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read a live recording as `Format.read`, for a session that adds phases to it; lost samples are NaN."""
    if rate_hz is not None:
        raise BadData(f"{path}: rate_hz = {rate_hz:g}: a live recording has times of its own; leave it out")
    recording = read_live_log(path).recording
    kinds = sorted({"raw" if isinstance(each, ImuSensor) else "orientation" for each in recording.sensors.values()})
    if len(kinds) > 1 or use not in (None, *kinds):
        raise BadData(f"{path}: use = {use!r}: it holds {' and '.join(kinds)} data; track it as it is")
    fields = {"gyro": "gyro_S", "accel": "accel_S"} if kinds == ["raw"] else {"orientation": "quat_VS"}
    sensors = {}
    for name, sensor in recording.sensors.items():
        lost = False if sensor.gap is None else sensor.gap[:, None]
        signals = {signal: np.where(lost, np.nan, getattr(sensor, each)) for signal, each in fields.items()}
        sensors[name] = DeviceSensor(recording.time, signals, name, sensor.stated_quat_LS)
    diagnostics = recording.diagnostics
    if recording.resets:
        diagnostics += (Diagnostic("heading-resets-not-repeated", INFO, path.name, len(recording.resets)),)
    aligned = all(sensor.aligned for sensor in recording.sensors.values())
    return Device(kinds[0], sensors, since_power_on=False, aligned=aligned, diagnostics=diagnostics)


def _read_content(path: Path) -> tuple[dict[str, Any], Arrivals, list[dict[str, Any]], np.ndarray, bool]:
    """Read header, samples, events, a row a pose (its tick and xyzw of each sensor), and whether the end is there."""
    from mcap.records import Channel, Footer, Message, Metadata
    from mcap.stream_reader import StreamReader

    header: dict[str, Any] = {}
    events: list[dict[str, Any]] = []
    topics: dict[int, str] = {}
    record: Any = None
    samples, poses = array("d"), array("d")  # eight numbers a sample, and a tick with four numbers a sensor
    with path.open("rb") as file:
        records = iter(StreamReader(file, validate_crcs=True, record_size_limit=LONGEST_RECORD).records)
        while not isinstance(record, Footer):
            try:
                record = next(records)
            except Exception:  # cut off or damaged: the library raises errors of many kinds
                break
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata) and record.name == HEADER and not header:
                header = {"subject": None, "joints": {}, "model": "", "orientations": {}}
                header |= json.loads(record.metadata.get("json", ""))
                if header["format"] != FORMAT:
                    raise BadData(f"{path}: is of format {header['format']}; this version reads format {FORMAT}")
            elif isinstance(record, Message):
                topic, message = topics[record.channel_id], json.loads(record.data)
                if topic == EVENTS:
                    events.append(message)
                elif topic == POSES:
                    poses.append(message["tick"])
                    for name in header["sensors"]:
                        poses.extend(message["quat_WL"][name])
                elif topic.startswith(SENSORS):
                    samples.extend((header["sensors"].index(topic.removeprefix(SENSORS)), message["t"]))
                    packed = [*message["orientation"], 0.0, 0.0] if "orientation" in message else None
                    samples.extend(packed or [*message["gyro"], *message["accel"]])
    numbers = np.array(samples).reshape(-1, 8)
    arrivals = Arrivals(numbers[:, 0].astype(np.uint8), numbers[:, 1:].copy())
    rows = np.array(poses).reshape(-1, 1 + 4 * len(header.get("sensors", ())))
    return header, arrivals, events, rows, isinstance(record, Footer)


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

    `header`: as of `LiveRecording`. `start`: first and last tick of the start pose; None: that of the header's phases.
    `resets`: ticks before which the headings were reset. `BadData`: a sensor never sent a sample.
    """
    first = ticks[0].first
    count = sum(len(t.time) for t in ticks) if last is None else last + 1 - first
    time = np.concatenate([t.time for t in ticks])[:count]
    gyro, accel = (np.concatenate([getattr(t, part) for t in ticks])[:count] for part in ("gyro_S", "accel_S"))
    sensors: dict[str, Sensor] = {}
    for i, name in enumerate(header["sensors"]):
        lost = ~np.isfinite(gyro[:, i]).all(axis=1)
        if lost.all():
            raise BadData(f"{source or header['name']}: sensors.{name} never sent a sample")
        stated, gap = header["mounts"].get(name), lost if lost.any() else None  # short gaps were bridged live
        mount = None if stated is None else np.array(stated)
        if name in header["orientations"]:
            quat = bridge(unpack_orientations(gyro[:, i], accel[:, i]), lost, time)
            sensors[name] = OrientationSensor(quat, mount, gap, header["orientations"][name])
        else:
            gyro_S, accel_S = (bridge(np.ascontiguousarray(each[:, i]), lost, time) for each in (gyro, accel))
            sensors[name] = ImuSensor(gyro_S, accel_S, mount, gap)
    phases = {}
    for name, spans in header["phases"].items():
        inside = [(float(a), float(b)) for a, b in spans if time[0] <= a < time[-1]]
        whole = name in ("start", "static")  # others may end with the recording
        phases[name] = tuple((a, min(b, float(time[-1]))) for a, b in inside if not whole or b <= time[-1])
    if start is not None:
        phases["start"] = ((float(time[start[0] - first]), float(time[start[1] - first])),)
    named = {key: header[key] for key in ("name", "start_pose", "remounted", "joints", "model")}
    after = tuple(tick - first for tick in resets)
    return Recording(time=time, rate_hz=rate_hz, sensors=sensors, phases=phases, source=source, resets=after, **named)
