"""Samples from UDP datagrams of JSON lines (docs/live-sources.md); what sources over UDP share."""

from __future__ import annotations

import contextlib
import json
import select
import socket
import time
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import BadData, BadOption, BadSource, one_of
from ...readers.device import ACCEL_UNITS, GYRO_UNITS
from ...recording.arrivals import Samples
from . import MAX_TIME, HostClock, Source, SourceKind, SourceOptions

LOOPBACK = "127.0.0.1"
MAX_DATAGRAMS = 2000  # in one `read`, so that a flood delays nobody for long
BUFFER = 4 << 20  # [bytes] that the system keeps while nobody reads: some seconds of five sensors at 1 kHz
COLLECT_S = 3.0  # [s] after the first sample in which the other sensors may appear
MAX_SPEED = 20.0  # of a sender's clock relative to ours; above it, the sender's times are not in seconds
MAX_SENSORS = 64  # of any name
MAX_CLOCKS = 64  # of senders; one that opens a new socket for each datagram has many
LONGEST_NAME = 24  # letters
UNITS = {"gyro_unit": GYRO_UNITS, "accel_unit": ACCEL_UNITS}  # key → unit → factor to SI
SI = {"gyro_unit": "rad/s", "accel_unit": "m/s^2"}
JSON_LINE = '{"sensor": "torso", "t": 0.1, "gyro": [0, 0, 0], "accel": [0, 0, 9.8]}'


def parse_address(text: str, option: str, example_port: int) -> tuple[str, int]:
    """Host and port of ``PORT``, of this machine, or ``HOST:PORT``; raises `BadOption` for anything else."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        examples = f"{example_port} or 192.168.1.20:{example_port}"
        raise BadOption(f"{option} {text}: a port or HOST:PORT is needed, as {examples}")
    return host or LOOPBACK, int(port)


def name_host(host: str) -> str:
    """The address under which others reach `host`; of "any address" that of this machine's network."""
    if host == "0.0.0.0":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
            probe.connect(("192.0.2.1", 9))  # sends nothing
            host = str(probe.getsockname()[0])
    return host


class DatagramSource(Source):
    """A UDP socket that takes datagrams from any sender; `take` makes samples of them.

    Parameters
    ----------
    port : 0 for any free one; then see `address`
    sensors : to take; None: those that send while it connects
    segments : names that sensors may have; None: any, and `sensors` grows as new ones send
    """

    kind: str  # of the source, for messages
    sender: str  # who sends to it

    def __init__(
        self, host: str, port: int, sensors: Sequence[str] | None = None, segments: Collection[str] | None = None
    ) -> None:
        super().__init__(sensors or ())
        self.address, self.segments = (host, port), segments
        self._socket: socket.socket | None = None
        self._searching = not self.sensors and segments is not None
        self._waiting: list[Samples] = []  # that came while it connected

    @abstractmethod
    def take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        """Make samples of datagrams, each with its sender's address, that came by `now` [s]."""

    def serve(self, now: float) -> None:
        """Do what senders want to hear from time to time; `now` [s]."""

    def open(self) -> None:
        """Bind; raises `BadSource` where the address cannot be bound."""
        host, port = self.address
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            self._socket.bind((host, port))
        except (OSError, UnicodeError) as error:
            self.close()
            reason = getattr(error, "strerror", None) or error
            needed = "an address of this machine and a port that nobody uses are needed"
            raise BadSource(f"{self.kind}:{host}:{port}: cannot listen there ({reason}); {needed}") from None
        self._socket.setblocking(False)
        self.address = self._socket.getsockname()[:2]
        if self._searching:
            self.sensors = tuple(self.segments or ())

    def connect(self, timeout_s: float) -> bool:
        """Wait for sensors where none are given: those that send within `COLLECT_S` of the first sample."""
        if not self._searching:
            return True
        self._waiting += self._read_new(timeout_s)
        if not self._waiting:
            return False
        deadline = time.monotonic() + COLLECT_S
        while time.monotonic() < deadline:
            self._waiting += self._read_new(0.1)
        present = {samples.sensor for samples in self._waiting}
        self.sensors = tuple(segment for segment in self.sensors if segment in present)
        self._searching = False
        return True

    def describe_awaited(self) -> str:
        host, port = self.address
        dropped = ", ".join(f"{count} {problem}" for problem, count in self.problems.items())
        here = " (this machine only)" if host.startswith("127.") else ""
        where = f"{self.sender} at UDP {name_host(host)}:{port}{here}"
        return where + (f"; dropped so far: {dropped}" if dropped else "")

    def read(self, timeout_s: float) -> list[Samples]:
        waiting, self._waiting = self._waiting, []
        return waiting or self._read_new(timeout_s)

    def _read_new(self, timeout_s: float) -> list[Samples]:
        deadline = time.monotonic() + timeout_s
        while self._socket is not None:
            left = deadline - time.monotonic()
            self.serve(time.monotonic())
            if select.select([self._socket], [], [], max(left, 0.0))[0]:
                datagrams: list[tuple[bytes, Any]] = []
                with contextlib.suppress(OSError):  # BlockingIOError: there are no more; else an ICMP reply
                    while len(datagrams) < MAX_DATAGRAMS:
                        datagrams.append(self._socket.recvfrom(65536))
                if samples := self.take(datagrams, time.monotonic()):
                    return samples
            if left <= 0.0:
                break
        return []

    def send(self, data: bytes, to: Any) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, to)

    def tracks(self, sensor: str) -> bool:
        """Whether a sensor is tracked; where it may have any name, a new one is from now on."""
        if self.segments is None and sensor not in self.sensors and len(self.sensors) < MAX_SENSORS:
            self.sensors += (sensor,)
        return sensor in self.sensors

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def open_spec(rest: str, options: SourceOptions) -> UdpSource:
    """The source of ``udp:[HOST:]PORT[,gyro_unit=…][,accel_unit=…]``."""
    address, *stated = rest.split(",")
    host, port = parse_address(address, f"source '{options.spec}':", 9000)
    units: dict[str, str] = {}
    for option in stated:
        key, _, unit = option.partition("=")
        if key not in UNITS:
            raise options.error(f"'{option}' is no unit; {one_of(UNITS, key)}, as gyro_unit=deg/s")
        if unit not in UNITS[key]:
            raise options.error(f"{key} '{unit}' is not known; {one_of(UNITS[key], unit)}")
        units[key] = unit
    return UdpSource(host, port, options.sensors, None if options.any_name else options.segments, units)


