"""SlimeVR trackers over Wi-Fi, for which this is the server they look for.

A tracker broadcasts a handshake until a server answers, then sends its orientation, to a world with z up whose heading
is its own, and the places of its sensors on the body. It wants a heartbeat at least every three seconds, and
sends no rates. Big-endian; a packet is its type (u32), a rising number (u64; 0 is always taken) and data. Source:
SlimeVR-Tracker-ESP, protocol version 22.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...recording.arrivals import Samples, pack_orientations
from ..addresses import parse_listening_address
from .base import SourceKind, SourceOptions
from .datagrams import DatagramSource

PORT = 6969
HEARTBEAT_S = 0.5  # [s] from one to the next
SILENT_S = 60.0  # [s] without a packet after which a tracker is forgotten
MAX_TRACKERS = 64
UNIT_ERROR = 0.05  # of a quaternion's length
LONGEST_STEP_S = 0.02  # [s] between orientations that came together
HEADER = struct.Struct(">IQ")
HANDSHAKE_ANSWER = (b"\x03Hey OVR =D 5").ljust(64, b"\0")
HEARTBEAT = HEADER.pack(1, 0)
HANDSHAKE, PING, BATTERY, SENSOR_INFO, ROTATION = 3, 10, 12, 15, 17
FLOATS, BUNDLED = struct.Struct(">4f"), struct.Struct(">4h")  # layouts of a rotation
ROTATIONS = {  # kind → place of the sensor's number, of the rotation, and its layout; without a place the number
    1: (None, 0, FLOATS, 0),
    16: (None, 0, FLOATS, 1),
    ROTATION: (0, 2, FLOATS, 0),
    23: (0, 1, BUNDLED, 0),
}
NORMAL = 1  # kind of a rotation; 2 is a correction
# Packets that hold nothing for us: heartbeat, acceleration, tap, error, signal and others.
UNUSED = frozenset({0, 2, 4, 11, 13, 14, 18, 19, 20, 21, 22, 26})
# Place on the body → segment.
SEGMENT_OF = {
    1: "head",
    3: "torso",
    4: "torso",
    5: "pelvis",
    6: "pelvis",
    13: "left_forearm",
    14: "right_forearm",
    15: "left_upper_arm",
    16: "right_upper_arm",
    17: "left_hand",
    18: "right_hand",
}
_MAC_AT = 12 + 7 * 4  # of a handshake, after seven numbers; then comes the firmware's name


@dataclass
class Tracker:
    """A tracker and the sensors on it."""

    mac: str  # six bytes as text, or empty where the tracker has not told it
    newest_time: float  # [s] at which it last sent
    number: int = 0  # of its newest packet
    places: dict[int, str] = field(default_factory=dict)  # sensor → segment by its place on the body
    battery: float = math.nan  # share, 0 to 1; NaN: not known


def open_spec(rest: str, options: SourceOptions) -> SlimeVrSource:
    """The source of ``slimevr:[HOST][:PORT][,TRACKER=SEGMENT…]``."""
    address, _, pairs = rest.partition(",")
    host, port = parse_listening_address(address, f"source '{options.spec}':", PORT)
    devices = options.read_pairs(pairs, "4c:11:ae:00:00:01/0") if pairs else {}
    assigned = {tracker.lower(): segment for segment, tracker in devices.items()}
    segments = None if options.any_name else options.segments
    return SlimeVrSource(host, port, options.sensors or list(devices), segments, assigned=assigned)


class SlimeVrSource(DatagramSource):
    """Orientations of SlimeVR trackers; other parameters and errors as `DatagramSource`.

    Where sensors may have any name, a tracker that states no place is ``MAC/SENSOR``.

    Parameters
    ----------
    assigned : tracker, as ``MAC`` or ``MAC/SENSOR``, → segment; goes before the place that the tracker states

    Attributes
    ----------
    trackers : address → tracker
    """

    kind, sender = "slimevr", "SlimeVR trackers"
    measures_orientations = True

    def __init__(self, *options: Any, assigned: Mapping[str, str] | None = None) -> None:
        super().__init__(*options)
        self.trackers: dict[Any, Tracker] = {}
        self._assigned, self._heartbeat = dict(assigned or {}), -math.inf
        self._last_times: dict[str, float] = {}

    @property
    def orientations(self) -> dict[str, bool]:
        return dict.fromkeys(self.sensors, False)

    @property
    def batteries(self) -> dict[str, float]:
        """Segment → battery of its tracker, 0 to 1, where it is known."""
        batteries = {}
        for tracker in self.trackers.values():
            for sensor in tracker.places or {0: ""}:
                segment = self._find_segment(tracker, sensor)
                if segment is not None and math.isfinite(tracker.battery):
                    batteries[segment] = tracker.battery
        return batteries

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:
        known = ", ".join(tracker.mac or address[0] for address, tracker in self.trackers.items())
        text = super().describe_awaited(sensors)
        return f"{text}; connected: {known}" if known else text

    def _serve(self, now: float) -> None:
        if now - self._heartbeat < HEARTBEAT_S:
            return
        self._heartbeat = now
        self.trackers = {at: tracker for at, tracker in self.trackers.items() if now - tracker.newest_time < SILENT_S}
        for address in self.trackers:
            self._send(HEARTBEAT, address)

    def _take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        by_segment: dict[str, list[np.ndarray]] = {}
        for datagram, sender in datagrams:
            decoded = self._decode(datagram, sender, now)
            if decoded is None:
                continue
            segment, quat = decoded
            size = float(np.linalg.norm(quat))
            if not self._tracks(segment):
                self.count(f"orientations of {segment}, which is not tracked")
            elif not (math.isfinite(size) and abs(size - 1.0) < UNIT_ERROR):
                self.count("orientations that are none")
            else:
                by_segment.setdefault(segment, []).append(quat / size)
        return [
            Samples(segment, self._find_times(segment, len(own), now), *pack_orientations(np.array(own)))
            for segment, own in by_segment.items()
        ]

    def _find_times(self, segment: str, count: int, now: float) -> np.ndarray:
        """Return the times (count,) [s] of samples that came together by `now`, sent one after the other."""
        begin = max(self._last_times.get(segment, -math.inf), now - LONGEST_STEP_S * count)
        self._last_times[segment] = now
        return begin + (now - begin) * np.arange(1, count + 1) / count

    def _send(self, data: bytes, to: Any) -> None:
        """Send a datagram; one that cannot be sent is left out."""
        if self._socket is not None:
            try:
                self._socket.sendto(data, to)
            except OSError:
                self.count("answers that could not be sent")

    def _decode(self, datagram: bytes, sender: Any, now: float) -> tuple[str, np.ndarray] | None:
        """Segment and orientation (4,) xyzw, not yet of unit length, in a datagram; None: it holds none."""
        if len(datagram) < HEADER.size or datagram[:3] != b"\0\0\0":
            self.count("datagrams that are none of SlimeVR")
            return None
        kind, number = HEADER.unpack_from(datagram)
        data = datagram[HEADER.size :]
        if kind == HANDSHAKE:
            self._welcome(datagram, sender, now)
            return None
        tracker = self.trackers.get(sender)
        if tracker is None:
            # It found a server before; without answer for three seconds it looks for one again.
            self.count("packets of trackers that have not introduced themselves")
            return None
        if number and number <= tracker.number:
            self.count("SlimeVR packets that came twice or too late")
            return None
        tracker.number, tracker.newest_time = max(number, tracker.number), now
        if kind in ROTATIONS:
            return self._read_rotation(kind, data, tracker)
        if kind == SENSOR_INFO and len(data) >= 2:
            self._send(struct.pack(">IBB", SENSOR_INFO, data[0], data[1]), sender)
            if len(data) >= 7 and data[6] in SEGMENT_OF:
                tracker.places[data[0]] = SEGMENT_OF[data[6]]
        elif kind == PING:
            self._send(datagram, sender)
        elif kind == BATTERY and len(data) >= 8:
            tracker.battery = float(np.clip(struct.unpack_from(">2f", data)[1], 0.0, 1.0))
        elif kind not in UNUSED:
            self.count(f"SlimeVR packets of type {kind}, which is not read")
        return None

    def _welcome(self, datagram: bytes, sender: Any, now: float) -> None:
        """Answer a handshake."""
        if len(self.trackers) >= MAX_TRACKERS and sender not in self.trackers:
            self.count("trackers beyond the number that can be used")
            return
        at = _MAC_AT
        if len(datagram) > at:
            at += 1 + datagram[at]  # the firmware's name
        mac = datagram[at : at + 6] if len(datagram) >= at + 6 else b""
        places = self.trackers[sender].places if sender in self.trackers else {}
        self.trackers[sender] = Tracker(mac.hex(":"), now, places=places)
        self._send(HANDSHAKE_ANSWER, sender)

    def _read_rotation(self, kind: int, data: bytes, tracker: Tracker) -> tuple[str, np.ndarray] | None:
        sensor_at, at, layout, sensor = ROTATIONS[kind]
        if len(data) < at + layout.size:
            self.count("SlimeVR packets of a wrong length")
            return None
        if kind == ROTATION and data[1] != NORMAL:
            return None
        sensor = sensor if sensor_at is None else data[sensor_at]
        segment = self._find_segment(tracker, sensor)
        if segment is None:
            self.count(f"orientations of {tracker.mac or 'a tracker'}/{sensor}, whose place on the body is not known")
            return None
        return segment, np.array(layout.unpack_from(data, at), dtype=float) / (2.0**15 if layout is BUNDLED else 1.0)

    def _find_segment(self, tracker: Tracker, sensor: int) -> str | None:
        named = f"{tracker.mac}/{sensor}"
        if named in self.sensors:
            return named
        stated = self._assigned.get(named) or (None if sensor else self._assigned.get(tracker.mac))
        return stated or tracker.places.get(sensor) or (named if self._segments is None and tracker.mac else None)


KIND = SourceKind("slimevr:[HOST][:PORT][,TRACKER=SEGMENT...]", open_spec)
