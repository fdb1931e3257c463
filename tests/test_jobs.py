"""Jobs: the command line and batch build the same dataclass and call the same function."""

from __future__ import annotations

import shlex
from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any, get_args

import pytest

from benchmarks.results import adapter
from wepose_pin import calibration
from wepose_pin.calibration import PROTOCOLS
from wepose_pin.cli import COMMANDS, find_command
from wepose_pin.cli.parser import parse
from wepose_pin.errors import BadOption
from wepose_pin.filters import METHODS, OFFLINE
from wepose_pin.jobs import Formulation, LiveMethod, Method
from wepose_pin.jobs.calibrate import CalibrateJob
from wepose_pin.jobs.evaluate import EvaluateJob
from wepose_pin.jobs.fields import build_job
from wepose_pin.jobs.simulate import SimulateJob, run_simulate
from wepose_pin.jobs.track import TrackJob, run_track
from wepose_pin.simulation import simulate, simulate_person
from wepose_pin.simulation.sequence import TASKS
from wepose_pin.writers import write_session

JOBS = {
    "track": TrackJob(Path("s.toml"), Path("out"), Path("anna"), method="smekf", open_loop=True, limits=False),
    "calibrate": CalibrateJob(
        *(Path("s.toml"), Path("out"), "table"),
        measured={"biacromial": 0.4, "trunk": 0.5},
        stature=1.7,
        sex="f",
        formulation="paper",
    ),
    "simulate": SimulateJob(Path("out"), 3, 50.0, preset="mild", imperfection={"bits": 12.0, "mount": "any"}),
}


def test_choices_of_options_are_those_of_the_rooms() -> None:
    """Options are annotated without loading a room; what is added there must be added here."""
    assert get_args(Method) == tuple(METHODS) == adapter.METHODS
    assert get_args(Formulation) == get_args(calibration.Formulation)
    assert get_args(LiveMethod) == tuple(name for name in METHODS if name not in OFFLINE)
    assert set(TASKS) <= set(PROTOCOLS)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"session": "s.toml", "out": "o", "speed": 3}, "speed is not an option; there is: "),
        ({"session": "s.toml"}, "out is missing"),
        ({"session": 3, "out": "o"}, "session = 3: a path is needed"),
        ({"session": "s.toml", "out": "o", "causal": 1}, "causal = 1: True or False is needed"),
        ({"session": "s.toml", "out": "o", "method": "ekf"}, "method = 'ekf' is not known; did you mean 'smekf'"),
    ],
)
def test_a_job_of_wrong_values_is_refused_by_name(values: dict[str, Any], said: str) -> None:
    with pytest.raises(BadOption) as error:
        build_job(TrackJob, values)
    assert said in str(error.value)


def test_values_of_json_and_toml_become_those_of_the_fields() -> None:
    job = build_job(EvaluateJob, {"result": "r", "truth": "t.csv", "interval": [1, 2]})
    assert job == EvaluateJob(Path("r"), Path("t.csv"), (1.0, 2.0))
    assert build_job(SimulateJob, {"out": "o", "rate_hz": 10**400}).rate_hz == float("inf")
    with pytest.raises(BadOption, match="between 20 and 2000"):
        build_job(SimulateJob, {"out": "o", "rate_hz": 10**400}).check()
    with pytest.raises(FrozenInstanceError):
        job.truth = Path("other")  # type: ignore[misc]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_of_a_command_is_a_job(name: str) -> None:
    command = find_command(name)
    first, *words = shlex.split(command.example)
    assert first == name
    assert isinstance(parse(name, command, words), command.job)


def test_words_and_defaults_become_the_fields() -> None:
    words = "s.toml --measured biacromial=0.4 --protocol table --measured trunk=0.5 --stature 1.7 --sex f"
    words += " --formulation paper -o out"
    assert parse("calibrate", find_command("calibrate"), words.split()) == JOBS["calibrate"]
    words = "--out=out s.toml --subject anna --method smekf --open-loop --no-limits"
    assert parse("track", find_command("track"), words.split()) == JOBS["track"]
    words = "-o out --seed 3 --rate-hz 50 --preset mild --imperfection bits=12 --imperfection mount=any"
    assert parse("simulate", find_command("simulate"), words.split()) == JOBS["simulate"]


def test_jobs_print_nothing_and_tell_a_growing_share(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    shares: list[tuple[str, float]] = []
    made = simulate(simulate_person(1).lengths, seed=1, clasp_s=8.0, circles=0)
    (tmp_path / "session").mkdir()
    write_session(tmp_path / "session", made.recording("made"), made.truth())
    outcome = run_track(TrackJob(tmp_path / "session", tmp_path / "result"), lambda *of: shares.append(of))
    assert outcome.page_failures == []
    assert outcome.summary["method"] == "amekf"
    assert list(dict.fromkeys(text for text, _ in shares)) == ["reading", "tracking by amekf", "making the pages"]
    assert shares[0][1] == 0.0
    assert sorted(share for _, share in shares) == [share for _, share in shares]
    assert all(0.0 <= share < 1.0 for _, share in shares)
    run_simulate(SimulateJob(tmp_path / "made", protocol="t_pose+bow"))
    assert capfd.readouterr() == ("", "")