class UdpSource(DatagramSource):
    """Samples of raw sensors, in `units` where a line states none; other parameters and errors as `DatagramSource`.

    Times of each sender, an address and port, are mapped to our clock (`HostClock`). Reading raises `BadData` when no
    sender's times are in seconds; if only some are not, their samples are dropped and counted.
    """

    kind, sender = "udp", "samples"

    def __init__(
        self,
        host: str,
        port: int,
        sensors: Sequence[str] | None = None,
        segments: Collection[str] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(host, port, sensors, segments)
        self._units = {**SI, **(units or {})}
        self._clocks: dict[Any, HostClock] = {}  # of each sender

    def take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        by_sender: dict[Any, list[Samples]] = {}  # together, since its newest sample determines its clock best
        for datagram, sender in datagrams:
            for line in filter(bytes.strip, datagram.splitlines()):
                try:
                    samples = self._decode(line)
                except ValueError as error:
                    self.count(str(error))
                else:
                    by_sender.setdefault(sender, []).append(samples)
        sound: list[Samples] = []
        for sender, own in by_sender.items():
            if len(self._clocks) >= MAX_CLOCKS:
                self._clocks.clear()
            clock = self._clocks.setdefault(sender, HostClock())
            times = clock.to_host(np.concatenate([each.time for each in own]), now)
            if clock.speed > MAX_SPEED:
                factor = float(f"{clock.speed:.1g}")
                problem = f"t grows {factor:.0f} times faster than this machine's clock; seconds are needed"
                if all(each.speed > MAX_SPEED for each in self._clocks.values()):
                    raise BadData(f"udp:{self.address[0]}:{self.address[1]}: {problem}")
                self.count(f"samples whose {problem}", len(times))
                continue
            for each in own:
                sound += self.keep_plausible(each._replace(time=times[: len(each.time)]))
                times = times[len(each.time) :]
        return sound

    def _decode(self, line: bytes) -> Samples:
        """The samples in a line of JSON, in SI units, on the sender's clock; raises `ValueError` with the problem."""
        try:
            message = json.loads(line)
            sensor, stated = message["sensor"], {key: str(message.get(key, unit)) for key, unit in self._units.items()}
            time, gyro, accel = (_read_numbers(message[key]) for key in ("t", "gyro", "accel"))
            if not (time.size and gyro.shape == accel.shape == (*time.shape, 3)):
                raise ValueError("shapes")
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            raise ValueError(f"lines that are not as {JSON_LINE}") from None
        is_name = isinstance(sensor, str) and 0 < len(sensor) <= LONGEST_NAME
        if not is_name or (self.segments is not None and sensor not in self.segments):
            raise ValueError(f"samples of an unknown sensor: {str(sensor)[:LONGEST_NAME]!r}")
        for key, known in UNITS.items():
            if stated[key] not in known:
                raise ValueError(f"JSON lines with {key} {stated[key][:LONGEST_NAME]!r}; {one_of(known)}")
        if not np.abs(time).max() < MAX_TIME:
            raise ValueError(f"samples with times over {MAX_TIME:g} s, which no clock has; t is in seconds")
        if not self.tracks(sensor):
            raise ValueError(f"samples of {sensor}, which is not tracked")
        gyro, accel = gyro * GYRO_UNITS[stated["gyro_unit"]], accel * ACCEL_UNITS[stated["accel_unit"]]
        return Samples(sensor, time.reshape(-1), gyro.reshape(-1, 3), accel.reshape(-1, 3))


def _read_numbers(value: Any) -> np.ndarray:
    """A number of JSON, or lists of them; texts and booleans, which NumPy would convert, are refused."""
    array = np.array(value, dtype=object)
    if not all(type(each) in (int, float) for each in array.flat):
        raise ValueError("not all are numbers")
    return array.astype(float)


KIND = SourceKind("udp:[HOST:]PORT[,gyro_unit=deg/s][,accel_unit=g]", open_spec)
