"""The scripts of docs/play.md, run as they stand there on a trajectory."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from test_export_robot import find_lerobot, place_by_pinocchio, write_trajectory_folder

from wepose_pin import export

PAGE = Path(__file__).resolve().parents[1] / "docs" / "play.md"
SCRIPTS = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL))


def run(script: str, folder: Path, *arguments: object, python: str = sys.executable) -> str:
    (folder / script).write_text(SCRIPTS[script], encoding="utf-8")
    words = [python, "-W", "ignore", script, *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    ran = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_the_page_has_a_script_of_each() -> None:
    assert {name: len(text.splitlines()) <= 26 for name, text in SCRIPTS.items()} == dict.fromkeys(
        ("play_mujoco.py", "send_trajectory.py", "clone.py"), True
    )
    for name, text in SCRIPTS.items():
        compile(text, name, "exec")


@pytest.mark.peer
def test_mujoco_plays_it(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    folder = write_trajectory_folder(tmp_path / "arm", seconds=2.4)
    compiler = '<mujoco><compiler balanceinertia="true" boundmass="0.1" boundinertia="0.1"/></mujoco>'
    text = (folder / "robot.urdf").read_text().replace('<robot name="arm">', f'<robot name="arm">{compiler}')
    spec = mujoco.MjSpec.from_string(text)
    spec.compile()
    (tmp_path / "arm.xml").write_text(spec.to_xml(), encoding="utf-8")
    printed = run("play_mujoco.py", tmp_path, folder, tmp_path / "arm.xml")
    assert printed.startswith("7 joints, 120 samples; the last body at [")
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d+(?:e-\d+)?", printed.partition("[")[2])]
    np.testing.assert_allclose(numbers, place_by_pinocchio(folder, -1, pin.SE3.Identity())["hand"][:3, 3], atol=1e-6)


@pytest.mark.peer
def test_lerobot_learns_from_it(tmp_path: Path) -> None:
    python = find_lerobot()
    folders = [write_trajectory_folder(tmp_path / f"reach_{seed}", seed=seed, seconds=4.0) for seed in (1, 2)]
    export(folders, tmp_path / "data", "lerobot", rate_hz=25.0, instruction="reach for the cup")
    printed = run("clone.py", tmp_path, tmp_path / "data", python=python)
    assert printed.startswith("2 episodes, 200 frames at 25 Hz: reach for the cup\n")
    losses = [float(number) for number in re.findall(r"epoch \d: ([\d.]+)", printed)]
    assert losses[2] < 0.7 * losses[0]
