"""Speed of the filters beside VQF and imufusion, as ratios within one run.

A section is a function that gives a `Table`; `sections` lists them. Absolute times belong to the machine and to what
else it does: everything is timed in turn with VQF's C++ (``pip install vqf imufusion``) and its ratio is the median
of the ratios of each round.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import wepose_pin as wp
from wepose_pin.errors import how_to_install
from wepose_pin.filters import METHODS, OFFLINE, SensorFilters, run_filter
from wepose_pin.filters.noise import SensorNoise, estimate_noise
from wepose_pin.recording import ImuSensor, Recording
from wepose_pin.simulation import simulate, simulate_paper_dynamic, simulate_person

from .tables import Column, Section, Table, is_installed, time_in_turn
from .trials import read_broad

NO_PEERS = f"No ratios, they need VQF: {how_to_install('vqf', 'imufusion')}."
TIMED = ("01", "16", "25")  # recordings of BROAD: slow rotation, fast translation, tapping
STATIC_S = (0.5, 4.5)  # [s] in which the sensor is static, in BROAD and in the simulated trial
STANDARD_GRAVITY = 9.80665  # [m/s²] in which imufusion wants its accelerations


class Sample(NamedTuple):
    """One sensor's data to run on."""

    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s²]
    rate_hz: float
    noise: SensorNoise


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    rounds: int = 15
    seconds: float = 1200.0  # [s] of data at 100 Hz, one call
    live_seconds: float = 60.0  # [s] of data at 100 Hz, sample by sample
    recording_s: float = 90.0  # [s] of joined hands of a simulated person
    counts: tuple[int, ...] = (1, 2, 4, 5, 8, 16)  # of sensors
    trials: int = 12  # simulated
    recordings: int = 1000  # of BROAD
    compiling: bool = True  # what the first use costs: a quarter of a minute by itself


FULL = Effort()
QUICK = Effort(7, 300.0, 20.0, 40.0, (1, 2, 5, 16), 3, 2, False)


def sections(effort: Effort = FULL, data: Path | None = None) -> dict[str, Section]:
    """Name → a function that measures it. `data`: the folder of the real recordings, or None.

    Raises
    ------
    MissingFile
        There are no recordings in `data`.
    """
    from . import accuracy

    paths = accuracy.recordings(data, effort.recordings) if data is not None else {}
    timed = sorted(path for path in data.glob("broad/*.mat") if path.stem[:2] in TIMED) if data is not None else []
    found: dict[str, Section] = {
        "filters": partial(filters, effort, timed),
        "recordings": partial(recordings, effort),
        "live": partial(live, effort),
        "bank": partial(bank, effort),
        "accuracy": partial(accuracy.simulated_accuracy, effort.trials),
    }
    if paths:
        found["recorded_accuracy"] = partial(accuracy.recorded_accuracy, paths)
    if effort.compiling:
        found["first_use"] = first_use
    return found


simulated_trial = lru_cache(simulate_paper_dynamic)


def repeated_trial(seconds: float, rate_hz: float = 100.0, seed: int = 1) -> Sample:
    """Data of one trial as in the paper (5 s static, 50 s motion, 5 s static), repeated until it is `seconds` long."""
    trial = simulated_trial(seed, rate_hz)
    n = round(seconds * rate_hz)
    rest = slice(round(0.5 * rate_hz), round(4.5 * rate_hz))
    noise = estimate_noise(trial.gyro_S[rest], trial.accel_S[rest], rate_hz)
    gyro, accel = (np.resize(signal, (n, 3)) for signal in (trial.gyro_S, trial.accel_S))
    return Sample(gyro, accel, rate_hz, noise)


def _batch_peers(data: Sample) -> dict[str, Callable[[], Any]]:
    """Batch runs of the peers that have one."""
    if not is_installed("vqf"):
        return {}
    import vqf

    dt = 1.0 / data.rate_hz
    return {
        "VQF": lambda: vqf.VQF(dt).updateBatch(data.gyro_S, data.accel_S),
        "offline VQF": lambda: vqf.offlineVQF(data.gyro_S, data.accel_S, None, dt),
    }


def _live_filters(data: Sample) -> dict[str, Callable[[], Any]]:
    """Loops over the samples, ours with its static detector; a Python call each, arrays made beforehand."""
    rows = list(zip(data.gyro_S, data.accel_S, strict=True))
    start = repeated_trial(STATIC_S[1])

    def ours(method: str) -> Callable[[], Any]:
        filters = _start_filters(start, 1, method)

        def loop() -> None:
            for gyro, accel in rows:
                filters.step(gyro[None], accel[None])

        return loop

    cases = {name: ours(name) for name in METHODS if name not in OFFLINE}
    return cases | _live_peers(data, rows)


