"""The tutorial to an OpenSim motion, word by word: each command, what it is said to print, and the script."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def run(words: list[str], folder: Path) -> str:
    """What a command prints on both streams; it has to succeed."""
    environment = os.environ | {
        "PATH": f"{folder}/bin{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "BROWSER": "true",  # a program that does nothing, in place of one that opens a window
    }
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, (words, done.stderr[-2000:])
    return done.stdout + done.stderr


def read_mot(file: Path) -> pl.DataFrame:
    lines = file.read_text(encoding="utf-8").splitlines()
    first = next(k for k, line in enumerate(lines) if line.strip() == "endheader") + 1
    rows = [line.split() for line in lines[first + 1 :] if line.strip()]
    return pl.DataFrame(np.array(rows, dtype=float), schema=lines[first].split())


@pytest.mark.peer
def test_the_tutorial_runs_as_it_stands(data: Path, tmp_path: Path) -> None:
    if importlib.util.find_spec("opensim") is None or importlib.util.find_spec("ezc3d") is None:
        pytest.skip("OpenSim's Python package, or ezc3d, is not installed")
    (tmp_path / "bin").mkdir()
    wepose = tmp_path / "bin" / "wepose"
    wepose.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m wepose_pin "$@"\n')
    wepose.chmod(0o755)
    shutil.copyfile(data / "osim" / "Rajagopal_2015.osim", tmp_path / "Rajagopal_2015.osim")  # what the page asks for
    run(["wepose", "simulate", "-o", "bin/recorded", "--seed", "1"], tmp_path)
    pl.read_parquet(tmp_path / "bin/recorded/recording.parquet").write_csv(tmp_path / "trial.csv")  # in place of step 1
    blocks = BLOCK.findall((ROOT / "docs" / "opensim.md").read_text(encoding="utf-8"))
    assert [kind for kind, _ in blocks].count("python") == 1
    for kind, text in blocks:
        if kind == "python":
            (tmp_path / "opensense.py").write_text(text)
            run([sys.executable, "opensense.py"], tmp_path)
            continue
        for command, *expected in (part.splitlines() for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]):
            printed = [" ".join(line.split()) for line in run(["sh", "-c", command], tmp_path).splitlines()]
            for line in expected:
                assert " ".join(line.split()) in printed, (command, printed)
    ours, theirs = read_mot(tmp_path / "circles.mot"), read_mot(tmp_path / "circles_ik.mot")
    ours = ours.filter(pl.col("time").is_between(theirs["time"].min() - 1e-6, theirs["time"].max() + 1e-6))
    assert theirs.height == 1001
    compared = [name for name in ours.columns if name in theirs.columns]
    assert {"time", "arm_flex_l", "pro_sup_r"} <= set(compared)
    assert theirs["arm_flex_l"].max() > 100.0  # beyond the limit of the generic model
    off = np.abs(ours.select(compared).to_numpy() - theirs.select(compared).to_numpy()).max()
    assert off < 0.2  # as the page says
