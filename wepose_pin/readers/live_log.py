"""The recording of a live session: everything that decided its poses, and the poses, in a file that may break off.

A file is the magic `MAGIC` and blocks: a tag of four bytes, the payload's length and its CRC-32 (both u32), payload.
All little-endian. A last block that is not whole is left out, so a session that was killed can be read up to there.

- ``HEAD``: JSON, what was known before the first sample: sensors, stated mounts, subject, method
- ``SMPL``: samples in the order of arrival: u32 m, then sensor u8 (m), time f64 (m), gyro f64 (m, 3), accel f64 (m, 3)
- ``EVNT``: JSON, ``{"kind": "clock", …}`` when ticks began, ``{"kind": "start", "begin": tick, "end": tick}`` the start
  pose, ``{"kind": "reset", "tick": tick}`` headings anew before that tick
- ``POSE``: the live poses: u64 first tick, u32 m, quat_WL f64 (m, k, 4) xyzw
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import BadData, MissingFile
from ..recording import SEGMENTS, Recording, Sensor, check
from .arrivals import Aligner, Arrivals, Ticks
from .clocks import GOOD, LONG, Clock, bridge

MAGIC = b"WEPOSE-LIVE-1\n"
SUFFIX = ".wepose"
BLOCK = struct.Struct("<4sII")
HEAD, SAMPLES, EVENT, POSES = b"HEAD", b"SMPL", b"EVNT", b"POSE"
_NUMBERS = ((1, 1), (3, 9), (3, 33))  # of a block of samples: numbers a sample, bytes a sample before them
LONGEST_BLOCK = 1 << 28  # [bytes] none that we write is so long


class LiveRecording(NamedTuple):
    """What a live session left."""

    recording: Recording  # on its ticks, with its start pose and resets
    header: dict[str, Any]  # as `HEAD`
    first: int  # tick of the first pose
    quat_WL: np.ndarray  # (n, k, 4) xyzw, the poses as they were shown, in the order of the header's sensors
    broken_off: bool  # the last block is not whole: the session was killed


def is_live_log(path: Path) -> bool:
    """Whether the file is the recording of a live session."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_live_log(path: Path) -> LiveRecording:
    """Read a live session's recording; its ticks are made anew from the arrivals, to the bit.

    Raises
    ------
    MissingFile, BadData
        Not there; no such file; it broke off before the start pose was held.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; `wepose live --record FILE` writes one")
    if not is_live_log(path):
        raise BadData(f"{path}: is not the recording of a live session")
    header: dict[str, Any] | None = None
    aligner: Aligner | None = None
    waiting: list[Arrivals] = []
    ticks: list[Ticks] = []
    start: tuple[int, int] | None = None
    resets, poses = [], []
    broken_off = True
    for tag, payload in blocks(path):
        if tag == b"":
            broken_off = False
        elif tag == HEAD:
            header = _header(path, payload)
        elif header is None:
            raise BadData(f"{path}: begins without a header; the file is damaged")
        elif tag == SAMPLES:
            came = _arrivals(path, payload, len(header["sensors"]))
            if aligner is None:
                waiting.append(came)
            else:
                ticks.append(aligner.push(came))
        elif tag == EVENT:
            event = json.loads(payload)
            if event["kind"] == "clock":
                aligner = Aligner(header["sensors"], event["rate_hz"], event["begin"], event["wait_s"])
                ticks += [aligner.push(came) for came in waiting]
            elif event["kind"] == "start":
                start = event["begin"], event["end"]
            elif event["kind"] == "reset":
                resets.append(int(event["tick"]))
        elif tag == POSES:
            first, count = struct.unpack_from("<QI", payload)
            quat = np.frombuffer(payload, "<f8", offset=12).reshape(count, len(header["sensors"]), 4)
            poses.append((first, quat))
    if header is None or aligner is None or start is None:
        raise BadData(f"{path}: broke off before the start pose was held; there is nothing to track in it")
    if aligner.next_tick <= start[1] + 1:
        raise BadData(f"{path}: broke off in the start pose; there is nothing to track in it")
    recording = check(recording_of(header, aligner.rate_hz, ticks, start, path, tuple(resets)))
    quat_WL = np.concatenate([quat for _, quat in poses]) if poses else np.empty((0, len(header["sensors"]), 4))
    return LiveRecording(recording, header, poses[0][0] if poses else start[1] + 1, quat_WL, broken_off)


def blocks(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Tag and payload of each whole block; at the end an empty one where nothing is left over."""
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        while True:
            head = file.read(BLOCK.size)
            if not head:
                yield b"", b""
                return
            if len(head) < BLOCK.size:
                return
            tag, size, crc = BLOCK.unpack(head)
            payload = file.read(size) if size <= LONGEST_BLOCK else b""
            if len(payload) < size or zlib.crc32(payload, zlib.crc32(tag)) != crc:
                return
            yield tag, payload


