"""Formats of UDP datagrams: lines of JSON, or packed binary (docs/live-sources.md)."""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple, NoReturn

import numpy as np

from ...errors import one_of
from ...readers.device import ACCEL_UNITS, GYRO_UNITS

MAGIC = b"WPIN"
VERSION = 1
HEADER = struct.Struct("<4sBBHd")  # magic, version, sensor, count, time [s] of the first sample
SAMPLE = np.dtype([("after", "<f4"), ("values", "<f4", 6)])  # [s] after that time; gyro [rad/s], accel [m/s²]
CRC = struct.Struct("<I")
# The index is the sensor's number in the format, so names are never removed or moved.
NUMBERS = tuple(
    "torso left_upper_arm left_forearm right_upper_arm right_forearm pelvis head left_hand right_hand".split()
)
UNITS = {"gyro_unit": GYRO_UNITS, "accel_unit": ACCEL_UNITS}  # key → unit → factor to SI
SI = {"gyro_unit": "rad/s", "accel_unit": "m/s^2"}
MAX_NAME = 24  # letters of a sensor's name


class Batch(NamedTuple):
    """Samples of one sensor in one datagram, on the sender's clock."""

    sensor: str
    time: np.ndarray  # (m,) [s]
    values: np.ndarray  # (m, 6) gyro [rad/s], accel [m/s²]
    battery: float = math.nan  # share of its charge, 0 to 1; NaN: not said


class _Malformed(Exception):
    """A malformed line or datagram; its text is the problem."""


def decode(
    datagram: bytes, segments: Collection[str] | None = NUMBERS, units: Mapping[str, str] = SI
) -> tuple[list[Batch], list[str]]:
    """The batches in a datagram, and a problem for each line that is dropped; raises nothing.

    Parameters
    ----------
    segments : names of sensors in lines of JSON; None: any
    units : as `SI`, of packets and of lines that do not state their own
    """
    if datagram[:4] == MAGIC:
        try:
            batch = _decode_binary(datagram)
            return [batch._replace(values=batch.values * find_scale(units))], []
        except _Malformed as error:
            return [], [str(error)]
    sensors: dict[str, tuple[list[float], list[list[float]]]] = {}
    charge: dict[str, float] = {}
    problems = []
    for line in datagram.splitlines():
        if line.strip():
            try:
                sensor, time, rows, battery = _decode_line(line, segments, units)
            except _Malformed as error:
                problems.append(str(error))
                continue
            times, values = sensors.setdefault(sensor, ([], []))
            times.extend(time)
            values.extend(rows)
            charge[sensor] = battery
    batches = [Batch(name, np.array(time), np.array(rows), charge[name]) for name, (time, rows) in sensors.items()]
    return batches, problems


def find_scale(units: Mapping[str, str]) -> np.ndarray:
    """Factors (6,) from these units to rad/s and m/s²."""
    return np.repeat([known[units[key]] for key, known in UNITS.items()], 3)


def _decode_binary(datagram: bytes) -> Batch:
    if len(datagram) < HEADER.size + CRC.size:
        raise _Malformed("binary packets of a wrong length")
    _, version, number, count, begin = HEADER.unpack_from(datagram)
    if version != VERSION:
        raise _Malformed(f"binary packets of version {version}, not {VERSION}")
    if count == 0 or len(datagram) != HEADER.size + count * SAMPLE.itemsize + CRC.size:
        raise _Malformed("binary packets of a wrong length")
    if zlib.crc32(datagram[: -CRC.size]) != CRC.unpack_from(datagram, len(datagram) - CRC.size)[0]:
        raise _Malformed("binary packets with a bad checksum")
    if number >= len(NUMBERS):
        raise _Malformed(f"samples of an unknown sensor: number {number}")
    samples = np.frombuffer(datagram, SAMPLE, count, HEADER.size)
    return Batch(NUMBERS[number], begin + samples["after"].astype(float), samples["values"].astype(float))


def _refuse_constant(text: str) -> NoReturn:
    raise _Malformed(f"JSON lines with {text}, which is no number")


def _decode_line(
    line: bytes, segments: Collection[str] | None, units: Mapping[str, str]
) -> tuple[str, list[float], list[list[float]], float]:
    """Sensor, times (m), rows of gyro and accel (m, 6), battery; lists, which are faster for a single sample."""
    try:
        message = json.loads(line, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise _Malformed("lines that are no JSON") from None
    if not isinstance(message, dict) or not message.keys() >= {"sensor", "t", "gyro", "accel"}:
        raise _Malformed("JSON lines without sensor, t, gyro and accel")
    sensor = message["sensor"]
    is_name = isinstance(sensor, str) and 0 < len(sensor) <= MAX_NAME
    if not is_name or (segments is not None and sensor not in segments):
        raise _Malformed(f"samples of an unknown sensor: {str(sensor)[:MAX_NAME]!r}")
    time, gyro, accel = message["t"], message["gyro"], message["accel"]
    if not isinstance(time, list):
        time, gyro, accel = [time], [gyro], [accel]
    if not (isinstance(gyro, list) and isinstance(accel, list) and len(time) == len(gyro) == len(accel)):
        raise _Malformed("JSON lines whose t, gyro and accel differ in length")
    battery = message.get("battery", math.nan)
    if type(battery) not in (int, float) or battery < 0.0 or battery > 1.0:
        raise _Malformed("JSON lines whose battery is not a share, 0 to 1")
    rows = [_check_triple(a) + _check_triple(b) for a, b in zip(gyro, accel, strict=True)]
    stated = {key: message.get(key, units[key]) for key in UNITS}
    if stated != SI:
        for key, known in UNITS.items():
            if not isinstance(stated[key], str) or stated[key] not in known:
                raise _Malformed(f"JSON lines with {key} {str(stated[key])[:MAX_NAME]!r}; {one_of(known)}")
        rows = (find_scale(stated) * rows).tolist()
    return sensor, _check_numbers(time), rows, float(battery)


def _check_triple(row: Any) -> list[float]:
    if not isinstance(row, list) or len(row) != 3:
        raise _Malformed("JSON lines whose gyro or accel is not three numbers")
    return _check_numbers(row)


def _check_numbers(values: list[Any]) -> list[float]:
    """Floats of a list that is not empty and holds numbers only; true and false are none."""
    if not values or not {*map(type, values)} <= {int, float}:
        raise _Malformed("JSON lines with something else than numbers")
    try:
        return [float(value) for value in values]
    except OverflowError:
        raise _Malformed("JSON lines with something else than numbers") from None
