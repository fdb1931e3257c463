"""Measured speed and accuracy of filters and calibration beside peers, as ratios within one run.

A section is a function that gives a `Table`; `sections` lists them. Absolute times belong to the machine and to what
else it does: everything is timed in turn with VQF's C++ (``pip install wepose-pin[peers]``) and its ratio is the median
of the ratios of each round.
"""

from __future__ import annotations

import gc
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..calibration.lengths import LOOK_RATE_HZ
from ..errors import BadData, MissingFile
from ..evaluation import attitude_error
from ..filters import METHODS, OFFLINE, Smekf, run_filter
from ..filters.bank import LiveBank
from ..filters.base import in_parallel, processors
from ..filters.noise import SensorNoise, noise_of
from ..filters.static import StaticDetector, StaticTest
from ..readers.trials import read_authors_trial, read_broad
from ..simulation import REALISTIC, paper_dynamic, simulate, simulated_person

FORMAT = 1
NO_PEERS = "No ratios: VQF is not installed; pip install 'wepose-pin[peers]' brings it and imufusion."
_G = 9.80665  # [m/s²] in which imufusion wants its accelerations


class Column(NamedTuple):
    """One figure of each row."""

    key: str
    header: str
    digits: int = 1
    compared: bool = False  # a ratio, fit to be held against another run's


@dataclass
class Table:
    """What a section gives; a row's first cell is its name, its others lie under the columns' keys."""

    title: str
    columns: tuple[Column, ...]
    rows: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class Sample(NamedTuple):
    """One sensor's data to run on."""

    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s²]
    rate_hz: float
    noise: SensorNoise


class Effort(NamedTuple):
    """How much is measured."""

    rounds: int
    seconds: float  # [s] of data at 100 Hz, batch
    live_seconds: float  # [s] of data at 100 Hz, sample by sample
    lengths: tuple[int, ...]  # of a recording, samples
    counts: tuple[int, ...]  # of sensors
    trials: int  # simulated
    recordings: int  # of BROAD
    compiling: bool  # what the first use costs: a quarter of a minute by itself
    clasp_s: float = 60.0  # [s] of joined hands to calibrate from
    look_rates_hz: tuple[float, ...] = (LOOK_RATE_HZ,)  # at which the calibration looks at them
    solves: int = 3  # of each problem of a calibration


FULL = Effort(
    rounds=15,
    seconds=1200.0,
    live_seconds=60.0,
    lengths=(10_000, 100_000, 1_000_000, 10_000_000),
    counts=(1, 2, 4, 5, 8, 16),
    trials=12,
    recordings=1000,
    compiling=True,
    look_rates_hz=(LOOK_RATE_HZ, 100.0),
)
QUICK = Effort(7, 300.0, 20.0, (10_000, 100_000, 1_000_000), (1, 2, 5, 16), 3, 2, False)


def sections(effort: Effort = FULL, data: Path | None = None) -> dict[str, Callable[[], Table]]:
    """Name → a function that measures it. `data`: the folder of the real recordings, or None.

    Raises
    ------
    MissingFile
        There are no recordings in `data`.
    """
    paths = {} if data is None else recordings(data, effort)
    found: dict[str, Callable[[], Table]] = {
        "filters": partial(filters, effort),
        "live": partial(live, effort),
        "samples": partial(samples, effort),
        "sensors": partial(sensors, effort),
        "accuracy": partial(simulated_accuracy, effort),
        "calibration": partial(calibration, effort),
    }
    if paths:
        found["recordings"] = partial(recorded_accuracy, paths)
    if effort.compiling:
        found["first_use"] = first_use
    return found


def live_sections(quick: bool = False) -> dict[str, Callable[[], Table]]:
    """As `sections`, of a live session."""
    from .session import live_session

    return {"a live session": lambda: live_session(30.0 if quick else 300.0)}


# Timing ------------------------------------------------------------------------------------------------------------


class Timing(NamedTuple):
    """Of one of several cases timed in turn."""

    median: float  # [s]
    spread: float  # [s] between the quartiles
    ratio: float  # median over rounds of its time by the reference's; NaN without one


