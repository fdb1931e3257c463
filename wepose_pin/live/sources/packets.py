"""What a UDP datagram may hold: lines of JSON, or the packed binary (docs/live-sources.md)."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any, NamedTuple, NoReturn

import numpy as np

from ...recording import SEGMENTS

MAGIC = b"WPIN"
VERSION = 1
HEADER = struct.Struct("<4sBBHd")  # magic, version, sensor, count, time [s] of the first sample
SAMPLE = np.dtype([("after", "<f4"), ("values", "<f4", 6)])  # [s] after that time; gyro [rad/s], accel [m/s²]
CRC = struct.Struct("<I")
# The number that names a sensor; part of the format, so nothing is ever taken out or moved.
NUMBERS = (
    "torso",
    "left_upper_arm",
    "left_forearm",
    "right_upper_arm",
    "right_forearm",
    "pelvis",
    "head",
    "left_hand",
    "right_hand",
)
# Sensors that are unknown are named in the problems up to this many letters.
LONGEST_NAME = 24


class Batch(NamedTuple):
    """Samples of one sensor in one datagram, on the sender's clock."""

    sensor: str
    time: np.ndarray  # (m,) [s]
    values: np.ndarray  # (m, 6) gyro [rad/s], accel [m/s²]


class _Bad(Exception):
    """A line or datagram that is none; its text is the kind of problem."""


def decode(datagram: bytes) -> tuple[list[Batch], list[str]]:
    """The batches in a datagram, and what was wrong, one entry for each thing thrown away; raises nothing."""
    if datagram[:4] == MAGIC:
        try:
            return [_binary(datagram)], []
        except _Bad as bad:
            return [], [str(bad)]
    found: dict[str, tuple[list[float], list[list[float]]]] = {}
    problems = []
    for line in datagram.splitlines():
        if line.strip():
            try:
                sensor, time, rows = _line(line)
            except _Bad as bad:
                problems.append(str(bad))
                continue
            so_far = found.setdefault(sensor, ([], []))
            so_far[0].extend(time)
            so_far[1].extend(rows)
    return [Batch(sensor, np.array(time), np.array(rows)) for sensor, (time, rows) in found.items()], problems


def _binary(datagram: bytes) -> Batch:
    if len(datagram) < HEADER.size + CRC.size:
        raise _Bad("binary packets of a wrong length")
    _, version, number, count, begin = HEADER.unpack_from(datagram)
    if version != VERSION:
        raise _Bad(f"binary packets of version {version}, not {VERSION}")
    if count == 0 or len(datagram) != HEADER.size + count * SAMPLE.itemsize + CRC.size:
        raise _Bad("binary packets of a wrong length")
    if zlib.crc32(datagram[: -CRC.size]) != CRC.unpack_from(datagram, len(datagram) - CRC.size)[0]:
        raise _Bad("binary packets with a bad checksum")
    if number >= len(NUMBERS):
        raise _Bad(f"samples of an unknown sensor: number {number}")
    samples = np.frombuffer(datagram, SAMPLE, count, HEADER.size)
    return Batch(NUMBERS[number], begin + samples["after"].astype(float), samples["values"].astype(float))


def _no_number(text: str) -> NoReturn:
    raise _Bad(f"JSON lines with {text}, which is no number")


def _line(line: bytes) -> tuple[str, list[float], list[list[float]]]:
    """Sensor, times (m), and gyro and accel in one row (m, 6); plain lists, which are quicker for a single sample."""
    try:
        found = json.loads(line, parse_constant=_no_number)
    except (ValueError, RecursionError):  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise _Bad("lines that are no JSON") from None
    if not isinstance(found, dict) or not found.keys() >= {"sensor", "t", "gyro", "accel"}:
        raise _Bad("JSON lines without sensor, t, gyro and accel")
    sensor = found["sensor"]
    if sensor not in SEGMENTS:
        raise _Bad(f"samples of an unknown sensor: {str(sensor)[:LONGEST_NAME]!r}")
    time, gyro, accel = found["t"], found["gyro"], found["accel"]
    if not isinstance(time, list):
        time, gyro, accel = [time], [gyro], [accel]
    if not (isinstance(gyro, list) and isinstance(accel, list) and len(time) == len(gyro) == len(accel)):
        raise _Bad("JSON lines whose t, gyro and accel differ in length")
    return sensor, _numbers(time), [_triple(a) + _triple(b) for a, b in zip(gyro, accel, strict=True)]


def _triple(row: Any) -> list[float]:
    if not isinstance(row, list) or len(row) != 3:
        raise _Bad("JSON lines whose gyro or accel is not three numbers")
    return _numbers(row)


def _numbers(found: list[Any]) -> list[float]:
    """Floats, of a list that is not empty and holds numbers only; true and false are none."""
    if not found or not {*map(type, found)} <= {int, float}:
        raise _Bad("JSON lines with something else than numbers")
    try:
        return [float(value) for value in found]
    except OverflowError:
        raise _Bad("JSON lines with something else than numbers") from None
