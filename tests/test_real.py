"""RING and UR5: read as they are, registered on a stretch that is not scored, and what the filters make of them."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.trials import Referenced
from benchmarks.validation import real
from benchmarks.validation.experiment import run_experiment
from benchmarks.validation.registration import register_sensors
from benchmarks.validation.single import SingleSensor, simulate_paper_dynamic
from wepose_pin.errors import WeposeError

# What the simulated sensor and its reference lie apart by.
OFFSET_S = -0.028
R_BS = Rotation.from_rotvec([8.0, -3.0, 95.0], degrees=True)
R_VW = Rotation.from_rotvec([0.0, 0.0, 130.0], degrees=True) * Rotation.from_rotvec([0.9, -0.5, 0.0], degrees=True)


@pytest.fixture(scope="module")
def moving() -> SingleSensor:
    return simulate_paper_dynamic(5, 100.0)


def seen_from_elsewhere(sensor: SingleSensor, still: slice = slice(0, 0)) -> Referenced:
    """The sensor beside a reference at 60 Hz with gaps, of another body frame, world and clock."""
    time = np.arange(0.0, sensor.time[-1] - 0.2, 1.0 / 60.0) + 0.1
    k = (time + OFFSET_S) * sensor.rate_hz
    before = np.floor(k).astype(int)
    R_WS = Rotation.from_quat(sensor.quat_WS)
    step = (R_WS[before].inv() * R_WS[before + 1]).as_rotvec()
    true = R_WS[before] * Rotation.from_rotvec((k - before)[:, None] * step)
    quat_VB = (R_VW * true * R_BS.inv()).as_quat()
    quat_VB[np.sin(2.0 * time) > 0.9] = np.nan
    return Referenced("made", sensor.rate_hz, sensor.gyro_S, sensor.accel_S, time, quat_VB, still)


@pytest.mark.parametrize("still", [slice(0, 0), slice(50, 450)], ids=["bias unknown", "bias known"])
def test_registration_finds_what_lies_between(moving: SingleSensor, still: slice) -> None:
    (registration,) = register_sensors([seen_from_elsewhere(moving, still)], (6.0, 16.0))
    assert registration.offset_s == pytest.approx(OFFSET_S, abs=1e-3)
    assert np.degrees((Rotation.from_quat(registration.quat_BS) * R_BS.inv()).magnitude()) < 0.1
    up_W = (Rotation.from_quat(registration.quat_WV) * R_VW).apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos(up_W[2])) < 0.35  # 3 mg of accelerometer bias are 0.17 deg
    assert np.degrees(np.abs(registration.gyro_bias - moving.gyro_bias.mean(axis=0)).max()) < 0.02
    assert registration.residual_deg < 0.2


def test_what_cannot_be_registered_is_said(moving: SingleSensor) -> None:
    apart = seen_from_elsewhere(moving)
    with pytest.raises(WeposeError, match="made: its body does not turn"):
        register_sensors([apart], (0.0, 4.5))  # at rest
    R_WS = Rotation.from_rotvec(np.sin(3.0 * apart.time)[:, None] * [0.5, 0.0, 0.0])
    gyro = np.column_stack([1.5 * np.cos(3.0 * (moving.time - 0.005 - OFFSET_S)), *np.zeros((2, len(moving.time)))])
    with pytest.raises(WeposeError, match="made: its body turns about one axis only"):
        register_sensors([apart._replace(gyro_S=gyro, quat_VB=R_WS.as_quat())], (6.0, 16.0))
    with pytest.raises(WeposeError, match="made: the reference saw 0 samples"):
        register_sensors([apart._replace(quat_VB=np.full_like(apart.quat_VB, np.nan))], (6.0, 16.0))
    with pytest.raises(WeposeError, match=r"made: no offset of the clocks within 0\.3 s"):
        register_sensors([apart._replace(time=apart.time + 0.31)], (6.0, 16.0))


def means(data: Path, experiment: str) -> dict[str, dict[str, float]]:
    summary = run_experiment(real.list_experiments(data)[experiment], workers=1)
    assert not summary.skipped
    return {
        method: {name: float(mean) for name, (mean, *_) in row.items() if mean is not None}
        for method, row in summary.rows.items()
    }


def test_the_filters_on_ring(data: Path) -> None:
    rigid = means(data, "RING, rigid mounts")
    loose = means(data, "RING, loose mounts")
    unknown = means(data, "RING, rigid mounts, bias unknown")
    for method in ("smekf", "ncf", "gdc"):
        assert rigid[method]["inclination [deg]"] < 1.5
        assert rigid[method]["heading [deg]"] < 1.5
        assert rigid[method]["total [deg]"] < loose[method]["total [deg]"] < 4.5
    # Never still: what sMEKF does not know of the bias it never learns, while the others lose only the heading.
    assert unknown["smekf"]["inclination [deg]"] > 3.0 * unknown["ncf"]["inclination [deg]"]


def test_link_lengths_from_orientations_and_tip(data: Path) -> None:
    for mount, limit_mm in (("rigid", 3.0), ("loose", 15.0)):
        mean = means(data, f"RING, link lengths, {mount} mounts")
        for method in ("smekf", "ncf", "gdc"):
            for link, optical in mean["optical"].items():
                assert abs(mean[method][link] - optical) < limit_mm


def test_the_filters_on_ur5(data: Path) -> None:
    assert len(real.list_experiments(data)["UR5"]) == 7
    mean = means(data, "UR5")
    for method in ("smekf", "ncf", "gdc"):
        assert mean[method]["total [deg]"] < 1.5
