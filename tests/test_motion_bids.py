"""Motion-BIDS: the rules of the specification, one dataset of several recordings, and the validator itself."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from test_export import a_pose, with_gap, write_folder

import wepose_pin as wp
from wepose_pin import cli
from wepose_pin.angles import joint_angles
from wepose_pin.recording import Mark
from wepose_pin.writers.export import export

# From the specification, motion: channel types and components, and the columns that come first.
TYPES = {"ACCEL", "ANGACCEL", "GYRO", "JNTANG", "LATENCY", "MAGN", "MISC", "ORNT", "POS", "VEL"}
COMPONENTS = {"x", "y", "z", "quat_x", "quat_y", "quat_z", "quat_w", "n/a"}
FIRST_COLUMNS = ["name", "component", "type", "tracked_point", "units"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("bids") / "result", with_gap(a_pose()))


@pytest.fixture(scope="module")
def dataset(result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of one person, and one of another in a session."""
    out = tmp_path_factory.mktemp("dataset") / "ds"
    for name in ("sub-01_task-reach_run-1", "sub-01_task-reach_run-2", "sub-02_ses-1_task-sit_acq-left"):
        written = export(result, out, "motion-bids", bids_name=name)
        assert {each.code for each in written.diagnostics} == {"export-gaps-unmarked", "angles-near-lock"}
    return out


def test_files_are_where_bids_has_them(dataset: Path) -> None:
    files = {str(path.relative_to(dataset)) for path in dataset.rglob("*") if path.is_file()}
    endings = ("motion.tsv", "motion.json", "channels.tsv", "channels.json")
    stems = [
        "sub-01/motion/sub-01_task-reach_tracksys-imu_run-1",
        "sub-01/motion/sub-01_task-reach_tracksys-imu_run-2",
        "sub-02/ses-1/motion/sub-02_ses-1_task-sit_tracksys-imu_acq-left",
    ]
    recordings = {f"{stem}_{ending}" for stem in stems for ending in endings}
    assert files == recordings | {"dataset_description.json", "participants.tsv", "README.md"}
    assert (dataset / "participants.tsv").read_text() == "participant_id\nsub-01\nsub-02\n"
    described = json.loads((dataset / "dataset_description.json").read_text())
    assert {"Name", "BIDSVersion"} <= set(described)


def test_channels_say_what_the_columns_are(dataset: Path) -> None:
    stem = dataset / "sub-02/ses-1/motion/sub-02_ses-1_task-sit_tracksys-imu_acq-left"
    channels = pl.read_csv(f"{stem}_channels.tsv", separator="\t")
    assert channels.columns[:5] == FIRST_COLUMNS
    assert set(channels["type"]) <= TYPES
    assert set(channels["component"]) <= COMPONENTS
    assert channels["name"].is_unique().all()
    table = pl.read_csv(
        f"{stem}_motion.tsv",
        separator="\t",
        has_header=False,
        new_columns=channels["name"].to_list(),
        null_values="n/a",
    )
    assert table.width == channels.height
    pose = a_pose()
    np.testing.assert_allclose(table["latency"], pose.time - pose.time[0], atol=1e-9)
    np.testing.assert_allclose(table["left_forearm_qz"], pose.quat_WL["left_forearm"][:, 2], atol=1e-9)
    np.testing.assert_allclose(table["left_palm_y"], pose.points["left_palm"][:, 1], atol=1e-9)
    flexion = np.degrees(joint_angles(pose)["left_elbow"].values[:, 0])
    np.testing.assert_allclose(table["left_elbow_flexion"], flexion, atol=1e-6)
    row = channels.row(by_predicate=pl.col("name") == "left_forearm_qz", named=True)
    assert [row[key] for key in FIRST_COLUMNS[1:]] == ["quat_z", "ORNT", "left_forearm", "n/a"]
    about = json.loads(Path(f"{stem}_motion.json").read_text())
    assert (about["TaskName"], about["SamplingFrequency"]) == ("sit", 100.0)
    for kind in ("ORNT", "POS", "JNTANG", "LATENCY", "GYRO"):
        assert about[f"{kind}ChannelCount"] == (channels["type"] == kind).sum()
    frames = json.loads(Path(f"{stem}_channels.json").read_text())["reference_frame"]["Levels"]
    assert set(channels["reference_frame"]) == {*frames, "n/a"}
    assert frames["W"]["SpatialAxes"] == "ALS"


