"""Noraxon MR3 CSV of myoMOTION, all sensors in one file.

Columns ``time`` [s], ``Noraxon MyoMotion-Segments-<segment>-Gyroscope-x (deg/s)`` and ``…-Acceleration-x (mG)``; some
versions name the latter ``<segment> Accel Sensor X (mG)``, with the side after the axis, ``Foot Accel Sensor X RT
(mG)``. Sides are ``RT`` and ``LT``. Lines of remarks may come before the names.

Source: names in published data sets and the programs that read them (NONAN GaitPrint and others).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..model import load_table
from .device import Device, make_device, read_converted
from .tables import Rows, read_columns, read_table

TIME = "time"
_SIGNAL = re.compile(
    r"(Noraxon MyoMotion-Segments-)?(?P<segment>.+?)[- ](?P<kind>Acceleration|Accel Sensor|Gyroscope|Gyro Sensor)[- ]"
    r"(?P<axis>[xyz])(?P<side> [LR]T)? ?\((?P<unit>.+)\)",
    re.IGNORECASE,
)


def is_noraxon(names: list[str]) -> bool:
    """Return whether columns of these names are those of myoMOTION."""
    return any(name.startswith("Noraxon MyoMotion") or " Accel Sensor " in name for name in names) and any(
        map(_SIGNAL.fullmatch, names)
    )


def read_noraxon(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' rates and specific forces; `rate_hz` replaces the file's own times.

    Raises
    ------
    MissingFile, BadData
        Not there; no export of MR3; no sensor with both; orientations asked for, which are of joints here.
    """
    if use == "orientation":
        raise BadData(f"{path}: course, pitch and roll of MR3 are not read as orientations; leave out data.use")
    rows = Rows(path)
    if not is_noraxon(rows.names):
        raise BadData(
            f"{path}: is no CSV of MR3: no columns such as Noraxon MyoMotion-Segments-Pelvis-Gyroscope-x (deg/s)"
        )
    columns: dict[str, dict[str, dict[str, tuple[str, str]]]] = {}  # segment → kind → axis → column, unit
    for name in rows.names:
        if match := _SIGNAL.fullmatch(name):
            label, kind = match["segment"].strip() + (match["side"] or ""), match["kind"].capitalize()
            columns.setdefault(label, {}).setdefault(kind, {})[match["axis"].lower()] = name, match["unit"]
    table, values = read_table(path), {}
    for label, kinds in columns.items():
        # The sensor's own signals, before those of the segment.
        gyro, accel = (
            next((kinds[kind] for kind in names if len(kinds.get(kind, {})) == 3), None)
            for names in (("Gyro sensor", "Gyroscope"), ("Accel sensor", "Acceleration"))
        )
        if gyro and accel:
            values[label] = {
                signal: read_converted(path, table, signal, [axes[axis][0] for axis in "xyz"], axes["x"][1])
                for signal, axes in (("gyro", gyro), ("accel", accel))
            }
    if not values:
        raise BadData(f"{path}: no segment has both Gyroscope and Acceleration in it; export both for each")
    if rate_hz:
        time = np.arange(table.height) / rate_hz
    else:
        stated = next((name for name in rows.names if name.lower().split(" ")[0].strip(",") == TIME), TIME)
        time = read_columns(table, [stated], str(path), str(path))[:, 0]
    left_out = [label for label in columns if label not in values]
    facts = {"devices": ", ".join(left_out), "signals": "gyro and accel"}
    missing = (Diagnostic("devices-left-out", WARNING, path.name, len(left_out), facts=facts),) if left_out else ()
    labels = {label: load_table().guess_segment(label) for label in values}
    return make_device("noraxon", "raw", dict.fromkeys(values, time), values, labels, missing)
