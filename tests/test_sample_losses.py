"""Calibration of sensors that lost samples between the start pose and the motion: their headings step there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.calibration import calibrate
from wepose_pin.calibration.lengths import Calibration
from wepose_pin.calibration.sample_losses import SampleLoss, find_sample_losses, group_steps, mask_connected
from wepose_pin.errors import BadPhase
from wepose_pin.recording import ImuSensor, Recording
from wepose_pin.simulation import NOISE_FREE, Simulation, simulate, simulate_person

ALL = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(simulate_person(3).lengths, seed=3, noise=NOISE_FREE, clasp_s=24.0, circles=0)


def lossy(simulation: Simulation, lost: tuple[float, float], names: tuple[str, ...], stated: bool = False) -> Recording:
    """The recording with these sensors lost from, to [s] after joining the hands; mounts stated or none."""
    recording = simulation.recording()
    first = recording.phases["clasp"][0][0]
    gap = (recording.time > first + lost[0]) & (recording.time < first + lost[1])

    def of(name: str, sensor: ImuSensor) -> ImuSensor:
        mount = sensor.stated_quat_LS if stated else None
        if name not in names:
            return replace(sensor, stated_quat_LS=mount)
        gyro_S = np.where(gap[:, None], 0.0, sensor.gyro_S)
        return replace(sensor, stated_quat_LS=mount, gyro_S=gyro_S, gap=gap)

    return replace(recording, sensors={name: of(name, sensor) for name, sensor in recording.imus.items()})


def worst_mount(calibration: Calibration, simulation: Simulation) -> float:
    """[deg]"""
    return max(
        float(np.degrees((Rotation.from_quat(quat) * Rotation.from_quat(simulation.quat_LS[name]).inv()).magnitude()))
        for name, quat in calibration.subject.mounts.items()
    )


@pytest.mark.parametrize(
    "names",
    [("left_upper_arm",), ("torso",), pytest.param(ALL, marks=pytest.mark.slow)],
    ids=["upper arm", "torso", "all"],
)
def test_headings_step_where_samples_were_lost(simulation: Simulation, names: tuple[str, ...]) -> None:
    calibration = calibrate(lossy(simulation, (11.0, 13.0), names))
    assert calibration.rms_gap < 0.003
    assert worst_mount(calibration, simulation) < 4.0


def test_a_loss_before_the_hands_are_joined_needs_the_mount(simulation: Simulation) -> None:
    with pytest.raises(BadPhase, match=r"left_upper_arm is lost from .* and its heading with it: .* state its mount"):
        calibrate(lossy(simulation, (-0.5, 2.0), ("left_upper_arm",)))
    calibration = calibrate(lossy(simulation, (-0.5, 2.0), ("left_upper_arm",), stated=True))
    assert calibration.rms_gap < 0.004  # arms that hang exactly contradict how people stand
    assert worst_mount(calibration, simulation) < 4.0


def test_samples_without_a_known_tilt_are_left_out(simulation: Simulation) -> None:
    """The smekf corrects while static, and joined hands are never static."""
    with pytest.raises(BadPhase, match=r"phases\.clasp holds 0 samples .*: sensors\.left_upper_arm, or their tilt"):
        calibrate(lossy(simulation, (-0.5, 2.0), ("left_upper_arm",), stated=True), method="smekf")


def test_what_lies_beyond_a_loss() -> None:
    simulation = simulate(simulate_person(3).lengths, seed=3, noise=NOISE_FREE, clasp_s=10.0, circles=0)
    recording = simulation.recording()
    start = recording.span(recording.phases["start"][0])
    sensor = recording.sensors["torso"]
    gap = np.zeros(len(recording), dtype=bool)
    for first, last in ((2, 9), (start.stop + 100, start.stop + 399), (start.stop + 420, start.stop + 425)):
        gap[first : last + 1] = True
    sensors = {**recording.sensors, "torso": replace(sensor, gap=gap)}
    early, long, short = losses = find_sample_losses(
        replace(recording, sensors=sensors), recording.phases["start"][0], ("torso", "left_forearm")
    )
    assert [loss.after for loss in losses] == [False, True, True]
    assert [loss.free for loss in losses] == [False, True, False]
    samples = np.array([0, start.start, start.stop + 90, start.stop + 410, start.stop + 500])
    assert mask_connected([long], samples).tolist() == [True, True, True, False, False]
    assert mask_connected([early], samples).tolist() == [False, True, True, True, True]
    names, std, beyond = group_steps(losses, samples)
    assert names == ("torso",) * 3
    assert beyond.astype(int).tolist() == [[1, 0, 0, 0, 0], [0, 0, 0, 1, 1], [0, 0, 0, 0, 1]]
    assert std.tolist() == [early.std, long.std, short.std]
    # Between two losses that no sample tells apart lies one step.
    names, std, beyond = group_steps(losses, samples[[1, 2, 4]])
    assert (names, len(beyond)) == (("torso",), 1)
    assert std[0] == pytest.approx(min(np.hypot(long.std, short.std), np.pi / np.sqrt(3.0)))


def test_nothing_lost_is_no_step() -> None:
    assert (
        find_sample_losses(
            Recording("none", np.arange(3.0), 1.0, {"torso": ImuSensor(np.zeros((3, 3)), np.zeros((3, 3)))}),
            (0.0, 1.0),
            ("torso",),
        )
        == []
    )
    names, std, beyond = group_steps([], np.arange(4))
    assert (names, len(std), beyond.shape) == ((), 0, (0, 4))
    assert mask_connected([], np.arange(2)).all()
    assert not mask_connected([SampleLoss("torso", 1, 2, True, 1.0)], np.array([3])).any()
