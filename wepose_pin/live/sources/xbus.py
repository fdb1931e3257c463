"""Xbus, the protocol of Xsens MTi sensors, written here: two kinds of message are needed, and all of it is fuzzed.

Bytes → frames → packets → samples, without a port.

A frame is ``FA FF MID LEN data checksum``; LEN ``FF`` is followed by the length in two bytes. All bytes but the first
add up to zero in the low byte. Numbers are big endian. An MTData2 frame (MID 36) is a row of items ``id id length
data``; the last four bits of an id say how its numbers are written. Source: Xsens, MT Low Level Communication Protocol
Documentation (MT0101P).
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

PREAMBLE, BID = 0xFA, 0xFF
MAX_LENGTH = 2048  # [bytes] of data in a frame
GO_TO_MEASUREMENT, GO_TO_CONFIG, DATA, ERROR, SET_OUTPUT = 0x10, 0x30, 0x36, 0x42, 0xC0

PACKET_COUNTER, SAMPLE_TIME_FINE = 0x1020, 0x1060
ACCELERATION, ACCELERATION_HR = 0x4020, 0x4040
RATE_OF_TURN, RATE_OF_TURN_HR = 0x8020, 0x8040
VECTORS = {ACCELERATION, ACCELERATION_HR, RATE_OF_TURN, RATE_OF_TURN_HR}  # [m/s²] and [rad/s], in the sensor's axes
TICKS_HZ = 10_000.0  # SampleTimeFine
WITH_EVERY_PACKET = 0xFFFF  # the rate of items that come with every packet

# Results that an Error message carries.
ERRORS = {
    0x03: "the period is not one it can keep",
    0x04: "the message is not valid in this state, or unknown to it",
    0x1E: "its timer overflowed: too much data, or too high a rate",
    0x20: "the baud rate is not one it knows",
    0x21: "a parameter is not one it knows",
    0x28: "the device failed; update its firmware",
    0x29: "too much data for this baud rate",
    0x2A: "its buffer overflowed: too much data for this baud rate",
}
SKIPPED, BAD_CHECKSUMS = "bytes skipped", "bad checksums"  # problems
UNTIMED, UNPAIRED = "packets without SampleTimeFine", "rates without an acceleration"
Vector = tuple[float, ...]  # three numbers


class Frame(NamedTuple):
    """One message."""

    mid: int
    data: bytes


class Malformed(ValueError):
    """Data of a frame with a good checksum that are no MTData2."""


def build_frame(mid: int, data: bytes = b"") -> bytes:
    """The bytes of one message to a device."""
    length = bytes([len(data)]) if len(data) < 0xFF else b"\xff" + struct.pack(">H", len(data))
    body = bytes([BID, mid]) + length + data
    return bytes([PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


class Frames:
    """Splits a stream of bytes into frames; after noise it resumes at the next frame with a good checksum.

    Attributes
    ----------
    problems : `SKIPPED` bytes that were in no frame, and of these the beginnings of frames with `BAD_CHECKSUMS`
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.problems: Counter[str] = Counter()

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that are complete with these bytes."""
        buffer, frames, at, skipped = self._buffer, list[Frame](), 0, 0
        buffer += data
        while (begin := buffer.find(PREAMBLE, at)) >= 0:
            skipped += begin - at
            at = begin
            head, length = 4, buffer[at + 3] if len(buffer) > at + 3 else 0
            if length == 0xFF and len(buffer) > at + 5:
                head, length = 6, buffer[at + 4] << 8 | buffer[at + 5]
            elif length == 0xFF or len(buffer) < at + 4:
                break
            end = at + head + length + 1
            if buffer[at + 1] == BID and length <= MAX_LENGTH:
                if end > len(buffer):
                    break
                if not sum(buffer[at + 1 : end]) & 0xFF:
                    frames.append(Frame(buffer[at + 2], bytes(buffer[at + head : end - 1])))
                    at = end
                    continue
                self.problems[BAD_CHECKSUMS] += 1
            skipped += 1
            at += 1
        else:
            skipped += len(buffer) - at
            at = len(buffer)
        if skipped:
            self.problems[SKIPPED] += skipped
        del buffer[:at]
        return frames


def parse_packet(data: bytes) -> dict[int, Vector]:
    """The items of an MTData2 frame that a sample needs: `VECTORS`, and SampleTimeFine as one number.

    Raises
    ------
    Malformed
        An item is cut off, or of a length that its id does not have.
    """
    items: dict[int, Vector] = {}
    at = 0
    while at < len(data):
        if at + 3 > len(data) or at + 3 + data[at + 2] > len(data):
            raise Malformed("an item is cut off")
        kind, content = data[at] << 8 | data[at + 1], data[at + 3 : at + 3 + data[at + 2]]
        at += 3 + len(content)
        try:
            if kind & 0xFFF0 == SAMPLE_TIME_FINE:
                items[SAMPLE_TIME_FINE] = struct.unpack(">I", content)
            elif kind & 0xFFF0 in VECTORS:
                items[kind & 0xFFF0] = _parse_vector(kind & 0x3, content)
        except struct.error:
            raise Malformed(f"item {kind:#06x} in {len(content)} bytes") from None
    return items


def _parse_vector(encoding: int, content: bytes) -> Vector:
    """Three numbers; `encoding` is 0 float32, 1 fixed 12.20, 2 fixed 16.32 (fraction first), 3 float64."""
    if encoding == 2:
        parts = struct.unpack(">IhIhIh", content)
        return tuple(whole + fraction / 2**32 for fraction, whole in zip(parts[::2], parts[1::2], strict=True))
    values = struct.unpack((">3f", ">3i", "", ">3d")[encoding], content)
    return tuple(value / 2**20 for value in values) if encoding == 1 else values


# Samples -------------------------------------------------------------------------------------------------------------

MAX_STEP_S = 0.1  # [s] between two accelerations that are interpolated, and for which a rate waits for one
RESTART_S = 1.0  # [s] by which time goes back when a device restarts


class Joiner:
    """Joins rates and accelerations of one device, which may come in separate packets and at different rates.

    Each rate gives a sample; its acceleration is of the same time, or interpolated linearly. Where a device sends the
    high-rate (HR) kind of either, the plain kind is ignored.

    Attributes
    ----------
    problems : `UNTIMED` packets, without SampleTimeFine, and `UNPAIRED` rates, without an acceleration
    """

    def __init__(self) -> None:
        self.problems: Counter[str] = Counter()
        self._ticks: int | None = None
        self._gyro, self._accel = RATE_OF_TURN, ACCELERATION  # the kind that is used
        self._rates: deque[tuple[float, Vector]] = deque()
        self._accels: deque[tuple[float, Vector]] = deque(maxlen=1024)
        self._time: list[float] = []
        self._values: list[Vector] = []

    def add(self, items: Mapping[int, Vector]) -> None:
        """Add a packet."""
        self._gyro = RATE_OF_TURN_HR if RATE_OF_TURN_HR in items else self._gyro
        self._accel = ACCELERATION_HR if ACCELERATION_HR in items else self._accel
        if self._gyro not in items and self._accel not in items:
            return
        if SAMPLE_TIME_FINE not in items:
            self.problems[UNTIMED] += 1
            return
        time = self._seconds(int(items[SAMPLE_TIME_FINE][0]))
        if self._accel in items:
            self._accels.append((time, items[self._accel]))
        if self._gyro in items:
            self._rates.append((time, items[self._gyro]))
        self._join()

    def take(self) -> tuple[np.ndarray, np.ndarray]:
        """Device times (m,) [s] and values (m, 6) of the samples since the last call: gyro [rad/s], accel [m/s²]."""
        time, values = np.array(self._time), np.array(self._values).reshape(-1, 6)
        self._time, self._values = [], []
        return time, values

    def _seconds(self, ticks: int) -> float:
        """Device time [s] that does not wrap at 2³² ticks."""
        before = ticks if self._ticks is None else self._ticks
        step = (ticks - before + 0x80000000) % 0x100000000 - 0x80000000
        if step < -RESTART_S * TICKS_HZ:
            self._rates.clear()
            self._accels.clear()
        self._ticks = before + step
        return self._ticks / TICKS_HZ

    def _join(self) -> None:
        rates, accels = self._rates, self._accels
        while rates:
            time, gyro = rates[0]
            while len(accels) > 1 and accels[1][0] <= time:
                accels.popleft()
            is_awaited = not accels or (len(accels) == 1 and accels[0][0] < time)
            if is_awaited and rates[-1][0] - time <= MAX_STEP_S:
                return  # its acceleration is still to come
            rates.popleft()
            if is_awaited or accels[0][0] > time or (accels[0][0] < time and accels[1][0] - accels[0][0] > MAX_STEP_S):
                self.problems[UNPAIRED] += 1
                continue
            (begin, accel), (end, after) = accels[0], accels[-1 if len(accels) == 1 else 1]
            if begin < time:
                share = (time - begin) / (end - begin)
                accel = tuple(a + share * (b - a) for a, b in zip(accel, after, strict=True))
            self._time.append(time)
            self._values.append((*gyro, *accel))


# Configuration -------------------------------------------------------------------------------------------------------


def build_output_items(rate_hz: int, gyro: int, accel: int) -> bytes:
    """Data of SetOutputConfiguration: counter, time, and these two items in float32, at `rate_hz`."""
    every = WITH_EVERY_PACKET
    return struct.pack(">8H", PACKET_COUNTER, every, SAMPLE_TIME_FINE, every, accel, rate_hz, gyro, rate_hz)


def read_rates(data: bytes) -> dict[int, int]:
    """Item → rate [Hz] of a device's answer to SetOutputConfiguration."""
    pairs = struct.iter_unpack(">2H", data[: len(data) // 4 * 4])
    return {item & 0xFFF0: rate for item, rate in pairs}


def describe_error(data: bytes) -> str:
    """The text of an Error message."""
    return ERRORS.get(data[0], f"error {data[0]:#04x}") if data else "an error without a number"
