"""The experiments: seeded, scored as they say, beside the paper's figures."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from wepose_pin.cli import main
from wepose_pin.errors import BadData, BadOption, MissingFile
from wepose_pin.filters import METHODS
from wepose_pin.jobs.validate import ValidateJob
from wepose_pin.readers.trials import read_authors_trial, read_broad
from wepose_pin.simulation import IDEAL_PRESET, simulate, simulate_person
from wepose_pin.validation import (
    Result,
    format_document,
    list_contenders,
    list_experiments,
    read_document,
    run_jobs,
    summarize,
)
from wepose_pin.validation.document import check_same_settings, parse_document
from wepose_pin.validation.paper import MEASURED, calibrate_person, set_exact_mounts, switch_off
from wepose_pin.validation.presets import PRESETS
from wepose_pin.validation.tables import PUBLISHED, describe_known


def run(name: str, quick: bool = True) -> list[Result]:
    return [result for job in list_experiments(quick)[name] for result in job()]


def test_the_papers_order_comes_back_out_of_the_box_only() -> None:
    """As they come, NCF and GDC are behind as in the paper; with tuned gains and the bias removed they are not."""
    mean = {method: figures for _, method, figures, _ in summarize(run("dynamic 100 Hz"))}
    assert set(METHODS) - {PUBLISHED} < set(mean)
    for axis in ("roll", "pitch", "yaw"):
        assert mean["smekf"][axis] < mean["gdc, default gains"][axis] < 5.0
        assert mean["smekf"][axis] < mean["ncf, default gains"][axis] < 5.0
        assert mean["gdc"][axis] < mean["gdc, default gains"][axis]
        assert mean["ncf"][axis] < mean["ncf, default gains"][axis]


@pytest.mark.slow
def test_two_runs_give_the_same_figures_on_any_number_of_workers() -> None:
    jobs = list_experiments(True)["dynamic 100 Hz"] * 2
    alone, again, *_ = run_jobs(jobs, workers=1)
    assert alone == again
    assert list(run_jobs(jobs, workers=2)) == [alone, again]


@pytest.mark.slow
def test_the_drift_experiment_is_the_papers() -> None:
    mean = {method: figures for _, method, figures, _ in summarize(run("drift"))}
    assert mean["smekf"]["drift_deg_min"] < 0.1
    assert mean["smekf"]["drift_deg_min"] < mean["ncf"]["drift_deg_min"] < mean["ncf, default gains"]["drift_deg_min"]


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "limit_mm"), [("ideal", 12.0), ("mild", 25.0)])
def test_the_hand_of_one_subject(preset: str, limit_mm: float) -> None:
    """The experiment's targets, 12 and 18 mm, are means over ten subjects; this one is among the worst of them."""
    (smekf,) = [result for result in run(f"upper body, {preset}") if result.method == "smekf"]
    assert smekf.figures["hand_from_shoulders_mm"]["mean"] < limit_mm


def test_each_experiment_says_what_was_known_beforehand(data: Path) -> None:
    experiments = list_experiments(data=data)
    assert {f"upper body, {preset}" for preset in PRESETS} < set(experiments)
    presets = {name: {"measured_std": preset.measured_std} for name, preset in PRESETS.items()}
    for name in experiments:
        known = describe_known(name, presets)
        assert len(known) > 20, name
        if name.startswith(("upper body", "arbitrary", "error budget")):
            millimetres = 1e3 * PRESETS[name.rpartition(", ")[2]].measured_std
            assert f"shoulder width between the joint centres, off by {millimetres:g} mm" in known
        else:
            assert "shoulder" not in known
    assert describe_known("never heard of", presets) == ""


def test_the_trunk_is_measured_where_a_row_says_so() -> None:
    """The same calibrations as the rows', with the names of what was measured."""
    assert MEASURED == ("shoulder_width",)
    person = simulate_person(0)
    simulation = simulate(person.lengths, seed=0, clasp_s=20.0, circles=1)
    prior = set_exact_mounts(person.prior, simulation)
    std = {
        names: calibrate_person(simulation.recording(), person, "smekf", prior, measured=names).std("trunk")
        for names in (MEASURED, (*MEASURED, "trunk"))
    }
    assert std[MEASURED] > 0.01
    assert std[*MEASURED, "trunk"] == pytest.approx(person.measured_std, rel=0.1)


