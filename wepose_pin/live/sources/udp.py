"""Samples from UDP datagrams: lines of JSON, or packed binary (docs/live-sources.md)."""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np

from ...errors import one_of
from ...readers.device import ACCEL_UNITS, GYRO_UNITS
from ...recording.arrivals import Samples
from ..addresses import LOOPBACK, parse_address
from .base import IMPLAUSIBLE, MAX_TIME, SourceKind, SourceOptions
from .clocks import HostClock
from .datagrams import DatagramSource

MAX_CLOCKS = 64  # of senders
MAX_NAME = 24  # letters of a sensor's name
MAGIC, VERSION = b"WPIN", 1
HEADER = struct.Struct("<4sBBHd")  # magic, version, sensor, count, time [s] of the first sample
SAMPLE = np.dtype([("after", "<f4"), ("values", "<f4", 6)])  # [s] after that time; gyro [rad/s], accel [m/s²]
CRC = struct.Struct("<I")
# The index is the sensor's number in the format, so names are never removed or moved.
NUMBERS = tuple(
    "torso left_upper_arm left_forearm right_upper_arm right_forearm pelvis head left_hand right_hand".split()
)
UNITS = {"gyro_unit": GYRO_UNITS, "accel_unit": ACCEL_UNITS}  # key → unit → factor to SI
SI = {"gyro_unit": "rad/s", "accel_unit": "m/s^2"}


class Batch(NamedTuple):
    """Samples of one sensor in a line or packet, on the sender's clock."""

    sensor: str
    time: np.ndarray  # (m,) [s]
    values: np.ndarray  # (m, 6) gyro [rad/s], accel [m/s²]
    battery: float = math.nan  # share of its charge, 0 to 1; NaN: not said


