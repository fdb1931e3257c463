"""Three short sessions and a plan over them, for the tests of `wepose batch`, which import the two fixtures."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from wepose_pin.simulation import simulate, simulate_person
from wepose_pin.writers import write_session

PLAN = """
[sessions]
files = ["data/*/session.toml"]
[steps.track]
view = false
report = false
[steps.evaluate]
"""


@pytest.fixture(name="recorded", scope="module")
def three_sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short sessions, one/ to three/."""
    folder = tmp_path_factory.mktemp("recorded")
    for seed, name in enumerate(("one", "two", "three"), 1):
        made_up = simulate(simulate_person(seed).lengths, seed=seed, clasp_s=8.0, circles=0)
        (folder / name).mkdir()
        write_session(folder / name, made_up.recording(name), made_up.truth())
    return folder


@pytest.fixture(name="study")
def sessions_and_plan(recorded: Path, tmp_path: Path) -> Path:
    shutil.copytree(recorded, tmp_path / "data")
    (tmp_path / "plan.toml").write_text(PLAN)
    return tmp_path


def files(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