def in_turn(
    cases: Mapping[str, Callable[[], Any]],
    rounds: int,
    reference: str,
    clock: Callable[[], float] = time.thread_time,
) -> dict[str, Timing]:
    """Each case timed once a round, after one unmeasured round.

    The thread's processor time by default: what else the machine does counts less.
    """
    times: dict[str, list[float]] = {name: [] for name in cases}
    enabled = gc.isenabled()
    gc.disable()
    try:
        for round_ in range(rounds + 1):
            for name, run in cases.items():
                begin = clock()
                run()
                if round_:
                    times[name].append(clock() - begin)
    finally:
        if enabled:
            gc.enable()
    by = np.array(times.get(reference, [np.nan] * rounds))
    found = {}
    for name, values in times.items():
        low, middle, high = np.percentile(values, [25, 50, 75])
        found[name] = Timing(float(middle), float(high - low), float(np.median(np.array(values) / by)))
    return found


def have(peer: str) -> bool:
    """Whether a peer is installed."""
    return importlib.util.find_spec(peer) is not None


_trial = lru_cache(paper_dynamic)


def sample(seconds: float, rate_hz: float = 100.0, seed: int = 1) -> Sample:
    """Data of one trial as in the paper (5 s rest, 50 s motion, 5 s rest), over and over for as long as asked."""
    trial = _trial(seed, rate_hz)
    n = round(seconds * rate_hz)
    rest = slice(round(0.5 * rate_hz), round(4.5 * rate_hz))
    noise = noise_of(trial.gyro_S[rest], trial.accel_S[rest], rate_hz)
    gyro, accel = (np.resize(signal, (n, 3)) for signal in (trial.gyro_S, trial.accel_S))
    return Sample(gyro, accel, rate_hz, noise)


def _filters(of: Sample) -> dict[str, Callable[[], Any]]:
    """Batch runs of our methods, each with its static detector."""
    return {name: partial(run_filter, *of, name) for name in METHODS}


def _peers(of: Sample) -> dict[str, Callable[[], Any]]:
    """Batch runs of the peers that have one."""
    if not have("vqf"):
        return {}
    import vqf

    dt = 1.0 / of.rate_hz
    return {
        "VQF": lambda: vqf.VQF(dt).updateBatch(of.gyro_S, of.accel_S),
        "offline VQF": lambda: vqf.offlineVQF(of.gyro_S, of.accel_S, None, dt),
    }


def _live_filters(of: Sample) -> dict[str, Callable[[], Any]]:
    """Loops over the samples, ours with its static detector; a Python call each, arrays made beforehand."""
    rows = list(zip(of.gyro_S, of.accel_S, strict=True))
    start = rotations.quat_from_gravity(of.accel_S[: StaticTest().samples(of.rate_hz)].mean(axis=0))

    def ours(make: Any) -> Callable[[], Any]:
        def loop() -> None:
            filter_, detector = make(of.noise, of.rate_hz, start), StaticDetector(of.noise, of.rate_hz)
            for gyro, accel in rows:
                filter_.update(gyro, accel, detector.update(gyro, accel))

        return loop

    cases = {name: ours(make) for name, make in METHODS.items() if name not in OFFLINE}
    return cases | _live_peers(of, rows)


def _live_peers(of: Sample, rows: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Callable[[], Any]]:
    cases: dict[str, Callable[[], Any]] = {}
    if have("vqf"):
        import vqf

        def by_vqf() -> None:
            filter_ = vqf.VQF(1.0 / of.rate_hz)
            for gyro, accel in rows:
                filter_.update(gyro, accel)
                filter_.getQuat6D()

        cases["VQF"] = by_vqf
    if have("imufusion"):

        def by_imufusion() -> None:
            filter_ = fusion(of.rate_hz)
            for gyro, accel in zip(gyro_deg, accel_g, strict=True):
                filter_.update_no_magnetometer(gyro, accel)
                filter_.get_quaternion()

        gyro_deg, accel_g = list(np.degrees(of.gyro_S)), list(of.accel_S / _G)
        cases["imufusion"] = by_imufusion
    return cases


def fusion(rate_hz: float) -> Any:
    """imufusion's filter as it comes, at this rate."""
    import imufusion

    settings = imufusion.AhrsSettings()
    settings.sample_rate = rate_hz
    filter_ = imufusion.Ahrs()
    filter_.set_settings(settings)
    return filter_


# Speed -------------------------------------------------------------------------------------------------------------


