"""Calibration of sensors that lost samples: what is connected with the start pose is used."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from wepose_pin import (
    NOISE_FREE,
    ImuSensor,
    Recording,
    Simulation,
    WeposeError,
    calibrate,
    simulate,
    simulate_person,
    track,
)


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(simulate_person(3).lengths, seed=3, noise=NOISE_FREE, clasp_s=24.0, circles=0)


def lossy(simulation: Simulation, lost: tuple[float, float]) -> Recording:
    """The recording with the left upper arm lost from, to [s] after joining the hands."""
    recording = simulation.recording()
    begin = recording.phases["clasp"][0][0]
    gap = (recording.time > begin + lost[0]) & (recording.time < begin + lost[1])
    arm = recording.imus["left_upper_arm"]
    arm = ImuSensor(np.where(gap[:, None], 0.0, arm.gyro_S), arm.accel_S, arm.stated_quat_LS, gap)
    return replace(recording, sensors={**recording.sensors, "left_upper_arm": arm})


def test_what_lies_beyond_a_loss_is_not_used(simulation: Simulation) -> None:
    recording = lossy(simulation, (14.0, 15.0))
    begin, end = recording.phases["clasp"][0]
    calibration = calibrate(recording)
    assert begin + 13.5 < calibration.time[-1] < begin + 14.1
    [unused] = [each for each in calibration.diagnostics if each.code == "samples-not-connected"]
    assert unused.place == "left_upper_arm"
    assert unused.value == pytest.approx(end - begin - 14.0, abs=0.05)
    upto = replace(recording, phases={**recording.phases, "clasp": ((begin, begin + 13.99),)})
    assert calibration.subject.lengths == pytest.approx(calibrate(upto).subject.lengths, rel=1e-3)
    posed = replace(recording, phases={**recording.phases, "t_pose": ((end - 3.0, end),)})
    assert calibrate(posed).subject.lengths == calibration.subject.lengths
    assert [each.place for each in calibrate(posed).diagnostics if each.code == "phase-not-used"] == ["t_pose"]
    with pytest.raises(WeposeError, match=r"phases\.t_pose has 0\.0 s in which"):
        calibrate(posed, protocol="clasp+t_pose")


def test_a_loss_between_the_start_pose_and_the_motion_is_one_line(simulation: Simulation) -> None:
    with pytest.raises(
        WeposeError,
        match=r"phases\.clasp has 0\.0 s in which .*; sensors\.left_upper_arm is lost from .* and its heading with it: "
        r"name a start pose and a motion with nothing lost between them, or record again",
    ) as caught:
        calibrate(lossy(simulation, (-0.5, 2.0)))
    assert "\n" not in str(caught.value)


def test_a_loss_of_some_samples_changes_little(simulation: Simulation) -> None:
    whole, short = calibrate(simulation.recording()), calibrate(lossy(simulation, (11.0, 11.08)))
    assert short.subject.lengths == pytest.approx(whole.subject.lengths, abs=2e-3)
    assert "samples-not-connected" not in [each.code for each in short.diagnostics]


@pytest.mark.parametrize("options", [{}, {"causal": True}, {"method": "smekf"}, {"method": "smoother"}])
def test_nothing_is_known_of_a_segment_while_its_sensor_is_lost(
    simulation: Simulation, options: dict[str, Any]
) -> None:
    """Its ± is that of an angle which may be any, and no hand is further off than an arm allows."""
    recording = lossy(simulation, (5.0, 15.0))
    begin = recording.phases["clasp"][0][0]
    pose = track(recording, **options).pose
    during = (pose.time > begin + 7.0) & (pose.time < begin + 14.5)
    std = np.sqrt(np.linalg.eigvalsh(pose.segment_cov["left_upper_arm"][during]))
    assert std == pytest.approx(np.pi / np.sqrt(3.0), rel=0.05)
    arm = sum(length for name, length in simulation.lengths.items() if name.startswith("left_"))
    assert np.sqrt(np.trace(pose.point_cov["left_palm"][during], axis1=1, axis2=2)).max() < 2.0 * arm
