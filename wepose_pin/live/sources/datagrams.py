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
from .base import Source

MAX_DATAGRAMS = 2000  # in one `read`, so that a flood delays nobody for long
BUFFER = 4 << 20  # [bytes] that the system keeps while nobody reads: some seconds of five sensors at 1 kHz
COLLECT_S = 1.0  # [s] after the first sample in which the other sensors may appear
MAX_SENSORS = 64  # of any name


class DatagramSource(Source):
    """A UDP socket that takes datagrams from any sender; `_take` makes samples of them.

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
        self.address, self._segments = (host, port), segments
        self._socket: socket.socket | None = None
        self._searching = not self.sensors and segments is not None
        self._waiting: list[Samples] = []  # that came while it connected

    @abstractmethod
    def _take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        """Make samples of datagrams, each with its sender's address, that came by `now` [s]; one `Samples` a sensor."""

    def _serve(self, now: float) -> None:
        """Do what senders want to hear from time to time; `now` [s]."""

    def open(self) -> None:
        """Bind; raises `BadSource` where the address cannot be bound."""
        host, port = self.address
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            self._socket.bind((host, port))
        except (OSError, UnicodeError) as error:
            self.close()
            raise BadSource(
                f"{self.kind}:{host}:{port}: cannot listen there ({getattr(error, 'strerror', None) or error}); an "
                f"address of this machine and a port that nobody uses are needed"
            ) from None
        self._socket.setblocking(False)
        self.address = self._socket.getsockname()[:2]
        if self._searching:
            self.sensors = tuple(self._segments or ())

    def connect(self, timeout_s: float) -> bool:
        """Wait for sensors where none are given: those that send within a second of the first sample are taken."""
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

    def describe_awaited(self, sensors: Sequence[str] = ()) -> str:  # noqa: ARG002
        host, port = self.address
        dropped = ", ".join(f"{count} {problem}" for problem, count in self.problems.items())
        here = " (this machine only)" if host.startswith("127.") or host == "::1" else ""
        where = f"{self.sender} at UDP {name_host(host)}:{port}{here}"
        return where + (f"; dropped so far: {dropped}" if dropped else "")

    def read(self, timeout_s: float) -> list[Samples]:
        waiting, self._waiting = self._waiting, []
        return waiting or self._read_new(timeout_s)

    def _read_new(self, timeout_s: float) -> list[Samples]:
        samples: list[Samples] = []
        deadline = time.monotonic() + timeout_s
        while not samples and self._socket is not None:
            left = deadline - time.monotonic()
            self._serve(time.monotonic())
            if select.select([self._socket], [], [], max(left, 0.0))[0]:
                datagrams: list[tuple[bytes, Any]] = []
                try:
                    while len(datagrams) < MAX_DATAGRAMS:
                        datagrams.append(self._socket.recvfrom(65536))
                except OSError:  # BlockingIOError: there are no more; else an ICMP reply to another datagram
                    pass
                samples = self._take(datagrams, time.monotonic())
            if left <= 0.0:
                break
        return samples

    def _tracks(self, sensor: str) -> bool:
        """Whether a sensor is tracked; where it may have any name, a new one is from now on."""
        if self._segments is None and sensor not in self.sensors and len(self.sensors) < MAX_SENSORS:
            self.sensors += (sensor,)
        return sensor in self.sensors

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
