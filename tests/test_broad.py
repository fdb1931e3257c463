"""Filters on the BROAD trials: 15 recordings of three minutes with optical truth (Laidig et al. 2021).

Heading aligned in the static phase, errors over the marked motion, root mean square, averaged over trials. The bias
measured in the static phase is removed for every filter.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.trials import read_broad
from wepose_pin import rotations
from wepose_pin.filters import FilterSettings, GdcParams, Smekf, run_filter
from wepose_pin.filters.noise import estimate_noise
from wepose_pin.filters.static import StaticDetector, StaticTest

ROWS = ("smekf", "smekf, no correction in motion", "smekf, start measured", "ncf", "gdc 0.12", "gdc 0.01")


def errors_deg(path: Path) -> dict[str, tuple[float, float, float]]:
    """Row → (inclination, heading, total) RMSE [deg] of one trial."""
    trial = read_broad(path)
    gyro, accel, rate_hz = trial.gyro_S, trial.accel_S, trial.rate_hz
    noise = estimate_noise(gyro[trial.static], accel[trial.static], rate_hz)
    seen = np.isfinite(trial.quat_true).all(axis=1)
    true = Rotation.from_quat(np.where(seen[:, None], trial.quat_true, [0, 0, 0, 1]))
    resting = np.zeros(len(seen), dtype=bool)
    resting[trial.static] = seen[trial.static]

    def rmse(quat_VS: np.ndarray) -> tuple[float, float, float]:
        R_VS = Rotation.from_quat(quat_VS)
        psi = rotations.heading((true[resting] * R_VS[resting].inv()).mean().as_quat())
        error = (Rotation.from_rotvec([0, 0, psi]) * R_VS[trial.scored]) * true[trial.scored].inv()
        parts = (
            np.arccos(np.clip(error.as_matrix()[:, 2, 2], -1, 1)),
            rotations.heading(error.as_quat()),
            error.magnitude(),
        )
        inclination, heading, total = (float(np.degrees(np.sqrt(np.mean(part**2)))) for part in parts)
        return inclination, heading, total

    def run(method: str, **options: Any) -> np.ndarray:
        return run_filter(gyro, accel, rate_hz, noise, FilterSettings(method, **options)).quat_WS

    # Correction only up to the motion: what the corrections in the trial are worth.
    early = StaticDetector(noise, rate_hz).run(gyro, accel)
    early[trial.static.stop + round(rate_hz) :] = False  # the motion begins a second after what counts as still
    start = rotations.quat_from_gravity(accel[: StaticTest().samples(rate_hz)].mean(axis=0))
    return {
        ROWS[0]: rmse(run("smekf")),
        ROWS[1]: rmse(Smekf(noise, rate_hz, start).run(gyro, accel, early).quat_WS),
        ROWS[2]: rmse(run("smekf", measured_start=True)),
        ROWS[3]: rmse(run("ncf")),
        ROWS[4]: rmse(run("gdc", params=GdcParams(0.12))),
        ROWS[5]: rmse(run("gdc", params=GdcParams(0.01))),
    }


@pytest.mark.slow
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
