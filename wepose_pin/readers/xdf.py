"""XDF, as LabRecorder writes streams of the lab streaming layer, by pyxdf.

A stream is one sensor or several, whose channels have labels and units (``acc_x`` in ``m/s^2``); what they measure is
found by their labels as in tables. Rates and specific forces may be in two streams whose names differ in that word
alone. Clocks are those of the streams, brought to one by pyxdf.

Source: sccn/xdf, specification; pyxdf's documentation.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..model import load_table
from ..recording.limits import STANDARD_GRAVITY
from .device import ACCEL_UNITS, Device, check_measured, convert, join_signals, make_device
from .guess import group_columns
from .libraries import import_library, library_errors

MAGIC = b"XDF:", b"\x1f\x8b"  # the latter of gzip


class _Signal(NamedTuple):
    """The channels of a signal."""

    time: np.ndarray  # (n,) [s]
    values: np.ndarray  # (n, 3 or 4), SI


def is_xdf(path: Path) -> bool:
    """Return whether a file is an XDF by its name."""
    return path.suffix.lower() in (".xdf", ".xdfz")


def read_xdf(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensors' raw data where they have them, else their orientations; `use` selects one of the two.

    `rate_hz` replaces the streams' times.

    Raises
    ------
    BadData
        No XDF, or damaged; no stream of a sensor; an unknown unit; not what `use` asks for; pyxdf is not installed.
    """
    sensors: dict[str, dict[str, _Signal]] = {}
    diagnostics = list[Diagnostic]()
    for stream in _load(path):
        name = _first(stream["info"], "name") or "stream"
        values = stream["time_series"]
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or len(values) < 2:
            continue
        diagnostics += _check_complete(path, stream, len(values))
        labels, units = _read_channels(stream["info"], values.shape[1])
        columns = [f"{name} {label}" for label in labels]
        for owner, signals in group_columns(columns).items():
            label = name if owner == f"?{name.lower()}" or len(group_columns(columns)) == 1 else owner.removeprefix("?")
            for signal, channels in signals.items():
                at = [columns.index(channel) for channel in channels]
                read = values[:, at].astype(float)
                check_measured(path, read, ", ".join(channels))
                if signal != "orientation":
                    unit, assumed = _find_unit(path, signal, read, units[at[0]], channels[0])
                    read = convert(path, signal, read, unit, channels[0])
                    diagnostics += assumed
                sensors.setdefault(label, {}).setdefault(signal, _Signal(stream["time_stamps"], read))
    sensors = _join_streams(sensors)
    kind = use or ("raw" if any({"gyro", "accel"} <= set(signals) for signals in sensors.values()) else "orientation")
    clocks: dict[str, np.ndarray] = {}
    values_: dict[str, dict[str, np.ndarray]] = {}
    for label, own in sensors.items():
        if kind == "raw" and {"gyro", "accel"} <= set(own):
            clocks[label], values_[label], joined = join_signals(f"{path.name} {label}", own["gyro"], own["accel"])
            diagnostics += joined
        elif kind in own:
            clocks[label], values_[label] = own[kind].time, {kind: own[kind].values}
    if not values_:
        what = "gyroscope and accelerometer" if kind == "raw" else "orientation"
        raise BadData(
            f"{path}: no stream with the channels of a sensor's {what}, by their labels; they need labels as gyr_x"
        )
    if rate_hz:
        clocks = {label: np.arange(len(time)) / rate_hz for label, time in clocks.items()}
    guessed = {label: load_table().guess_segment(label) for label in values_}
    return make_device("xdf", kind, clocks, values_, guessed, diagnostics)


def _load(path: Path) -> list[dict[str, Any]]:
    pyxdf = import_library("pyxdf", path, "an XDF")
    with path.open("rb") as file:
        if not file.read(4).startswith(MAGIC):
            raise BadData(f"{path}: is no XDF: it does not begin with 'XDF:'")
    logger, level = logging.getLogger("pyxdf"), logging.getLogger("pyxdf").level
    logger.setLevel(logging.CRITICAL)  # it reports what it mends
    try:
        with library_errors(path, "an XDF"):
            streams, _ = pyxdf.load_xdf(str(path))
    finally:
        logger.setLevel(level)
    return list(streams)


def _first(info: Any, key: str) -> str:
    """Return the first text of an element of a stream's description; empty: it has none."""
    value = info.get(key) if isinstance(info, dict) else None
    value = value[0] if isinstance(value, list) and value else value
    return value.strip() if isinstance(value, str) else ""


def _read_channels(info: Any, width: int) -> tuple[list[str], list[str]]:
    """Read labels and units of the channels."""
    node: Any = info
    for key in ("desc", "channels"):
        node = (node.get(key) or [None])[0] if isinstance(node, dict) else None
    channels = node.get("channel") if isinstance(node, dict) else None
    channels = [*(channels if isinstance(channels, list) else []), *[None] * width][:width]
    return [_first(each, "label") for each in channels], [_first(each, "unit") for each in channels]


def _check_complete(path: Path, stream: dict[str, Any], count: int) -> list[Diagnostic]:
    """Compare the number of samples with that of the footer; a file that was cut off has none."""
    footer = (stream.get("footer") or {}).get("info", {})
    text = _first(footer, "sample_count")
    stated = int(text) if text.isdigit() else count + 1
    return [Diagnostic("samples-missing-in-file", WARNING, path.name, count, stated)] if stated > count else []


def _find_unit(
    path: Path, signal: str, values: np.ndarray, unit: str, channel: str
) -> tuple[str, tuple[Diagnostic, ...]]:
    """Return the unit of a signal; where the stream states none, SI, or that in which gravity is."""
    if unit:
        return unit, ()
    unit = "rad/s"
    if signal == "accel":
        norm = float(np.nanmedian(np.linalg.norm(values, axis=1)))
        unit = min(ACCEL_UNITS, key=lambda known: abs(np.log(max(norm, 1e-9) * ACCEL_UNITS[known] / STANDARD_GRAVITY)))
    return unit, (Diagnostic("units-assumed", WARNING, path.name, facts={"columns": channel, "unit": unit}),)


def _join_streams(sensors: dict[str, dict[str, _Signal]]) -> dict[str, dict[str, _Signal]]:
    """Join the rates of one stream with the specific forces of another whose name differs in the signal alone."""
    joined: dict[str, dict[str, _Signal]] = {}
    for label, signals in sensors.items():
        words = label.lower().replace("accelerometer", "").replace("gyroscope", "").replace("accel", "")
        key = words.replace("gyro", "").replace("acc", "").replace("gyr", "").strip(" _-./") or label
        target = joined.setdefault(label if len(signals) > 1 else key, {})
        for signal, values in signals.items():
            target.setdefault(signal, values)
    return joined
