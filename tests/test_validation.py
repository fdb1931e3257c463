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
from wepose_pin.validation import Result, list_experiments, run_jobs, summarize


def run(name: str, quick: bool = True) -> list[Result]:
    return [result for job in list_experiments(quick)[name] for result in job()]


def test_the_papers_order_comes_back_out_of_the_box_only() -> None:
    """As they come, NCF and GDC are behind as in the paper; with tuned gains and the bias removed they are not."""
    mean = {method: figures for _, method, figures, _ in summarize(run("dynamic 100 Hz"))}
    assert set(METHODS) < set(mean)
    for axis in ("roll", "pitch", "yaw"):
        assert mean["smekf"][axis] < mean["gdc, default gains"][axis] < 5.0
        assert mean["smekf"][axis] < mean["ncf, default gains"][axis] < 5.0
        assert mean["gdc"][axis] < mean["gdc, default gains"][axis]
        assert mean["ncf"][axis] < mean["ncf, default gains"][axis]


def test_two_runs_give_the_same_figures_on_any_number_of_workers() -> None:
    jobs = list_experiments(True)["dynamic 100 Hz"] * 2
    alone, again, *_ = run_jobs(jobs, workers=1)
    assert alone == again
    assert list(run_jobs(jobs, workers=2)) == [alone, again]


def test_the_drift_experiment_is_the_papers() -> None:
    mean = {method: figures for _, method, figures, _ in summarize(run("drift"))}
    assert mean["smekf"]["drift_deg_min"] < 0.1
    assert mean["smekf"]["drift_deg_min"] < mean["ncf"]["drift_deg_min"] < mean["ncf, default gains"]["drift_deg_min"]


@pytest.mark.slow
@pytest.mark.parametrize(("world", "limit_mm"), [("MTi-3 noise alone", 12.0), ("realistic", 25.0)])
def test_the_hand_of_one_subject(world: str, limit_mm: float) -> None:
    """The experiment's targets, 12 and 18 mm, are means over ten subjects; this one is among the worst of them."""
    (smekf,) = [result for result in run(f"upper body, {world}") if result.method == "smekf"]
    assert smekf.figures["hand_mm"]["mean"] < limit_mm
    assert smekf.figures["hand_from_shoulders_mm"]["mean"] < limit_mm


def test_the_command_writes_every_trial(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {k: v[:1] for k, v in list_experiments(True, data).items() if k in ("dynamic 100 Hz", "BROAD", "UR5")}
    monkeypatch.setattr("wepose_pin.validation.list_experiments", lambda *_: few)
    with pytest.raises(SystemExit) as stop:
        main(["validate", "--quick", "--data", str(data), "-o", str(tmp_path / "out")])
    assert not stop.value.code
    said = capsys.readouterr().out
    for words in ("dynamic 100 Hz", "BROAD, 1 trial", "UR5"):
        assert words in said
    document = json.loads((tmp_path / "out" / "validation.json").read_text())
    assert {result["experiment"] for result in document["results"]} == set(few)


def test_trials_that_are_none_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match="neither broad"):
        list_experiments(data=tmp_path)
    for read in (read_broad, read_authors_trial):
        with pytest.raises(MissingFile, match="no such file"):
            read(tmp_path / "nothing.mat")
        (tmp_path / "text.mat").write_text("no trial\n")
        with pytest.raises(BadData):
            read(tmp_path / "text.mat")


def test_real_trials_are_read_as_they_are(data: Path) -> None:
    trial = read_broad(next(iter(sorted((data / "broad").glob("*.mat")))))
    assert trial.rate_hz == pytest.approx(286, abs=1)
    assert np.linalg.norm(trial.accel_S[trial.static], axis=1).mean() == pytest.approx(9.8, abs=0.2)
    assert not trial.scored[trial.static].any()
    authors = read_authors_trial(data / "wepose_hr" / "prova_HR.txt")
    assert int(np.argmax(authors.scored)) == 725
