"""Speed of the filters beside VQF, as ratios within one run, and their accuracy by two experiments of the validation.

Absolute times belong to the machine and to what else it does: everything is timed in turn with VQF's C++ (``pip install
vqf``), and its ratio is the median of the ratios of each round.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import wepose_pin as wp
from wepose_pin.filters import METHODS, OFFLINE, SensorFilters
from wepose_pin.filters.phases import SensorNoise, estimate_noise
from wepose_pin.recording import ImuSensor, Recording
from wepose_pin.simulation import simulate, simulate_person

from . import validation
from .tables import Column, Section, Table, is_installed, time_in_turn
from .trials import read_broad, run_filter
from .validation.single import simulate_paper_dynamic

NO_PEERS = "No ratios, they need VQF: pip install vqf."
TIMED = ("01", "16", "25")  # recordings of BROAD: slow rotation, fast translation, tapping
STATIC_S = (0.5, 4.5)  # [s] in which the sensor is static, in BROAD and in the simulated trial


class Sample(NamedTuple):
    """One sensor's data to run on."""

    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s²]
    rate_hz: float
    noise: SensorNoise


class Effort(NamedTuple):
    """How much is measured."""

    rounds: int = 15
    seconds: float = 1200.0  # [s] of data at 100 Hz, one call
    live_seconds: float = 60.0  # [s] of data at 100 Hz, sample by sample
    recording_s: float = 90.0  # [s] of joined hands of a simulated person
    counts: tuple[int, ...] = (1, 5, 16)  # of sensors


FULL = Effort()
QUICK = Effort(7, 300.0, 20.0, 40.0, (1, 5))


def sections(quick: bool, data: Path | None = None) -> list[Section]:
    """List the functions that measure; `data`: the folder of the real recordings."""
    effort = QUICK if quick else FULL
    timed = sorted(path for path in data.glob("broad/*.mat") if path.stem[:2] in TIMED) if data is not None else []
    return [
        partial(measure_filters, effort, timed),
        partial(measure_calls, effort),
        partial(measure_live, effort),
        *validation.sections(True, None, "dynamic 100 Hz"),
        *(validation.sections(True, data, "BROAD") if data is not None else []),
    ]


def repeat_trial(seconds: float, rate_hz: float = 100.0) -> Sample:
    """Repeat a trial as in the paper (5 s static, 50 s motion, 5 s static) until it is `seconds` long."""
    trial = simulate_paper_dynamic(1, rate_hz)
    n = round(seconds * rate_hz)
    gyro, accel = (np.resize(signal, (n, 3)) for signal in (trial.gyro_S, trial.accel_S))
    return _make_sample(gyro, accel, rate_hz)


def _make_sample(gyro: np.ndarray, accel: np.ndarray, rate_hz: float) -> Sample:
    rest = slice(*(round(time * rate_hz) for time in STATIC_S))
    noise = estimate_noise(gyro[rest], accel[rest], rate_hz)
    return Sample(np.ascontiguousarray(gyro), np.ascontiguousarray(accel), rate_hz, noise)


