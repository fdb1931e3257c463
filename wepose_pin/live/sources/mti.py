"""Xsens MTi sensors on serial ports, one port a sensor; `xbus` holds the protocol."""

from __future__ import annotations

import os
import select
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from ...errors import BadSource, how_to_install
from ...recording.arrivals import Samples
from ..state import join_names
from . import xbus
from .base import Source, SourceKind, SourceOptions
from .clocks import HostClock

# Name, rate of turn, acceleration; every MTi has the plain outputs up to 100 Hz, above the HR outputs are tried first.
PLAIN, HIGH_RATE = ("", xbus.RATE_OF_TURN, xbus.ACCELERATION), ("HR", xbus.RATE_OF_TURN_HR, xbus.ACCELERATION_HR)
PLAIN_HZ = 100
ANSWER_S = 0.5
TRIES = 3
SILENT_S = 3.0  # [s] without a byte, after which a port is reopened: not every adapter reports a pulled cable
RETRY_S = 1.0
WAIT_S = 0.05
PAUSE_S = 0.002  # [s] between two reads: at 1 kHz two packets come at once, and cost half


class Delivery(NamedTuple):
    """What the thread of a port has read."""

    segment: str
    problems: Counter[str]
    time: np.ndarray = np.empty(0)  # (m,) [s]
    values: np.ndarray = np.empty((0, 6))


def open_spec(rest: str, options: SourceOptions) -> MTiSource:
    """The source of ``mti:DEVICE=SEGMENT,…[@RATE]``."""
    pairs, separator, rate = rest.rpartition("@")
    if separator and not (rate.isascii() and rate.isdigit() and 0 < int(rate) <= 2000):
        raise options.error(f"rate '{rate}'; whole samples a second from 1 to 2000, as @100")
    devices = options.read_pairs(pairs if separator else rest, "/dev/ttyUSB0")
    chosen = {name: devices[name] for name in options.choose(devices, "device for")}
    return MTiSource(chosen, int(rate) if separator else None, options.baud)


class MTiSource(Source):
    """Sensors on `devices` (segment → port); a lost port is reopened when it is back.

    Parameters
    ----------
    rate_hz : configures the devices, lastingly, to send gyro and accel at this rate; None: leaves them as they are
    baud : of the ports; a device on USB takes any

    Notes
    -----
    One thread a port reads and decodes, so that arrivals are stamped in time.
    """

    def __init__(self, devices: Mapping[str, str], rate_hz: int | None = None, baud: int = 115200) -> None:
        super().__init__(devices, rate_hz)
        self._inbox: SimpleQueue[Delivery] = SimpleQueue()
        self._devices = [Device(segment, port, rate_hz, baud, self._inbox) for segment, port in devices.items()]
        self._problem = ""  # of the port that is awaited

    def open(self) -> None:
        for device in self._devices:
            device.open()

    def connect(self, timeout_s: float) -> bool:
        """Open and configure the ports, and listen once all are there; raises `BadSource` where one lacks the rate."""
        for device in self._devices:
            if not device.is_open:
                try:
                    device.connect()
                except NotReady as error:
                    self._problem = f"the MTi of {device.place}: {error}"
                    time.sleep(timeout_s)
                    return False
        for device in self._devices:
            device.start()
        self._problem = ""
        return True

    def read(self, timeout_s: float) -> list[Samples]:
        """Samples since the last call, in the order of arrival."""
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        try:
            while True:
                left = deadline - time.monotonic()
                is_awaited = left > 0.0 and not samples
                came = self._inbox.get(timeout=left) if is_awaited else self._inbox.get_nowait()
                for problem, number in came.problems.items():
                    self.count(problem, number)
                samples += self.keep_plausible(came.segment, came.time, came.values)
        except Empty:
            return samples

    def close(self) -> None:
        """Stop listening and free the ports."""
        for device in self._devices:
            device.close()

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:
        places = [device.place for device in self._devices if device.segment in sensors or not sensors]
        return self._problem or f"MTi sensors: {', '.join(places)}"


class NotReady(Exception):
    """A port cannot be opened, or no MTi answers there: it may come."""


