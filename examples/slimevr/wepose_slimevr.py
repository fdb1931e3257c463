"""SlimeVR trackers over Wi-Fi as a source of `wepose live`, the server they look for: `pip install examples/slimevr`.

A tracker broadcasts a handshake until a server answers, then sends its orientation, to a world with z up whose heading
is its own, and the places of its sensors on the body. It wants a heartbeat at least every three seconds, and sends no
rates. Big-endian; a packet is its type (u32), a rising number (u64; 0 is always taken) and data. It was tested against
an emulator, not with a device. Source: SlimeVR-Tracker-ESP, protocol version 22.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wepose_pin.live.sources import SourceKind, SourceOptions
from wepose_pin.live.sources.udp import DatagramSource, parse_address
from wepose_pin.recording.arrivals import Samples, pack_orientations

PORT = 6969
HEARTBEAT_S = 0.5  # [s] from one to the next
UNIT_ERROR = 0.05  # of a quaternion's length
LONGEST_STEP_S = 0.02  # [s] between orientations that came together
HEADER = struct.Struct(">IQ")
HANDSHAKE_ANSWER = (b"\x03Hey OVR =D 5").ljust(64, b"\0")
HEARTBEAT = HEADER.pack(1, 0)
HANDSHAKE, PING, SENSOR_INFO, ROTATION = 3, 10, 15, 17
NORMAL = 1  # kind of a rotation; 2 is a correction
ARMS = "left_forearm right_forearm left_upper_arm right_upper_arm left_hand right_hand".split()
# Place on the body → segment.
SEGMENT_OF = {1: "head", 3: "torso", 4: "torso", 5: "pelvis", 6: "pelvis", **dict(enumerate(ARMS, 13))}
DAMAGED = "damaged SlimeVR packets"
_FIRMWARE_AT = 12 + 7 * 4  # of a handshake, after seven numbers: length and letters of a name, then the MAC address


@dataclass
class Tracker:
    """A tracker and the sensors on it."""

    mac: str  # six bytes as text, or empty where the tracker has not told it
    number: int = 0  # of its newest packet
    places: dict[int, str] = field(default_factory=dict)  # sensor → segment by its place on the body


def open_spec(rest: str, options: SourceOptions) -> SlimeVrSource:
    """The source of ``slimevr:HOST[:PORT]``, or of a port of this machine alone."""
    host, port = rest, PORT
    if rest.isdigit() or ":" in rest:
        host, port = parse_address(rest, f"source '{options.spec}':", PORT)
    return SlimeVrSource(host, port, options.sensors, None if options.any_name else options.segments)


class SlimeVrSource(DatagramSource):
    """Orientations of SlimeVR trackers; parameters and errors as `DatagramSource`.

    A sensor's name is the segment of the place that its tracker states. Where sensors may have any name, or where its
    name is among the `sensors`, it is ``MAC/SENSOR``.
    """

    kind, sender = "slimevr", "SlimeVR trackers"
    measures_orientations = True

    def __init__(self, *options: Any) -> None:
        super().__init__(*options)
        self._trackers: dict[Any, Tracker] = {}  # by address
        self._heartbeat = -math.inf  # [s]
        self._last_times: dict[str, float] = {}

    @property
    def orientations(self) -> dict[str, bool]:
        return dict.fromkeys(self.sensors, False)

    def serve(self, now: float) -> None:
        if now - self._heartbeat >= HEARTBEAT_S:
            self._heartbeat = now
            for address in self._trackers:
                self.send(HEARTBEAT, address)

    def take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        by_segment: dict[str, list[np.ndarray]] = {}
        for datagram, sender in datagrams:
            try:
                decoded = self._decode(datagram, sender)
            except (struct.error, IndexError):
                self.count(DAMAGED)
                continue
            if decoded is None:
                continue
            segment, quat = decoded
            size = float(np.linalg.norm(quat))
            if not self.tracks(segment):
                self.count(f"orientations of {segment}, which is not tracked")
            elif not abs(size - 1.0) < UNIT_ERROR:
                self.count(DAMAGED)
            else:
                by_segment.setdefault(segment, []).append(quat / size)
        samples = []
        for segment, own in by_segment.items():  # sent one after the other
            begin = max(self._last_times.get(segment, -math.inf), now - LONGEST_STEP_S * len(own))
            self._last_times[segment] = now
            time_s = np.linspace(begin, now, len(own) + 1)[1:]
            samples.append(Samples(segment, time_s, *pack_orientations(np.array(own))))
        return samples

    def _decode(self, datagram: bytes, sender: Any) -> tuple[str, np.ndarray] | None:
        """Segment and orientation (4,) xyzw, not yet of unit length, in a datagram; None: it holds none."""
        kind, number = HEADER.unpack_from(datagram)
        data, tracker = datagram[HEADER.size :], self._trackers.get(sender)
        if kind == HANDSHAKE:
            at = _FIRMWARE_AT + 1 + datagram[_FIRMWARE_AT] if len(datagram) > _FIRMWARE_AT else len(datagram)
            mac = datagram[at : at + 6].hex(":")
            self._trackers[sender] = Tracker(mac, places=tracker.places if tracker is not None else {})
            self.send(HANDSHAKE_ANSWER, sender)
            return None
        if tracker is None:  # it found another server before; without answer for three seconds it looks for one again
            return None
        if number and number <= tracker.number:
            self.count("SlimeVR packets that came twice or too late")
            return None
        tracker.number = max(number, tracker.number)
        if kind == SENSOR_INFO:
            self.send(struct.pack(">IBB", SENSOR_INFO, data[0], data[1]), sender)
            if len(data) >= 7 and data[6] in SEGMENT_OF:
                tracker.places[data[0]] = SEGMENT_OF[data[6]]
        elif kind == PING:
            self.send(datagram, sender)
        elif kind == ROTATION and data[1] == NORMAL:
            segment = self._find_segment(tracker, data[0])
            if segment is not None:
                return segment, np.array(struct.unpack_from(">4f", data, 2))
            self.count(f"orientations of {tracker.mac or 'a tracker'}/{data[0]}, whose place on the body is not known")
        return None

    def _find_segment(self, tracker: Tracker, sensor: int) -> str | None:
        named = f"{tracker.mac}/{sensor}"
        if named in self.sensors:
            return named
        return tracker.places.get(sensor) or (named if self.segments is None and tracker.mac else None)


SOURCE = SourceKind("slimevr:HOST[:PORT]", open_spec)
