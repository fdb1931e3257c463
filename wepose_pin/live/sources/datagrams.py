"""What sources over UDP share: `DatagramSource`."""

from __future__ import annotations

import select
import socket
import time
from abc import abstractmethod
from collections.abc import Collection, Sequence
from typing import Any

from ...errors import BadSource
from ...recording.arrivals import Samples
from ..addresses import name_host
from .base import Source, Waiting
from .packets import NUMBERS

MAX_SIZE = 65536  # [bytes] of a datagram
MAX_DATAGRAMS = 2000  # in one `read`, so that a flood delays nobody for long
BUFFER = 4 << 20  # [bytes] that the system keeps while nobody reads: some seconds of five sensors at 1 kHz
COLLECT_S = 1.0  # [s] after the first sample in which the other sensors may appear
MAX_SENSORS = 64  # of any name


class DatagramSource(Source):
    """A UDP socket that takes datagrams from any sender; `_take` makes samples of them.

    Parameters
    ----------
    port : 0 for any free one; then see `address`
    sensors : to take; None: those that send while `open` waits
    segments : names that sensors may have; None: any, and `sensors` grows as new ones send
    wait_s : [s] for which `open` waits for the first sample where `sensors` are not given

    Attributes
    ----------
    kind, sender, hint : of the source, who sends to it, and in what form, for messages
    """

    kind: str
    sender: str
    hint = ""

    def __init__(
        self,
        host: str,
        port: int,
        sensors: Sequence[str] | None = None,
        segments: Collection[str] | None = NUMBERS,
        wait_s: float = 10.0,
    ) -> None:
        super().__init__(sensors or ())
        self.address, self._segments, self._wait_s = (host, port), segments, wait_s
        self._socket: socket.socket | None = None
        self._waiting: list[Samples] = []

    @abstractmethod
    def _take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        """Make samples of datagrams, each with its sender's address, that came by `now` [s]; one `Samples` a sensor."""

    def _serve(self, now: float) -> None:
        """Do what senders want to hear from time to time; `now` [s]."""

    def open(self, waiting: Waiting | None = None) -> None:
        """Bind; where the sensors are not given, wait for them, with `waiting` until it returns False.

        Raises
        ------
        BadSource
            The address cannot be bound, or without `waiting` nothing comes.
        """
        self._socket = self._bind(*self.address)
        self.address = self._socket.getsockname()[:2]
        if not self.sensors and self._segments is not None:
            self._find_sensors(self._segments, waiting)

    def _bind(self, host: str, port: int) -> socket.socket:
        """A socket at an address of this machine, which never blocks."""
        bound = None
        try:
            family, form, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            bound = socket.socket(family, form, protocol)
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            bound.bind(address)
        except (OSError, UnicodeError) as error:
            if bound is not None:
                bound.close()
            raise BadSource(
                f"{self.kind}:{host}:{port}: cannot listen there ({getattr(error, 'strerror', None) or error}); "
                f"an address of this machine and a port that nobody uses are needed"
            ) from None
        bound.setblocking(False)
        return bound

    def _find_sensors(self, segments: Collection[str], waiting: Waiting | None) -> None:
        """Take the sensors that send."""

        def collect(timeout_s: float) -> bool:
            self._waiting += self._read_new(timeout_s)
            return bool(self._waiting)

        self.sensors = tuple(segments)
        if self.wait_for(collect, self.describe_awaited, waiting, self._wait_s):
            deadline = time.monotonic() + COLLECT_S
            while time.monotonic() < deadline:
                collect(0.1)
            present = {samples.sensor for samples in self._waiting}
            self.sensors = tuple(segment for segment in segments if segment in present)

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:  # noqa: ARG002
        host, port = self.address
        dropped = ", ".join(f"{count} {problem}" for problem, count in self.problems.items())
        here = " (this machine only)" if host.startswith("127.") or host == "::1" else ""
        every = " (all addresses of this machine)" if host in ("0.0.0.0", "::") else ""
        where = f"{self.sender} at UDP {name_host(host)}:{port}{here}{every}{self.hint}"
        return where + (f"; dropped so far: {dropped}" if dropped else "")

    def read(self, timeout_s: float) -> list[Samples]:
        """Samples since the last call, one `Samples` a sensor."""
        waiting, self._waiting = self._waiting, []
        return waiting or self._read_new(timeout_s)

    def _read_new(self, timeout_s: float) -> list[Samples]:
        """Samples in the socket, or the first that come within `timeout_s`."""
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        while not samples and self._socket is not None:
            left = deadline - time.monotonic()
            self._serve(time.monotonic())
            if select.select([self._socket], [], [], max(left, 0.0))[0]:
                samples = self._take(self._receive(self._socket), time.monotonic())
            if left <= 0.0:
                break
        return samples

    def _receive(self, udp: socket.socket) -> list[tuple[bytes, Any]]:
        datagrams: list[tuple[bytes, Any]] = []
        while len(datagrams) < MAX_DATAGRAMS:
            try:
                datagram, sender = udp.recvfrom(MAX_SIZE)
            except BlockingIOError:
                break
            except OSError:  # an ICMP reply to another datagram
                self.count("errors of the socket")
                break
            datagrams.append((datagram, sender[:2]))
        return datagrams

    def _tracks(self, sensor: str) -> bool:
        """Whether a sensor is tracked; where it may have any name, a new one is from now on."""
        if self._segments is None and sensor not in self.sensors and len(self.sensors) < MAX_SENSORS:
            self.sensors += (sensor,)
        return sensor in self.sensors

    def close(self) -> None:
        """Free the port."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
