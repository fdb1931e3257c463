"""Xsens MTi sensors on serial ports, one port a sensor; `xbus` holds the protocol."""

from __future__ import annotations

import os
import select
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

from ...errors import BadOption, BadSource, how_to_install
from ...recording.arrivals import Samples
from ..state import join_names
from . import xbus
from .base import Source, SourceKind, SourceOptions, Waiting
from .clocks import HostClock

PLAIN_HZ = 100  # that the plain outputs of every MTi have; above, the HR outputs are tried first
ANSWER_S = 0.5
TRIES = 3
SILENT_S = 3.0  # [s] without a byte, after which a port is reopened: not every adapter reports a pulled cable
RETRY_S = 1.0
WAIT_S = 0.05
PAUSE_S = 0.002  # [s] between two reads: at 1 kHz two packets come at once, and cost half
MAX_WAITING = 20_000  # blocks while nobody reads; then the oldest are dropped


def open_spec(rest: str, options: SourceOptions) -> MTiSource:
    """The source of ``mti:DEVICE=SEGMENT,…[@RATE]``."""
    pairs, separator, rate = rest.rpartition("@")
    if separator and not (rate.isascii() and rate.isdigit() and 0 < int(rate) <= 2000):
        raise BadOption(f"source '{options.spec}': rate '{rate}'; whole samples a second from 1 to 2000, as @100")
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
        self._inbox = Inbox()
        self._devices = [Device(segment, port, rate_hz, baud, self._inbox) for segment, port in devices.items()]

    def open(self, waiting: Waiting | None = None) -> None:
        """Open and configure every port, then listen; wait for a port, with `waiting` until that returns False.

        Raises
        ------
        BadSource
            An MTi cannot send at the rate; without `waiting` also: a port cannot be opened, or no MTi answers there.
        """
        for device in self._devices:
            refuse = device.refuse
            if not self.wait_for(device.try_to_connect, device.describe_wait, waiting, 0.0, refuse):
                return
        for device in self._devices:
            device.start()

    def read(self, timeout_s: float) -> list[Samples]:
        """Samples since the last call, in the order of arrival."""
        samples, problems = self._inbox.take(timeout_s)
        for problem, number in problems.items():
            self.count(problem, number)
        return [kept for sensor, time_s, values in samples for kept in self.keep_plausible(sensor, time_s, values)]

    def close(self) -> None:
        """Stop listening and free the ports."""
        for device in self._devices:
            device.close()

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:
        places = [device.place for device in self._devices if device.segment in sensors or not sensors]
        return f"MTi sensors: {', '.join(places)}"


class Inbox:
    """What the threads of all ports have read: samples, with sensor, times and values, and counts of problems."""

    def __init__(self) -> None:
        self._filled = threading.Condition()
        self._samples: deque[tuple[str, Any, Any]] = deque(maxlen=MAX_WAITING)
        self._problems: Counter[str] = Counter()

    def put(self, sensor: str, time_s: Any, values: Any) -> None:
        """Add samples of a sensor, perhaps none."""
        if len(time_s):
            with self._filled:
                self._samples.append((sensor, time_s, values))
                self._filled.notify()

    def count(self, problems: Mapping[str, int]) -> None:
        with self._filled:
            self._problems.update(problems)

    def take(self, timeout_s: float) -> tuple[list[tuple[str, Any, Any]], Counter[str]]:
        """All samples and counts since the last call; wait `timeout_s` for a sample."""
        with self._filled:
            self._filled.wait_for(lambda: self._samples, timeout_s)
            samples, problems = list(self._samples), self._problems
            self._samples.clear()
            self._problems = Counter()
        return samples, problems


class NotReady(BadSource):
    """A port cannot be opened, or no MTi answers there: it may come."""

    def __init__(self, path: str, reason: str, remedy: str) -> None:
        super().__init__(f"mti:{path}: {reason}; {remedy}")
        self.reason = reason


