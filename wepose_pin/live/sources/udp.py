"""Samples from UDP datagrams, JSON or binary (`packets`)."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import BadOption, one_of
from ...recording.arrivals import Samples
from ..addresses import LOOPBACK, parse_address
from .base import IMPLAUSIBLE, MAX_TIME, SourceKind, SourceOptions
from .clocks import HostClock
from .datagrams import DatagramSource
from .packets import SI, UNITS, Batch, decode

MAX_CLOCKS = 64  # of senders


def open_spec(rest: str, options: SourceOptions) -> UdpSource:
    """The source of ``udp:[HOST:]PORT[,gyro_unit=…][,accel_unit=…]``."""
    address, *stated = rest.split(",")
    host, port = parse_address(address, f"source '{options.spec}':", 9000)
    units: dict[str, str] = {}
    for option in stated:
        key, _, unit = option.partition("=")
        if key not in UNITS:
            raise BadOption(f"source '{options.spec}': '{option}' is no unit; {one_of(UNITS, key)}, as gyro_unit=deg/s")
        if unit not in UNITS[key]:
            raise BadOption(f"source '{options.spec}': {key} '{unit}' is not known; {one_of(UNITS[key], unit)}")
        units[key] = unit
    segments = None if options.any_name else options.segments
    return UdpSource(host, port, options.sensors, segments, options.wait_s, units=units)


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
        by_sender: dict[tuple[str, int], list[Batch]] = {}
        for datagram, sender in datagrams:
            batches, problems = decode(datagram, self._segments, self._units)
            for problem in problems:
                self.count(problem)
            batches = [batch for batch in batches if self._accepts(batch)]
            if batches:
                by_sender.setdefault(sender, []).extend(batches)
        parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for sender, batches in by_sender.items():
            times = self._clock_of(sender).to_host(np.concatenate([batch.time for batch in batches]), now)
            for batch in batches:
                own, times = times[: len(batch.time)], times[len(batch.time) :]
                parts.setdefault(batch.sensor, []).append((own, batch.values))
        samples: list[Samples] = []
        for sensor, pieces in parts.items():
            time, values = (np.concatenate(column) for column in zip(*pieces, strict=True))
            samples += self.keep_plausible(sensor, time, values)
        return samples

    def _accepts(self, batch: Batch) -> bool:
        """Whether the batch is of a tracked sensor, with times that fit a clock."""
        if not self._tracks(batch.sensor):
            self.count(f"samples of {batch.sensor}, which is not tracked", len(batch.time))
            return False
        if not float(np.abs(batch.time).max()) < MAX_TIME:
            self.count(IMPLAUSIBLE, len(batch.time))
            return False
        if math.isfinite(batch.battery):
            self._batteries[batch.sensor] = batch.battery
        return True

    def _clock_of(self, sender: tuple[str, int]) -> HostClock:
        """The clock of a sender; that of the one that has been silent longest is forgotten."""
        clock = self._clocks.setdefault(sender, HostClock())
        self._clocks.move_to_end(sender)
        if len(self._clocks) > MAX_CLOCKS:
            self._clocks.popitem(last=False)
        return clock


KIND = SourceKind("udp:[HOST:]PORT[,gyro_unit=deg/s][,accel_unit=g]", open_spec)
