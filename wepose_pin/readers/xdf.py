"""XDF, as LabRecorder writes streams of the lab streaming layer, by pyxdf.

A stream is one sensor or several, whose channels have labels and units (``acc_x`` in ``m/s^2``); what they measure is
found by their labels as in tables. Rates and specific forces may be in two streams whose names differ in that word
alone. Clocks are those of the streams, brought to one by pyxdf.

Source: sccn/xdf, specification; pyxdf's documentation.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..libraries import import_library, library_errors
from ..recording.limits import STANDARD_GRAVITY
from .device import ACCEL_UNITS, Device, Signal, check_measured, convert, make_device
from .guess import group_columns

NEEDS = "gyroscope and accelerometer, nor orientation, by the labels of its channels; they need labels as gyr_x"
MAGIC = b"XDF:", b"\x1f\x8b"  # the latter of gzip
_SIGNAL_WORDS = re.compile("accelerometer|gyroscope|accel|gyro|acc|gyr")


def read_xdf(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the streams, as `Format.read`; `rate_hz` replaces their times."""
    pyxdf = import_library("pyxdf", path, "an XDF")
    with path.open("rb") as file:
        if not file.read(4).startswith(MAGIC):
            raise BadData(f"{path}: is no XDF: it does not begin with 'XDF:'")
    logging.getLogger("pyxdf").setLevel(logging.CRITICAL)  # it reports what it mends
    with library_errors(path, "an XDF"):
        streams, _ = pyxdf.load_xdf(str(path))
    sensors: dict[str, dict[str, Signal]] = {}
    diagnostics: list[Diagnostic] = []
    if any(not stream.get("footer") for stream in streams):
        diagnostics.append(Diagnostic("file-incomplete", WARNING, path.name, facts={"variant": "footer"}))
    for stream in streams:
        values = stream["time_series"]
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or len(values) < 2:
            continue
        name = stream["info"]["name"][0] or "stream"
        columns = [f"{name} {label}" for label in _read_channels(stream, "label", values.shape[1])]
        units = dict(zip(columns, _read_channels(stream, "unit", values.shape[1]), strict=True))
        groups = group_columns(columns)
        for owner, signals in groups.items():
            label = name if owner == f"?{name.lower()}" or len(groups) == 1 else owner.removeprefix("?")
            for signal, channels in signals.items():
                read = values[:, [columns.index(channel) for channel in channels]].astype(float)
                check_measured(f"{path}: {signal} of {label}", read)
                if signal != "orientation":
                    unit = units[channels[0]] or _guess_unit(signal, read)
                    read = convert(path, signal, read, unit, channels[0])
                    if not units[channels[0]]:
                        facts = {"columns": channels[0], "unit": unit}
                        diagnostics.append(Diagnostic("file-assumption", WARNING, path.name, facts=facts))
                sensors.setdefault(label, {}).setdefault(signal, Signal(stream["time_stamps"], read))
    return make_device(path, _join_streams(sensors), NEEDS, use, rate_hz, diagnostics)


def _read_channels(stream: Mapping[str, Any], key: str, count: int) -> list[str]:
    """Read a text of each channel; empty where the stream describes none."""
    try:
        channels = stream["info"]["desc"][0]["channels"][0]["channel"]
        texts = [((channel.get(key) or [""])[0] or "").strip() for channel in channels]
    except (KeyError, IndexError, TypeError, AttributeError):
        texts = []
    return [*texts, *[""] * count][:count]


def _guess_unit(signal: str, values: np.ndarray) -> str:
    """Guess the unit of a signal: SI, or that in which the specific force is gravity's."""
    if signal == "gyro":
        return "rad/s"
    norm = max(float(np.nanmedian(np.linalg.norm(values, axis=1))), 1e-9)
    return min(ACCEL_UNITS, key=lambda unit: abs(np.log(norm * ACCEL_UNITS[unit] / STANDARD_GRAVITY)))


def _join_streams(sensors: Mapping[str, Mapping[str, Signal]]) -> dict[str, dict[str, Signal]]:
    """Join the rates of one stream with the specific forces of another whose name differs in the signal alone."""
    joined: dict[str, dict[str, Signal]] = {}
    for label, signals in sensors.items():
        shared = _SIGNAL_WORDS.sub("", label.lower()).strip(" _-./") or label
        target = joined.setdefault(label if len(signals) > 1 else shared, {})
        for signal, values in signals.items():
            target.setdefault(signal, values)
    return joined