def filters(effort: Effort) -> Table:
    """Batch and sample by sample, one sensor."""
    data, rounds = sample(effort.seconds), effort.rounds
    n = len(data.gyro_S)
    detector = {"static detector": lambda: StaticDetector(data.noise, data.rate_hz).run(data.gyro_S, data.accel_S)}
    batch = in_turn(_peers(data) | _filters(data) | detector, rounds, "VQF")
    short = sample(effort.live_seconds)
    lives = in_turn(_live_filters(short), rounds, "VQF")
    static = StaticDetector(data.noise, data.rate_hz).run(data.gyro_S, data.accel_S).mean()
    table = Table(
        f"One sensor, one thread: {n} samples at 100 Hz, {100 * static:.0f} % at rest; medians of {rounds} rounds",
        (
            Column("batch_ns", "batch [ns]"),
            Column("batch_spread_ns", "± [ns]"),
            Column("batch_ratio", "by VQF", 2, True),
            Column("live_ns", "live [ns]", 0),
            Column("live_spread_ns", "± [ns]", 0),
            Column("live_ratio", "by VQF", 2, True),
        ),
        notes=[
            "Processor time of one sample, ours with the static detector; ± between the quartiles. Live: a Python call",
            "a sample, and two for a filter and its detector; LiveBank, below, makes one for all sensors.",
        ],
    )
    for name in [*METHODS, "static detector", "VQF", "offline VQF", "imufusion"]:
        row: dict[str, float] = {}
        for kind, timing, count in (("batch", batch.get(name), n), ("live", lives.get(name), len(short.gyro_S))):
            if timing is not None:
                row |= {f"{kind}_ns": 1e9 * timing.median / count, f"{kind}_spread_ns": 1e9 * timing.spread / count}
                row |= {f"{kind}_ratio": timing.ratio}
        if row:
            table.rows[name] = row
    return _noted(table)


def live(effort: Effort) -> Table:
    """One live update of several sensors in one call."""
    table = Table(
        "Live: one update of all sensors, detector and smekf in one call (LiveBank)",
        (
            Column("median_us", "median [µs]", 2),
            Column("worst_us", "99.9 % within [µs]", 2),
            Column("ratio", "by as many of VQF", 2, True),
        ),
        notes=["Each call timed by itself, the clock's own time left in. VQF: update and getQuat6D of each sensor."],
    )
    for count in effort.counts:
        # Each sensor elsewhere in the trial
        data = sample(5.0 * effort.live_seconds + count)
        rows = np.arange(count)[None, :] * 100 + np.arange(len(data.gyro_S) - 100 * count)[:, None]
        gyro, accel = list(data.gyro_S[rows]), list(data.accel_S[rows])
        bank = LiveBank(
            [Smekf(data.noise, data.rate_hz, rotations.quat_from_gravity(accel[0][i])) for i in range(count)],
            [StaticDetector(data.noise, data.rate_hz) for _ in range(count)],
        )
        ours = _each(bank.update, gyro, accel)
        row = {"median_us": float(np.median(ours)), "worst_us": float(np.percentile(ours, 99.9))}
        if have("vqf"):
            import vqf

            peers = [vqf.VQF(1.0 / data.rate_hz) for _ in range(count)]

            def update(gyro: np.ndarray, accel: np.ndarray, peers: list[Any] = peers) -> None:
                for peer, rate, force in zip(peers, gyro, accel, strict=True):
                    peer.update(rate, force)
                    peer.getQuat6D()

            row["ratio"] = row["median_us"] / float(np.median(_each(update, gyro, accel)))
        table.rows[f"{count} sensor{'s' * (count > 1)}"] = row
    return _noted(table)


def _each(update: Callable[..., Any], gyro: list[np.ndarray], accel: list[np.ndarray]) -> np.ndarray:
    """Time of each call [µs]."""
    times = np.empty(len(gyro))
    for k, (rate, force) in enumerate(zip(gyro, accel, strict=True)):
        begin = time.perf_counter_ns()
        update(rate, force)
        times[k] = 1e-3 * (time.perf_counter_ns() - begin)
    return times