def _header(path: Path, payload: bytes) -> dict[str, Any]:
    header = json.loads(payload)
    sensors = header.get("sensors")
    if header.get("format") != 1 or not isinstance(sensors, list) or not sensors or not set(sensors) <= set(SEGMENTS):
        raise BadData(f"{path}: format {header.get('format')!r} with sensors {sensors!r}; this version reads format 1")
    return dict(header)


def _arrivals(path: Path, payload: bytes, sensors: int) -> Arrivals:
    (count,) = struct.unpack_from("<I", payload)
    if len(payload) != 4 + count * 57:
        raise BadData(f"{path}: a block of {count} samples has {len(payload)} bytes; the file is damaged")
    which = np.frombuffer(payload, "u1", count, 4)
    if count and which.max() >= sensors:
        raise BadData(f"{path}: samples of sensor {which.max()} of {sensors}; the file is damaged")
    time, gyro, accel = (np.frombuffer(payload, "<f8", k * count, 4 + at * count).astype(float) for k, at in _NUMBERS)
    return Arrivals(which, time, gyro.reshape(count, 3), accel.reshape(count, 3))


def recording_of(
    header: Mapping[str, Any],
    rate_hz: float,
    ticks: Sequence[Ticks],
    start: tuple[int, int],
    source: Path | None = None,
    resets: tuple[int, ...] = (),
    last: int | None = None,
) -> Recording:
    """Ticks that follow each other as a recording, up to the tick `last`; what was lost is bridged and marked.

    Parameters
    ----------
    header : name, sensors, mounts, phases, start_pose, strapping, as in `HEAD`
    start : first and last tick of the start pose
    resets : ticks before which headings were set anew

    Raises
    ------
    BadData
        A sensor that never sent a sample.
    """
    ticks = [t for t in ticks if len(t.time)]
    first = ticks[0].first
    count = sum(len(t.time) for t in ticks) if last is None else last + 1 - first
    time = np.concatenate([t.time for t in ticks])[:count]
    gyro, accel = (np.concatenate([getattr(t, part) for t in ticks])[:count] for part in ("gyro_S", "accel_S"))
    clock = Clock(time, np.arange(count), 1.0 / rate_hz)
    sensors = {}
    for i, name in enumerate(header["sensors"]):
        lost = ~np.isfinite(gyro[:, i]).all(axis=1)
        if lost.all():
            raise BadData(f"{source or header['name']}: sensors.{name} never sent a sample")
        marks = np.where(lost, LONG, GOOD).astype(np.int8)  # short holes were bridged when they were live
        stated = header["mounts"].get(name)
        sensors[name] = Sensor(
            gyro_S=bridge(np.ascontiguousarray(gyro[:, i]), marks, clock, rate=True),
            accel_S=bridge(np.ascontiguousarray(accel[:, i]), marks, clock),
            stated_quat_LS=None if stated is None else np.array(stated),
            gap=lost if lost.any() else None,
        )
    phases = {
        name: tuple((float(a), float(b)) for a, b in spans if time[0] <= a and b <= time[-1])
        for name, spans in header["phases"].items()
    }
    phases["start"] = ((float(time[start[0] - first]), float(time[start[1] - first])),)
    return Recording(
        header["name"],
        time,
        rate_hz,
        sensors,
        phases,
        header["start_pose"],
        header["strapping"],
        source,
        resets=tuple(tick - first for tick in resets),
    )
