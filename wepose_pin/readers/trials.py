"""Real recordings of one sensor with an optical truth: BROAD's trials, and the paper authors' own."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import so3
from ..errors import BadData, MissingFile


class Trial(NamedTuple):
    """One sensor, its data and the truth."""

    name: str
    rate_hz: float
    gyro_S: np.ndarray  # (n, 3) [rad/s]
    accel_S: np.ndarray  # (n, 3) [m/s²]
    quat_true: np.ndarray  # (n, 4) xyzw, sensor to the truth's world; NaN where it was not seen
    still: slice  # samples at rest before the motion
    scored: np.ndarray  # (n,) bool, samples that count and have a truth


def read_broad(path: Path) -> Trial:
    """A trial of the BROAD benchmark, a ``.mat`` file (Laidig et al. 2021, doi 10.3390/data6070072).

    Raises
    ------
    MissingFile, BadData
        Not there; not such a file.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    if not path.is_file():
        raise MissingFile(f"{path}: no such file; a .mat file of the BROAD benchmark is wanted here")
    try:
        mat = loadmat(path)
        gyro, accel = (np.ascontiguousarray(mat[key], dtype=float) for key in ("imu_gyr", "imu_acc"))
        rate_hz = float(mat["sampling_rate"].squeeze())
        moving, true = mat["movement"].ravel().astype(bool), so3.xyzw_from_wxyz(mat["opt_quat"])
    except (KeyError, ValueError, NotImplementedError, MatReadError) as error:
        raise BadData(f"{path}: is no trial of the BROAD benchmark: {error}") from error
    begin, second = int(np.argmax(moving)), round(rate_hz)
    seen = np.isfinite(true).all(axis=1)
    return Trial(path.stem, rate_hz, gyro, accel, true, slice(second, begin - second), moving & seen)


def read_authors_trial(path: Path) -> Trial:
    """The paper authors' trial ``prova_HR.txt``: 1 kHz, still for a second, then moved before Vicon.

    Columns: time [1e-4 s], gyro [rad/s], accel [m/s²], 3 empty, 4 unused, Vicon quaternion x y z w (zeros before it
    begins), Vicon position [mm].

    Raises
    ------
    MissingFile, BadData
        Not there; not such a file.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; the authors' prova_HR.txt is wanted here")
    try:
        rows = [line.replace(";", "").split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        table = np.array(rows, dtype=float)
        true = table[:, 14:18].copy()
    except (ValueError, IndexError) as error:
        raise BadData(f"{path}: is not the authors' table of 21 numbers a line: {error}") from error
    seen = np.linalg.norm(true, axis=1) > 0.5
    true[~seen] = np.nan
    gyro, accel = np.ascontiguousarray(table[:, 1:4]), np.ascontiguousarray(table[:, 4:7])
    return Trial(path.stem, 1000.0, gyro, accel, true, slice(50, 901), seen)
