"""What a recording of a day costs: the time and the memory of `wepose track`."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl

from wepose_pin.errors import NoSolution
from wepose_pin.recording import Recording, Sensor
from wepose_pin.simulation import simulate, simulate_person
from wepose_pin.writers import write_session

from .tables import Column, Section, Table

HOURS, FEW_HOURS = (1.0, 6.0, 24.0), (0.5, 1.0)


def sections(quick: bool) -> list[Section]:
    """List the functions that measure."""
    return [partial(measure_long_recordings, FEW_HOURS if quick else HOURS)]


def measure_long_recordings(hours: tuple[float, ...]) -> Table:
    """Track recordings of these lengths [h]."""
    table = Table(
        "Long recordings: five sensors at 100 Hz, wepose track",
        (
            Column("seconds", "time [s]", 0),
            Column("memory", "memory [MB]", 0),
        ),
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for length in hours:
            _write(folder / f"{length:g}", length)
            table.rows[f"{length:g} h"] = _track(folder, length)
    table.notes.append("Memory is that of the whole process, Python and all libraries in it, at its highest.")
    return table


def _write(folder: Path, hours: float) -> None:
    """A person who stands, joins hands, draws circles and does it all backwards, again and again."""
    recording = simulate(simulate_person(1).lengths, seed=1).recording("day")
    folder.mkdir()
    write_session(folder, there_and_back(recording, recording.span(recording.phases["start"][0])))
    once = pl.scan_parquet(folder / "recording.parquet").drop("time")
    count = round(hours * 3600.0 * recording.rate_hz)
    repeated = pl.concat([once] * (count // (2 * len(recording)) + 1)).head(count).with_row_index("time")
    repeated = repeated.with_columns(pl.col("time") / recording.rate_hz)
    repeated.sink_parquet(folder / "repeated.parquet")
    (folder / "repeated.parquet").replace(folder / "recording.parquet")


def there_and_back(recording: Recording, rest: slice) -> Recording:
    """A recording and the same backwards: it ends as it began, and can be repeated.

    Backwards a rate is negative and a specific force the same; a gyroscope's bias is no rate and stays.
    """
    sensors: dict[str, Sensor] = {}
    for name, sensor in recording.imus.items():
        bias = sensor.gyro_S[rest].mean(axis=0)
        # The rate at a sample is that of the interval which ends there; backwards it is the one that begins there.
        back = np.roll(2.0 * bias - sensor.gyro_S[::-1], 1, axis=0)
        accel_S = np.concatenate([sensor.accel_S, sensor.accel_S[::-1]])
        sensors[name] = replace(sensor, gyro_S=np.concatenate([sensor.gyro_S, back]), accel_S=accel_S)
    n = 2 * len(recording)
    return replace(recording, time=np.arange(n) / recording.rate_hz, sensors=sensors)


def _track(folder: Path, hours: float) -> dict[str, float]:
    """Track in a process of its own, and return what that costs; `NoSolution`: it fails."""
    session = folder / f"{hours:g}"
    argv = [sys.executable, "-m", "wepose_pin", "track", str(session), "-o", str(folder / "out"), "--force"]
    argv.append("--no-report")
    begin = time.perf_counter()
    process = subprocess.Popen(argv, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise NoSolution(f"wepose track of {hours:g} h ended with {process.returncode}")
    return {
        "seconds": time.perf_counter() - begin,
        "memory": used.ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0) / 1e6,
    }
