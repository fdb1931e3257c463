"""x-IMU3 sensors by x-io's own package, over TCP or a serial port (USB).

A connection receives in a thread of the package, which hands each inertial message on. Rates come in deg/s and specific
forces in g; times are microseconds since the sensor was switched on.
"""

from __future__ import annotations

import ipaddress
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import BadOption, BadSource, how_to_install
from ...recording.arrivals import Samples
from ...recording.limits import STANDARD_GRAVITY
from ..addresses import parse_address
from ..state import join_names
from .base import Source
from .checks import IMPLAUSIBLE, keep_plausible
from .clocks import HostClock
from .waiting import Waiting, wait_for

TCP_PORT = 7000
POLL_S = 0.002  # [s]
MAX_ROWS = 100_000  # that wait for a read
_SCALE = np.repeat([np.pi / 180.0, STANDARD_GRAVITY], 3)


class Ximu3Source(Source):
    """One connection a sensor; one that is lost is opened again by the package.

    Parameters
    ----------
    devices : segment → ``HOST[:PORT]`` of a TCP connection, or a serial port such as ``/dev/ttyACM0``
    baud : of serial ports
    """

    def __init__(self, devices: Mapping[str, str], baud: int = 115200, wait_s: float = 10.0) -> None:
        super().__init__(devices)
        self._devices, self._baud, self._wait_s = dict(devices), baud, wait_s
        self._clocks = {segment: HostClock() for segment in devices}
        self._lock = threading.Lock()
        self._rows: dict[str, list[tuple[float, ...]]] = {segment: [] for segment in devices}
        self._connections: dict[str, Any] = {}
        self._keepers: list[Any] = []

    def open(self, waiting: Waiting | None = None) -> None:
        """Connect to every sensor, and wait for those that do not answer; with `waiting` until it returns False.

        Raises
        ------
        BadSource
            The package is missing, or without `waiting` a sensor does not answer.
        """
        try:
            import ximu3
        except ImportError as error:
            raise BadSource(f"ximu3: needs the package ximu3 ({error}): {how_to_install('ximu3')}") from None
        try:
            found = wait_for(lambda _: self._connect_all(ximu3), self._describe_unconnected, self._wait_s, waiting)
        except BadSource:
            self.close()
            raise
        if not found:
            self.close()

    def _connect_all(self, ximu3: Any) -> bool:
        for segment, device in self._devices.items():
            if segment in self._connections:
                continue
            connection = ximu3.Connection(make_config(ximu3, device, self._baud))
            try:
                connection.open()
            except Exception:  # the package has no error of its own
                time.sleep(POLL_S)
                continue
            connection.add_inertial_callback(lambda message, segment=segment: self._take(segment, message))
            connection.add_receive_error_callback(lambda _: self._count("messages that cannot be read"))
            self._connections[segment] = connection
            self._keepers.append(ximu3.KeepOpen(connection))
        return len(self._connections) == len(self._devices)

    def _describe_unconnected(self) -> str:
        return self.describe_awaited([segment for segment in self._devices if segment not in self._connections])

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:
        places = [
            f"{join_names([name])} at {at}" for name, at in self._devices.items() if name in sensors or not sensors
        ]
        return f"x-IMU3 sensors: {', '.join(places)}"

    def _take(self, segment: str, message: Any) -> None:
        """Take a message, in a thread of the package."""
        rate = message.gyroscope_x, message.gyroscope_y, message.gyroscope_z
        force = message.accelerometer_x, message.accelerometer_y, message.accelerometer_z
        with self._lock:
            rows = self._rows[segment]
            if len(rows) < MAX_ROWS:
                rows.append((time.monotonic(), 1e-6 * message.timestamp, *rate, *force))
            else:
                self.problems["samples that nobody read"] += 1

    def read(self, timeout_s: float) -> list[Samples]:
        """Samples since the last call, one `Samples` a sensor."""
        deadline = time.monotonic() + timeout_s
        while True:
            with self._lock:
                taken = {segment: rows for segment, rows in self._rows.items() if rows}
                self._rows |= {segment: [] for segment in taken}
            samples: list[Samples] = []
            for segment, rows in taken.items():
                table = np.array(rows)
                times = self._clocks[segment].to_host(table[:, 1], float(table[-1, 0]))
                plausible, dropped = keep_plausible(segment, times, table[:, 2:] * _SCALE)
                samples += plausible
                if dropped:
                    self._count(IMPLAUSIBLE, dropped)
            left = deadline - time.monotonic()
            if samples or left <= 0.0:
                return samples
            time.sleep(min(POLL_S, left))

    def close(self) -> None:
        """Disconnect."""
        self._keepers.clear()
        for connection in self._connections.values():
            connection.close()
        self._connections.clear()

    def _count(self, problem: str, number: int = 1) -> None:
        with self._lock:
            self.problems[problem] += number


def make_config(ximu3: Any, device: str, baud: int) -> Any:
    """Return the package's configuration of a connection to ``HOST[:PORT]`` or a serial port."""
    if device.startswith("/"):
        return ximu3.SerialConnectionConfig(device, baud, False)
    host, _, port = device.partition(":")
    return ximu3.TcpConnectionConfig(host, int(port) if port else TCP_PORT)


def check_device(device: str, spec: str) -> None:
    """Raise `BadOption` where a device is neither a serial port nor an IPv4 address with or without a port."""
    if device.startswith("/"):
        return
    host, colon, _ = device.partition(":")
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        raise BadOption(
            f"source '{spec}': '{host}' is no device; its IP address, as 192.168.1.2 or 192.168.1.2:{TCP_PORT}, or a "
            f"serial port, as /dev/ttyACM0"
        ) from None
    if colon:
        parse_address(device, f"source '{spec}':", TCP_PORT)
