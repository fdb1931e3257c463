"""OpenSim ``.sto`` tables of IMU orientations, as OpenSense reads and writes them.

Lines ``key=value`` up to ``endheader``, among them ``DataType=Quaternion``; then names and rows separated by tabs, each
cell a quaternion ``w,x,y,z`` of the sensor to its world, z up as the device had it.

Source: OpenSim documentation, OpenSense; the headers of OpenSense's example files.
"""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ..data_tables import read_body, read_first_lines
from ..errors import BadData
from ..libraries import library_errors
from .device import Device, Signal, make_device

# The header line of files that `wepose export` wrote, in OpenSim's ground. OpenSim takes it for a remark.
OWN = ("Frames", "bodies of Rajagopal's model in ground")


def read_opensim(path: Path, use: str | None = None, rate_hz: float | None = None) -> Device:
    """Read the orientations of all columns but time, as `Format.read`."""
    lines = read_first_lines(path)
    end = next((k for k, line in enumerate(lines) if line.strip().lower() == "endheader"), None)
    if end is None:
        raise BadData(f"{path}: no line 'endheader' in its first {len(lines)} lines; an OpenSim .sto file has one")
    about = {key.strip().lower(): value.strip() for key, _, value in (line.partition("=") for line in lines[:end])}
    if about.get("datatype", "").lower() != "quaternion":
        kind = about.get("datatype") or "none"
        raise BadData(f"{path}: DataType={kind}; orientations are needed, DataType=Quaternion, as of OpenSense")
    if about.get(OWN[0].lower()) == OWN[1]:
        raise BadData(f"{path}: was written by `wepose export`; use the result that it was made from")
    signals = {}
    with library_errors(path, "an OpenSim .sto"):
        cells = pl.read_csv(read_body(path, end + 1), separator="\t", infer_schema=False).with_columns(
            pl.all().str.strip_chars(" \r~[]()")
        )
        cells = cells.rename(str.strip).drop_nulls(cells.columns[0])
        time = cells["time"].cast(pl.Float64).to_numpy()
    for label in cells.columns[1:]:
        with library_errors(path, f"quaternions w,x,y,z, one a row, in column '{label}'"):
            wxyz = cells[label].str.split(",").list.to_array(4).cast(pl.Array(pl.Float64, 4)).to_numpy()
            signals[label] = {"orientation": Signal(time, wxyz[:, [1, 2, 3, 0]])}
    device = make_device(path, signals, "gyroscope and accelerometer, a .sto has orientations", use, rate_hz)
    return device._replace(since_power_on=False)
