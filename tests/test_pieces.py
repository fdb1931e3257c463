"""Long recordings: in pieces they give what they give as a whole, to the bit, in a memory that does not grow."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from reading import text_of

from benchmarks.long_recordings import there_and_back
from wepose_pin.calibration import calibrate
from wepose_pin.errors import BadData, BadOption
from wepose_pin.kinematics import build_pose_table
from wepose_pin.model import load_model
from wepose_pin.readers import load_session
from wepose_pin.recording import Recording
from wepose_pin.report import render_track_report
from wepose_pin.simulation import Person, Simulation, simulate
from wepose_pin.subject import Subject
from wepose_pin.tracking import SummaryAccumulator, TrackedRecording, TrackOptions, summarize, track, track_session
from wepose_pin.tracking.measures import measure
from wepose_pin.writers import write_session
from wepose_pin.writers.result import write_subject


@pytest.fixture(scope="module")
def made(person: Person) -> Simulation:
    """A minute: two stretches of joined hands, of which the session tells, and what lies between."""
    return simulate(person.lengths, seed=8, clasp_s=30.0, circles=2)


@pytest.fixture(scope="module")
def subject(made: Simulation, person: Person) -> Subject:
    """Calibrated, with hinges: headings are held together by them and by the hands."""
    calibration = calibrate(
        made.recording(), measured=person.measured, prior=person.prior, measured_std=person.measured_std
    )
    assert set(calibration.subject.hinges) == {"left_elbow", "right_elbow"}
    return calibration.subject


@pytest.fixture
def session(made: Simulation, tmp_path: Path) -> Path:
    return written(tmp_path / "session", made.recording())


def written(folder: Path, recording: Recording) -> Path:
    folder.mkdir(parents=True)
    write_session(folder, recording)
    return folder


def joined(pieces: list[TrackedRecording]) -> pl.DataFrame:
    return pl.concat([build_pose_table(piece.pose, covariance=True) for piece in pieces])


@pytest.mark.parametrize(
    ("method", "seconds"),
    [("amekf", 7.31), *(pytest.param(*case, marks=pytest.mark.slow) for case in (("smekf", 5.0), ("ncf", 2.0)))],
)
def test_pieces_put_together_are_the_whole(session: Path, subject: Subject, method: str, seconds: float) -> None:
    whole = track(load_session(session), subject, method=method)
    pieces = list(track_session(session, subject, options=TrackOptions(method), seconds=seconds))
    assert len(pieces) > 2
    assert joined(pieces).equals(build_pose_table(whole.pose, covariance=True))
    assert whole.correction is not None
    assert pieces[-1].correction is not None
    assert max(whole.correction.max_correction_deg.values()) > 0.01  # there was something to hold
    accumulator = SummaryAccumulator()
    for piece in pieces:
        accumulator.add(piece)
    assert accumulator.finish().content == summarize(whole).content


@pytest.mark.slow
def test_of_a_csv_too_and_with_lost_samples(session: Path, subject: Subject, monkeypatch) -> None:
    """Gaps over the edges of pieces, over a whole piece, and of rows: what is marked is marked in both."""
    monkeypatch.setattr("wepose_pin.readers.tables.BLOCK_ROWS", 333)
    table = pl.read_parquet(session / "recording.parquet")
    time = table["time"].to_numpy()
    lost = {"left_forearm": (14.0, 27.0), "torso": (19.5, 20.3), "right_forearm": (40.0, 40.03)}
    for segment, (first, last) in lost.items():
        gone = pl.Series((time >= first) & (time < last))
        columns = [name for name in table.columns if name.startswith(segment)]
        table = table.with_columns(pl.when(~gone).then(pl.col(columns)).name.keep())
    table = table.filter(pl.Series((time < 31.0) | (time > 45.0)))
    table.write_csv(session / "recording.csv")
    text = (session / "session.toml").read_text().replace("recording.parquet", "recording.csv")
    (session / "session.toml").write_text(text)
    whole = track(load_session(session, gaps=True), subject)
    pieces = list(track_session(session, subject, seconds=6.0, gaps=True))
    ours, wanted = joined(pieces), build_pose_table(whole.pose, covariance=True)
    assert ours.equals(wanted)
    assert wanted["left_forearm_gap"].sum() == pytest.approx(100 * (13.0 + 14.0), abs=3)
    of_pieces, of_whole = (of["sensors"]["torso"] for of in (summary_of(pieces), summarize(whole).content))
    assert (
        (of_pieces["gaps"], of_pieces["gap_s"])
        == (of_whole["gaps"], of_whole["gap_s"])
        == (2, pytest.approx(14.8, abs=0.03))
    )
    with pytest.raises(BadData, match=r"--gaps"):
        list(track_session(session, subject, seconds=6.0))


def summary_of(pieces: list[TrackedRecording]) -> dict:
    accumulator = SummaryAccumulator()
    for piece in pieces:
        accumulator.add(piece)
    return accumulator.finish().content


def test_a_late_start_pose_makes_the_first_piece_longer(made: Simulation, tmp_path: Path) -> None:
    recording = made.recording()
    again = there_and_back(recording, recording.span((0.5, 4.5)))
    late = (float(again.time[-1]) - 4.5, float(again.time[-1]) - 1.0)
    session = written(tmp_path / "late", replace(again, phases={"static": ((0.5, 4.5),), "start": (late,)}))
    whole = track(load_session(session))
    pieces = list(track_session(session, seconds=3.0))
    assert pieces[0].time[-1] >= late[1] > pieces[0].time[-1] - 3.0
    assert joined(pieces).equals(build_pose_table(whole.pose, covariance=True))


# The smoother ---------------------------------------------------------------------------------------------------------


# The command ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def person_folder(subject: Subject, tmp_path: Path) -> Path:
    folder = tmp_path / "person"
    folder.mkdir()
    write_subject(folder, subject, load_model().with_lengths(dict(subject.lengths)))
    return folder


def test_the_command_gives_the_same_folder(session: Path, person_folder: Path, tmp_path: Path, monkeypatch) -> None:
    options = [session, "--subject", person_folder, "--covariance"]
    assert run("track", *options, "-o", tmp_path / "whole") == 0
    assert run("track", *options, "-o", tmp_path / "pieces", "--chunk-seconds", 10) == 0
    monkeypatch.setattr("wepose_pin.tracking.LARGE", 1000)
    assert run("track", *options, "-o", tmp_path / "large") == 0
    whole = pl.read_parquet(tmp_path / "whole" / "pose.parquet")
    summary = json.loads((tmp_path / "whole" / "summary.json").read_text())
    for name in ("pieces", "large"):
        assert sorted(p.name for p in (tmp_path / name).iterdir()) == sorted(
            p.name for p in (tmp_path / "whole").iterdir()
        )
        assert pl.read_parquet(tmp_path / name / "pose.parquet").equals(whole)
        ours = json.loads((tmp_path / name / "summary.json").read_text())
        assert ours | {"provenance": None} == summary | {"provenance": None}


def test_what_is_wrong_late_leaves_nothing(session: Path, tmp_path: Path, capsys) -> None:
    table = pl.read_parquet(session / "recording.parquet")
    wrong = table.with_columns(
        pl.when(pl.col("time") > 50.0).then(1e5).otherwise(pl.col("torso_gyr_x")).alias("torso_gyr_x")
    )
    wrong.write_parquet(session / "recording.parquet")
    assert run("track", session, "-o", tmp_path / "out", "--chunk-seconds", 5) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "sensors.torso.gyro" in line
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--torques"], "--torques is tracked as a whole"),
        (["--chunk-seconds", "-1"], "at least 2 s"),
        (["--chunk-seconds", "nan"], "'nan' is not a number"),
    ],
)
def test_what_has_no_pieces(session: Path, tmp_path: Path, capsys, options: list[str], said: str) -> None:
    assert run("track", session, "-o", tmp_path / "out", "--chunk-seconds", 5, *options) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(BadOption, match="at least 2 s"):
        next(track_session(session, seconds=0.5))


def test_a_decimated_report_keeps_extremes(session: Path, subject: Subject, monkeypatch) -> None:
    """What lasts, what is lost and what was largest are those of all samples, though one in eighteen is kept."""
    monkeypatch.setattr("wepose_pin.tracking.decimation.MOST", 300)
    pose = track(load_session(session), subject)
    accumulator = SummaryAccumulator(len(pose.time))
    for piece in track_session(session, subject, seconds=7.31):
        accumulator.add(piece)
    summary = accumulator.finish()
    thin, totals = summary.decimator.decimated
    wanted = measure(pose)
    assert totals.samples == len(pose.time) == 5698
    assert len(thin.time) == 317
    np.testing.assert_array_equal(thin.time, pose.time[::18])
    assert totals.steps_ms == pytest.approx(wanted.steps_ms)
    for name, signal in wanted.signals.items():
        ours = totals.signals[name]
        bins = [signal.rate[first : first + 18].max() for first in range(0, 5698, 18)]
        np.testing.assert_allclose(ours.rate, bins, rtol=1e-12)
        assert ours.peak_accel == signal.peak_accel
        assert ours.static is not None
        assert signal.static is not None
        np.testing.assert_array_equal(ours.static, [signal.static[k : k + 18].all() for k in range(0, 5698, 18)])
        np.testing.assert_array_equal(ours.bias, signal.bias)
    for name, tip in wanted.tips.items():
        assert 0.8 * tip.peak_speed < totals.tips[name].peak_speed <= tip.peak_speed
    page = render_track_report(summary)
    assert "5698 samples at 100 Hz" in text_of(page)
    assert "for 317 samples, one in 18" in text_of(page)
