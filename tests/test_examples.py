"""Every example runs as it stands."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))
SAYS = {
    "calibrate_subject.py": "shoulder_width",
    "estimate_orientation.py": "smekf  largest error 0.",
    "live_consumer.py": "no pose for 3 s",
    "track_recording.py": "right hand from its shoulder",
}
LONGEST = ("calibrate_subject.py", "track_recording.py")


def test_there_are_examples() -> None:
    assert set(SAYS) <= {path.name for path in EXAMPLES}


@pytest.mark.parametrize(
    "path", [pytest.param(path, marks=[pytest.mark.slow] * (path.name in LONGEST), id=path.name) for path in EXAMPLES]
)
def test_it_runs(path: Path, tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-W", "error", str(path)], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    assert SAYS.get(path.name, "") in run.stdout
    assert not list(tmp_path.iterdir())
