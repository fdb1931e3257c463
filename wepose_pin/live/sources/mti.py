"""Xsens MTi sensors on serial ports, one port a sensor, by their protocol Xbus.

A frame is ``FA FF MID LEN data checksum``; all bytes but the first add up to zero in the low byte. Numbers are big
endian. An MTData2 frame (MID 36) is a row of items ``id id length data``; each must have the items of a sample, in
float32. Source: Xsens, MT Low Level Communication Protocol Documentation (MT0101P).
"""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from ...errors import BadSource, how_to_install
from ...recording.arrivals import Samples
from ..state import join_names
from .base import HostClock, Source, SourceKind, SourceOptions

DATA = 0x36  # message
SAMPLE_TIME, GYRO, ACCEL = 0x1060, 0x8020, 0x4020  # items: [1e-4 s], rate of turn [rad/s], acceleration [m/s²]
GO_TO_MEASUREMENT = b"\xfa\xff\x10\x00\xf1"
BAUD = 115200  # a device on USB takes any
SILENT_S = 3.0  # [s] without a byte, after which a port is reopened: not every adapter reports a pulled cable
RETRY_S = 0.5  # [s] between two attempts to open a port
WAIT_S = 0.05
PAUSE_S = 0.002  # [s] between two reads
AWAITED = "no packets with SampleTimeFine, RateOfTurn and Acceleration come; configure it with MT Manager"


def take_frames(buffer: bytearray) -> tuple[list[tuple[int, bytes]], int]:
    """Take the whole frames, MID and data, out of a buffer; return them, and how many bytes before were in none."""
    frames, at, skipped = list[tuple[int, bytes]](), 0, 0
    while len(buffer) - at >= 5:
        end = at + buffer[at + 3] + 5
        is_frame = buffer[at : at + 2] == b"\xfa\xff"
        if is_frame and end > len(buffer):
            break
        if is_frame and not sum(buffer[at + 1 : end]) & 0xFF:
            frames.append((buffer[at + 2], bytes(buffer[at + 4 : end - 1])))
            at = end
        else:
            at, skipped = at + 1, skipped + 1
    del buffer[:at]
    return frames, skipped


def parse_packet(data: bytes) -> tuple[float, tuple[float, ...]] | None:
    """Device time [s], and gyro [rad/s] and accel [m/s²] of an MTData2 frame; None: it lacks one of them."""
    items, at = dict[int, bytes](), 0
    while at + 3 <= len(data):
        end = at + 3 + data[at + 2]
        items[(data[at] << 8 | data[at + 1]) & ~0xC] = data[at + 3 : end]  # two bits tell the axes of the world
        at = end
    try:
        (ticks,) = struct.unpack(">I", items[SAMPLE_TIME])
        return 1e-4 * ticks, struct.unpack(">6f", items[GYRO] + items[ACCEL])
    except (KeyError, struct.error):
        return None


def open_spec(rest: str, options: SourceOptions) -> MTiSource:
    """The source of ``mti:DEVICE=SEGMENT,…``."""
    devices: dict[str, str] = {}
    for pair in rest.split(","):
        device, _, segment = pair.rpartition("=")
        if not device:
            raise options.error(f"'{pair}' is no DEVICE=SEGMENT, as /dev/ttyUSB0={options.segments[0]}")
        options.check_segment(segment)
        if segment in devices or device in devices.values():
            raise options.error(f"'{pair}': each device and each segment is named once")
        devices[segment] = device
    return MTiSource({name: devices[name] for name in options.choose(devices, "device for")})


class MTiSource(Source):
    """Sensors on `devices` (segment → port).

    One thread a port opens it and listens, again and again, so that arrivals are stamped in time and a lost port is
    taken up when it is back.
    """

    def __init__(self, devices: Mapping[str, str]) -> None:
        super().__init__(devices)
        try:
            import serial
        except ImportError:
            raise BadSource(f"mti: needs pyserial: {how_to_install('pyserial')}") from None
        self._serial, self._devices = serial, dict(devices)
        self._inbox: SimpleQueue[Samples | str] = SimpleQueue()  # samples, or a problem
        self._waits = dict.fromkeys(devices, "the port is being opened")  # segment → why nothing comes; empty: it does
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def open(self) -> None:
        self._stop.clear()
        self._threads = [threading.Thread(target=self._run, args=each, daemon=True) for each in self._devices.items()]
        for thread in self._threads:
            thread.start()

    def connect(self, timeout_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        while any(self._waits.values()) and time.monotonic() < deadline:
            time.sleep(WAIT_S)
        return not any(self._waits.values())

    def read(self, timeout_s: float) -> list[Samples]:
        samples: list[Samples] = []
        with suppress(Empty):
            came = self._inbox.get(timeout=timeout_s)
            while True:
                if isinstance(came, str):
                    self.count(came)
                else:
                    samples += self.keep_plausible(came)
                came = self._inbox.get_nowait()
        return samples

    def close(self) -> None:
        self._stop.set()
        while self._threads:
            self._threads.pop().join()

    def describe_awaited(self) -> str:
        places = {name: f"{join_names([name])} at {path}" for name, path in self._devices.items()}
        for name, place in places.items():
            if self._waits[name]:
                return f"the MTi of {place}: {self._waits[name]}"
        return f"MTi sensors: {', '.join(places.values())}"

    # In the thread of a port -----------------------------------------------------------------------------------------

    def _run(self, segment: str, path: str) -> None:
        while not self._stop.is_set():
            try:
                with self._serial.Serial(path, BAUD, timeout=WAIT_S, write_timeout=1.0, exclusive=True) as port:
                    port.write(GO_TO_MEASUREMENT)  # it may be in its state of configuration
                    self._waits[segment] = AWAITED
                    self._listen(segment, port)
            except (OSError, ValueError) as error:  # SerialException is an OSError
                if not self._waits[segment]:
                    self._inbox.put(f"connections lost to {segment}")
                errno = getattr(error, "errno", None)
                self._waits[segment] = f"cannot open the port ({os.strerror(errno)})" if errno else str(error)
                self._stop.wait(RETRY_S)

    def _listen(self, segment: str, port: Any) -> None:
        buffer, clock, last_byte = bytearray(), HostClock(), time.monotonic()
        while not self._stop.is_set():
            data, now = port.read(port.in_waiting or 1), time.monotonic()
            if data:
                last_byte = now
            elif now - last_byte > SILENT_S:
                raise OSError(f"nothing comes at {BAUD} baud; check the cable, the port and the baud rate")
            buffer += data
            frames, skipped = take_frames(buffer)
            packets = [parse_packet(content) for mid, content in frames if mid == DATA]
            if (skipped or None in packets) and not self._waits[segment]:  # before, it may begin within a packet
                self._inbox.put(f"damaged or incomplete packets of {segment}")
            if samples := [packet for packet in packets if packet is not None]:
                time_s, values = map(np.array, zip(*samples, strict=True))
                self._inbox.put(Samples(segment, clock.to_host(time_s, now), values[:, :3], values[:, 3:]))
                self._waits[segment] = ""
            time.sleep(PAUSE_S)


KIND = SourceKind("mti:DEVICE=SEGMENT,DEVICE=SEGMENT", open_spec)
