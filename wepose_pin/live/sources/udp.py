"""Samples from UDP datagrams, JSON or binary (`packets`)."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...recording.arrivals import Samples
from ..addresses import LOOPBACK
from .checks import IMPLAUSIBLE, MAX_TIME, keep_plausible
from .clocks import HostClock
from .datagrams import DatagramSource
from .packets import SI, Batch, decode

MAX_CLOCKS = 64  # of senders


class UdpSource(DatagramSource):
    """Samples of raw sensors; other parameters and errors as `DatagramSource`.

    Times of each sender, an address and port, are mapped to our clock (`HostClock`).

    Parameters
    ----------
    units : ``gyro_unit`` and ``accel_unit`` of what does not state its own
    """

    kind, sender, hint = "udp", "samples", ", in a format of docs/live-sources.md"

    def __init__(self, *args: Any, units: Mapping[str, str] | None = None, **options: Any) -> None:
        super().__init__(*args, **options)
        self._units = {**SI, **(units or {})}
        self._batteries: dict[str, float] = {}
        self._clocks: OrderedDict[tuple[str, int], HostClock] = OrderedDict()

    @property
    def batteries(self) -> dict[str, float]:
        return self._batteries

    def explain_unit(self, key: str, unit: str) -> str:
        host, port = self.address
        at = f"{port}" if host == LOOPBACK else f"{host}:{port}"
        return f'State the unit: --source udp:{at},{key}={unit}, or "{key}": "{unit}" in each line of JSON'

    def _take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        """Each sender's samples together, since its newest one determines its clock best."""
        came: dict[tuple[str, int], list[Batch]] = {}
        for datagram, sender in datagrams:
            batches, problems = decode(datagram, self._segments, self._units)
            for problem in problems:
                self._count(problem)
            batches = [batch for batch in batches if self._accepts(batch)]
            if batches:
                came.setdefault(sender, []).extend(batches)
        parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for sender, batches in came.items():
            times = self._clock_of(sender).to_host(np.concatenate([batch.time for batch in batches]), now)
            for batch in batches:
                own, times = times[: len(batch.time)], times[len(batch.time) :]
                parts.setdefault(batch.sensor, []).append((own, batch.values))
        return [samples for sensor, own in parts.items() for samples in self._join(sensor, own)]

    def _accepts(self, batch: Batch) -> bool:
        """Whether the batch is of a tracked sensor, with times that fit a clock."""
        if not self._tracks(batch.sensor):
            self._count(f"samples of {batch.sensor}, which is not tracked", len(batch.time))
            return False
        if not float(np.abs(batch.time).max()) < MAX_TIME:
            self._count(IMPLAUSIBLE, len(batch.time))
            return False
        if math.isfinite(batch.battery):
            self._batteries[batch.sensor] = batch.battery
        return True

    def _join(self, sensor: str, parts: list[tuple[np.ndarray, np.ndarray]]) -> list[Samples]:
        """The plausible samples of the parts as one; none where nothing is left."""
        times, values = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        samples, dropped = keep_plausible(sensor, times, values)
        if dropped:
            self._count(IMPLAUSIBLE, dropped)
        return samples

    def _clock_of(self, sender: tuple[str, int]) -> HostClock:
        clock = self._clocks.get(sender)
        if clock is None:
            clock = self._clocks[sender] = HostClock()
            if len(self._clocks) > MAX_CLOCKS:
                self._clocks.popitem(last=False)
        self._clocks.move_to_end(sender)
        return clock
