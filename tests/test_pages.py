"""Pages beside a result: one that fails is a warning; the result has landed before, and nothing is half written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from reading import text_of
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin.writers import write_session

RESULT = {"pose.parquet", "subject.toml", "subject.urdf", "summary.json"}
ARM = {"right_upper_arm": 0.8, "right_forearm": 1.4}  # [rad], swung to and fro; everything else hangs


def recorded(
    moved: dict[str, float], *, seconds: float = 6.0, noise: float = 1e-3, sensors: str = "both"
) -> wp.Recording:
    """A person who stands for two seconds and then swings `moved` about the y axis."""
    rng, time = np.random.default_rng(1), np.arange(round(seconds * 100.0)) / 100.0
    R_LS = Rotation.from_matrix([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
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
        gyro = np.vstack([np.zeros(3), (R_WS[:-1].inv() * R_WS[1:]).as_rotvec() * 100.0])
        accel = R_WS.inv().apply([0.0, 0.0, 9.81])
        made[segment] = tuple(s + n * noise * rng.standard_normal(s.shape) for s, n in ((gyro, 1.0), (accel, 10.0)))
    mounts, start = dict.fromkeys(segments, ("+x", "-z")), ((0.2, min(1.9, seconds - 0.1)),)
    return wp.Recording.from_arrays(100.0, name="hangs", mounts=mounts, phases={"start": start}, **made)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hangs")
    write_session(folder, recorded(ARM))
    return folder


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def fails(*_: Any, **__: Any) -> Any:
    raise ValueError("cannot convert\nfloat NaN to integer")


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
def test_a_report_of_nothing_that_moves(sensors: str, seconds: float, noise: float, tmp_path: Path) -> None:
    folder = wp.track(recorded({}, seconds=seconds, noise=noise, sensors=sensors)).save(tmp_path / "out")
    assert names(folder) == RESULT | {"view.html", "report.html"}
    assert "nan" not in text_of((folder / "report.html").read_text(encoding="utf-8"))


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
    assert "of another motion" not in (tmp_path / "out" / "view.html").read_text()
    assert str(tmp_path / "out" / "report.html") not in captured.out
    assert run("evaluate", tmp_path / "out", tmp_path / "out" / "pose.parquet") == 0


def test_a_result_that_is_stopped_leaves_the_earlier_one(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "view.html").write_text("of another motion")

    def stopped(*_: Any, **__: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("wepose_pin.report.pages.pose_html", stopped)
    assert run("track", session, "--force", "-o", tmp_path / "out") == 130
    assert names(tmp_path / "out") == {"view.html"}
    assert str(tmp_path) not in capsys.readouterr().err
