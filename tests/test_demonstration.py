"""What the figure does to show a step of the guide."""

import numpy as np
import pytest

from wepose_pin import load_model
from wepose_pin.calibration import load_protocol
from wepose_pin.live.guide import Demonstration
from wepose_pin.live.state import GuideView


def wrist_heights(protocol: str, phase: str) -> np.ndarray:
    """(n,) [m] of the left wrist above the hips, over half a minute of a phase."""
    model = load_model()
    figure = Demonstration(model, load_protocol(protocol))
    wrist = figure.info.points.index("left_wrist")
    return np.array(
        [figure.pose(GuideView("", demonstration=phase), t).points[wrist, 2] for t in np.arange(0, 30, 0.5)]
    )


@pytest.mark.parametrize("protocol", ["clasp+t_pose", "t_pose+bow", "clasp+t_pose+bow"])
def test_each_phase_of_a_joined_protocol_is_shown(protocol: str) -> None:
    lengths = load_model().lengths
    heights = wrist_heights(protocol, "t_pose")
    assert heights.max() == pytest.approx(lengths["trunk"], abs=0.05)  # the level of the shoulders
    for step in load_protocol(protocol).steps:
        if step.phase != "start":
            assert np.ptp(wrist_heights(protocol, step.phase)) > 0.05, step.phase


def test_the_start_pose_stands() -> None:
    assert np.ptp(wrist_heights("clasp", "")) == 0.0
