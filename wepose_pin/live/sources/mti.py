"""Xsens MTi sensors on serial ports, one port a sensor; the protocol is `xbus`'s."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Mapping
from queue import Empty, SimpleQueue
from types import ModuleType
from typing import Any

from ...errors import BadSource
from ...recording.arrivals import Samples
from . import xbus
from .checks import UNSOUND, sound
from .clocks import HostClock

# Plain outputs go up to this rate on every MTi; faster ones are asked of the HR outputs first.
PLAIN_HZ = 100
ANSWER_S = 0.5
TRIES = 3
# A port that is silent for this long is opened anew: not every adapter says that its cable was pulled.
SILENT_S = 3.0
RETRY_S = 1.0
WAIT_S = 0.05
# After bytes, so long until the next are taken [s]: at 1 kHz two packets come at once, and cost half.
PAUSE_S = 0.002
# So many chunks wait while nobody reads; then the newest are thrown away.
MOST_WAITING = 20_000


class MTiSource:
    """Sensors on `devices` (segment → port); a port that vanishes is looked for until it is back.

    Parameters
    ----------
    rate_hz : the devices are configured to send gyro and accel at this rate, and keep that; None: as they are set up
    baud : of the ports; a device on USB takes any

    Notes
    -----
    One thread a port reads and decodes, so that arrival is stamped in time.
    """

    def __init__(self, devices: Mapping[str, str], rate_hz: int | None = None, baud: int = 115200) -> None:
        self.sensors = tuple(devices)
        self.rate_hz: float | None = rate_hz
        self.problems: dict[str, int] = {}
        self._queue: SimpleQueue[Samples | tuple[str, int]] = SimpleQueue()
        self._devices = [_Device(segment, port, rate_hz, baud, self._queue) for segment, port in devices.items()]

    def open(self) -> None:
        """Open and configure every port, then listen.

        Raises
        ------
        BadSource
            A port is not there, no MTi answers, or it cannot send at the rate.
        """
        try:
            for device in self._devices:
                device.open()
        except BadSource:
            self.close()
            raise
        for device in self._devices:
            device.start()

    def read(self, timeout_s: float) -> list[Samples]:
        """What came, in the order of arrival."""
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        while not samples:
            try:
                self._sort(self._queue.get(timeout=max(deadline - time.monotonic(), 0.0)), samples)
            except Empty:
                break
        for _ in range(self._queue.qsize()):
            self._sort(self._queue.get(), samples)
        return samples

    def clock(self) -> float:
        """Now [s], monotonic."""
        return time.monotonic()

    def close(self) -> None:
        """Stop listening and free the ports."""
        for device in self._devices:
            device.close()

    def _sort(self, found: Samples | tuple[str, int], samples: list[Samples]) -> None:
        if isinstance(found, Samples):
            samples.append(found)
        else:
            self.problems[found[0]] = self.problems.get(found[0], 0) + found[1]


class _Device:
    """One port, and the thread that listens to it."""

    def __init__(
        self, segment: str, path: str, rate_hz: int | None, baud: int, queue: SimpleQueue[Samples | tuple[str, int]]
    ) -> None:
        self._segment, self._path, self._rate_hz, self._baud = segment, path, rate_hz, baud
        self._queue = queue
        self._serial = _pyserial()
        self._port: Any = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        self._stop.clear()
        self.connect()

    def connect(self) -> None:
        """Open the port and bring the device to measure; raises `BadSource`."""
        try:
            self._port = self._serial.Serial(self._path, self._baud, timeout=WAIT_S, write_timeout=1.0, exclusive=True)
            self._frames, self._joiner, self._clock = xbus.Frames(), xbus.Joiner(), HostClock()
            if self._rate_hz is None:
                self._measure()
            else:
                self._configure(self._rate_hz)
            self._counted = self._counts()  # a stream that is cut into begins with half a frame
        except (OSError, ValueError) as error:  # SerialException is an OSError
            self._drop()
            why = getattr(error, "strerror", None) or str(error)
            raise BadSource(
                f"mti:{self._path}: cannot open the port ({why}); a serial port that is there, may be read and is not "
                f"in use, as /dev/ttyUSB0"
            ) from None
        except BadSource:
            self._drop()
            raise

    def start(self) -> None:
        self._thread = threading.Thread(target=self._listen, name=f"mti {self._path}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._drop()

    def _drop(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    # Talking ---------------------------------------------------------------------------------------------------------

    def _configure(self, rate_hz: int) -> None:
        self._ask(xbus.GO_TO_CONFIG)
        found = []
        for hr in (False, True) if rate_hz <= PLAIN_HZ else (True, False):
            items = xbus.RATE_OF_TURN_HR if hr else xbus.RATE_OF_TURN, xbus.ACCELERATION_HR if hr else xbus.ACCELERATION
            names = ("RateOfTurnHR", "AccelerationHR") if hr else ("RateOfTurn", "Acceleration")
            answer = self._ask(xbus.SET_OUTPUT, xbus.output_items(rate_hz, hr))
            if answer.mid == xbus.ERROR:
                found.append(f"{names[0]}: {xbus.error_words(answer.data)}")
                continue
            rates = xbus.granted(answer.data)
            if all(rates.get(item) == rate_hz for item in items):
                self._ask(xbus.GO_TO_MEASUREMENT)
                return
            found += [f"{name} at {rates.get(item, 0)} Hz" for item, name in zip(items, names, strict=True)]
        raise BadSource(
            f"mti:{self._path}: does not send rate of turn and acceleration at {rate_hz} Hz; it offers "
            f"{', '.join(found)}; choose a rate that it has"
        )

    def _ask(self, mid: int, data: bytes = b"") -> xbus.Frame:
        """Send a message; the acknowledgement, or the error that is the answer to SetOutputConfiguration."""
        for _ in range(TRIES):
            self._port.write(xbus.frame(mid, data))
            deadline = time.monotonic() + ANSWER_S
            while time.monotonic() < deadline and not self._stop.is_set():
                for found in self._frames.feed(self._bytes()):
                    if found.mid == mid + 1 or (found.mid == xbus.ERROR and mid == xbus.SET_OUTPUT):
                        return found
                    if found.mid == xbus.ERROR and mid != xbus.GO_TO_CONFIG:  # then it may be of before
                        raise BadSource(f"mti:{self._path}: the device says: {xbus.error_words(found.data)}")
        raise BadSource(
            f"mti:{self._path}: no MTi answers at {self._baud} baud; check the cable, the port and the baud rate"
        )

    def _measure(self) -> None:
        """Wait for data of a device that is left as it is set up; wake it where it waits to be configured."""
        for _ in range(2):
            deadline = time.monotonic() + 2.0 * ANSWER_S
            while time.monotonic() < deadline and not self._stop.is_set():
                if any(found.mid == xbus.DATA for found in self._frames.feed(self._bytes())):
                    return
            self._port.write(xbus.frame(xbus.GO_TO_MEASUREMENT))
        raise BadSource(
            f"mti:{self._path}: no MTData2 comes at {self._baud} baud; check cable, port, baud rate and outputs, "
            f"or name a rate, as @100, for the device to be configured"
        )

    def _bytes(self) -> bytes:
        """What came, or nothing after a while; below pyserial, whose `read` costs twice as much."""
        port = self._port.fileno()
        if not select.select([port], [], [], WAIT_S)[0]:
            return b""
        found = os.read(port, 4096)
        if not found:
            raise OSError("the port is gone")
        return found

    # Listening -------------------------------------------------------------------------------------------------------

    def _listen(self) -> None:
        heard = time.monotonic()
        while not self._stop.is_set():
            try:
                if self._port is None:
                    self.connect()
                    self._put((f"reconnections of {self._segment}", 1))
                    heard = time.monotonic()
                data = self._bytes()
                now = time.monotonic()
                if data:
                    heard = now
                    self._decode(data, now)
                    time.sleep(PAUSE_S)
                elif now - heard > SILENT_S:
                    self._lost()
            except BadSource:
                self._stop.wait(RETRY_S)
            except OSError:  # SerialException is one
                self._lost()

    def _lost(self) -> None:
        self._drop()
        self._put((f"connections lost to {self._segment}", 1))

    def _decode(self, data: bytes, arrival: float) -> None:
        for found in self._frames.feed(data):
            if found.mid == xbus.DATA:
                try:
                    self._joiner.add(xbus.packet(found.data))
                except xbus.Malformed:
                    self._put(("malformed MTData2 packets", 1))
            elif found.mid == xbus.ERROR:
                self._put((f"{self._segment} says: {xbus.error_words(found.data)}", 1))
        self._report()
        device_time, values = self._joiner.take()
        good = sound(device_time, values)
        if not good.all():
            self._put((UNSOUND, int((~good).sum())))
            device_time, values = device_time[good], values[good]
        if not len(device_time):
            return
        host = self._clock.to_host(device_time, arrival)
        self._put(Samples(self._segment, host, values[:, :3], values[:, 3:]))

    def _report(self) -> None:
        """Tell what frames and joiner counted since the last time."""
        names = ("bytes skipped", "bad checksums", "packets without SampleTimeFine", "rates without an acceleration")
        now = self._counts()
        for name, new, old in zip(names, now, self._counted, strict=True):
            if new > old:
                self._put((name, new - old))
        self._counted = now

    def _counts(self) -> tuple[int, ...]:
        return self._frames.skipped, self._frames.bad_checksums, self._joiner.untimed, self._joiner.alone

    def _put(self, found: Samples | tuple[str, int]) -> None:
        if self._queue.qsize() < MOST_WAITING:
            self._queue.put(found)


def _pyserial() -> ModuleType:
    try:
        import serial
    except ImportError:
        raise BadSource("mti: pyserial is not installed; pip install 'wepose-pin[live]'") from None
    module: ModuleType = serial
    return module