def _live_peers(data: Sample, rows: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Callable[[], Any]]:
    cases: dict[str, Callable[[], Any]] = {}
    if is_installed("vqf"):
        import vqf

        def run_vqf() -> None:
            filter_ = vqf.VQF(1.0 / data.rate_hz)
            for gyro, accel in rows:
                filter_.update(gyro, accel)
                filter_.getQuat6D()

        cases["VQF"] = run_vqf
    if is_installed("imufusion"):

        def run_imufusion() -> None:
            filter_ = imufusion_filter(data.rate_hz)
            for gyro, accel in zip(gyro_deg, accel_g, strict=True):
                filter_.update_no_magnetometer(gyro, accel)
                filter_.get_quaternion()

        gyro_deg, accel_g = list(np.degrees(data.gyro_S)), list(data.accel_S / STANDARD_GRAVITY)
        cases["imufusion"] = run_imufusion
    return cases


def imufusion_filter(rate_hz: float) -> Any:
    """imufusion's filter with default gains at this rate."""
    import imufusion

    settings = imufusion.AhrsSettings()
    settings.sample_rate = rate_hz
    filter_ = imufusion.Ahrs()
    filter_.set_settings(settings)
    return filter_


def filters(effort: Effort, paths: Sequence[Path] = ()) -> Table:
    """`wp.estimate_orientation` as a user calls it, and the run inside it, on recordings or a simulated trial."""
    trials = [read_sample(path) for path in paths] or [repeated_trial(effort.seconds)]
    table = Table(
        f"One call a recording, one thread: {', '.join(path.stem for path in paths) or 'simulated'}; medians of "
        f"{effort.rounds} rounds",
        (
            Column("ns", "a sample [ns]"),
            Column("ratio", "ratio to VQF", 2, True),
            Column("offline_ratio", "ratio to offline VQF", 2, True),
        ),
        notes=["Processor time. Of several recordings the mean time and the largest ratios."],
    )
    for data in trials:
        cases = _batch_peers(data)
        for name in METHODS:
            call = partial(wp.estimate_orientation, *data[:3], method=name, static=STATIC_S)
            cases |= {name: call, f"{name}, inner run": partial(run_filter, *data, name)}
        timings = time_in_turn(cases, effort.rounds, "VQF")
        offline = timings["offline VQF"].median if "offline VQF" in timings else float("nan")
        for name, timing in timings.items():
            row = table.rows.setdefault(name, {"ns": 0.0, "ratio": 0.0, "offline_ratio": 0.0})
            row["ns"] += 1e9 * timing.median / len(data.gyro_S) / len(trials)
            row["ratio"] = float(np.maximum(row["ratio"], timing.ratio))
            row["offline_ratio"] = float(np.maximum(row["offline_ratio"], timing.median / offline))
    return _noted(table)


def read_sample(path: Path) -> Sample:
    """Read a recording of BROAD."""
    trial = read_broad(path)
    rest = slice(*(round(time * trial.rate_hz) for time in STATIC_S))
    noise = estimate_noise(trial.gyro_S[rest], trial.accel_S[rest], trial.rate_hz)
    return Sample(np.ascontiguousarray(trial.gyro_S), np.ascontiguousarray(trial.accel_S), trial.rate_hz, noise)


def recordings(effort: Effort) -> Table:
    """`wp.track` and `wp.calibrate` of a simulated person with five sensors."""
    person = simulate_person(1)
    recording = simulate(person.lengths, seed=1, clasp_s=effort.recording_s, circles=0).recording("simulated")
    measured = {"shoulder_width": person.lengths["shoulder_width"]}
    cases: dict[str, Callable[[], Any]] = {
        "track": partial(wp.track, recording),
        "calibrate": partial(wp.calibrate, recording, measured=measured),
    }
    table = Table("Whole calls: five sensors at 100 Hz", (Column("seconds", "for 100 s of recording [s]", 3),))
    for name, timing in time_in_turn(cases, 3, "track", time.process_time).items():
        table.rows[name] = {"seconds": timing.median * 100.0 / (recording.time[-1] - recording.time[0])}
    return table


def live(effort: Effort) -> Table:
    """Sample by sample, one sensor: a Python call a sample for the filter and one for its detector."""
    data = repeated_trial(effort.live_seconds)
    table = Table(
        "Live: one sensor, a call of SensorFilters.step a sample, detector and filter",
        (Column("ns", "a sample [ns]", 0), Column("ratio", "ratio to VQF", 2, True)),
    )
    for name, timing in time_in_turn(_live_filters(data), effort.rounds, "VQF").items():
        table.rows[name] = {"ns": 1e9 * timing.median / len(data.gyro_S), "ratio": timing.ratio}
    return _noted(table)


