"""A person's right arm moves a robot arm, within the robot's limits.

    python examples/move_robot.py result panda_table

`result` is a folder that `wepose track` wrote. Without arguments it simulates a person and takes the Panda of
example-robot-data (`pip install '.[retarget]'`), upright on a table; `panda` lies on its side, as an arm hangs on a
torso. Both are shown side by side in view.html.
"""

import sys
from pathlib import Path

import numpy as np

import wepose_pin as wp
from wepose_pin.report.viewer import retarget_html

if len(sys.argv) > 2:
    result, robot = wp.load_result(sys.argv[1]), sys.argv[2]
else:
    subject = wp.population_subject(1.75, "f")
    recording = wp.simulate(subject.lengths, seed=1, clasp_s=10.0, circles=2).recording()
    result, robot = wp.track(recording, subject), "panda_table"

trajectory = wp.retarget(result, robot)
print(trajectory)
print(f"{len(trajectory.time)} samples at {1.0 / np.median(np.diff(trajectory.time)):.0f} Hz")
print(f"joint positions {trajectory.joint_position.shape} [rad]")
page = retarget_html(result.model, result.pose, trajectory, title=f"{result.name}, {robot}")
Path("view.html").write_text(page, encoding="utf-8")