def test_what_is_not_known_is_missing(tmp_path: Path) -> None:
    pose = a_pose(n=9)
    pose.quat_WL["left_hand"][4] = np.nan
    export(write_folder(tmp_path / "r", pose), tmp_path / "ds", "motion-bids", bids_name="sub-1_task-a")
    [file] = (tmp_path / "ds").rglob("*_motion.tsv")
    lines = file.read_text().splitlines()
    assert [line.count("n/a") for line in lines] == [7 if k == 4 else 0 for k in range(9)]  # a quaternion, three angles
    assert "NaN" not in file.read_text()


def test_phases_and_marks_are_events_on_the_times_of_the_motion(tmp_path: Path) -> None:
    pose = a_pose(n=400)  # of 4 s
    pose = replace(pose, time=pose.time - pose.time[0] + 100.0)
    folder = write_folder(tmp_path / "r", pose)
    marks = [[101.25, "trial\t3"], [120.0, "after it"]]
    about = {"recorded_phases": {"start": [[99.0, 100.5]], "reach": [[101.0, 102.5], [103.0, 103.5]]}}
    (folder / "summary.json").write_text(json.dumps({**about, "recorded_marks": marks}), encoding="utf-8")

    def read(interval: tuple[float, float] | None) -> list[tuple[object, ...]]:
        out = tmp_path / "ds"
        export(folder, out, "motion-bids", bids_name="sub-1_task-a", force=True, interval=interval)
        files = {path.suffix: path for path in out.rglob("*_events.*")}
        if not files:
            return []
        table = pl.read_csv(files[".tsv"], separator="\t")
        assert set(table.columns) == set(json.loads(files[".json"].read_text()))
        assert table.columns == ["onset", "duration", "trial_type"]
        return table.rows()

    start, first, mark, second = (-1.0, 1.5, "start"), (1.0, 1.5, "reach"), (1.25, 0.0, "trial 3"), (3.0, 0.5, "reach")
    assert read(None) == [start, first, mark, second]
    assert read((102.0, 102.9)) == [(-1.0, 1.5, "reach")]
    assert read((102.6, 102.9)) == []  # and those of the recording that it replaces are gone
    [motion] = (tmp_path / "ds").rglob("*_motion.tsv")
    assert len(motion.read_text().splitlines()) == 31


def test_a_mark_of_a_live_session_comes_through_the_result(tmp_path: Path) -> None:
    simulation = wp.simulate(wp.population_subject(1.75).lengths, seed=1, clasp_s=10.0, circles=0)
    recording = replace(simulation.recording(), marks=(Mark(6.0, "cup"),))
    result = wp.track(recording)
    for k, each in enumerate((result, result.source, wp.load_result(result.save(tmp_path / "r")), tmp_path / "r")):
        out = tmp_path / f"ds{k}"
        export(each, out, "motion-bids", bids_name="sub-1")
        [events] = out.rglob("*_events.tsv")
        onset = 6.0 - float(result.time[0])
        assert (round(onset, 6), 0.0, "cup") in pl.read_csv(events, separator="\t").rows()


def test_a_dataset_is_added_to_and_nothing_is_lost(dataset: Path, result: Path, tmp_path: Path) -> None:
    out = shutil.copytree(dataset, tmp_path / "ds")
    (out / "participants.tsv").write_text("participant_id\tage\nsub-01\t31\n")
    (out / "dataset_description.json").write_text('{"Name": "mine", "BIDSVersion": "1.9.0"}')
    export(result, out, "motion-bids", bids_name="sub-03_task-reach")
    assert (out / "participants.tsv").read_text() == "participant_id\tage\nsub-01\t31\nsub-03\tn/a\n"
    assert json.loads((out / "dataset_description.json").read_text())["Name"] == "mine"
    assert len(list(out.rglob("*_motion.tsv"))) == 4