def measure_filters(effort: Effort, paths: Sequence[Path] = ()) -> Table:
    """Measure `wp.estimate_orientation` as a user calls it, and the run inside it, on recordings or a trial."""
    trials = [_make_sample(each.gyro_S, each.accel_S, each.rate_hz) for each in map(read_broad, paths)]
    table = Table(
        f"One call a recording, one thread: {', '.join(path.stem for path in paths) or 'simulated'}; medians of "
        f"{effort.rounds} rounds",
        (Column("ns", "a sample [ns]"), Column("ratio", "ratio to VQF", 2), Column("offline", "to offline VQF", 2)),
        notes=["Processor time. Of several recordings the mean time and the largest ratios."],
    )
    trials = trials or [repeat_trial(effort.seconds)]
    for data in trials:
        cases: dict[str, Callable[[], Any]] = {}
        if is_installed("vqf"):
            import vqf

            dt, signals = 1.0 / data.rate_hz, (data.gyro_S, data.accel_S)
            cases["VQF"] = partial(vqf.VQF(dt).updateBatch, *signals)
            cases["offline VQF"] = partial(vqf.offlineVQF, *signals, None, dt)
        for name in METHODS:
            cases[name] = partial(wp.estimate_orientation, *data[:3], method=name, static=STATIC_S)
            cases[f"{name}, inner run"] = partial(run_filter, *data, name)
        timings = time_in_turn(cases, effort.rounds, "VQF")
        offline = timings["offline VQF"].median if "offline VQF" in timings else np.nan
        for name, timing in timings.items():
            row = table.rows.setdefault(name, {"ns": 0.0, "ratio": 0.0, "offline": 0.0})
            row["ns"] += 1e9 * timing.median / len(data.gyro_S) / len(trials)
            row["ratio"] = float(np.maximum(row["ratio"], timing.ratio))
            row["offline"] = float(np.maximum(row["offline"], timing.median / offline))
    table.notes += [NO_PEERS] * (not is_installed("vqf"))
    return table


def measure_calls(effort: Effort) -> Table:
    """Measure `wp.track` and `wp.calibrate` of a simulated person with five sensors."""
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


def measure_live(effort: Effort) -> Table:
    """Measure one live update of several sensors in one call, detector and filter; arrays are made beforehand."""
    table = Table(
        "Live: a call of SensorFilters.step a sample",
        (
            Column("median_us", "median [µs]", 2),
            Column("worst_us", "99.9 % within [µs]", 2),
            Column("ratio", "ratio to as many of VQF", 2),
        ),
        notes=["Each call timed by itself, the clock's own time left in. VQF: update and getQuat6D of each sensor."],
    )
    for count in effort.counts:
        data = repeat_trial(effort.live_seconds + count)
        # Each sensor is elsewhere in the trial.
        rows = np.arange(count)[None, :] * 100 + np.arange(len(data.gyro_S) - 100 * count)[:, None]
        gyro, accel = list(data.gyro_S[rows]), list(data.accel_S[rows])
        reference = np.nan
        if is_installed("vqf"):
            import vqf

            peers = [vqf.VQF(1.0 / data.rate_hz) for _ in range(count)]

            def update(gyro: np.ndarray, accel: np.ndarray, peers: list[Any] = peers) -> None:
                for peer, rate, force in zip(peers, gyro, accel, strict=True):
                    peer.update(rate, force)
                    peer.getQuat6D()

            reference = float(np.median(_time_calls(update, gyro, accel)))
        for method in (name for name in METHODS if name not in OFFLINE):
            times = _time_calls(_start_filters(data, count, method).step, gyro, accel)
            median = float(np.median(times))
            table.rows[f"{method}, {count} sensor{'s' * (count > 1)}"] = {
                "median_us": median,
                "worst_us": float(np.percentile(times, 99.9)),
                "ratio": median / reference,
            }
    table.notes += [NO_PEERS] * (not is_installed("vqf"))
    return table


def _start_filters(data: Sample, count: int, method: str) -> SensorFilters:
    """Return the filters of as many sensors after the static phase."""
    n = round(STATIC_S[1] * data.rate_hz)
    sensors = {f"sensor_{i}": ImuSensor(data.gyro_S[:n], data.accel_S[:n]) for i in range(count)}
    filters = SensorFilters(dict.fromkeys(sensors, data.noise), method=method, start=slice(0, n))
    filters.push(Recording("trial", np.arange(n) / data.rate_hz, data.rate_hz, sensors))
    return filters


def _time_calls(update: Callable[..., Any], gyro: list[np.ndarray], accel: list[np.ndarray]) -> np.ndarray:
    """Return the time of each call [µs]."""
    times = np.empty(len(gyro))
    for k, (rate, force) in enumerate(zip(gyro, accel, strict=True)):
        begin = time.perf_counter_ns()
        update(rate, force)
        times[k] = 1e-3 * (time.perf_counter_ns() - begin)
    return times
