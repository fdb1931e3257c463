"""A result in a folder that holds an earlier result, or files of the user: `--force` deletes and replaces only ours."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from wepose_pin import ExistingOutput, load_model, population_subject, simulate
from wepose_pin.commands.recordings import calibrate as calibrate_session
from wepose_pin.commands.recordings import track as track_session
from wepose_pin.writers import write_session
from wepose_pin.writers.result import write_subject


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session")
    lengths = population_subject(1.75).lengths
    write_session(folder, simulate(lengths, seed=5, rate_hz=50.0, clasp_s=6.0, circles=0).recording("session"))
    return folder


def calibrate(session: Path, out: Path) -> None:
    calibrate_session(session, out=out, report=False, force=True)


def track(session: Path, out: Path) -> None:
    track_session(session, out=out, view=False, report=False, force=True)


WRITERS = pytest.mark.parametrize("write", [calibrate, track])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@WRITERS
def test_the_body_of_an_earlier_result_does_not_stay(
    write: Callable[[Path, Path], None], session: Path, tmp_path: Path
) -> None:
    """It would be read with the new subject."""
    body = load_model("whole_body")  # another one, which has joints of one axis
    write_subject(tmp_path, population_subject(body=body), body)
    (tmp_path / "summary.json").write_text('{"joints": {"elbow": {}}}', encoding="utf-8")
    pl.DataFrame({"time": [0.0], "elbow": [0.1]}).write_parquet(tmp_path / "joints.parquet")
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    assert "left_thigh" in load_model(tmp_path / "subject.urdf").table.segments
    write(session, tmp_path)
    assert not (tmp_path / "model.toml").exists()
    assert not (tmp_path / "joints.parquet").exists()
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert "left_thigh" not in load_model(tmp_path / "subject.urdf").table.segments


@pytest.mark.parametrize("name", ["model.toml", "joints.parquet"])
def test_a_users_file_is_not_mixed_with_a_result(name: str, session: Path, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine", encoding="utf-8")
    with pytest.raises(ExistingOutput, match=f"{name}: is of no earlier result"):
        track(session, tmp_path)
    assert contents(tmp_path) == {name: b"mine"}


@WRITERS
def test_what_a_session_in_the_folder_needs_is_not_replaced(
    write: Callable[[Path, Path], None], session: Path, tmp_path: Path
) -> None:
    """A result may lie beside the session that it is made from, under other names."""
    for file in session.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    write(tmp_path, tmp_path)
    write(tmp_path, tmp_path)
    assert {"session.toml", "recording.parquet", "subject.toml"} <= set(contents(tmp_path))
    (tmp_path / "me.toml").write_text('urdf = "subject.urdf"\nlike = "upper_body"\n', encoding="utf-8")
    text = (session / "session.toml").read_text(encoding="utf-8")
    (tmp_path / "session.toml").write_text(f'model = "me.toml"\n{text}', encoding="utf-8")
    before = contents(tmp_path)
    with pytest.raises(ExistingOutput, match=r"subject\.\w+: is an input of .*session\.toml, and would be replaced"):
        write(tmp_path, tmp_path)
    assert contents(tmp_path) == before


def test_pages_of_an_earlier_result_do_not_outlive_it(session: Path, tmp_path: Path) -> None:
    for name in ("view.html", "report.html", "torques.parquet"):
        (tmp_path / name).write_text("of another motion", encoding="utf-8")
    track(session, tmp_path)
    assert not [name for name in contents(tmp_path) if name.endswith(".html") or "torques" in name]
    (tmp_path / "view.html").mkdir()  # it is no page
    track_session(session, out=tmp_path, view=False, force=True)
    assert (tmp_path / "view.html").is_dir()
    assert "<b>Good for</b> elbow flexion" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["samples"] > 0
    assert np.isfinite(pl.read_parquet(tmp_path / "pose.parquet")["torso_qw"].to_numpy()).all()
