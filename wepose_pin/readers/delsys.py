"""Delsys CSV: Trigno Discover and EMGworks, all sensors in one file; each channel has a column of times of its own.

Trigno Discover: lines on the recording, a line of sensors (the name above the first of its columns, the serial number
in parentheses), one of their modes, one of channels (``ACC X Time Series (s)``, ``ACC X (G)``, ``GYRO X (deg/s)``),
their rates and periods. EMGworks: one line of names, ``X[s]`` and ``Trigno IM sensor 1: Acc 1.X (IM) [g]`` in turn, or
``ACC1.X`` after lines ``Label: ACC1.X Sampling frequency: 148.148 Unit: g``. A channel that is sampled less often ends
before the others. In countries with decimal commas semicolons separate the columns.

Source: programs that read such files (emgio and others).
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..diagnostics import Diagnostic
from ..errors import BadData
from ..model import load_table
from .device import Device, Text, convert, join_signals, make_device, parse_rows, read_first_lines

_DISCOVER = re.compile(r"(?P<kind>ACC|GYRO) (?P<axis>[XYZ]) \((?P<unit>.+)\)", re.IGNORECASE)
_EMGWORKS = re.compile(
    r"((?P<label>.+?): )?(?P<kind>acc|gyro) ?(?P<number>\d*)\.(?P<axis>[xyz]) ?(\(.*\))? ?(\[(?P<unit>.+)\])?",
    re.IGNORECASE,
)
_LABEL = re.compile(r"Label: *(?P<name>.+?) +Sampling frequency:.* Unit: *(?P<unit>\S+)", re.IGNORECASE)
MOST_LINES = 2000  # before the channels, one for each of them
_TIME = re.compile(r".*time series \(s\)|x ?\[s\]", re.IGNORECASE)
SIGNALS = {"acc": "accel", "gyro": "gyro"}


def is_delsys(lines: Sequence[str]) -> bool:
    """Return whether a file that begins with these lines is one of Delsys's."""
    return any(map(_LABEL.match, lines)) or _find_channels(lines) is not None


def read_delsys(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' rates and specific forces; `rate_hz` replaces the file's own times.

    Raises
    ------
    MissingFile, BadData
        Not there; no such export; no sensor with both; orientations asked for.
    """
    if use == "orientation":
        raise BadData(f"{path}: orientations of Delsys are not read; leave out data.use")
    lines = read_first_lines(path, MOST_LINES)
    units = {match["name"].strip(): match["unit"] for match in map(_LABEL.match, lines) if match}
    by_sensor = _find_channels(lines)
    if by_sensor is None:
        raise BadData(f"{path}: is no CSV of Delsys: no line of channels such as 'ACC X Time Series (s), ACC X (G)'")
    at, separator = by_sensor
    channels = _split(lines[at], separator)
    owners = _name_owners(_split(lines[at - 2], separator), len(channels)) if at > 1 else []
    body = path.read_bytes().split(b"\n")
    first = next(
        (k for k in range(at + 1, len(body)) if re.match(rb"\s*-?\d+([.,]\d+)?\s*([,;\t\r]|$)", body[k])), len(body)
    )
    names = [str(k) for k in range(len(channels))]
    text = Text(path, {}, parse_rows(path, b"\n".join(body[first:]), names, separator, at + 1, "CSV of Delsys"))
    columns: dict[str, dict[str, dict[str, tuple[int, str]]]] = {}  # label → signal → axis → column, unit
    for k, channel in enumerate(channels):
        match = _DISCOVER.fullmatch(channel) or _EMGWORKS.fullmatch(channel)
        if match:
            about = match.groupdict()
            label = about.get("label") or (
                f"sensor {about['number']}" if "number" in about else owners[k] if owners else ""
            )
            signals = columns.setdefault(label.strip() or "sensor", {})
            unit = match["unit"] or units.get(channel, "")
            signals.setdefault(SIGNALS[match["kind"].lower()], {})[match["axis"].lower()] = k, unit
    clocks, values, diagnostics = {}, {}, list[Diagnostic]()
    for label, signals in columns.items():
        if not all(len(signals.get(signal, {})) == 3 for signal in SIGNALS.values()):
            continue
        read = {signal: _read_signal(text, channels, signal, axes) for signal, axes in signals.items()}
        clocks[label], values[label], joined = join_signals(f"{path.name} {label}", read["gyro"], read["accel"])
        diagnostics += joined
        if rate_hz:
            clocks[label] = np.arange(len(clocks[label])) / rate_hz
    if not values:
        raise BadData(f"{path}: no sensor has three channels of ACC and three of GYRO; choose a mode of it with both")
    labels = {label: load_table().guess_segment(label) for label in values}
    return make_device("delsys", "raw", clocks, values, labels, diagnostics)


def _find_channels(lines: Sequence[str]) -> tuple[int, str] | None:
    """Find the line of channels and its separator."""
    for k, line in enumerate(lines):
        for separator in ",;\t":
            cells = _split(line, separator)
            times = any(map(_TIME.fullmatch, cells))
            if times and any(_DISCOVER.fullmatch(cell) or _EMGWORKS.fullmatch(cell) for cell in cells):
                return k, separator
    return None


def _split(line: str, separator: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]
    except csv.Error:  # no text
        return []


def _name_owners(cells: Sequence[str], width: int) -> list[str]:
    """Name the sensor of each column, from a line that has it above the first; without its serial number."""
    owners, owner = [], ""
    for cell in [*cells, *[""] * width][:width]:
        owner = cell or owner
        owners.append(owner)
    short = {owner: re.sub(r" *\(\d+\)$", "", owner) for owner in owners}
    return [owner if list(short.values()).count(short[owner]) > 1 else short[owner] for owner in owners]


def _read_signal(
    text: Text, channels: Sequence[str], signal: str, axes: dict[str, tuple[int, str]]
) -> tuple[np.ndarray, np.ndarray]:
    """Read times (n,) [s] of the axis x and values (n, 3) in SI; a column's times are in the one before it."""
    columns = [axes[axis][0] for axis in "xyz"]
    time = columns[0] - 1
    if time < 0 or not _TIME.fullmatch(channels[time]):
        raise BadData(f"{text.path}: no column of times right before '{channels[columns[0]]}'; export them too")
    values = text.numbers([str(k) for k in columns])
    return text.numbers([str(time)])[:, 0], convert(text.path, signal, values, axes["x"][1], channels[columns[0]])
