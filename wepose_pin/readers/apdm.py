"""APDM (Opal) CSV, as Motion Studio and Mobility Lab export it: all sensors of a recording in one file.

``Format=7``: three lines of names. The first has each sensor's number and name, the second what is measured
(Accelerometer [m/s²], Gyroscope [rad/s], Magnetometer, Barometer, Orientation), the third the axes; Time is in µs since
1970. Before that: ``Test Name:``, ``Sample Rate:``, then ``<sensor>/Acceleration/X`` and so on, and a line of units.
Orientations are quaternions (scalar first) of the sensor to a world with z up.

Source: OpenSim's APDM reader and the files it is tested with.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData, one_of
from ..model import load_table
from .device import Device, Text, make_table, parse_rows, read_first_lines

US = 1e-6
# What is measured → the signal, and its axes in the file.
KINDS = {
    "Accelerometer": "accel",
    "Acceleration": "accel",
    "Gyroscope": "gyro",
    "Angular Velocity": "gyro",
    "Orientation": "orientation",
}
AXES = {"accel": "XYZ", "gyro": "XYZ", "orientation": "SXYZ"}
UNITS = {"accel": {"m/s^2": 1.0, "m/s²": 1.0}, "gyro": {"rad/s": 1.0, "deg/s": np.pi / 180.0, "°/s": np.pi / 180.0}}


def is_apdm(lines: Sequence[str]) -> bool:
    """Return whether a file that begins with these lines is one of APDM's."""
    names = lines[2] if len(lines) > 2 else ""
    return lines[0].startswith("Format=7,") or (
        lines[0].startswith("Test Name:") and names.startswith("Time,") and "/Acceleration/X" in names
    )


def read_apdm(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' raw data where all have them, else their orientations; `use` selects one of the two.

    `rate_hz` replaces the file's own times.

    Raises
    ------
    MissingFile, BadData
        Not there; no CSV of APDM; not what `use` asks for.
    """
    head = read_first_lines(path, 4)
    if not is_apdm(head):
        raise BadData(f"{path}: is no CSV of APDM: neither 'Format=7' nor 'Test Name:' begins its first line")
    rows = [[cell.strip() for cell in line.split(",")] for line in head]
    newer = head[0].startswith("Format=")
    places, scale = _places_of_format_7(rows) if newer else _places_by_name(path, rows)
    lines = 3 if newer else 4
    names = [str(k) for k in range(len(rows[1] if newer else rows[2]))]
    body = path.read_bytes().split(b"\n", lines)[lines:]
    text = Text(path, {}, parse_rows(path, body[0] if body else b"", names, ",", lines, "CSV of APDM"))
    needed = {"raw": ("gyro", "accel"), "orientation": ("orientation",)}
    kinds = [use] if use else list(needed)
    signals = {
        kind: {
            label: its
            for label, its in places.items()
            if all(signal in its and [str(k) for k in its[signal]] in text for signal in needed[kind])
        }
        for kind in kinds
    }
    kind = next((kind for kind in kinds if signals[kind]), None)
    if kind is None:
        instead = "; leave out data.use" if use else ""
        raise BadData(
            f"{path}: no sensor in it has {' or '.join(' and '.join(needed[kind]) for kind in kinds)}{instead}"
        )
    values = {}
    for label, its in signals[kind].items():
        values[label] = {
            signal: scale.get(signal, 1.0) * text.numbers([str(k) for k in its[signal]]) for signal in needed[kind]
        }
        if kind == "orientation":
            values[label] = {"orientation": values[label]["orientation"][:, [1, 2, 3, 0]]}
    left_out = [label for label in places if label not in values]
    facts = {"devices": ", ".join(left_out), "signals": " and ".join(needed[kind])}
    missing = (Diagnostic("devices-left-out", WARNING, path.name, len(left_out), facts=facts),) if left_out else ()
    time = np.arange(text.cells.height) / rate_hz if rate_hz else (US if newer else 1.0) * text.numbers(["0"])[:, 0]
    labels = {label: load_table().guess_segment(label) for label in values}
    return Device("apdm", make_table(time, values), labels, kind, since_power_on=True, diagnostics=missing)


def _places_of_format_7(rows: Sequence[Sequence[str]]) -> tuple[dict[str, dict[str, list[int]]], dict[str, float]]:
    """Sensor → signal → its columns, from the three lines of names; a sensor begins where its accelerometer does."""
    who, kinds, _ = ([*row, *[""] * (len(rows[1]) - len(row))] for row in rows[:3])
    begins = [k for k, kind in enumerate(kinds) if kind == "Accelerometer"]
    places: dict[str, dict[str, list[int]]] = {}
    for first, last in zip(begins, [*begins, len(kinds)][1:], strict=True):
        number, *title = [cell for cell in who[first:last] if cell] or [f"sensor {len(places) + 1}"]
        label = title[0] if title and title[0] not in places else f"{title[0]} {number}" if title else number
        its = {KINDS[kinds[k]]: k for k in range(first, last) if kinds[k] in KINDS}
        places[label] = {signal: list(range(k, k + len(AXES[signal]))) for signal, k in its.items()}
    return places, {}


def _places_by_name(
    path: Path, rows: Sequence[Sequence[str]]
) -> tuple[dict[str, dict[str, list[int]]], dict[str, float]]:
    """Sensor → signal → its columns, from names as ``Lumbar/Acceleration/X``; and its factor to SI, by units."""
    at: dict[str, dict[str, dict[str, int]]] = {}
    scale: dict[str, float] = {}
    for k, name in enumerate(rows[2]):
        label, _, rest = name.partition("/")
        kind, _, axis = rest.partition("/")
        signal = KINDS.get(kind)
        if signal is None:
            continue
        at.setdefault(label, {}).setdefault(signal, {})["S" if axis == "Scalar" else axis] = k
        if signal in UNITS:
            unit = rows[3][k] if k < len(rows[3]) else ""
            if unit not in UNITS[signal]:
                raise BadData(f"{path}: '{name}' is in '{unit}'; {one_of(UNITS[signal], unit)}")
            if scale.setdefault(signal, UNITS[signal][unit]) != UNITS[signal][unit]:
                raise BadData(
                    f"{path}: '{name}' is in '{unit}', other columns of {signal} are not; export them in one unit"
                )
    return {
        label: {
            signal: [axes[axis] for axis in AXES[signal]]
            for signal, axes in its.items()
            if set(AXES[signal]) <= set(axes)
        }
        for label, its in at.items()
    }, scale
