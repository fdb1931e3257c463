"""What --interval and --phase select: one rule for all commands that read a result."""

import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from test_export import a_pose, write_folder

import wepose_pin as wp

PHASES = {"start": ((2.0, 2.4),), "reach": ((2.5, 3.0), (3.5, 4.2)), "empty": (), "odd:2": ((4.0, 4.5),)}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """From 2 to 5 s."""
    folder = write_folder(tmp_path_factory.mktemp("selection") / "result", a_pose())
    (folder / "summary.json").write_text(json.dumps({"recorded_phases": PHASES}), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("interval", "phase", "selected"),
    [
        (None, None, (2.0, 5.0)),
        ((2.5, 3.0), None, (2.5, 3.0)),
        ((1.99, 5.01), None, (2.0, 5.0)),  # a recording of 5 s whose last sample is at 4.99 has "0 5"
        (None, "start:1", (2.0, 2.4)),
        (None, "reach:2", (3.5, 4.2)),
        (None, "odd:2", (4.0, 4.5)),  # a name may look like a number of another
    ],
)
def test_an_interval_or_a_phase_is_selected(interval, phase, selected, result: Path, tmp_path: Path) -> None:
    wp.export(result, tmp_path / "a.parquet", interval=interval, phase=phase)
    table, whole = pl.read_parquet(tmp_path / "a.parquet"), pl.read_parquet(result / "pose.parquet")
    assert table["time"][[0, -1]].to_list() == pytest.approx(selected)
    kept = (whole["time"] >= selected[0] - 1e-6) & (whole["time"] <= selected[1] + 1e-6)
    np.testing.assert_allclose(table["right_palm_x"], whole.filter(kept)["right_palm_x"])


@pytest.mark.parametrize(
    ("interval", "phase", "said"),
    [
        ((3.0, 2.0), None, "`interval` 3 2: two times in seconds are needed, the earlier one first"),
        ((2.0, 2.0), None, "the earlier one first"),
        ((0.0, 3.0), None, "`interval` 0 3: the recording runs from 2 to 5 s"),
        ((3.0, 7.0), None, "`interval` 3 7: the recording runs from 2 to 5 s"),
        ((2.501, 2.504), None, "the interval 2.501 to 2.504 s has no sample"),
        ((2.0, 3.0), "start", "`interval` 2 3: `phase` start is given too"),
        (None, "stat", "`phase` stat: the recording has no such phase; did you mean 'start'"),
        (None, "empty", "`phase` empty: the recording has no such phase"),
        (None, "reach", "`phase` reach: reach has 2 intervals; choose reach:1 (2.5 to 3 s), reach:2 (3.5 to 4.2 s)"),
        (None, "reach:3", "`phase` reach:3: reach has 2 intervals"),
        (None, "reach:0", "`phase` reach:0: reach has 2 intervals"),
        (None, "start:2", "`phase` start:2: start has one interval; choose start:1"),
    ],
)
def test_what_selects_nothing_is_said(interval, phase, said: str, result: Path, tmp_path: Path) -> None:
    with pytest.raises(wp.WeposeError, match=re.escape(said)):
        wp.export(result, tmp_path / "a.csv", interval=interval, phase=phase)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_without_phases_has_none_to_choose(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "result", a_pose())
    (folder / "summary.json").write_text('{"recorded_phases": {}}', encoding="utf-8")
    with pytest.raises(wp.WeposeError, match="has no phases; use `interval`"):
        wp.export(folder, tmp_path / "a.csv", phase="start")


def test_view_and_evaluate_take_only_what_is_selected(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "a.html"
    assert run("view", result, "-o", page, "--no-open", "--phase", "reach:2") == 0
    assert re.search('"begin": ?3.5, ?"end": ?4.2', page.read_text(encoding="utf-8"))
    assert run("evaluate", result, result / "pose.parquet", "--phase", "reach:1") == 0
    assert "51 samples from 2.5 to 3 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "export {result} -o {out}/x.urdf --phase start",
            "--phase start: not of format urdf; there is no motion in it",
        ),
        ("export {result} -o {out}/x.csv --phase clasp", "--phase clasp: the recording has no such phase"),
        ("view {result} --phase start", "--phase start: needs -o FILE"),
        ("view {result} --interval 9 11 -o {out}/x.html", "--interval 9 11: the recording runs from 2 to 5 s"),
        ("evaluate {result} {result}/pose.parquet --phase reach", "--phase reach: reach has 2 intervals"),
        ("retarget {result} --robot panda -o {out}/r --interval 3 2", "--interval 3 2: two times in seconds"),
    ],
)
def test_a_wrong_selection_is_one_line_and_exit_2(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    assert run(*(word.format(result=result, out=tmp_path) for word in words.split())) == 2
    line = capsys.readouterr().err
    assert said in line
    assert line.count("\n") == 1