def samples(effort: Effort) -> Table:
    """How the time grows with the length of the recording."""
    table = Table(
        "Length of a recording: smekf with the static detector, one sensor, one call",
        (
            Column("ns", "a sample [ns]"),
            Column("spread_ns", "± [ns]"),
            Column("ratio", "by VQF", 2, True),
            Column("seconds", "in all [s]", 3),
        ),
    )
    for n in effort.lengths:
        if n * 400 > _free_memory():  # bytes a sample of input and output
            table.notes.append(f"{n:.0e} samples: left out, not enough free memory.")
            continue
        data = sample(n / 100.0)
        cases = {name: run for name, run in (_peers(data) | _filters(data)).items() if name in ("VQF", "smekf")}
        timing = in_turn(cases, int(np.clip(3e6 / n, min(effort.rounds, 3), effort.rounds)), "VQF")["smekf"]
        row = {"ns": 1e9 * timing.median / n, "spread_ns": 1e9 * timing.spread / n, "seconds": timing.median}
        table.rows[f"{n:.0e} samples".replace("e+0", "e")] = row | {"ratio": timing.ratio}
    return _noted(table)


def _free_memory() -> float:
    """[bytes], or infinite where it cannot be told."""
    try:
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError):
        return float("inf")


def sensors(effort: Effort) -> Table:
    """Several sensors at a time in threads."""
    data = sample(effort.seconds)
    n = len(data.gyro_S)
    table = Table(
        f"Sensors in parallel: {n} samples each, smekf with the static detector, a thread a processor",
        (
            Column("seconds", "in all [s]", 4),
            Column("ns", "a sample [ns]"),
            Column("speedup", "× one thread", 2),
        ),
        notes=[f"{processors()} processors."],
    )
    for count in effort.counts:
        columns = list(zip(*[(*data, "smekf")] * count, strict=True))
        cases = {
            "one": partial(in_parallel, run_filter, *columns, threads=1),
            "all": partial(in_parallel, run_filter, *columns),
        }
        timing = in_turn(cases, effort.rounds, "one", time.perf_counter)["all"]
        row = {"seconds": timing.median, "ns": 1e9 * timing.median / n / count, "speedup": 1.0 / timing.ratio}
        table.rows[f"{count} sensor{'s' * (count > 1)}"] = row
    return table


def calibration(effort: Effort) -> Table:
    """The solve of a hands-together calibration beside SciPy's."""
    from ..calibration.timed import OURS, building, peak_memory, posed, solvers

    person = simulated_person(3)
    made = simulate(person.lengths, seed=3, imperfections=REALISTIC, clasp_s=effort.clasp_s, circles=0)
    table = Table(
        f"Calibration: {effort.clasp_s:g} s of joined hands, one least squares from one start",
        (
            Column("seconds", "solve [s]", 3),
            Column("spread_s", "± [s]", 3),
            Column("ratio", "by ours", 2, True),
            Column("cost", "cost by ours", 4),
            Column("megabytes", "memory [MB]"),
        ),
        notes=[
            "Processor time of all threads, medians; no compiler. Memory: by how much a new process grows at most.",
            "least_squares: trf, scaled by the Jacobian, tolerances as they come. Whole: search for a start, all",
            "rounds of weights, the last solve; filters apart. Building: CasADi's functions, once for so many looks.",
        ],
    )
    problems, whole = posed(made.recording(), person.average, person.taped, person.taped_std, effort.look_rates_hz)
    for problem, calibrated in zip(problems, whole, strict=True):
        looks = f"{len(problem.weights)} looks"
        table.rows[f"{looks}: building"] = {"seconds": building(problem)}
        costs: dict[str, float] = {}

        def solved(name: str, run: Callable[[], float], costs: dict[str, float] = costs) -> None:
            costs[name] = run()

        cases: dict[str, Callable[[], Any]] = {n: partial(solved, n, run) for n, run in solvers(problem).items()}
        timings = in_turn(cases | {"whole": calibrated}, effort.solves, OURS, time.process_time)
        for name, timing in timings.items():
            row = {"seconds": timing.median, "spread_s": timing.spread, "ratio": timing.ratio}
            if name in cases:
                row |= {"cost": costs[name] / costs[OURS], "megabytes": 1e-6 * peak_memory(problem, name)}
            table.rows[f"{looks}: {name}"] = {key: value for key, value in row.items() if value == value}
    return table


