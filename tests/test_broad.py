"""Filters on the BROAD trials: 15 recordings of three minutes with optical truth (Laidig et al. 2021).

Heading aligned in the still phase, errors over the marked motion, root mean square, averaged over trials. The bias
measured in the still phase is removed for every filter.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from wepose_pin import so3
from wepose_pin.filters import GdcParams, run_filter
from wepose_pin.noise import noise_of
from wepose_pin.static import StaticDetector, StaticTest

ROWS = ("smekf", "smekf, no correction in motion", "smekf, start measured", "ncf", "gdc 0.12", "gdc 0.01")


def errors_deg(path: Path) -> dict[str, tuple[float, float, float]]:
    """Row → (inclination, heading, total) RMSE [deg] of one trial."""
    trial = loadmat(path)
    gyro, accel = np.ascontiguousarray(trial["imu_gyr"], float), np.ascontiguousarray(trial["imu_acc"], float)
    rate_hz = float(trial["sampling_rate"].squeeze())
    moving = trial["movement"].ravel().astype(bool)
    true = so3.xyzw_from_wxyz(trial["opt_quat"])
    seen = np.isfinite(true).all(axis=1)
    begin = int(np.argmax(moving))
    rest = slice(round(1.0 * rate_hz), begin - round(1.0 * rate_hz))
    noise = noise_of(gyro[rest], accel[rest], rate_hz)
    static = StaticDetector(noise, rate_hz).run(gyro, accel)

    def rmse(quat_VS: np.ndarray) -> tuple[float, float, float]:
        scored = moving & seen
        aligning = seen.copy()
        aligning[rest.stop :] = False
        aligning[: rest.start] = False
        R_VS = Rotation.from_quat(quat_VS)
        R_true = Rotation.from_quat(np.where(seen[:, None], true, [0, 0, 0, 1]))
        psi = so3.heading((R_true[aligning] * R_VS[aligning].inv()).mean().as_quat())
        error = (Rotation.from_rotvec([0, 0, psi]) * R_VS[scored]) * R_true[scored].inv()
        up = error.as_matrix()[:, 2, 2]
        total, heading = error.magnitude(), so3.heading(error.as_quat())
        parts = np.arccos(np.clip(up, -1, 1)), heading, total
        return tuple(float(np.degrees(np.sqrt(np.mean(part**2)))) for part in parts)  # type: ignore[return-value]

    def run(method: str, **options: object) -> np.ndarray:
        return run_filter(gyro, accel, rate_hz, noise, method, **options).quat_WS  # type: ignore[arg-type]

    # Correction only up to the motion: what the corrections in the trial are worth.
    from wepose_pin.filters import Smekf

    early = static.copy()
    early[begin:] = False
    start = so3.tilt(accel[: StaticTest().samples(rate_hz)].mean(axis=0))
    return {
        ROWS[0]: rmse(run("smekf")),
        ROWS[1]: rmse(Smekf(noise, rate_hz, start).run(gyro, accel, early).quat_WS),
        ROWS[2]: rmse(run("smekf", measured_start=True)),
        ROWS[3]: rmse(run("ncf")),
        ROWS[4]: rmse(run("gdc", params=GdcParams(0.12))),
        ROWS[5]: rmse(run("gdc", params=GdcParams(0.01))),
    }


def test_the_filters_on_real_motion(data: Path) -> None:
    paths = sorted((data / "broad").glob("*.mat"))
    if not paths:
        pytest.skip(f"no real recordings at {data / 'broad'}")
    rows = [errors_deg(path) for path in paths]
    mean = {name: np.mean([row[name] for row in rows], axis=0) for name in ROWS}
    print(f"\n{len(paths)} trials, RMSE [deg]            inclination  heading  total")
    for name, (inclination, heading, total) in mean.items():
        print(f"{name:36s} {inclination:8.2f} {heading:10.2f} {total:6.2f}")
    inclination, _, total = mean["smekf"]
    assert 4.5 <= total <= 6.5
    assert inclination <= 3.5
    # The correction at rests is worth something, and the other two are as good as they are known to be.
    assert inclination < mean[ROWS[1]][0]
    assert mean["ncf"][2] < 9.0
    assert mean["gdc 0.01"][2] < mean["gdc 0.12"][2] < 8.0