class Device:
    """One port, and the thread that listens to it."""

    def __init__(self, segment: str, path: str, rate_hz: int | None, baud: int, inbox: SimpleQueue[Delivery]) -> None:
        try:
            import serial
        except ImportError:
            raise BadSource(f"mti: needs pyserial: {how_to_install('pyserial')}") from None
        self.segment, self.place = segment, f"{join_names([segment])} at {path}"
        self._path, self._rate_hz, self._baud, self._inbox, self._serial = path, rate_hz, baud, inbox, serial
        self._port: Any = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_open(self) -> bool:
        return self._port is not None

    def open(self) -> None:
        """Begin anew after `close`."""
        self._stop.clear()

    def connect(self) -> None:
        """Open the port and start measurement; raises `NotReady`, or `BadSource` where it lacks the rate."""
        try:
            self._port = self._serial.Serial(self._path, self._baud, timeout=WAIT_S, write_timeout=1.0, exclusive=True)
            self._frames, self._joiner, self._clock = xbus.Frames(), xbus.Joiner(), HostClock()
            if self._rate_hz is None:
                self._wait_for_data()
            else:
                self._configure(self._rate_hz)
            self._frames.problems.clear()  # a running stream begins with a partial frame
        except (OSError, ValueError) as error:  # SerialException is an OSError
            self._disconnect()
            reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
            raise NotReady(f"cannot open the port ({reason})") from None
        except (NotReady, BadSource):
            self._disconnect()
            raise

    def start(self) -> None:
        """Listen in a thread."""
        self._thread = threading.Thread(target=self._listen, name=f"mti {self._path}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._disconnect()

    def _disconnect(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    # Requests --------------------------------------------------------------------------------------------------------

    def _configure(self, rate_hz: int) -> None:
        self._ask(xbus.GO_TO_CONFIG)
        offers = []
        for kind, gyro, accel in (PLAIN, HIGH_RATE) if rate_hz <= PLAIN_HZ else (HIGH_RATE, PLAIN):
            answer = self._ask(xbus.SET_OUTPUT, xbus.build_output_items(rate_hz, gyro, accel))
            if answer.mid == xbus.ERROR:
                offers.append(f"RateOfTurn{kind}: {xbus.describe_error(answer.data)}")
                continue
            rates = xbus.read_rates(answer.data)
            if rates.get(gyro) == rates.get(accel) == rate_hz:
                self._ask(xbus.GO_TO_MEASUREMENT)
                return
            offers.append(
                f"RateOfTurn{kind} at {rates.get(gyro, 0)} Hz, Acceleration{kind} at {rates.get(accel, 0)} Hz"
            )
        raise BadSource(
            f"mti:{self._path}: does not send rate of turn and acceleration at {rate_hz} Hz; it offers "
            f"{', '.join(offers)}; choose a rate that it has"
        )

    def _ask(self, mid: int, data: bytes = b"") -> xbus.Frame:
        """Send a message; return its acknowledgement, or the error that answers SetOutputConfiguration."""
        for _ in range(TRIES):
            self._port.write(xbus.build_frame(mid, data))
            deadline = time.monotonic() + ANSWER_S
            while time.monotonic() < deadline and not self._stop.is_set():
                for frame in self._frames.feed(self._read_bytes()):
                    if frame.mid == mid + 1 or (frame.mid == xbus.ERROR and mid == xbus.SET_OUTPUT):
                        return frame
                    if frame.mid == xbus.ERROR and mid != xbus.GO_TO_CONFIG:  # then it may be an earlier one
                        raise BadSource(f"mti:{self._path}: the device says: {xbus.describe_error(frame.data)}")
        raise NotReady(f"no MTi answers at {self._baud} baud; check the cable, the port and the baud rate")

    def _wait_for_data(self) -> None:
        """Wait for data of a device that is not configured; start its measurement where it waits for that."""
        for _ in range(2):
            deadline = time.monotonic() + 2.0 * ANSWER_S
            while time.monotonic() < deadline and not self._stop.is_set():
                if any(frame.mid == xbus.DATA for frame in self._frames.feed(self._read_bytes())):
                    return
            self._port.write(xbus.build_frame(xbus.GO_TO_MEASUREMENT))
        remedy = "check cable, port, baud rate and outputs, or name a rate, as @100, for the device to be configured"
        raise NotReady(f"no MTData2 comes at {self._baud} baud; {remedy}")

    def _read_bytes(self) -> bytes:
        """Bytes that came, none after a while; past pyserial, whose `read` costs twice as much."""
        port = self._port.fileno()
        if not select.select([port], [], [], WAIT_S)[0]:
            return b""
        data = os.read(port, 4096)
        if not data:
            raise OSError("the port is gone")
        return data

    # Listening -------------------------------------------------------------------------------------------------------

    def _listen(self) -> None:
        last_byte = time.monotonic()
        while not self._stop.is_set():
            try:
                if self._port is None:
                    self.connect()
                    self._inbox.put(Delivery(self.segment, Counter({f"reconnections of {self.segment}": 1})))
                    last_byte = time.monotonic()
                data = self._read_bytes()
                now = time.monotonic()
                if data:
                    last_byte = now
                    self._decode(data, now)
                    time.sleep(PAUSE_S)
                elif now - last_byte > SILENT_S:
                    raise OSError("nothing comes")
            except (NotReady, BadSource):
                self._stop.wait(RETRY_S)
            except OSError:  # SerialException is one
                self._disconnect()
                self._inbox.put(Delivery(self.segment, Counter({f"connections lost to {self.segment}": 1})))

    def _decode(self, data: bytes, arrival: float) -> None:
        """Put the samples in bytes that came at a time [s] into the inbox."""
        problems: Counter[str] = Counter()
        for frame in self._frames.feed(data):
            if frame.mid == xbus.DATA:
                try:
                    self._joiner.add(xbus.parse_packet(frame.data))
                except xbus.Malformed:
                    problems["malformed MTData2 packets"] += 1
            elif frame.mid == xbus.ERROR:
                problems[f"{self.segment} says: {xbus.describe_error(frame.data)}"] += 1
        for own in (self._frames.problems, self._joiner.problems):
            problems.update(own)
            own.clear()
        time_s, values = self._joiner.take()
        if len(time_s):
            self._inbox.put(Delivery(self.segment, problems, self._clock.to_host(time_s, arrival), values))
        elif problems:
            self._inbox.put(Delivery(self.segment, problems))


KIND = SourceKind("mti:DEVICE=SEGMENT,DEVICE=SEGMENT[@RATE]", open_spec)