_FIRST_USE = """
import sys, time
begin = time.perf_counter()
import numpy as np
from wepose_pin.filters import METHODS, OFFLINE, Smekf, run_filter
from wepose_pin.filters.bank import LiveBank
from wepose_pin.filters.noise import noise_of
from wepose_pin.filters.static import StaticDetector
rng = np.random.default_rng(0)
gyro = rng.normal(scale=1e-3, size=(1000, 3))
accel = rng.normal(scale=1e-2, size=(1000, 3)) + [0.0, 0.0, 9.81]
noise = noise_of(gyro, accel, 100.0)
print("imports", time.perf_counter() - begin)
for name in METHODS:
    begin = time.perf_counter()
    run_filter(gyro, accel, 100.0, noise, name)
    print(name, time.perf_counter() - begin)
begin = time.perf_counter()
bank = LiveBank([Smekf(noise, 100.0, np.array([0.0, 0.0, 0.0, 1.0]))], [StaticDetector(noise, 100.0)])
bank.update(gyro[:1], accel[:1])
print("LiveBank", time.perf_counter() - begin)
"""


def first_use() -> Table:
    """What compiling costs: a new process with an empty cache, and the next one."""
    table = Table(
        "First use: seconds that the first run of each takes in a new process, in this order",
        (Column("first_s", "nothing compiled [s]", 2), Column("next_s", "next start [s]", 3)),
        notes=["What several filters share is compiled with the first of them."],
    )
    with tempfile.TemporaryDirectory(prefix="wepose-bench-") as cache:
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


# Accuracy ----------------------------------------------------------------------------------------------------------


class Truth(NamedTuple):
    """A recording whose orientation is known."""

    data: Sample
    quat_true: np.ndarray  # (n, 4) xyzw, NaN where not known
    at_rest: np.ndarray  # (n,) bool, where headings are aligned
    scored: np.ndarray  # (n,) bool


def simulated_accuracy(effort: Effort) -> Table:
    """Trials as in the paper's dynamic experiment, 100 Hz, an MTi-3's noise."""
    truths = []
    for seed in range(effort.trials):
        trial = _trial(seed, 100.0)
        at_rest = (trial.time >= 0.5) & (trial.time <= 4.5)
        noise = noise_of(trial.gyro_S[at_rest], trial.accel_S[at_rest], trial.rate_hz)
        scored = (trial.time >= trial.moving[0]) & (trial.time <= trial.moving[1])
        truths.append(Truth(Sample(trial.gyro_S, trial.accel_S, trial.rate_hz, noise), trial.quat_WS, at_rest, scored))
    return _accuracy(f"Accuracy: {len(truths)} simulated trials of the paper's dynamic experiment, 100 Hz", truths)


def recordings(folder: Path, effort: Effort) -> dict[str, list[Path]]:
    """The real recordings below a folder, or in it: BROAD's ``.mat`` and the authors' ``prova_HR.txt``.

    Raises
    ------
    MissingFile
        There are none.
    """
    broad = sorted((folder / "broad").glob("*.mat")) or sorted(folder.glob("*.mat"))
    authors = [path for path in (folder / "wepose_hr" / "prova_HR.txt", folder / "prova_HR.txt") if path.is_file()]
    found = {"BROAD": broad[: effort.recordings], "the authors' trial": authors[:1]}
    if not broad and not authors:
        raise MissingFile(f"{folder}: neither broad/*.mat nor wepose_hr/prova_HR.txt in it; see the data's README")
    return {name: paths for name, paths in found.items() if paths}


def recorded_accuracy(paths: dict[str, list[Path]]) -> Table:
    """Real recordings with an optical truth."""
    truths = []
    for name, files in paths.items():
        for path in files:
            trial = read_broad(path) if name == "BROAD" else read_authors_trial(path)
            gyro, accel = trial.gyro_S, trial.accel_S
            at_rest = np.zeros(len(gyro), dtype=bool)
            at_rest[trial.still] = True
            if name != "BROAD":  # Vicon's world begins after the rest
                at_rest = np.arange(len(gyro)) == int(np.argmax(trial.scored))
            noise = noise_of(gyro[trial.still], accel[trial.still], trial.rate_hz)
            data = Sample(np.ascontiguousarray(gyro), np.ascontiguousarray(accel), trial.rate_hz, noise)
            truths.append(Truth(data, trial.quat_true, at_rest, trial.scored))
    what = " and ".join(f"{len(files)} of {name}" if name == "BROAD" else name for name, files in paths.items())
    return _accuracy(f"Accuracy: {what}", truths)


