"""Every example runs as it stands, and writes what it says."""

import os
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from wepose_pin.body.urdf import find_example_data

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))
WAITING = ("live_consumer.py", "robot_receiver.py")  # for ever
SAYS = {
    "calibrate_subject.py": "shoulder_width",
    "estimate_orientation.py": "smekf  largest error 0.",
    "joint_angles.py": "carrying_angle",
    "live_consumer.py": "waiting for poses on 127.0.0.1:9001",
    "move_robot.py": "Trajectory('panda_table'",
    "robot_receiver.py": "waiting for commands on 127.0.0.1:9002",
    "track_recording.py": "right hand from its shoulder",
    "udp_sender.py": "sent 200 samples of each of 5 sensors to 127.0.0.1:9000",
}
WRITES = {
    "estimate_orientation.py": {"errors.svg"},
    "joint_angles.py": {"figures"},
    "move_robot.py": {"view.html"},
    "track_recording.py": {"view.html"},
}
LONGEST = ("calibrate_subject.py", "joint_angles.py", "move_robot.py", "track_recording.py")


def test_there_are_examples() -> None:
    assert set(SAYS) <= {path.name for path in EXAMPLES}


@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=[pytest.mark.slow] * (path.name in LONGEST), id=path.name) for path in EXAMPLES]
)
def test_it_runs(path: Path, tmp_path: Path) -> None:
    if path.name == "move_robot.py":
        pytest.importorskip("daqp")
        if find_example_data() is None:
            pytest.skip("example-robot-data is not installed")
    words = [sys.executable, "-W", "error", str(path)]
    if path.name in WAITING:
        with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as waiting:
            assert waiting.stdout is not None
            assert SAYS[path.name] in waiting.stdout.readline()
            waiting.terminate()
        return
    run = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    assert SAYS.get(path.name, "") in run.stdout
    assert {file.name for file in tmp_path.iterdir()} == WRITES.get(path.name, set())


def test_the_gallery_waits_for_no_live_session() -> None:
    pytest.importorskip("sphinx")
    spec = spec_from_file_location("gallery", EXAMPLES[0].parents[1] / "docs/extensions/gallery.py")
    assert spec is not None
    assert spec.loader is not None
    gallery = module_from_spec(spec)
    spec.loader.exec_module(gallery)
    assert set(gallery.WAITING) == set(WAITING)


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a recording to a figure and a robot, cell by cell."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("daqp")
    if find_example_data() is None:
        pytest.skip("example-robot-data is not installed")
    folder = EXAMPLES[0].parent
    monkeypatch.setenv("PYTHONPATH", f"{folder.parent}:{os.environ.get('PYTHONPATH', '')}")
    notebook = nbformat.read(folder / "recording_to_robot.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("<iframe" in data.get("text/html", "") for data in shown)
    assert any(data.get("text/plain", "").startswith("Trajectory('panda'") for data in shown)
    assert {file.name for file in tmp_path.iterdir()} == {"circles.mot", "angles.svg"}