def test_names_come_from_the_recording(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "ds", "motion-bids")
    assert (tmp_path / "ds/sub-01/motion/sub-01_task-aMadeOne_tracksys-imu_motion.tsv").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("OUT", "--format", "motion-bids", "--bids-name", "sub-01_task-reach_run-2"), "run-2_motion.tsv: exists"),
        (("OUT", "--format", "motion-bids", "--bids-name", "sub-0-1"), "'sub-0-1' is no entity with a label"),
        (("OUT", "--format", "motion-bids", "--bids-name", "subject-1"), "'subject-1' is no entity"),
        (("OUT", "--format", "motion-bids", "--bids-name", "sub-1_run-b"), "'run-b' is no entity"),
        (("OUT/a.csv", "--bids-name", "sub-1"), "only motion-bids has such names"),
        (("OUT/README.md", "--format", "motion-bids"), "is a file; a folder is wanted"),
        (("OUT/sub-01", "--format", "motion-bids"), "exists and is not empty"),
    ],
)  # fmt: skip
def test_what_does_not_go_gets_one_line(
    dataset: Path, result: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in dataset.rglob("*")}
    out, *options = (word.replace("OUT", str(dataset)) for word in words)
    with pytest.raises(SystemExit) as stopped:
        cli.main(["export", str(result), "-o", out, *options])
    assert stopped.value.code == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1
    assert said in error[0]
    assert {path: path.stat().st_mtime_ns for path in dataset.rglob("*")} == before


def test_a_damaged_participants_file_is_not_replaced(dataset: Path, result: Path, tmp_path: Path) -> None:
    out = shutil.copytree(dataset, tmp_path / "ds")
    (out / "participants.tsv").write_text("id\tage\n1\t31\n")
    with pytest.raises(Exception, match="begins with the column 'id'; participant_id is needed"):
        export(result, out, "motion-bids", bids_name="sub-03")
    assert not (out / "sub-03").exists()


def test_a_dataset_names_no_folder_of_the_user(result: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main(["export", str(result), "-o", str(tmp_path / "ds"), "--format", "motion-bids"])
    assert stopped.value.code in (None, 0)
    texts = [path.read_text(encoding="utf-8") for path in (tmp_path / "ds").rglob("*.json")]
    assert any('"Provenance"' in text for text in texts)
    assert not any(str(result.parent) in text for text in texts)


def validate(dataset: Path) -> dict[str, Any]:
    """What the BIDS validator says."""
    validator = shutil.which(
        "bids-validator-deno", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    )
    if validator is None:
        pytest.skip("the BIDS validator is not installed")
    run = subprocess.run([validator, str(dataset), "--json"], capture_output=True, text=True, timeout=300, check=False)
    report: dict[str, Any] = json.loads(run.stdout)
    return report


@pytest.mark.peer
def test_the_validator_takes_the_events(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "r", a_pose(n=400))
    begin = float(a_pose().time[0])
    about = {"recorded_phases": {"start": [[begin, begin + 1.0]]}, "recorded_marks": [[begin + 2.0, "cup"]]}
    (folder / "summary.json").write_text(json.dumps(about), encoding="utf-8")
    export(folder, tmp_path / "ds", "motion-bids", bids_name="sub-01_task-reach_run-1")
    issues = validate(tmp_path / "ds")["issues"]["issues"]
    assert [issue for issue in issues if issue["severity"] == "error"] == []
    left = {issue["code"] for issue in issues} - {"SIDECAR_KEY_RECOMMENDED", "JSON_KEY_RECOMMENDED"}
    assert left == {"NO_AUTHORS", "TOO_FEW_AUTHORS"}
    [events] = (tmp_path / "ds").rglob("*_events.tsv")
    events.write_text(events.read_text().replace("onset", "begin"))
    assert any(issue["severity"] == "error" for issue in validate(tmp_path / "ds")["issues"]["issues"])


@pytest.mark.peer
def test_the_validator_finds_no_error(dataset: Path, tmp_path: Path) -> None:
    report = validate(dataset)
    assert sorted(report["summary"]["tasks"]) == ["reach", "sit"]
    assert report["summary"]["modalities"] == ["motion"]
    issues = report["issues"]["issues"]
    assert [issue for issue in issues if issue["severity"] == "error"] == []
    left = {issue["code"] for issue in issues} - {"SIDECAR_KEY_RECOMMENDED", "JSON_KEY_RECOMMENDED"}
    assert left == {"EVENTS_TSV_MISSING", "NO_AUTHORS", "TOO_FEW_AUTHORS"}  # warnings: there are no events or authors
    spoiled = shutil.copytree(dataset, tmp_path / "ds")
    for path in spoiled.rglob("*run-2_motion.json"):
        path.write_text('{"TaskName": "reach"}')
    errors = {each["code"] for each in validate(spoiled)["issues"]["issues"] if each["severity"] == "error"}
    assert errors == {"SIDECAR_KEY_REQUIRED"}  # SamplingFrequency
