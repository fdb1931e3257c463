"""Samples from UDP datagrams: lines of JSON, or packed binary (docs/live-sources.md)."""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...errors import one_of
from ...readers.device import ACCEL_UNITS, GYRO_UNITS
from ...recording.arrivals import Samples
from ..addresses import LOOPBACK, parse_address
from .base import MAX_TIME, SourceKind, SourceOptions
from .clocks import HostClock
from .datagrams import DatagramSource

MAX_CLOCKS = 64  # of senders; one that opens a new socket for each datagram has many
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

    Times of each sender, an address and port, are mapped to our clock (`HostClock`). `units` are ``gyro_unit`` and
    ``accel_unit`` of what does not state its own.
    """

    kind, sender = "udp", "samples"

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
        self._clocks: dict[Any, HostClock] = {}  # of each sender

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
            for batch in batches:
                if self._tracks(batch.sensor):
                    by_sender.setdefault(sender, []).append(batch)
                    if math.isfinite(batch.battery):
                        self._batteries[batch.sensor] = batch.battery
                else:
                    problems.append(f"samples of {batch.sensor}, which is not tracked")
            for problem in problems:
                self.count(problem)
        parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for sender, batches in by_sender.items():
            if len(self._clocks) >= MAX_CLOCKS:
                self._clocks.clear()
            clock = self._clocks.setdefault(sender, HostClock())
            times = clock.to_host(np.concatenate([batch.time for batch in batches]), now)
            for batch in batches:
                own, times = times[: len(batch.time)], times[len(batch.time) :]
                parts.setdefault(batch.sensor, []).append((own, batch.values))
        samples: list[Samples] = []
        for sensor, pieces in parts.items():
            time, values = (np.concatenate(column) for column in zip(*pieces, strict=True))
            samples += self.keep_plausible(sensor, time, values)
        return samples


def decode(
    datagram: bytes, segments: Collection[str] | None = NUMBERS, units: Mapping[str, str] = SI
) -> tuple[list[Batch], list[str]]:
    """The batches in a datagram, and a problem for each line that is dropped; raises nothing.

    `segments` are names of sensors in lines of JSON; None: any. `units` are of what does not state its own.
    """
    batches: list[Batch] = []
    problems: list[str] = []
    is_binary = datagram[:4] == MAGIC
    for part in [datagram] if is_binary else filter(bytes.strip, datagram.splitlines()):
        try:
            batch, stated = _decode_packet(part, units) if is_binary else _decode_line(part, segments, units)
        except Malformed as error:
            problems.append(str(error))
            continue
        if not np.abs(batch.time).max() < MAX_TIME:  # no clock has it
            problems.append("samples with times that no clock has")
            continue
        factors = np.repeat([known[stated[key]] for key, known in UNITS.items()], 3)
        batches.append(batch._replace(values=batch.values * factors))
    return batches, problems


def _decode_packet(datagram: bytes, units: Mapping[str, str]) -> tuple[Batch, Mapping[str, str]]:
    """The samples of a binary packet, and their units."""
    try:
        _, version, number, count, begin = HEADER.unpack_from(datagram)
        (checksum,) = CRC.unpack(datagram[HEADER.size + count * SAMPLE.itemsize :])
    except struct.error:
        raise Malformed("binary packets of a wrong length") from None
    if version != VERSION:
        raise Malformed(f"binary packets of version {version}, not {VERSION}")
    if zlib.crc32(datagram[: -CRC.size]) != checksum:
        raise Malformed("binary packets with a bad checksum")
    if number >= len(NUMBERS) or count == 0:
        raise Malformed(f"samples of an unknown sensor: number {number}")
    samples = np.frombuffer(datagram, SAMPLE, count, HEADER.size)
    return Batch(NUMBERS[number], begin + samples["after"].astype(float), samples["values"].astype(float)), units


def _decode_line(
    line: bytes, segments: Collection[str] | None, units: Mapping[str, str]
) -> tuple[Batch, Mapping[str, str]]:
    """The samples of a line of JSON, and their units."""
    try:
        message = json.loads(line)
        sensor, battery = message["sensor"], float(message.get("battery", math.nan))
        stated = {key: str(message.get(key, unit)) for key, unit in units.items()}
        time, gyro, accel = (_read_numbers(message[key]) for key in ("t", "gyro", "accel"))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        raise Malformed('lines that are not as {"sensor": "torso", "t": 0.1, "gyro": [0, 0, 0], "accel": …}') from None
    is_name = isinstance(sensor, str) and 0 < len(sensor) <= MAX_NAME
    if not is_name or (segments is not None and sensor not in segments):
        raise Malformed(f"samples of an unknown sensor: {str(sensor)[:MAX_NAME]!r}")
    if not time.size or battery < 0.0 or battery > 1.0:
        raise Malformed("lines without samples, or whose battery is not a share, 0 to 1")
    if not gyro.shape == accel.shape == (*time.shape, 3):
        raise Malformed("lines whose gyro or accel is not three numbers for each time")
    for key, known in UNITS.items():
        if stated[key] not in known:
            raise Malformed(f"JSON lines with {key} {stated[key][:MAX_NAME]!r}; {one_of(known)}")
    values = np.concatenate([gyro, accel], axis=-1).reshape(-1, 6)
    return Batch(sensor, time.reshape(-1), values, battery), stated


def _read_numbers(value: Any) -> np.ndarray:
    """A number of JSON, or lists of them, as an array; texts and booleans, which NumPy would convert, are refused."""
    array = np.array(value, dtype=object)
    if not all(type(each) in (int, float) for each in array.flat):
        raise ValueError("not all are numbers")
    return array.astype(float)


KIND = SourceKind("udp:[HOST:]PORT[,gyro_unit=deg/s][,accel_unit=g]", open_spec)
