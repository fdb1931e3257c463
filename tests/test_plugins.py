"""Plug-ins: the example's distribution is installed, and what it registers is used as what this package has."""

import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

import wepose_pin as wp
from wepose_pin.writers import write_session

EXAMPLE = Path(__file__).parents[1] / "examples" / "plugin"
RUN = """
from wepose_pin.commands import main
for line in {lines!r}:
    try:
        main(line.split())
    except SystemExit as stop:
        assert (stop.code or 0) == 2 * ("nowhere" in line), line
"""


def run(folder: Path, *lines: str) -> str:
    """What commands print, in a process in which the example is installed."""
    pytest.importorskip("setuptools", minversion="77")
    shutil.copytree(EXAMPLE, folder / "source")
    build = [sys.executable, "-c", "from setuptools.build_meta import build_wheel; build_wheel('..')"]
    subprocess.run(build, cwd=folder / "source", capture_output=True, check=True)
    (wheel,) = folder.glob("*.whl")
    ZipFile(wheel).extractall(folder / "site")  # as pip does, in a third of the time
    code = f"import sys; sys.path.insert(0, 'site')\n{RUN.format(lines=lines)}"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_example_reads_writes_and_sends(half_minute: wp.Recording, tmp_path: Path) -> None:
    torso = half_minute.imus["torso"]
    for name in ("made", "band"):
        (tmp_path / name).mkdir()
    write_session(tmp_path / "made", half_minute)
    rows = np.column_stack([half_minute.time, torso.gyro_S, torso.accel_S])
    np.savetxt(tmp_path / "band" / "torso.acme", rows)
    printed = run(
        tmp_path,
        "track made -o result --no-view --no-report",
        "export result -o palm.acme --rate-hz 50",
        "info band/torso.acme --write",
        "info band/session.toml",
        "live --source acme:nowhere --no-page",  # which its source looks for
        "live --source replay:made --speed max --no-page --output acme:height.txt",
    )
    palm, height = (np.loadtxt(tmp_path / name) for name in ("palm.acme", "height.txt"))
    assert palm.shape[1] == 4
    assert np.allclose(np.diff(palm[:, 0]), 0.02)
    assert "recording of an Acme Band" in printed
    assert 'format = "acme"' in (tmp_path / "band/session.toml").read_text(encoding="utf-8")
    assert len(height) > 20
    assert np.all(np.diff(height[:, 0]) > 0)
