"""A recording as a session file with its data beside it, and its truth where there is one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from ..body.kinematics import Pose, build_pose_table
from ..documents import toml_key
from ..readers.session import format_keys
from ..recording import ImuSensor, Recording, find_mount_axes
from .result import write_table


def write_session(folder: Path, recording: Recording, truth: Pose | None = None) -> None:
    """``session.toml``, ``recording.parquet`` and, with a truth, ``truth.parquet`` into an existing folder."""
    model = str(Path(recording.model).absolute()) if Path(recording.model).is_file() else recording.model
    head = {"name": recording.name, "model": model, "start_pose": recording.start_pose}
    data = {"file": "recording.parquet", "time": "time", "gyro_unit": "rad/s", "accel_unit": "m/s^2"}
    spans = {
        name: [[round(float(time), 3) for time in span] for span in each] for name, each in recording.phases.items()
    }
    tables: dict[str, Mapping[str, Any]] = {
        "data": data | ({} if truth is None else {"truth": "truth.parquet"}),
        "phases": spans,
        "joints": {name: float(value) for name, value in recording.joints.items()},
    }
    columns = {"time": recording.time}
    for segment, sensor in recording.sensors.items():
        if isinstance(sensor, ImuSensor):
            signals = {"gyro": ("gyr_", sensor.gyro_S), "accel": ("acc_", sensor.accel_S)}
        else:
            signals = {"orientation": ("q", sensor.quat_VS)}
        keys: dict[str, Any] = {}
        for key, (short, values) in signals.items():
            keys[key] = [f"{segment}_{short}{c}" for c in "xyzw"[: values.shape[1]]]
            columns |= {column: values[:, k] for k, column in enumerate(keys[key])}
        if sensor.aligned:
            keys["aligned"] = True
        if sensor.stated_quat_LS is not None:
            keys["mount"] = dict(zip(("up", "forward"), find_mount_axes(sensor.stated_quat_LS), strict=True))
        tables[f"sensors.{toml_key(segment)}"] = keys
    lines = format_keys({key: value for key, value in head.items() if value})
    lines += ["remounted = true"] if recording.remounted else []
    for name, own in tables.items():
        lines += ["", f"[{name}]", *format_keys(own)] if own else []
    write_table(folder / "recording.parquet", pl.DataFrame(columns))
    if truth is not None:
        write_table(folder / "truth.parquet", build_pose_table(truth))
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