def _accuracy(title: str, truths: list[Truth]) -> Table:
    keys = "inclination_rmse", "heading_rmse", "total_rmse"
    table = Table(
        title,
        tuple(Column(key, key.removesuffix("_rmse") + " [deg]", 2) for key in keys),
        notes=["Means of the RMSE of each trial. All get the gyroscope without the bias of the still phase; headings"]
        + ["are aligned at rest, once. Ours and the peers at their defaults."],
    )
    errors: dict[str, list[list[float]]] = {}
    for truth in truths:
        for name, quat in _orientations(truth.data).items():
            errors.setdefault(name, []).append(_errors(quat, truth))
    for name, rows in errors.items():
        table.rows[name] = dict(zip(keys, np.mean(rows, axis=0).tolist(), strict=True))
    return table


def _orientations(data: Sample) -> dict[str, np.ndarray]:
    """Method or peer → its quaternions (n, 4) xyzw."""
    gyro, accel, rate_hz, noise = data
    found = {name: run_filter(gyro, accel, rate_hz, noise, name, measured_start=True).quat_WS for name in METHODS}
    unbiased = np.ascontiguousarray(gyro - noise.gyro_bias)
    if have("vqf"):
        import vqf

        found["VQF"] = rotations.xyzw_from_wxyz(vqf.VQF(1.0 / rate_hz).updateBatch(unbiased, accel)["quat6D"])
        offline = vqf.offlineVQF(unbiased, accel, None, 1.0 / rate_hz)
        found["offline VQF"] = rotations.xyzw_from_wxyz(offline["quat6D"])
    if have("imufusion"):
        filter_, quat = fusion(rate_hz), np.empty((len(gyro), 4))
        for k, (rate, force) in enumerate(zip(np.degrees(unbiased), accel / _G, strict=True)):
            filter_.update_no_magnetometer(rate, force)
            quat[k] = filter_.get_quaternion()
        found["imufusion"] = rotations.xyzw_from_wxyz(quat)
    return found


def _errors(quat: np.ndarray, truth: Truth) -> list[float]:
    """Inclination, heading, total RMSE [deg]."""
    known = np.isfinite(truth.quat_true).all(axis=1)
    true = Rotation.from_quat(np.where(known[:, None], truth.quat_true, [0.0, 0.0, 0.0, 1.0]))
    estimated = Rotation.from_quat(quat)
    where = truth.at_rest & known
    psi = float(rotations.heading((true[where] * estimated[where].inv()).mean().as_quat()))
    aligned = Rotation.from_rotvec([0.0, 0.0, psi]) * estimated
    time_ = np.arange(len(quat)) / truth.data.rate_hz
    error = attitude_error(aligned[truth.scored], true[truth.scored], time_[truth.scored])
    return [error.inclination_rmse, error.heading_rmse, error.total_rmse]


# Files -------------------------------------------------------------------------------------------------------------


def document(tables: dict[str, Table], quick: bool, versions: dict[str, str]) -> dict[str, Any]:
    """What ``--save`` writes: figures with where, when and by what they were measured."""
    found = {name: importlib.metadata.version(name) for name in ("numba", "vqf", "imufusion") if have(name)}
    return {
        "format": FORMAT,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {"processor": _processor(), "system": platform.platform(), "processors": os.cpu_count()},
        "versions": versions | found,
        "quick": quick,
        "sections": {name: asdict(table) | {"rows": _known(table)} for name, table in tables.items()},
    }


def _known(table: Table) -> dict[str, dict[str, float]]:
    """The rows without figures that there are none of."""
    return {name: {key: value for key, value in row.items() if value == value} for name, row in table.rows.items()}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def read_document(path: Path) -> dict[str, Any]:
    """What an earlier ``--save`` wrote.

    Raises
    ------
    MissingFile, BadData
        Not there; not such a file.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; one that `wepose bench --save` wrote is wanted here")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise BadData(f"{path}: is no JSON that `wepose bench --save` wrote: {error}") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT or not isinstance(found.get("sections"), dict):
        raise BadData(f"{path}: no 'format = {FORMAT}' and 'sections' in it; `wepose bench --save` writes such a file")
    return found


def then_by_now(before: dict[str, Any], section: str, name: str, key: str, now: float) -> float:
    """An earlier run's ratio by this run's: over 1, it was slower then. NaN where the earlier run has none."""
    try:
        return float(before["sections"][section]["rows"][name][key]) / now
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return float("nan")


def _noted(table: Table) -> Table:
    """The table without the ratios that there are none of, and a word on why."""
    if not have("vqf"):
        table.notes.append(NO_PEERS)
    table.rows = _known(table)
    return table
