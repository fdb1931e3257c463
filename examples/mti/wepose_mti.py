"""Xsens MTi sensors, each on its serial port, as a source of `wepose live`: `pip install examples/mti`.

    wepose live --source mti:/dev/ttyUSB0=torso,/dev/ttyUSB1=left_forearm …

Configure each sensor once with MT Manager, to send SampleTimeFine, RateOfTurn and Acceleration as float32 at 115200
baud. It was tested against an emulator, not with a device. Protocol: Xsens, MT Low Level Communication Protocol
(MT0101P). A frame is ``FA FF MID LEN data checksum``, whose bytes but the first add up to zero in the low byte.
"""

import struct
import threading
import time
from contextlib import suppress
from queue import Empty, SimpleQueue

import numpy as np
import serial

from wepose_pin.live.sources import HostClock, Source, SourceKind
from wepose_pin.recording.arrivals import Samples

DATA, SAMPLE_TIME, GYRO, ACCEL = 0x36, 0x1060, 0x8020, 0x4020  # a message, and its items: 1e-4 s, rad/s, m/s²
GO_TO_MEASUREMENT = b"\xfa\xff\x10\x00\xf1"
SILENT_S = 3.0  # [s] without a byte, after which a port is opened anew: not every adapter reports a pulled cable


def take_frames(buffer):
    """Take the whole frames, MID and data, out of a buffer; return them, and how many bytes were in none."""
    frames, at, skipped = [], 0, 0
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


def parse_packet(data):
    """Device time [s], and gyro [rad/s] and accel [m/s²] of a packet; None: it lacks one of them."""
    items, at = {}, 0
    while at + 3 <= len(data):
        end = at + 3 + data[at + 2]
        items[(data[at] << 8 | data[at + 1]) & ~0xC] = data[at + 3 : end]  # two bits tell the axes of the world
        at = end
    try:
        return 1e-4 * struct.unpack(">I", items[SAMPLE_TIME])[0], struct.unpack(">6f", items[GYRO] + items[ACCEL])
    except (KeyError, struct.error):
        return None


def open_spec(rest, options):
    devices = {}
    for pair in rest.split(","):
        device, _, segment = pair.rpartition("=")
        if not device or segment in devices or device in devices.values():
            raise options.error(f"'{pair}': DEVICE=SEGMENT is needed, each device and each segment once")
        options.check_segment(segment)
        devices[segment] = device
    return MTiSource({name: devices[name] for name in options.choose(devices, "device for")})


class MTiSource(Source):
    """Sensors on `devices` (segment → port), with a thread for each port, so that arrivals are stamped in time."""

    def __init__(self, devices):
        super().__init__(devices)
        self.devices, self.inbox, self.stop, self.threads = devices, SimpleQueue(), threading.Event(), []
        self.waits = dict.fromkeys(devices, "the port is being opened")  # segment → why nothing comes; empty: it does

    def open(self):
        self.stop.clear()
        self.threads = [threading.Thread(target=self.run, args=each, daemon=True) for each in self.devices.items()]
        for thread in self.threads:
            thread.start()

    def connect(self, timeout_s):
        deadline = time.monotonic() + timeout_s
        while any(self.waits.values()) and time.monotonic() < deadline:
            time.sleep(0.05)
        return not any(self.waits.values())

    def read(self, timeout_s):
        samples = []
        with suppress(Empty):
            came = self.inbox.get(timeout=timeout_s)
            while True:
                if isinstance(came, str):
                    self.count(came)
                else:
                    samples += self.keep_plausible(came)
                came = self.inbox.get_nowait()
        return samples

    def close(self):
        self.stop.set()
        while self.threads:
            self.threads.pop().join()

    def describe_awaited(self):
        waits = [f"{name} at {self.devices[name]}: {wait}" for name, wait in self.waits.items() if wait]
        return f"the MTi of {waits[0]}" if waits else ""

    def run(self, segment, path):
        """In the thread of a port: open it and listen, again and again."""
        while not self.stop.is_set():
            try:
                with serial.Serial(path, 115200, timeout=0.05, write_timeout=1.0, exclusive=True) as port:
                    port.write(GO_TO_MEASUREMENT)  # it may be in its state of configuration
                    self.waits[segment] = "no packets with SampleTimeFine, RateOfTurn and Acceleration come"
                    self.listen(segment, port)
            except (OSError, ValueError) as error:  # SerialException is an OSError
                if not self.waits[segment]:
                    self.inbox.put(f"connections lost to {segment}")
                self.waits[segment] = str(error)
                self.stop.wait(0.5)

    def listen(self, segment, port):
        buffer, clock, last_byte = bytearray(), HostClock(), time.monotonic()
        while not self.stop.is_set():
            data, now = port.read(port.in_waiting or 1), time.monotonic()
            last_byte = now if data else last_byte
            if now - last_byte > SILENT_S:
                raise OSError("nothing comes at 115200 baud; check the cable, the port and the baud rate")
            buffer += data
            frames, skipped = take_frames(buffer)
            packets = [parse_packet(content) for mid, content in frames if mid == DATA]
            if (skipped or None in packets) and not self.waits[segment]:  # before, it may begin within a packet
                self.inbox.put(f"damaged or incomplete packets of {segment}")
            if samples := [packet for packet in packets if packet is not None]:
                time_s, values = map(np.array, zip(*samples, strict=True))
                self.inbox.put(Samples(segment, clock.to_host(time_s, now), values[:, :3], values[:, 3:]))
                self.waits[segment] = ""
            time.sleep(0.002)


SOURCE = SourceKind("mti:DEVICE=SEGMENT,DEVICE=SEGMENT", open_spec)
