"""Kernels are compiled once and kept."""

import os
import subprocess
import sys
from pathlib import Path

_FIRST_USE = """
import numpy as np
from wepose_pin import rotations
print(rotations.up_in_sensor(np.array([0.0, 0.0, 0.0, 1.0])))
"""


def _fresh(code: str, notices: int = 0, **environment: str) -> str:
    run = subprocess.run(
        [sys.executable, "-B", "-c", code], env=os.environ | environment, capture_output=True, text=True, check=True
    )
    assert run.stderr.count("compiling the filters") == run.stderr.count("\n") == notices
    return run.stdout


def test_compiled_once_and_kept(tmp_path: Path) -> None:
    announced = "import sys\nsys.stderr.isatty = lambda: True\n" + _FIRST_USE
    assert _fresh(announced, notices=1, NUMBA_CACHE_DIR=str(tmp_path)) == "(0.0, 0.0, 1.0)\n"
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")}
    assert kept
    assert _fresh(announced, NUMBA_CACHE_DIR=str(tmp_path)) == "(0.0, 0.0, 1.0)\n"
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")} == kept


def test_neither_tracking_nor_calibration_loads_the_statistics_of_scipy() -> None:
    """They take half a second."""
    code = (
        "import sys, wepose_pin.tracking, wepose_pin.calibration, wepose_pin.report.track, wepose_pin.writers\n"
        "print(sorted({'scipy.signal', 'scipy.stats', 'scipy.optimize'} & set(sys.modules)))"
    )
    assert _fresh(code) == "[]\n"
