"""A simulated UR5 with a sensor on each link, its tip on points: two lengths are calibrated."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from test_chain import urdf  # noqa: F401  the arm's URDF

from benchmarks.four_bar import LENGTHS, PROTOCOL, move_four_bar, write_four_bar
from benchmarks.ur5_arm import MOVE_S, TRUE, Moved, move_arm, write_table
from wepose_pin import BodyModel, Calibration, WeposeError, calibrate, load_model
from wepose_pin.writers import write_session

RECORDED = '[[closure]]\nphase = "tip"\nkind = "recorded"\npoints = ["tip"]\nslip = 0.001\n'


@pytest.fixture(scope="module")
def four_bar(tmp_path_factory: pytest.TempPathFactory) -> BodyModel:
    return load_model(write_four_bar(tmp_path_factory.mktemp("four_bar")))


@pytest.fixture(scope="module")
def arm(urdf: Path) -> BodyModel:  # noqa: F811
    return load_model(write_table(urdf))


def calibrate_arm(body: BodyModel, moved: Moved, protocol: str = "") -> Calibration:
    """By the text of a protocol; that of a tip on a point where none is stated."""
    text = protocol or PROTOCOL.replace("at = {at}\n", "").replace("at_std = 0.002\n", "")
    file = Path(body.table.where).with_name("points.toml")
    file.write_text(text, encoding="utf-8")
    return calibrate(moved.recording, model=body, protocol=str(file))


def deviations(calibration: Calibration, moved: Moved) -> np.ndarray:
    """(2,) errors of the lengths in standard deviations."""
    subject = calibration.subject
    return np.array([(subject.lengths[name] - true) / subject.std(name) for name, true in moved.lengths.items()])


def test_lengths_are_found_within_their_deviation(arm: BodyModel) -> None:
    moved = move_arm(arm, 0)
    calibration = calibrate_arm(arm, moved)
    assert np.abs(deviations(calibration, moved)).max() < 3.0
    assert calibration.rms_gap < 1e-3
    for name in TRUE:  # a tenth before the motion
        assert calibration.subject.std(name) < 0.01 * moved.lengths[name]
    # The first link turns about the vertical alone: the heading of its sensor's mount moves no point.
    assert "shoulder_link" not in [check.diagnostic.place for check in calibration.quality.checks]


def test_a_loop_closed_with_the_world(four_bar: BodyModel) -> None:
    """A four-bar linkage: both its ends are at known places of the ground, so all three lengths are shown."""
    moved = move_four_bar(four_bar, 0)
    calibration = calibrate_arm(four_bar, moved, PROTOCOL.format(at=moved.tip[0].tolist()))
    assert np.abs(deviations(calibration, moved)).max() < 3.0
    for name in LENGTHS:  # a tenth before the motion
        assert calibration.subject.std(name) < 0.04 * moved.lengths[name]


def test_recorded_places_of_the_tip_close_the_chain(arm: BodyModel, tmp_path: Path) -> None:
    moved = move_arm(arm, 6, points=0)
    time = np.arange(0.013, moved.recording.time[-1], 1.0 / 30.0)
    places = np.column_stack([np.interp(time, moved.recording.time, axis) for axis in moved.tip.T])
    lost = np.sin(time) > 0.8
    places[lost] = np.nan
    columns = {"time": time, **{f"tip_{axis}": places[:, k] for k, axis in enumerate("xyz")}}
    pl.DataFrame(columns).write_parquet(tmp_path / "optical.parquet")
    moved = replace(moved, recording=replace(moved.recording, truth=tmp_path / "optical.parquet"))
    calibration = calibrate_arm(arm, moved, RECORDED)
    assert np.abs(deviations(calibration, moved)).max() < 3.0
    seen = np.interp(calibration.time, time, (~lost).astype(float))
    assert seen.min() == 1.0
    assert len(calibration.time) < 0.9 * 8.0 * (moved.recording.phases["tip"][0][1] - MOVE_S - 2.0)
    assert "scale" not in {check.diagnostic.code.partition("-")[0] for check in calibration.quality.checks}


def test_a_chain_whose_limb_is_drawn_is_assessed(urdf: Path) -> None:  # noqa: F811
    table = write_table(urdf)
    text = table.read_text(encoding="utf-8")
    table.write_text(f'{text}[draw]\nlimbs = [["base", "elbow", "wrist", "tip"]]\n', encoding="utf-8")
    arm = load_model(table)
    short = calibrate_arm(arm, move_arm(arm, 0, seconds=12.0))
    reasons = short.quality.reasons
    assert "motion-too-small" in {diagnostic.code for diagnostic in reasons}
    words = " ".join(map(str, reasons))
    assert not re.search("hand|palm|anatom|person", words)


def test_what_a_truth_lacks_is_said_in_one_line(arm: BodyModel, tmp_path: Path) -> None:
    recording = replace(move_arm(arm, 0, seconds=12.0).recording, truth=tmp_path / "optical.parquet")
    time = np.arange(0.0, 12.0, 0.1)
    lost = np.full(len(time), np.nan)
    good = {"time": time, "tip_x": time, "tip_y": time, "tip_z": time}
    for table, named in (
        ({"time": time, "tip_x": time, "tip_y": time}, "no column 'tip_z' in optical.parquet"),
        (good | {"time": time[::-1]}, "time of optical.parquet does not increase"),
        (good | {"tip_x": lost}, "has 0.0 s in which all sensors measure"),
    ):
        pl.DataFrame(table).write_parquet(tmp_path / "optical.parquet")
        with pytest.raises(WeposeError) as raised:
            calibrate_arm(arm, Moved(recording, {}, lost), RECORDED)
        assert named in str(raised.value)
        assert "\n" not in str(raised.value)


def test_a_lost_sensor_is_named_in_one_line(arm: BodyModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = move_arm(arm, 0, seconds=20.0).recording
    sensors = {link: sensor for link, sensor in recording.sensors.items() if link != "forearm_link"}
    write_session(tmp_path, replace(recording, sensors=sensors))
    words = ("--model", arm.table.where, "--protocol", "tip")
    assert run("calibrate", tmp_path, *words, "-o", tmp_path / "out") == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "forearm_link" in line
    assert not (tmp_path / "out").exists()


def test_a_chain_by_option_has_its_report_and_its_live_recording(
    four_bar: BodyModel, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`--model` is the body of what a live recording is tracked with, too."""
    moved, model = move_four_bar(four_bar, 5, seconds=20.0), four_bar.table.where
    (tmp_path / "session").mkdir()
    write_session(tmp_path / "session", moved.recording)
    (tmp_path / "pivot.toml").write_text(PROTOCOL.format(at=moved.tip[0].tolist()), encoding="utf-8")

    session, cal, log = tmp_path / "session", tmp_path / "cal", tmp_path / "a.mcap"
    words = ("--model", model, "--protocol", tmp_path / "pivot.toml", "-o", cal)
    assert run("calibrate", session, *words) in (0, 3, 4), capsys.readouterr().err
    page = re.sub(
        "<script.*?</script>|<[^>]+>", " ", (cal / "report.html").read_text(encoding="utf-8"), flags=re.DOTALL
    )
    assert not re.search("cannot be tracked|[Pp]alm|hands|anatom|population", page)
    replay = ("live", "--source", f"replay:{session}", "--speed", "max", "--no-page", "--record", log)
    assert run(*replay, "--model", model, "--subject", cal, "--accept-failed") == 0, capsys.readouterr().err
    assert run("track", log, "-o", tmp_path / "result", "--no-report", "--no-view") == 0
    assert (tmp_path / "result" / "joints.parquet").exists()