def test_every_imperfection_of_a_preset_is_in_one_group_of_the_budget() -> None:
    for imperfections, _ in PRESETS.values():
        groups = switch_off(imperfections)
        for field in fields(imperfections):
            if getattr(imperfections, field.name) != getattr(IDEAL_PRESET, field.name) and "_place" not in field.name:
                off = [
                    label
                    for label, others in groups.items()
                    if getattr(others, field.name) != getattr(imperfections, field.name)
                ]
                assert len(off) == 1, (field.name, off)


def only_contenders(monkeypatch: pytest.MonkeyPatch, setting: str, *labels: str) -> None:
    few = [each for each in list_contenders(setting) if each.label in labels]
    assert len(few) == len(labels)
    for module in ("paper", "real"):
        monkeypatch.setattr(f"wepose_pin.validation.{module}.list_contenders", lambda *_: few)


@pytest.mark.slow
@pytest.mark.parametrize("half", [0, 1])
def test_each_half_of_the_authors_trial_is_scored_with_the_other(
    half: int, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_contenders(monkeypatch, "real", "smekf", "gdc", "gdc, default gains", "ncf, default gains")
    jobs = list_experiments(data=data)["the authors' trial"]
    assert [job.trial for job in jobs] == ["5 to 11 s", "11 to 17.3 s"]
    figures = {result.method: result.figures for result in jobs[half]()}
    assert 12.0 < figures["smekf"]["clock_offset_ms"] < 22.0
    assert figures["smekf"]["mount_deg"] == pytest.approx(2.5, abs=0.3)
    assert figures["smekf"]["total_rmse"] < figures["gdc"]["total_rmse"] < figures["gdc, default gains"]["total_rmse"]
    assert figures["smekf"]["total_rmse"] < figures["ncf, default gains"]["total_rmse"]


@pytest.mark.slow
def test_a_run_of_some_experiments_keeps_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def validate(*words: object) -> int:
        with pytest.raises(SystemExit) as stop:
            main(["validate", "--quick", *map(str, words)])
        return int(stop.value.code or 0)

    first, second = tmp_path / "first", tmp_path / "second"
    assert validate("--experiment", "drift", "-o", first) == 0
    assert validate("--experiment", "dynamic 100", "--keep", first / "validation.json", "-o", second) == 0
    document = read_document(second / "validation.json")
    assert list(dict.fromkeys(result.experiment for result in document.results)) == ["dynamic 100 Hz", "drift"]
    assert [each for each in document.results if each.experiment == "drift"] == read_document(
        first / "validation.json"
    ).results
    capsys.readouterr()
    assert validate("--experiment", "nothing", "-o", tmp_path / "third") == 2
    assert "no experiment begins so; there are: dynamic 100 Hz" in capsys.readouterr().err


def test_results_of_other_settings_are_not_joined() -> None:
    result = Result("drift", "0", "smekf", {"drift_deg_min": 0.1})
    documents = [parse_document(json.loads(format_document([result], True, {"numpy": v})), "x") for v in ("1", "2")]
    check_same_settings(documents[0], documents[0], "earlier")
    with pytest.raises(BadData, match="earlier: versions: made with others"):
        check_same_settings(*documents, "earlier")


def test_fewer_trials() -> None:
    assert {len(jobs) for name, jobs in list_experiments(trials=3).items() if name != "gains"} == {3}
    with pytest.raises(BadOption, match="--trials 0"):
        ValidateJob(trials=0).check()


@pytest.mark.slow
def test_the_command_writes_every_trial(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    only_contenders(monkeypatch, "real", "smekf", "ncf, default gains")
    few = {k: v[:1] for k, v in list_experiments(True, data).items() if k in ("dynamic 100 Hz", "BROAD", "UR5")}
    monkeypatch.setattr("wepose_pin.validation.list_experiments", lambda *_: few)
    with pytest.raises(SystemExit) as stop:
        main(["validate", "--quick", "--data", str(data), "-o", str(tmp_path / "out")])
    assert not stop.value.code
    printed = capsys.readouterr().out
    for words in ("dynamic 100 Hz", "BROAD, 1 trial", "UR5"):
        assert words in printed
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
