"""Long recordings: in chunks they give what they give as a whole, bit-identical."""

import json
import os
import weakref
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run

from wepose_pin import Simulation, Subject, WeposeError, calibrate, simulate, track
from wepose_pin.simulation import Person
from wepose_pin.tracking import Tracker, TrackSummary, track_chunks
from wepose_pin.writers import write_session


@pytest.fixture(scope="module")
def made(person: Person) -> Simulation:
    """A minute: two stretches of joined hands, of which the session tells, and what lies between."""
    return simulate(person.lengths, seed=8, clasp_s=20.0, circles=1)


@pytest.fixture(scope="module")
def subject(made: Simulation, person: Person) -> Subject:
    """Calibrated, with hinges: headings are held together by them and by the hands."""
    calibration = calibrate(
        made.recording(), measured=person.measured, prior=person.prior, measured_std=person.measured_std
    )
    assert set(calibration.subject.hinges) == {"left_elbow", "right_elbow"}
    return calibration.subject


@pytest.mark.parametrize(
    ("method", "seconds"),
    [("amekf", 7.31), *(pytest.param(*case, marks=pytest.mark.slow) for case in (("smekf", 5.0), ("ncf", 2.0)))],
)
def test_chunks_put_together_are_the_whole(made: Simulation, subject: Subject, method: str, seconds: float) -> None:
    recording = made.recording()
    whole = track(recording, subject, method=method)
    chunks = list(track_chunks(Tracker(subject, method=method), recording, seconds))
    assert len(chunks) > 2
    for part in ("quat_WL", "points"):
        for name, values in getattr(whole, part).items():
            assert np.array_equal(np.concatenate([getattr(chunk, part)[name] for chunk in chunks]), values), name
    for name, cov in whole.pose.point_cov.items():
        assert np.array_equal(np.concatenate([chunk.pose.point_cov[name] for chunk in chunks]), cov), name
    assert whole.correction is not None
    assert chunks[-1].correction is not None
    assert max(whole.correction.max_correction_deg.values()) > 0.01  # there was something to hold


def test_an_open_loop_in_chunks_is_the_whole(made: Simulation, subject: Subject) -> None:
    whole = track(made.recording(), subject, open_loop=True)
    chunks = list(track_chunks(Tracker(subject, open_loop=True), made.recording(), 30.0))
    for name, quat in whole.quat_WL.items():
        assert np.array_equal(np.concatenate([chunk.quat_WL[name] for chunk in chunks]), quat)


def test_a_summary_keeps_no_chunk_in_memory(made: Simulation) -> None:
    recording, passed = made.recording(), list[weakref.ref[np.ndarray]]()
    summary = TrackSummary(recording)
    for tracked in summary.accumulate(track_chunks(Tracker(), recording, 5.0)):
        passed.append(weakref.ref(tracked.pose.point_cov["right_palm"]))
    assert len(passed) > 4
    assert not any(values() is not None for values in passed[:-1])


def test_the_smoother_takes_the_recording_as_a_whole(made: Simulation) -> None:
    recording = made.recording()
    assert len(list(track_chunks(Tracker(method="smoother"), recording, 5.0))) == 1
    tracker = Tracker(method="smoother")
    tracker.push(recording.cut(slice(0, 2000)))
    with pytest.raises(WeposeError, match="method 'smoother' takes the whole recording as one chunk"):
        tracker.push(recording.cut(slice(2000, 4000)))


# The command ----------------------------------------------------------------------------------------------------------


def test_the_command_gives_the_same_folder(
    made: Simulation, subject: Subject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("session", "person"):
        (tmp_path / name).mkdir()
    write_session(tmp_path / "session", made.recording())
    subject.save(tmp_path / "person")
    words = [tmp_path / "session", "--subject", tmp_path / "person", "--covariance"]
    assert run("track", *words, "-o", tmp_path / "whole") == 0
    monkeypatch.setattr("wepose_pin.tracking.CHUNK_S", 10.0)
    places = tmp_path / "whole", tmp_path / os.fsdecode(b"chunks[1]\xff")  # which polars takes for no path
    assert run("track", *words, "-o", places[1]) == 0
    names = [sorted(path.name for path in place.iterdir()) for place in places]
    assert names[0] == names[1]
    whole, chunks = (pl.read_parquet((place / "pose.parquet").read_bytes()) for place in places)
    assert chunks.equals(whole)
    whole, chunks = (json.loads((place / "summary.json").read_text()) for place in places)
    assert chunks | {"provenance": None} == whole | {"provenance": None}
