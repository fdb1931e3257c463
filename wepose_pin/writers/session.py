"""A recording as a session file with its data beside it, and its truth where there is one."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ..body.kinematics import Pose, build_pose_table
from ..documents import toml_key, toml_string, toml_strings
from ..recording import ImuSensor, Recording, find_mount_axes
from .result import write_table


def write_session(folder: Path, recording: Recording, truth: Pose | None = None) -> None:
    """``session.toml``, ``recording.parquet`` and, with a truth, ``truth.parquet`` into an existing folder."""
    table, model = {"time": recording.time}, recording.model
    if Path(model).is_file():
        model = str(Path(model).absolute())
    lines = [
        f"name = {toml_string(recording.name)}",
        *([f"model = {toml_string(model)}"] if model else []),
        f"start_pose = {toml_string(recording.start_pose)}",
        *(["remounted = true"] if recording.remounted else []),
        "",
        "[data]",
        'file = "recording.parquet"',
        'time = "time"',
        'gyro_unit = "rad/s"',
        'accel_unit = "m/s^2"',
        *(['truth = "truth.parquet"'] if truth is not None else []),
        "",
        "[phases]   # seconds on the time column",
    ]
    for name, spans in recording.phases.items():
        lines.append(f"{toml_key(name)} = [{', '.join(f'[{first:.3f}, {last:.3f}]' for first, last in spans)}]")
    if recording.joints:
        lines += ["", "[joints]   # rad, m for a prismatic joint"]
        lines += [f"{toml_key(name)} = {float(value)!r}" for name, value in recording.joints.items()]
    for segment, sensor in recording.sensors.items():
        lines += ["", f"[sensors.{toml_key(segment)}]"]
        if isinstance(sensor, ImuSensor):
            signals = {"gyro": ("gyr_", sensor.gyro_S), "accel": ("acc_", sensor.accel_S)}
        else:
            signals = {"orientation": ("q", sensor.quat_VS)}
        for key, (short, values) in signals.items():
            names = [f"{segment}_{short}{c}" for c in "xyzw"[: values.shape[1]]]
            table |= {column: values[:, k] for k, column in enumerate(names)}
            lines.append(f"{key} = {toml_strings(names)}")
        if sensor.aligned:
            lines.append("aligned = true")
        if sensor.stated_quat_LS is not None:
            up, forward = find_mount_axes(sensor.stated_quat_LS)
            lines.append(f'mount = {{ up = "{up}", forward = "{forward}" }}')
    write_table(folder / "recording.parquet", pl.DataFrame(table))
    if truth is not None:
        write_table(folder / "truth.parquet", build_pose_table(truth))
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