class Malformed(Exception):
    """A malformed line or datagram; its text is the problem."""


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
    """Samples of raw sensors; other parameters and errors as `DatagramSource`.

    Times of each sender, an address and port, are mapped to our clock (`HostClock`).

    Parameters
    ----------
    units : ``gyro_unit`` and ``accel_unit`` of what does not state its own
    """

    kind, sender, hint = "udp", "samples", ", in a format of docs/live-sources.md"

    def __init__(
        self,
        host: str,
        port: int,
        sensors: Sequence[str] | None = None,
        segments: Collection[str] | None = NUMBERS,
        units: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(host, port, sensors, segments)
        self._units, self._batteries = {**SI, **(units or {})}, dict[str, float]()
        self._clocks: dict[Any, HostClock] = {}  # sender → its clock, the one that was heard last at the end

    @property
    def batteries(self) -> dict[str, float]:
        return self._batteries

    def explain_unit(self, key: str, unit: str) -> str:
        host, port = self.address
        at = f"{port}" if host == LOOPBACK else f"{host}:{port}"
        return f'State the unit: --source udp:{at},{key}={unit}, or "{key}": "{unit}" in each line of JSON'

    def _take(self, datagrams: Sequence[tuple[bytes, Any]], now: float, /) -> list[Samples]:
        """Each sender's samples together, since its newest one determines its clock best."""
        by_sender: dict[Any, list[Batch]] = {}
        for datagram, sender in datagrams:
            batches, problems = decode(datagram, self._segments, self._units)
            for problem in problems:
                self.count(problem)
            accepted = [batch for batch in batches if self._accepts(batch)]
            if accepted:
                by_sender.setdefault(sender, []).extend(accepted)
        parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for sender, batches in by_sender.items():
            clock = self._clocks[sender] = self._clocks.pop(sender, HostClock())
            if len(self._clocks) > MAX_CLOCKS:
                del self._clocks[next(iter(self._clocks))]
            times = clock.to_host(np.concatenate([batch.time for batch in batches]), now)
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


def decode(
    datagram: bytes, segments: Collection[str] | None = NUMBERS, units: Mapping[str, str] = SI
) -> tuple[list[Batch], list[str]]:
    """The batches in a datagram, and a problem for each line that is dropped; raises nothing.

    Parameters
    ----------
    segments : names of sensors in lines of JSON; None: any
    units : as `SI`, of packets and of lines that do not state their own
    """
    batches: list[Batch] = []
    problems: list[str] = []
    is_binary = datagram[:4] == MAGIC
    for part in [datagram] if is_binary else datagram.splitlines():
        if part.strip():
            try:
                batch, stated = _decode_packet(part, units) if is_binary else _decode_line(part, segments, units)
            except Malformed as error:
                problems.append(str(error))
                continue
            if stated != SI:
                factors = np.repeat([known[stated[key]] for key, known in UNITS.items()], 3)
                batch = batch._replace(values=batch.values * factors)
            batches.append(batch)
    return batches, problems


def _decode_packet(datagram: bytes, units: Mapping[str, str]) -> tuple[Batch, Mapping[str, str]]:
    """The samples of a binary packet, and their units."""
    if len(datagram) < HEADER.size + CRC.size:
        raise Malformed("binary packets of a wrong length")
    _, version, number, count, begin = HEADER.unpack_from(datagram)
    if version != VERSION:
        raise Malformed(f"binary packets of version {version}, not {VERSION}")
    if count == 0 or len(datagram) != HEADER.size + count * SAMPLE.itemsize + CRC.size:
        raise Malformed("binary packets of a wrong length")
    if zlib.crc32(datagram[: -CRC.size]) != CRC.unpack_from(datagram, len(datagram) - CRC.size)[0]:
        raise Malformed("binary packets with a bad checksum")
    if number >= len(NUMBERS):
        raise Malformed(f"samples of an unknown sensor: number {number}")
    samples = np.frombuffer(datagram, SAMPLE, count, HEADER.size)
    return Batch(NUMBERS[number], begin + samples["after"].astype(float), samples["values"].astype(float)), units


def _refuse_constant(text: str) -> NoReturn:
    raise Malformed(f"JSON lines with {text}, which is no number")


def _decode_line(
    line: bytes, segments: Collection[str] | None, units: Mapping[str, str]
) -> tuple[Batch, Mapping[str, str]]:
    """The samples of a line of JSON, and their units."""
    try:
        message = json.loads(line, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise Malformed("lines that are no JSON") from None
    if not isinstance(message, dict) or not message.keys() >= {"sensor", "t", "gyro", "accel"}:
        raise Malformed("JSON lines without sensor, t, gyro and accel")
    sensor, battery = message["sensor"], message.get("battery", math.nan)
    is_name = isinstance(sensor, str) and 0 < len(sensor) <= MAX_NAME
    if not is_name or (segments is not None and sensor not in segments):
        raise Malformed(f"samples of an unknown sensor: {str(sensor)[:MAX_NAME]!r}")
    if type(battery) not in (int, float) or battery < 0.0 or battery > 1.0:
        raise Malformed("JSON lines whose battery is not a share, 0 to 1")
    stated = {key: message.get(key, unit) for key, unit in units.items()}
    for key, known in UNITS.items():
        if not isinstance(stated[key], str) or stated[key] not in known:
            raise Malformed(f"JSON lines with {key} {str(stated[key])[:MAX_NAME]!r}; {one_of(known)}")
    columns = message["t"], message["gyro"], message["accel"]
    time, gyro, accel = columns if isinstance(columns[0], list) else ([each] for each in columns)
    if not (isinstance(gyro, list) and isinstance(accel, list) and len(time) == len(gyro) == len(accel)):
        raise Malformed("JSON lines whose t, gyro and accel differ in length")
    if not all(isinstance(row, list) and len(row) == 3 for row in gyro + accel):
        raise Malformed("JSON lines whose gyro or accel is not three numbers")
    values = np.array([_check_numbers(a + b) for a, b in zip(gyro, accel, strict=True)])
    return Batch(sensor, np.array(_check_numbers(time)), values, float(battery)), stated


def _check_numbers(values: list[Any]) -> list[float]:
    """Floats of a list that is not empty and holds numbers only; true and false are none."""
    if values and {*map(type, values)} <= {int, float}:
        try:
            return [float(value) for value in values]
        except OverflowError:
            pass
    raise Malformed("JSON lines with something else than numbers")


KIND = SourceKind("udp:[HOST:]PORT[,gyro_unit=deg/s][,accel_unit=g]", open_spec)
