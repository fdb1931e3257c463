"""RING and UR5: read as they are, registered on a stretch that is not scored, and what the filters make of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.trials import (
    RING_MOUNTS,
    RING_SEGMENTS,
    Referenced,
    read_broad,
    read_ring,
    read_ur5,
)
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


def test_ring_is_read_as_it_is(data: Path) -> None:
    chain = read_ring(data / "ring" / "trial1")
    assert set(chain.sensors) == {(mount, segment) for mount in RING_MOUNTS for segment in RING_SEGMENTS}
    lost = [np.isnan(quat).any(axis=1) for quat in chain.quat_VB.values()]
    assert all(np.array_equal(lost[0], each) for each in lost)
    assert lost[0].sum() == 223
    for sensor in chain.sensors.values():
        assert sensor.rate_hz == 40.0
        assert np.median(np.linalg.norm(sensor.accel_S, axis=1)) == pytest.approx(9.9, abs=0.3)
    lengths = real.fit_optical_links(chain).lengths
    assert lengths["seg2"] == pytest.approx(0.289, abs=1.5e-3)
    assert lengths["seg3"] == pytest.approx(0.289, abs=1.5e-3)
    assert lengths["seg4"] == pytest.approx(0.2705, abs=1e-3)


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


def test_ur5_is_read_as_it_is(data: Path) -> None:
    for recording, sensor, begins_s in (("circle-100", "carpus", 0.9), ("triangle-250", "radius", 4.2)):
        trial = read_ur5(data, recording, sensor)
        assert trial.rate_hz == pytest.approx(125.0)
        assert trial.static.stop / trial.rate_hz == pytest.approx(begins_s, abs=0.3)
        at_rest = np.linalg.norm(trial.accel_S[trial.static], axis=1).mean()
        assert at_rest == pytest.approx(0.97 * 9.81, abs=0.2)


def test_the_filters_on_ur5(data: Path) -> None:
    assert len(real.list_experiments(data)["UR5"]) == 7
    mean = means(data, "UR5")
    for method in ("smekf", "ncf", "gdc"):
        assert mean[method]["total [deg]"] < 1.5


def test_broad_needs_no_registration(data: Path) -> None:
    """Its authors have aligned it: half a sample of the gyroscope's interval is left, and what ten seconds can tell."""
    trial = read_broad(data / "broad" / "01_undisturbed_slow_rotation_A.mat")
    first = int(np.argmax(trial.scored))
    part = slice(first - 800, first + 2860)
    gyro = trial.gyro_S[part] - trial.gyro_S[trial.static].mean(axis=0)
    time = np.arange(len(gyro)) / trial.rate_hz
    sensor = Referenced(
        trial.name, trial.rate_hz, gyro, trial.accel_S[part], time, trial.quat_true[part], trial.static
    )._replace(static=slice(0, 0))
    (registration,) = register_sensors([sensor], (0.0, 12.8))
    assert registration.offset_s == pytest.approx(0.5 / trial.rate_hz, abs=1e-3)
    assert np.degrees(Rotation.from_quat(registration.quat_BS).magnitude()) < 0.3
    assert registration.tilt_deg < 0.4


def test_broken_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(WeposeError, match=r"omc\.csv"):
        read_ring(tmp_path)
    with pytest.raises(WeposeError, match=r"carpus_adx\.csv"):
        read_ur5(tmp_path, "circle-250", "carpus")
    (tmp_path / "omc.csv").write_text("a,b\n1,2\n")
    with pytest.raises(WeposeError, match=r"omc\.csv: begins with 'a,b'.*sampling frequency"):
        read_ring(tmp_path)
    (tmp_path / "omc.csv").write_text("# sampling frequency: 30\na,b\n1,2\n")
    with pytest.raises(WeposeError, match=r"no column 'seg1_quat_w' in .*omc\.csv"):
        read_ring(tmp_path)
