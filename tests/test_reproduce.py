"""`wepose reproduce`: results say what made them, are made again to the bit, and what has changed is named."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from arms import write_arm

from wepose_pin import __version__
from wepose_pin.batch.comparison import find_differences
from wepose_pin.batch.items import run_items
from wepose_pin.batch.plan import Item, step_options
from wepose_pin.cli import main
from wepose_pin.simulation import simulate, simulate_person
from wepose_pin.writers import write_session
from wepose_pin.writers.provenance import code, collect_provenance, file_hash, read_provenance


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)


@pytest.fixture(autouse=True)
def _one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WEPOSE_THREADS", "1")


@pytest.fixture
def session(tmp_path: Path) -> Path:
    made = simulate(simulate_person(1).lengths, seed=1, rate_hz=50.0, clasp_s=8.0, circles=0)
    (tmp_path / "session").mkdir()
    write_session(tmp_path / "session", made.recording("made"), made.truth())
    return tmp_path / "session"


@pytest.fixture
def result(session: Path) -> Path:
    out = session.parent / "result"
    assert run("track", session, "--no-report", "--method", "ncf", "-o", out) == 0
    return out


def test_a_result_says_what_made_it(result: Path, session: Path) -> None:
    block = read_provenance(result)
    assert json.loads((result / "summary.json").read_text())["provenance"] == block
    assert (block["command"], block["version"], block["code"]) == ("track", __version__, code()["code"])
    assert block["options"]["method"] == "ncf"
    assert {"out", "force", "session"}.isdisjoint(block["options"])
    assert block["inputs"] == {
        "session": {
            "path": str(session),
            "files": {name: file_hash(session / name) for name in ("session.toml", "recording.parquet")},
        }
    }
    assert block["packages"]["numpy"]
    assert block["machine"]


def test_the_commit_is_that_of_the_checkout() -> None:
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        assert code()["commit"] is None
        return
    head = subprocess.run(["git", "-C", root, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout
    commit = code()["commit"]
    assert commit is not None
    assert head.startswith(commit.removesuffix("+"))


def test_track_again_is_the_same(result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in result.rglob("*")}
    capsys.readouterr()
    assert run("reproduce", result) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{result}: the same, made again by wepose track\n"
    assert {path: path.read_bytes() for path in result.rglob("*")} == before


@pytest.mark.slow
def test_what_is_made_by_other_commands(session: Path, result: Path, tmp_path: Path) -> None:
    assert run("calibrate", session, "--measured", "shoulder_width=0.36", "-o", tmp_path / "anna") in (0, 3, 4)
    assert run("reproduce", tmp_path / "anna") == 0
    assert run("export", result, "--rate-hz", 50, "-o", tmp_path / "motion.trc") == 0
    assert run("reproduce", tmp_path / "motion.trc") == 0
    text = (tmp_path / "motion.trc").read_text()
    (tmp_path / "motion.trc").write_text(text + "1\n")
    assert run("reproduce", tmp_path / "motion.trc") == 3
    assert (
        run(
            "simulate",
            "--seed",
            4,
            "--protocol",
            "poses",
            "--imperfection",
            "palm_slip=0",
            "--seconds",
            10,
            "-o",
            tmp_path / "made",
        )
        == 0
    )
    assert read_provenance(tmp_path / "made")["options"]["seed"] == 4
    assert run("reproduce", tmp_path / "made") == 0


def test_what_another_version_has_made_is_made_again_and_said(result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = json.loads((result / "summary.json").read_text())
    summary["provenance"] |= {"version": "0.0.9", "commit": "abc", "code": "0" * 64}
    summary["provenance"]["packages"]["numpy"] = "1.0"
    (result / "summary.json").write_text(json.dumps(summary))
    capsys.readouterr()
    assert run("reproduce", result) == 0
    captured = capsys.readouterr()
    assert "warning: The result was made by wepose-pin 0.0.9 (abc); this is " in captured.err
    assert "warning: Other versions are installed now: numpy " in captured.err
    assert "the same, made again by wepose track" in captured.out


@pytest.mark.slow
def test_retarget_again(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("daqp")
    robot = tmp_path / "robot"
    robot.mkdir()
    write_arm(robot)
    assert run("retarget", result, "--robot", robot / "arm.urdf", "--no-view", "-o", tmp_path / "moved") == 0
    assert run("reproduce", tmp_path / "moved") == 0
    text = (robot / "arm.toml").read_text()
    (robot / "arm.toml").write_text(text + "\n")
    capsys.readouterr()
    assert run("reproduce", tmp_path / "moved") == 2
    assert f"of its robot, {robot / 'arm.toml'} has changed" in capsys.readouterr().err
    (robot / "arm.toml").write_text(text)
    (result / "pose.parquet").unlink()
    assert run("reproduce", tmp_path / "moved") == 2
    assert "of its result, pose.parquet is gone" in capsys.readouterr().err


@pytest.mark.slow
def test_a_whole_study_again(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(session, tmp_path / "other")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "session.toml").write_text("")
    steps = "[steps.track]\nview = false\nreport = false\n"
    (tmp_path / "plan.toml").write_text(f'[sessions]\nfiles = ["session", "other", "bad"]\n{steps}')
    assert run("batch", tmp_path / "plan.toml", "--workers", 1, "-o", tmp_path / "study") == 3
    capsys.readouterr()
    assert run("reproduce", tmp_path / "study") == 0
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'study'}: the same, made again by wepose batch\n"
    assert "1 items had failed" in captured.err
    pose = tmp_path / "study" / "items" / "other" / "track" / "pose.parquet"
    pl.read_parquet(pose).head(3).write_parquet(pose)
    (session / "recording.parquet").unlink()
    assert run("reproduce", tmp_path / "study") == 3
    captured = capsys.readouterr()
    assert "other: track/pose.parquet: " in captured.out
    assert "session: cannot be made again: " in captured.out
    assert "recording.parquet is gone" in captured.out
    (tmp_path / "study" / "results.parquet").unlink()
    assert run("reproduce", tmp_path / "study") == 2


def test_differences_are_named(result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = pl.read_parquet(result / "pose.parquet")
    changed = pl.when(pl.int_range(pl.len()) == 3).then(pl.col("left_palm_x") + 0.25).otherwise(pl.col("left_palm_x"))
    table.with_columns(changed).write_parquet(result / "pose.parquet")
    summary = json.loads((result / "summary.json").read_text())
    (result / "summary.json").write_text(json.dumps(summary | {"rate_hz": 99.0}))
    (result / "subject.urdf").unlink()
    capsys.readouterr()
    assert run("reproduce", result) == 3
    printed = capsys.readouterr().out
    assert f"pose.parquet: column left_palm_x differs in 1 of {table.height} rows, by 0.25 at most" in printed
    assert "summary.json: rate_hz was 99.0, is 50.0" in printed
    assert "subject.urdf: is missing, or new" in printed


@pytest.mark.parametrize("wrong", ["gone", "changed", "data", "none", "damaged", "format", "unknown", "nothing"])
def test_what_cannot_be_made_again(wrong: str, result: Path, session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = json.loads((result / "summary.json").read_text())
    block: dict[str, Any] = summary["provenance"]
    expected = "provenance"
    if wrong == "gone":
        (session / "session.toml").unlink()
        expected = f"of its session, session.toml is gone: {session / 'session.toml'}"
    elif wrong == "changed":
        (session / "session.toml").write_text((session / "session.toml").read_text() + "\n")
        expected = f"of its session, {session / 'session.toml'} has changed: SHA-256 was "
    elif wrong == "data":
        (session / "recording.parquet").unlink()
        expected = "recording.parquet is gone"
    elif wrong == "none":
        summary.pop("provenance")
        expected = "does not say what made it"
    elif wrong == "damaged":
        block["inputs"] = []
        expected = "provenance is damaged"
    elif wrong == "format":
        block["format"] = 2
        expected = "provenance is not of format 1"
    elif wrong == "unknown":
        block["options"]["speed"] = 3
        expected = "wepose track of this version: speed is not an option"
    (result / "summary.json").write_text(json.dumps(summary))
    if wrong == "nothing":
        result, expected = result / "nothing", "no such result"
    capsys.readouterr()
    assert run("reproduce", result) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_an_item_of_a_batch_and_its_parts(session: Path, tmp_path: Path) -> None:
    """Each as a user types it, in a process of its own: the number of BLAS threads is then that of the workers."""
    steps = {
        "calibrate": step_options("calibrate") | {"report": False},
        "track": step_options("track") | {"report": False},
    }
    steps |= {"evaluate": {"interval": None}}
    script = (
        "import sys; from wepose_pin.batch.items import run_items; from wepose_pin.batch.plan import Item\n"
        f"row, = run_items([Item('one', sys.argv[1], {steps!r})], sys.argv[2]); print(row['status'])"
    )
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    made = subprocess.run(
        [sys.executable, "-c", script, session, tmp_path / "items"],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    assert made.stdout == "done\n"
    for part in ("one", "one/track"):
        command = [sys.executable, "-m", "wepose_pin.cli", "reproduce", tmp_path / "items" / part]
        again = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (again.returncode, again.stdout, again.stderr) == (
            0,
            f"{tmp_path / 'items' / part}: the same, made again by wepose batch item\n",
            "",
        )


def test_an_item_whose_truth_has_changed(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steps = {"track": step_options("track") | {"report": False, "view": False}, "evaluate": {"interval": None}}
    run_items([Item("one", str(session), steps)], str(tmp_path / "items"))
    (session / "truth.parquet").unlink()
    assert run("reproduce", tmp_path / "items" / "one") == 2
    assert "of its session, truth.parquet is gone" in capsys.readouterr().err


def test_what_counts_as_a_difference(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        pl.DataFrame({"x": [1.0, float("nan"), None]}).write_parquet(tmp_path / name / "t.parquet", compression="lz4")
        (tmp_path / name / "view.html").write_text(name)
        (tmp_path / name / "s.json").write_text(json.dumps({"v": 1, "provenance": name}))
    assert find_differences(tmp_path / "a", tmp_path / "b") == []
    pl.DataFrame({"x": [1.0, None, None]}).write_parquet(tmp_path / "b" / "t.parquet")
    assert find_differences(tmp_path / "a", tmp_path / "b")[0].startswith("t.parquet: column x differs in 1 of 3 rows")
    pl.DataFrame({"x": [1.0]}).write_parquet(tmp_path / "b" / "t.parquet")
    assert find_differences(tmp_path / "a", tmp_path / "b") == ["t.parquet: 3 rows before, 1 now"]


def test_files_that_options_name_are_inputs(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text('urdf = "body.urdf"\n')
    (tmp_path / "body.urdf").write_text("<robot/>")
    values = {"protocol": str(tmp_path / "own.toml"), "method": "amekf", "out": tmp_path, "measured": {"a": 1.0}}
    block = collect_provenance("x", values)
    assert list(block["inputs"]["protocol"]["files"]) == ["own.toml", "body.urdf"]
    assert block["options"] == {"method": "amekf", "measured": {"a": 1.0}}
