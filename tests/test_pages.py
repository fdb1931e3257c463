"""Pages beside a result: one that fails is a warning; the result has landed before, and nothing is half written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from reading import text_of
from scipy.spatial.transform import Rotation

from wepose_pin.recording import ImuSensor, Recording, check_recording, compute_mount
from wepose_pin.report.track import render_track_report
from wepose_pin.tracking import TrackResult, summarize, track
from wepose_pin.writers import write_session

RESULT = {"pose.parquet", "subject.toml", "subject.urdf", "summary.json"}
ARM = {"right_upper_arm": 0.8, "right_forearm": 1.4}  # [rad], swung to and fro; everything else hangs


def recorded(moved: dict[str, float], *, seconds: float = 6.0, noise: float = 1e-3, sensors: str = "both") -> Recording:
    """A person who stands for two seconds and then swings `moved` about the y axis."""
    rate_hz, rng = 100.0, np.random.default_rng(1)
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    R_LS = Rotation.from_quat(compute_mount("+x", "-z"))
    segments = {
        "both": ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm"),
        "one arm": ("torso", "right_upper_arm", "right_forearm"),
        "forearm": ("right_forearm",),
    }[sensors]
    made = {}
    for segment in segments:
        later = np.maximum(time - 2.0, 0.0)
        angle = moved.get(segment, 0.0) * np.sin(2.0 * later) * (1.0 - np.exp(-later))
        R_WS = Rotation.from_rotvec(np.outer(angle, [0.0, 1.0, 0.0])) * R_LS
        rate = (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * rate_hz
        made[segment] = ImuSensor(
            gyro_S=np.vstack([np.zeros(3), rate]) + noise * rng.standard_normal((len(time), 3)),
            accel_S=R_WS.inv().apply([0.0, 0.0, 9.81]) + 10.0 * noise * rng.standard_normal((len(time), 3)),
            stated_quat_LS=R_LS.as_quat(),
        )
    until = min(1.9, seconds - 0.1)
    return check_recording(Recording("hangs", time, rate_hz, made, {"start": ((0.2, until),)}))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hangs")
    write_session(folder, recorded(ARM))
    return folder


@pytest.fixture(scope="module")
def pose() -> TrackResult:
    return track(recorded(ARM))


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def fails(*_: Any, **__: Any) -> Any:
    raise ValueError("cannot convert\nfloat NaN to integer")


# The causes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [[], ["--causal"]])
def test_an_arm_that_hangs_throughout_is_tracked(
    session: Path, tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """The shoulder of an arm that hangs is at gimbal lock all the time: there are no angles to sum up."""
    assert run("track", session, *options, "-o", tmp_path / "out") == 0
    assert names(tmp_path / "out") == RESULT | {"view.html", "report.html"}
    assert "cannot be made" not in capsys.readouterr().err
    page = (tmp_path / "out" / "report.html").read_text()
    assert "left shoulder, adduction" in page
    assert "cannot be made" not in page


@pytest.mark.parametrize("sensors", ["both", "one arm", "forearm"])
@pytest.mark.parametrize(("seconds", "noise"), [(1.2, 1e-3), (6.0, 1e-9)])
def test_a_report_of_nothing_that_moves(sensors: str, seconds: float, noise: float) -> None:
    tracked = track(recorded({}, seconds=seconds, noise=noise, sensors=sensors))
    page = render_track_report(summarize(tracked), view="<p>")
    assert "nan" not in text_of(page)


def nowhere(values: np.ndarray, rows: slice) -> np.ndarray:
    values = values.copy()
    values[rows] = np.nan
    return values


@pytest.mark.parametrize("rows", [slice(None), slice(0, 300), slice(None, None, 2)])
@pytest.mark.parametrize("segments", ["arm", "all"])
def test_a_report_where_segments_are_not_known(pose: TrackResult, rows: slice, segments: str) -> None:
    """No filter should give NaN undeclared; where one does, the report still stands."""
    lost = [name for name in pose.quat_WL if segments == "all" or name.startswith("left")]
    changed = replace(
        pose.pose,
        quat_WL={k: nowhere(v, rows) if k in lost else v for k, v in pose.quat_WL.items()},
        segment_cov={k: nowhere(v, rows) if k in lost else v for k, v in pose.pose.segment_cov.items()},
        points={k: nowhere(v, rows) for k, v in pose.points.items()},
        point_cov={k: nowhere(v, rows) for k, v in pose.pose.point_cov.items()},
    )
    render_track_report(summarize(replace(pose, pose=changed)), view="<p>")


# What fails all the same ----------------------------------------------------------------------------------------------


def test_a_page_that_fails_is_a_warning(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    for name in ("view.html", "report.html"):
        (tmp_path / "out" / name).write_text("of another motion")
    monkeypatch.setattr("wepose_pin.report.track.draw_timeline", fails)
    assert run("track", session, "--force", "-o", tmp_path / "out") == 0
    assert names(tmp_path / "out") == RESULT | {"view.html"}
    captured = capsys.readouterr()
    (line,) = [line for line in captured.err.splitlines() if "report.html" in line]
    assert "ValueError: cannot convert float NaN to integer" in line
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    (saved,) = [each for each in summary["diagnostics"] if each["code"] == "output-incomplete"]
    assert saved["text"]["what"] in line
    assert "of another motion" not in (tmp_path / "out" / "view.html").read_text()
    assert str(tmp_path / "out" / "report.html") not in captured.out
    assert run("evaluate", tmp_path / "out", tmp_path / "out" / "pose.parquet") == 0


def test_the_result_is_there_when_the_page_is_stopped(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: Any, **__: Any) -> str:
        assert names(tmp_path / "out") == RESULT
        raise KeyboardInterrupt

    monkeypatch.setattr("wepose_pin.report.pages.pose_html", stopped)
    assert run("track", session, "-o", tmp_path / "out") == 130
    assert names(tmp_path / "out") == RESULT
    assert f"{tmp_path / 'out'} was written before" in capsys.readouterr().err


def test_a_calibration_outlasts_its_report(
    half_minute: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_session(tmp_path, half_minute)
    monkeypatch.setattr("wepose_pin.report.calibration.draw_lengths", fails)
    assert run("calibrate", tmp_path, "-o", tmp_path / "anna") in (0, 3)
    assert names(tmp_path / "anna") == {"subject.toml", "subject.urdf", "calibration.json"}
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "ValueError" in line]
    diagnostics = json.loads((tmp_path / "anna" / "calibration.json").read_text())["diagnostics"]
    (saved,) = [each for each in diagnostics if each["code"] == "output-incomplete"]
    assert saved["text"]["what"] in line
