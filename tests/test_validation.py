"""The experiments: seeded, scored as they say, beside the paper's figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from wepose_pin.cli import main
from wepose_pin.errors import BadData, MissingFile
from wepose_pin.filters import METHODS
from wepose_pin.readers.trials import read_authors_trial, read_broad
from wepose_pin.validation import Result, experiments, summary


def run(name: str, quick: bool = True) -> list[Result]:
    return [result for job in experiments(quick)[name] for result in job()]


def test_the_order_of_the_filters_in_the_dynamic_experiment() -> None:
    results = run("dynamic 100 Hz")
    assert len(results) == 2 * len(METHODS)
    mean = {method: figures for _, method, figures, _ in summary(results)}
    for axis in ("roll", "pitch"):
        assert mean["smekf"][axis] < mean["gdc"][axis] < mean["ncf"][axis]
    assert all(figures["yaw"] < 2.5 for figures in mean.values())


def test_two_runs_give_the_same_figures() -> None:
    assert run("drift") == run("drift")


def test_the_drift_experiment_is_the_papers() -> None:
    mean = {method: figures for _, method, figures, _ in summary(run("drift"))}
    assert mean["smekf"]["drift_deg_min"] < 0.1
    assert mean["smekf"]["drift_deg_min"] < mean["ncf"]["drift_deg_min"]


def test_the_hand_with_sensor_noise_alone_is_within_the_papers_error() -> None:
    for _, method, figures, paper in summary(run("upper body, MTi-3 noise alone")):
        print(f"{method}: hand {figures['hand']:.2f} mm, shoulders {figures['from shoulders']:.2f}, paper {paper}")
        if method == "smekf":
            assert figures["from shoulders"] < 12.0


def test_the_command_writes_every_trial(tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["validate", "--quick", "--data", str(data), "-o", str(tmp_path / "out")])
    assert not stop.value.code
    said = capsys.readouterr().out
    for words in ("dynamic 1 kHz", "12.05 ± 6.20", "BROAD, 2 trials", "the authors' trial"):
        assert words in said
    document = json.loads((tmp_path / "out" / "validation.json").read_text())
    names = {result["experiment"] for result in document["results"]}
    assert names == set(experiments(True, data))


def test_trials_that_are_none_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match="neither broad"):
        experiments(data=tmp_path)
    for read in (read_broad, read_authors_trial):
        with pytest.raises(MissingFile, match="no such file"):
            read(tmp_path / "nothing.mat")
        (tmp_path / "text.mat").write_text("no trial\n")
        with pytest.raises(BadData):
            read(tmp_path / "text.mat")


def test_real_trials_are_read_as_they_are(data: Path) -> None:
    trial = read_broad(next(iter(sorted((data / "broad").glob("*.mat")))))
    assert trial.rate_hz == pytest.approx(286, abs=1)
    assert np.linalg.norm(trial.accel_S[trial.still], axis=1).mean() == pytest.approx(9.8, abs=0.2)
    assert not trial.scored[trial.still].any()
    authors = read_authors_trial(data / "wepose_hr" / "prova_HR.txt")
    assert int(np.argmax(authors.scored)) == 725
