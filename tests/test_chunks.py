"""Long recordings: in chunks they give what they give as a whole, bit-identical."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from reading import text_of

from wepose_pin.body import load_model
from wepose_pin.body.kinematics import build_pose_table
from wepose_pin.body.subject import Subject
from wepose_pin.calibration import calibrate
from wepose_pin.data_tables import read_table
from wepose_pin.errors import WeposeError
from wepose_pin.readers import load_session
from wepose_pin.recording import Recording
from wepose_pin.report.track import render_track_report
from wepose_pin.simulation import Person, Simulation, simulate
from wepose_pin.tracking import (
    SummaryAccumulator,
    Tracker,
    TrackOptions,
    TrackResult,
    TrackSummary,
    summarize,
    track,
    track_chunks,
)
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


def joined(chunks: list[TrackResult]) -> pl.DataFrame:
    return pl.concat([build_pose_table(chunk.pose, covariance=True) for chunk in chunks])


def summarize_chunks(recording: Recording, chunks: list[TrackResult]) -> TrackSummary:
    accumulator = SummaryAccumulator(recording)
    for chunk in chunks:
        accumulator.add(chunk)
    return accumulator.finish()


@pytest.mark.parametrize(
    ("method", "seconds"),
    [("amekf", 7.31), *(pytest.param(*case, marks=pytest.mark.slow) for case in (("smekf", 5.0), ("ncf", 2.0)))],
)
def test_chunks_put_together_are_the_whole(made: Simulation, subject: Subject, method: str, seconds: float) -> None:
    recording = made.recording()
    whole = track(recording, subject, method=method)
    chunks = list(track_chunks(recording, subject, options=TrackOptions(method), chunk_s=seconds))
    assert len(chunks) > 2
    assert joined(chunks).equals(build_pose_table(whole.pose, covariance=True))
    assert whole.correction is not None
    assert chunks[-1].correction is not None
    assert max(whole.correction.max_correction_deg.values()) > 0.01  # there was something to hold
    assert summarize_chunks(recording, chunks).content == summarize(whole).content


def test_the_smoother_takes_the_recording_as_a_whole(made: Simulation) -> None:
    recording = made.recording()
    assert len(list(track_chunks(recording, options=TrackOptions("smoother"), chunk_s=5.0))) == 1
    tracker = Tracker(options=TrackOptions("smoother"))
    tracker.push(recording.cut(slice(0, 2000)))
    with pytest.raises(WeposeError, match="method 'smoother' takes the whole recording as one chunk"):
        tracker.push(recording.cut(slice(2000, 4000)))


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
    monkeypatch.setattr("wepose_pin.tracking.CHUNK_S", 10.0)
    places = tmp_path / "whole", tmp_path / os.fsdecode(b"chunks[1]\xff")  # which polars takes for no path
    assert run("track", *options, "-o", places[1]) == 0
    names = [sorted(path.name for path in place.iterdir()) for place in places]
    assert names[0] == names[1]
    whole, chunks = (read_table(place / "pose.parquet") for place in places)
    assert chunks.equals(whole)
    whole, chunks = (json.loads((place / "summary.json").read_text()) for place in places)
    assert chunks | {"provenance": None} == whole | {"provenance": None}


def test_a_decimated_report_keeps_extremes(session: Path, subject: Subject, monkeypatch) -> None:
    """What lasts, what is lost and what was largest are those of all samples, though one in eighteen is kept."""
    recording = load_session(session)
    pose = track(recording, subject)
    full = summarize(pose)
    monkeypatch.setattr("wepose_pin.tracking.summary.MOST_SAMPLES", 300)
    summary = summarize_chunks(recording, list(track_chunks(recording, subject, chunk_s=7.31)))
    thin, totals, wanted = summary.tracked, summary.measures, full.measures
    assert totals.samples == len(pose.time) == 5698
    assert len(thin.time) == 317
    np.testing.assert_array_equal(thin.time, pose.time[::18])
    assert totals.steps_ms == pytest.approx(wanted.steps_ms)
    for name, signal in wanted.signals.items():
        ours = totals.signals[name]
        bins = [signal.rate[first : first + 18].max() for first in range(0, 5698, 18)]
        np.testing.assert_allclose(ours.rate, bins, rtol=1e-12)
        assert ours.static is not None
        assert signal.static is not None
        np.testing.assert_array_equal(ours.static, [signal.static[k : k + 18].all() for k in range(0, 5698, 18)])
    for name, tip in wanted.tips.items():
        assert totals.tips[name].peak_speed == pytest.approx(tip.peak_speed, rel=1e-12)
    page = render_track_report(summary)
    assert "5698 samples at 100 Hz" in text_of(page)
    assert "for 317 samples, one in 18" in text_of(page)
