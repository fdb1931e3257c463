"""`wepose retarget`: its files, its exit codes, and what it refuses."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import trimesh
from arms import JOINTS, person, write_arm
from commands import run as run_command

import wepose_pin as wp
from wepose_pin import retargeting

pytest.importorskip("daqp")


@pytest.fixture(scope="module")
def swung(tmp_path_factory: pytest.TempPathFactory) -> retargeting.Trajectory:
    return wp.retarget(person(), write_arm(tmp_path_factory.mktemp("arm")))


def test_the_files_say_the_same(swung: retargeting.Trajectory, tmp_path: Path) -> None:
    retargeting.write_trajectory(tmp_path, swung)
    whole = pl.read_parquet(tmp_path / "trajectory.parquet")
    assert whole.columns[:5] == ["time", "recorded_time", "flexion", "flexion_velocity", "flexion_acceleration"]
    text = pl.read_csv(tmp_path / "trajectory.csv")
    assert text.columns == whole.columns
    assert np.abs(text.to_numpy() - whole.to_numpy()).max() < 1e-8
    message = json.loads((tmp_path / "joint_trajectory.json").read_text())
    assert message["joint_names"] == list(JOINTS)
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert np.allclose(times, swung.time)
    assert np.allclose([p["positions"] for p in message["points"]], swung.joint_position, atol=1e-8)


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str]:
    code, text = run_command(*argv), capsys.readouterr()
    return code, text.out + text.err


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = wp.simulate(wp.population_subject(1.75).lengths, seed=2, clasp_s=5.0, circles=0).recording("made")
    made = replace(made.cut(slice(0, 600)), phases={"start": made.phases["start"]})
    return wp.track(made).save(tmp_path_factory.mktemp("result") / "r")


def test_the_command(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = write_arm(tmp_path)
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"))
    assert code == 0, text
    made = {path.name for path in (tmp_path / "out").iterdir()}
    assert made == {"trajectory.parquet", "trajectory.csv", "joint_trajectory.json",
                    "robot.urdf", "summary.json", "view.html", "report.html"}  # fmt: skip
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["recording"], summary["recorded_phases"].keys()) == ("made", {"start"})
    assert (summary["robot"], tuple(summary["joints"])) == ("arm", JOINTS)
    table = pl.read_parquet(tmp_path / "out" / "trajectory.parquet")
    begun = table["time"].filter(table["recorded_time"] > table["recorded_time"][0])[0]
    assert begun == pytest.approx(summary["approach_s"], abs=0.02)
    assert wp.export(tmp_path / "out", tmp_path / "data", "lerobot") == ("lerobot", [])
    frames = pl.read_parquet(tmp_path / "data" / "data" / "chunk-000" / "file-000.parquet")
    np.testing.assert_array_equal(frames["observation.state"].to_numpy(), table.select(JOINTS).to_numpy().astype("f4"))
    assert summary["within_limits"] is True
    assert summary["self_collisions"]["samples"] == 0
    assert "keeps all limits" in text
    page = (tmp_path / "out" / "view.html").read_text()
    assert '"robot 0"' in page
    assert '"right_robot"' in page
    report = (tmp_path / "out" / "report.html").read_text()
    assert "cannot be made" not in report
    for joint in JOINTS:
        assert f"<td>{joint}</td>" in report
    assert re.search(r"At worst, at [\d.]+ s of the trajectory \([\d.]+ s of the recording\), the", report)
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"))
    assert (code, "--force replaces" in text) == (2, True)
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(result), "--force")
    assert (code, "pose.parquet: is of `wepose track`" in text) == (2, True)


def test_the_exit_code_says_that_no_robot_should_run_it(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the check of the written trajectory finds decides, not what the solver thinks of it."""
    urdf = write_arm(tmp_path)
    hit = retargeting.SelfCollisions(3, "hand_0 and base_0 at 2.00 s", 10)
    monkeypatch.setattr("wepose_pin.retargeting.find_self_collisions", lambda *_: hit)
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"), "--no-view")
    assert code == 3
    assert "touch each other in 3 samples, first hand_0 and base_0 at 2.00 s" in " ".join(text.split())
    assert (tmp_path / "out" / "trajectory.parquet").is_file()


def test_a_robot_without_shapes_is_said_to_be_unchecked(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = write_arm(tmp_path)
    urdf.write_text(re.sub("<collision>.*?</collision>", "", urdf.read_text()))
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(tmp_path / "out"), "--no-view")
    assert code == 0
    assert "do not collide" not in text
    diagnostics = json.loads((tmp_path / "out" / "summary.json").read_text())["diagnostics"]
    assert "robot-shapes-missing" in [each["code"] for each in diagnostics]


@pytest.mark.parametrize(
    ("robot", "more", "text"),
    [
        ("nobody", (), "--robot nobody: not known"),
        ("missing.urdf", (), "missing.urdf: no such file"),
        ("arm.urdf", ("--arm", "both"), "--arm left: arm has no left arm"),
        ("arm.urdf", ("--scale", "-1"), "--scale -1"),
        ("arm.urdf", ("--smoothing-hz", "-1"), "--smoothing-hz -1"),
        ("arm.urdf", ("--speed-scale", "1.2"), "--speed-scale 1.2: above 0, up to 1"),
        ("arm.urdf", ("--limit-margin", "1.5"), "--limit-margin 1.5: joint 'elbow' moves from -2.6 to -0.02 only"),
    ],
)
def test_wrong_usage_is_one_line_and_writes_nothing(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], robot: str, more: tuple[str, ...], text: str
) -> None:
    write_arm(tmp_path)
    where = str(tmp_path / robot) if "." in robot else robot
    code, said = run(capsys, "retarget", str(result), "--robot", where, "-o", str(tmp_path / "out"), *more)
    assert code == 2
    assert text in said
    assert len(said.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_meshes_are_found_in_the_written_robot_and_a_missing_one_is_left_out_of_the_view(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm" / "meshes").mkdir(parents=True)
    urdf = write_arm(tmp_path / "arm")
    trimesh.creation.box((0.1, 0.1, 0.2)).export(tmp_path / "arm" / "meshes" / "hand.stl")
    drawn, lost = (
        f'<visual><geometry><mesh filename="meshes/{name}.stl"/></geometry></visual></link>'
        for name in ("hand", "lost")
    )
    links = re.split("(?<=</link>)", urdf.read_text())
    links[-2] = links[-2].replace("</link>", drawn)
    links[1] = links[1].replace("</link>", lost)
    urdf.write_text("".join(links))
    out = tmp_path / "out"
    code, text = run(capsys, "retarget", str(result), "--robot", str(urdf), "-o", str(out))
    assert code == 0, text
    assert (out / "view.html").is_file()
    wp.export(out, tmp_path / "robot.urdf")
    for file in (out / "robot.urdf", tmp_path / "robot.urdf"):
        meshes = re.findall('filename="(.*?)"', file.read_text())
        assert sorted(meshes) == sorted([str(tmp_path / "arm" / "meshes" / "hand.stl"), "meshes/lost.stl"])
