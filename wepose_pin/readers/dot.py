"""Movella (Xsens) DOT CSV, one file a sensor: of the app, of the SDK's logger, and of the data exporter.

Lines such as ``DeviceTag:,D422CD00`` come before the line of names, or none. Acc [m/s²], Gyr [deg/s], or the increments
dq and dv [m/s] over a sample; Quat (W X Y Z) or Euler [deg] to a world with z up. SampleTimeFine counts microseconds,
begins anew at 2³², and is one clock for sensors that were synchronised.

Source: Xsens DOT User Manual, data outputs; headers of the SDK's logger.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..diagnostics import WARNING, Diagnostic
from ..errors import BadData
from ..model import load_table
from .device import Device, Text, compute_counted_time, make_table, read_text, unwrap_counter
from .mt_manager import RAW, read_orientation

FINE_S, WRAPS = 1e-6, 2.0**32
INCREMENTS = (
    ("dq_W", "dq_X", "dq_Y", "dq_Z", "dv[1]", "dv[2]", "dv[3]"),
    ("dq_W", "dq_X", "dq_Y", "dq_Z", "dv_X", "dv_Y", "dv_Z"),
)


def read_dot(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the sensor's rates or increments where the file has them, else its orientation; `use` selects one.

    `rate_hz` is the output rate; it goes before SampleTimeFine.

    Raises
    ------
    MissingFile, BadData
        Not there; no DOT CSV; no time in it; not what `use` asks for.
    """
    text = read_text(path, "PacketCounter", "a CSV of a DOT")
    time, wraps_s = _compute_time(text, rate_hz)
    increments = next((names for names in INCREMENTS if names in text), None)
    kind = "orientation" if use == "orientation" or (RAW not in text and increments is None) else "raw"
    if use == "raw" and kind != "raw":
        raise BadData(
            f"{path}: neither Acc and Gyr nor dq and dv; record in a mode with rate or delta quantities, or leave out "
            f"data.use and its orientation is read"
        )
    if kind == "orientation":
        values = {"orientation": read_orientation(text)}
    elif RAW not in text and increments is not None:
        values = _compute_rates(text.numbers(increments), _find_usual_step(text, time))
    else:
        numbers = text.numbers(RAW)
        values = {"accel": numbers[:, :3], "gyro": np.deg2rad(numbers[:, 3:])}
    # Clocks of devices that were not synchronized start at power-on.
    status = text.about.get("SyncStatus", "synced").lower()
    unsynced = Diagnostic("device-not-synchronized", WARNING, path.name)
    diagnostics = () if status.startswith("synced") else (unsynced,)
    label = text.about.get("DeviceTag") or path.stem
    labels = {label: load_table().guess_segment(label) or load_table().guess_segment(path.stem)}
    table = make_table(time, {label: values})
    return Device("dot", table, labels, kind, since_power_on=True, wraps_s=wraps_s, diagnostics=diagnostics)


def _compute_rates(increments: np.ndarray, step: float) -> dict[str, np.ndarray]:
    """Compute mean rate and mean specific force over each sample of `step` [s], from dq (w x y z) and dv."""
    turn = np.full((len(increments), 3), np.nan)
    good = np.isfinite(increments[:, :4]).all(axis=1) & (np.linalg.norm(increments[:, :4], axis=1) > 0.5)
    if good.any():
        turn[good] = Rotation.from_quat(increments[good][:, [1, 2, 3, 0]]).as_rotvec()
    return {"gyro": turn / step, "accel": increments[:, 4:] / step}


def _find_usual_step(text: Text, time: np.ndarray) -> float:
    steps = np.diff(time)
    step = float(np.median(steps[np.isfinite(steps)])) if np.isfinite(steps).any() else 0.0
    if not step > 0.0:
        raise BadData(f"{text.path}: its time does not grow from row to row, so that dq and dv give no rate")
    return step


def _compute_time(text: Text, rate_hz: float | None) -> tuple[np.ndarray, float | None]:
    """Compute times (n,) [s] on the device's clock, and the time [s] after which its counter wraps."""
    if ["SampleTimeFine"] in text and rate_hz is None:
        time = FINE_S * unwrap_counter(text.numbers(["SampleTimeFine"])[:, 0], WRAPS)
        return time, FINE_S * WRAPS
    number = re.match(r"\d+(\.\d+)?", text.about.get("OutputRate", ""))
    rate = rate_hz or (float(number[0]) if number else 0.0)
    if rate <= 0.0:
        raise BadData(
            f"{text.path}: no SampleTimeFine and no OutputRate, so that times are not known; state the output rate as "
            f"rate_hz in [data], or export one of the two"
        )
    return compute_counted_time(text.numbers(["PacketCounter"])[:, 0], rate, WRAPS)[0], None