class Device:
    """One port, and the thread that listens to it."""

    def __init__(self, segment: str, path: str, rate_hz: int | None, baud: int, inbox: Inbox) -> None:
        self.segment, self.place = segment, f"{join_names([segment])} at {path}"
        self._path, self._rate_hz, self._baud, self._inbox = path, rate_hz, baud, inbox
        self._serial = _import_pyserial()
        self._port: Any = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._error: NotReady | None = None  # for which it could not be connected

    def try_to_connect(self, timeout_s: float) -> bool:
        """Connect, or wait `timeout_s` and return False where that cannot be done now."""
        self._stop.clear()
        try:
            self.connect()
        except NotReady as error:
            self._error = error
            self._stop.wait(timeout_s)
            return False
        return True

    def describe_wait(self) -> str:
        return f"the MTi of {self.place}: {self._error.reason if self._error else ''}"

    def refuse(self) -> str:
        """Why it could not be connected."""
        return str(self._error)

    def connect(self) -> None:
        """Open the port and start measurement; raises `BadSource`."""
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
            remedy = "a serial port that is there, may be read and is not in use, as /dev/ttyUSB0"
            raise NotReady(self._path, f"cannot open the port ({reason})", remedy) from None
        except BadSource:
            self._disconnect()
            raise

    def start(self) -> None:
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
        for hr in (False, True) if rate_hz <= PLAIN_HZ else (True, False):
            items = xbus.RATE_OF_TURN_HR if hr else xbus.RATE_OF_TURN, xbus.ACCELERATION_HR if hr else xbus.ACCELERATION
            names = ("RateOfTurnHR", "AccelerationHR") if hr else ("RateOfTurn", "Acceleration")
            answer = self._ask(xbus.SET_OUTPUT, xbus.build_output_items(rate_hz, hr))
            if answer.mid == xbus.ERROR:
                offers.append(f"{names[0]}: {xbus.describe_error(answer.data)}")
                continue
            rates = xbus.read_rates(answer.data)
            if all(rates.get(item) == rate_hz for item in items):
                self._ask(xbus.GO_TO_MEASUREMENT)
                return
            offers += [f"{name} at {rates.get(item, 0)} Hz" for item, name in zip(items, names, strict=True)]
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
        remedy = "check the cable, the port and the baud rate"
        raise NotReady(self._path, f"no MTi answers at {self._baud} baud", remedy)

    def _wait_for_data(self) -> None:
        """Wait for data of a device that is not configured; start its measurement where it waits for that."""
        for _ in range(2):
            deadline = time.monotonic() + 2.0 * ANSWER_S
            while time.monotonic() < deadline and not self._stop.is_set():
                if any(frame.mid == xbus.DATA for frame in self._frames.feed(self._read_bytes())):
                    return
            self._port.write(xbus.build_frame(xbus.GO_TO_MEASUREMENT))
        remedy = "check cable, port, baud rate and outputs, or name a rate, as @100, for the device to be configured"
        raise NotReady(self._path, f"no MTData2 comes at {self._baud} baud", remedy)

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
                    self._inbox.count({f"reconnections of {self.segment}": 1})
                    last_byte = time.monotonic()
                data = self._read_bytes()
                now = time.monotonic()
                if data:
                    last_byte = now
                    self.decode(data, now)
                    time.sleep(PAUSE_S)
                elif now - last_byte > SILENT_S:
                    raise OSError("nothing comes")
            except BadSource:
                self._stop.wait(RETRY_S)
            except OSError:  # SerialException is one
                self._disconnect()
                self._inbox.count({f"connections lost to {self.segment}": 1})

    def decode(self, data: bytes, arrival: float) -> None:
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
        if problems:
            self._inbox.count(problems)
        time_s, values = self._joiner.take()
        if len(time_s):
            self._inbox.put(self.segment, self._clock.to_host(time_s, arrival), values)


def _import_pyserial() -> ModuleType:
    try:
        import serial
    except ImportError:
        raise BadSource(f"mti: needs pyserial: {how_to_install('pyserial')}") from None
    module: ModuleType = serial
    return module


KIND = SourceKind("mti:DEVICE=SEGMENT,DEVICE=SEGMENT[@RATE]", open_spec)
