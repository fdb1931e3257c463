"""What --interval and --phase select: one rule for all commands that read a result."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from test_export import a_pose, write_folder

from wepose_pin.body.kinematics import find_samples
from wepose_pin.commands import main
from wepose_pin.errors import BadData, WrongOption
from wepose_pin.recording import select_interval
from wepose_pin.writers.result import read_phases

TIME = 2.0 + np.arange(301) / 100.0
PHASES = {"start": ((2.0, 2.4),), "reach": ((2.5, 3.0), (3.5, 4.2)), "empty": (), "odd:2": ((4.0, 4.5),)}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_folder(tmp_path_factory.mktemp("selection") / "result", a_pose())
    (folder / "summary.json").write_text(json.dumps({"recorded_phases": PHASES}), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("interval", "phase", "selected"),
    [
        (None, None, None),
        ((2.5, 3.0), None, (2.5, 3.0)),
        ((1.99, 5.01), None, (1.99, 5.01)),  # a recording of 5 s whose last sample is at 4.99 has "0 5"
        (None, "start", (2.0, 2.4)),
        (None, "start:1", (2.0, 2.4)),
        (None, "reach:2", (3.5, 4.2)),
        (None, "odd:2", (4.0, 4.5)),  # a name may look like a number of another
    ],
)
def test_an_interval_or_a_phase_is_selected(interval, phase, selected) -> None:
    assert select_interval(TIME, PHASES, interval, phase) == selected


@pytest.mark.parametrize(
    ("interval", "phase", "said"),
    [
        ((3.0, 2.0), None, "--interval 3 2: two times in seconds are needed, the earlier one first"),
        ((2.0, 2.0), None, "the earlier one first"),
        ((0.0, 3.0), None, "--interval 0 3: the recording runs from 2 to 5 s"),
        ((3.0, 7.0), None, "--interval 3 7: the recording runs from 2 to 5 s"),
        ((3.0, np.inf), None, "the recording runs from 2 to 5 s"),
        ((2.0, 3.0), "start", "--interval 2 3: --phase start is given too"),
        (None, "stat", "--phase stat: the recording has no such phase; did you mean 'start'"),
        (None, "empty", "--phase empty: the recording has no such phase"),
        (None, "reach", "--phase reach: reach has 2 intervals; choose reach:1 (2.5 to 3 s), reach:2 (3.5 to 4.2 s)"),
        (None, "reach:3", "--phase reach:3: reach has 2 intervals"),
        (None, "reach:0", "--phase reach:0: reach has 2 intervals"),
        (None, "start:2", "--phase start:2: start has one interval; choose start:1"),
    ],
)
def test_what_selects_nothing_is_said(interval, phase, said: str) -> None:
    with pytest.raises(WrongOption) as error:
        select_interval(TIME, PHASES, interval, phase)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_recording_without_phases_has_none_to_choose() -> None:
    with pytest.raises(WrongOption, match="has no phases; use --interval FROM TO"):
        select_interval(TIME, {}, None, "start")


def test_all_of_a_pose_is_cut() -> None:
    pose = a_pose()
    part = pose.cut(find_samples(pose.time, (2.5, 3.0)))
    assert part.time.tolist() == pose.time[50:101].tolist()
    for name in ("quat_WL", "points", "segment_cov", "point_cov"):
        whole = getattr(pose, name)
        assert {key: values[50:101].tolist() for key, values in whole.items()} == {
            key: values.tolist() for key, values in getattr(part, name).items()
        }
    with pytest.raises(BadData, match=r"the interval 2\.501 to 2\.504 s has no sample"):
        find_samples(pose.time, (2.501, 2.504))


def test_damaged_phases_of_a_summary_are_none() -> None:
    assert read_phases({"recorded_phases": {"a": [[1, 2]], "b": [1, 2], "c": None, "d": [["x", 1]]}}) == {
        "a": ((1.0, 2.0),)
    }
    assert read_phases({"recorded_phases": [1]}) == {} == read_phases({})


def test_each_command_takes_only_what_is_selected(result: Path, tmp_path: Path) -> None:
    for words, rows in ((["--phase", "reach:2"], 71), (["--interval", "2.5", "3"], 51)):
        out = tmp_path / f"{rows}.parquet"
        with pytest.raises(SystemExit) as stop:
            main(["export", str(result), "-o", str(out), *words])
        assert stop.value.code == 0
        assert len(pl.read_parquet(out)) == rows
        page = tmp_path / f"{rows}.html"
        with pytest.raises(SystemExit) as stop:
            main(["view", str(result), "-o", str(page), "--no-open", *words])
        assert stop.value.code == 0
        assert page.is_file()


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
    with pytest.raises(SystemExit) as stop:
        main([word.format(result=result, out=tmp_path) for word in words.split()])
    assert stop.value.code == 2
    line = capsys.readouterr().err
    assert said in line
    assert line.count("\n") == 1


def test_evaluate_counts_only_the_phase(result: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", str(result), str(result / "pose.parquet"), "--phase", "reach:1"])
    assert stop.value.code == 0
    assert "51 samples from 2.5 to 3 s" in capsys.readouterr().out