def bank(effort: Effort) -> Table:
    """One live update of several sensors in one call."""
    table = Table(
        "Live: one step of all sensors, detector and smekf (SensorFilters)",
        (
            Column("median_us", "median [µs]", 2),
            Column("worst_us", "99.9 % within [µs]", 2),
            Column("ratio", "ratio to as many of VQF", 2, True),
        ),
        notes=["Each call timed by itself, the clock's own time left in. VQF: update and getQuat6D of each sensor."],
    )
    for count in effort.counts:
        # Each sensor elsewhere in the trial
        data = repeated_trial(5.0 * effort.live_seconds + count)
        rows = np.arange(count)[None, :] * 100 + np.arange(len(data.gyro_S) - 100 * count)[:, None]
        gyro, accel = list(data.gyro_S[rows]), list(data.accel_S[rows])
        ours = _each(_start_filters(data, count).step, gyro, accel)
        row = {"median_us": float(np.median(ours)), "worst_us": float(np.percentile(ours, 99.9))}
        if is_installed("vqf"):
            import vqf

            peers = [vqf.VQF(1.0 / data.rate_hz) for _ in range(count)]

            def update(gyro: np.ndarray, accel: np.ndarray, peers: list[Any] = peers) -> None:
                for peer, rate, force in zip(peers, gyro, accel, strict=True):
                    peer.update(rate, force)
                    peer.getQuat6D()

            row["ratio"] = row["median_us"] / float(np.median(_each(update, gyro, accel)))
        table.rows[f"{count} sensor{'s' * (count > 1)}"] = row
    return _noted(table)


def _start_filters(data: Sample, count: int, method: str = "smekf") -> SensorFilters:
    """Return the filters of as many sensors after the static phase."""
    n = round(STATIC_S[1] * data.rate_hz)
    sensor = ImuSensor(data.gyro_S[:n], data.accel_S[:n])
    sensors = {f"sensor_{i}": sensor for i in range(count)}
    time = np.arange(n) / data.rate_hz
    filters = SensorFilters(dict.fromkeys(sensors, data.noise), method=method, start=slice(0, n))
    filters.push(Recording("trial", time, data.rate_hz, sensors))
    return filters


def _each(update: Callable[..., Any], gyro: list[np.ndarray], accel: list[np.ndarray]) -> np.ndarray:
    """Time of each call [µs]."""
    times = np.empty(len(gyro))
    for k, (rate, force) in enumerate(zip(gyro, accel, strict=True)):
        begin = time.perf_counter_ns()
        update(rate, force)
        times[k] = 1e-3 * (time.perf_counter_ns() - begin)
    return times


_FIRST_USE = """
import sys, time
begin = time.perf_counter()
import numpy as np
from wepose_pin.filters import METHODS, SensorFilters, run_filter
from wepose_pin.filters.noise import estimate_noise
from wepose_pin.recording import ImuSensor, Recording
rng = np.random.default_rng(0)
gyro = rng.normal(scale=1e-3, size=(1000, 3))
accel = rng.normal(scale=1e-2, size=(1000, 3)) + [0.0, 0.0, 9.81]
noise = estimate_noise(gyro, accel, 100.0)
print("imports", time.perf_counter() - begin)
for name in METHODS:
    begin = time.perf_counter()
    run_filter(gyro, accel, 100.0, noise, name)
    print(name, time.perf_counter() - begin)
begin = time.perf_counter()
filters = SensorFilters({"a": noise}, method="smekf", start=slice(0, 900))
filters.push(Recording("start", np.arange(1000) / 100.0, 100.0, {"a": ImuSensor(gyro, accel)}))
filters.step(gyro[:1], accel[:1])
print("SensorFilters", time.perf_counter() - begin)
"""


def first_use() -> Table:
    """What compiling costs: a new process with an empty cache, and the next one."""
    table = Table(
        "First use: seconds that the first run of each takes in a new process, in this order",
        (Column("first_s", "nothing compiled [s]", 2), Column("next_s", "next start [s]", 3)),
        notes=["What several filters share is compiled with the first of them."],
    )
    with tempfile.TemporaryDirectory(prefix="wepose-benchmark-") as cache:
        for key in ("first_s", "next_s"):
            run = subprocess.run(
                [sys.executable, "-c", _FIRST_USE],
                env=os.environ | {"NUMBA_CACHE_DIR": cache},
                capture_output=True,
                text=True,
                check=True,
            )
            for line in run.stdout.splitlines():
                name, _, seconds = line.rpartition(" ")
                table.rows.setdefault(name, {})[key] = float(seconds)
    kernels = [row for name, row in table.rows.items() if name != "imports"]
    table.rows["all but the imports"] = {key: sum(row[key] for row in kernels) for key in ("first_s", "next_s")}
    return table


def _noted(table: Table) -> Table:
    """The table without the ratios that are NaN, and a note on why."""
    if not is_installed("vqf"):
        table.notes.append(NO_PEERS)
    table.rows = table.known_rows()
    return table
