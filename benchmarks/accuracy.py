"""Accuracy of the filters beside VQF and imufusion, on simulated trials and on real recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.trials import read_authors_trial, read_broad
from wepose_pin import rotations
from wepose_pin.errors import MissingFile
from wepose_pin.evaluation import attitude_error
from wepose_pin.filters import METHODS, run_filter
from wepose_pin.filters.noise import estimate_noise

from .filters import STANDARD_GRAVITY, Sample, imufusion_filter, simulated_trial
from .tables import Column, Table, is_installed


class Truth(NamedTuple):
    """A recording whose orientation is known."""

    data: Sample
    quat_true: np.ndarray  # (n, 4) xyzw, NaN where not known
    static: np.ndarray  # (n,) bool, where headings are aligned
    scored: np.ndarray  # (n,) bool


def simulated_accuracy(trials: int) -> Table:
    """Trials as in the paper's dynamic experiment, 100 Hz, an MTi-3's noise."""
    truths = []
    for seed in range(trials):
        trial = simulated_trial(seed, 100.0)
        static = (trial.time >= 0.5) & (trial.time <= 4.5)
        noise = estimate_noise(trial.gyro_S[static], trial.accel_S[static], trial.rate_hz)
        scored = (trial.time >= trial.moving[0]) & (trial.time <= trial.moving[1])
        truths.append(Truth(Sample(trial.gyro_S, trial.accel_S, trial.rate_hz, noise), trial.quat_WS, static, scored))
    return _accuracy(f"Accuracy: {len(truths)} simulated trials of the paper's dynamic experiment, 100 Hz", truths)


def recordings(folder: Path, most: int) -> dict[str, list[Path]]:
    """The real recordings in a folder or its sub-folders: at most so many of BROAD's ``.mat``, and the authors' trial.

    Raises
    ------
    MissingFile
        There are none.
    """
    broad = sorted((folder / "broad").glob("*.mat")) or sorted(folder.glob("*.mat"))
    authors = [path for path in (folder / "wepose_hr" / "prova_HR.txt", folder / "prova_HR.txt") if path.is_file()]
    found = {"BROAD": broad[:most], "the authors' trial": authors[:1]}
    if not broad and not authors:
        raise MissingFile(f"{folder}: neither broad/*.mat nor wepose_hr/prova_HR.txt in it; see the data's README")
    return {name: paths for name, paths in found.items() if paths}


def recorded_accuracy(paths: Mapping[str, list[Path]]) -> Table:
    """Real recordings with an optical truth."""
    truths = []
    for name, files in paths.items():
        for path in files:
            trial = read_broad(path) if name == "BROAD" else read_authors_trial(path)
            gyro, accel = trial.gyro_S, trial.accel_S
            static = np.zeros(len(gyro), dtype=bool)
            static[trial.static] = True
            if name != "BROAD":  # Vicon's world begins after the static phase
                static = np.arange(len(gyro)) == int(np.argmax(trial.scored))
            noise = estimate_noise(gyro[trial.static], accel[trial.static], trial.rate_hz)
            data = Sample(np.ascontiguousarray(gyro), np.ascontiguousarray(accel), trial.rate_hz, noise)
            truths.append(Truth(data, trial.quat_true, static, trial.scored))
    what = " and ".join(f"{len(files)} of {name}" if name == "BROAD" else name for name, files in paths.items())
    return _accuracy(f"Accuracy: {what}", truths)


def _accuracy(title: str, truths: Sequence[Truth]) -> Table:
    keys = "inclination_rmse", "heading_rmse", "total_rmse"
    table = Table(
        title,
        tuple(Column(key, key.removesuffix("_rmse") + " [deg]", 2) for key in keys),
        notes=["Means of the RMSE of each trial. All get the gyroscope without the bias of the static phase; headings"]
        + ["are aligned once, in that phase. Ours and the peers have default gains."],
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
    found = {name: run_filter(gyro, accel, rate_hz, noise, name).quat_VS for name in METHODS}
    unbiased = np.ascontiguousarray(gyro - noise.gyro_bias)
    if is_installed("vqf"):
        import vqf

        found["VQF"] = rotations.xyzw_from_wxyz(vqf.VQF(1.0 / rate_hz).updateBatch(unbiased, accel)["quat6D"])
        offline = vqf.offlineVQF(unbiased, accel, None, 1.0 / rate_hz)
        found["offline VQF"] = rotations.xyzw_from_wxyz(offline["quat6D"])
    if is_installed("imufusion"):
        filter_, quat = imufusion_filter(rate_hz), np.empty((len(gyro), 4))
        for k, (rate, force) in enumerate(zip(np.degrees(unbiased), accel / STANDARD_GRAVITY, strict=True)):
            filter_.update_no_magnetometer(rate, force)
            quat[k] = filter_.get_quaternion()
        found["imufusion"] = rotations.xyzw_from_wxyz(quat)
    return found


def _errors(quat: np.ndarray, truth: Truth) -> list[float]:
    """Inclination, heading, total RMSE [deg]."""
    known = np.isfinite(truth.quat_true).all(axis=1)
    true = Rotation.from_quat(np.where(known[:, None], truth.quat_true, [0.0, 0.0, 0.0, 1.0]))
    estimated = Rotation.from_quat(quat)
    where = truth.static & known
    psi = float(rotations.heading((true[where] * estimated[where].inv()).mean().as_quat()))
    aligned = Rotation.from_rotvec([0.0, 0.0, psi]) * estimated
    time_ = np.arange(len(quat)) / truth.data.rate_hz
    error = attitude_error(aligned[truth.scored], true[truth.scored], time_[truth.scored])
    return [error.inclination_rmse, error.heading_rmse, error.total_rmse]
