"""`PLAN.toml`: what it may say, whose sessions are whose, and what is said of mistakes."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from wepose_pin.batch.plan import Plan, read_plan
from wepose_pin.errors import BadPlan, WeposeError

STEPS = "[steps.calibrate]\n[steps.track]\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("anna/one", "anna/two", "ben/one"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "session.toml").write_text("")
    return tmp_path


def planned(folder: Path, text: str) -> Plan:
    (folder / "plan.toml").write_text(text)
    return read_plan(folder / "plan.toml", "OUT/items")


def test_globs_give_items_named_by_their_folders(folder: Path) -> None:
    plan = planned(folder, f'[sessions]\nfiles = ["*/one", "anna/two/session.toml"]\n{STEPS}')
    assert [item.name for item in plan.items] == ["anna-one", "ben-one", "anna-two"]
    assert [Path(item.session).is_absolute() for item in plan.items] == [True] * 3
    assert list(plan.items[0].steps) == ["calibrate", "track"]
    assert plan.calibrations == ()


def test_steps_run_in_their_order_however_they_are_written(folder: Path) -> None:
    plan = planned(
        folder,
        '[sessions]\nfiles = "ben/one"\n[steps.evaluate]\ninterval = [1, 2]\n[steps.export]\nformats = ["trc", "mot"]\n'
        "rate_hz = 50\n[steps.track]\ncovariance = true\n",
    )
    assert list(plan.items[0].steps) == ["track", "export", "evaluate"]
    exports, evaluates = plan.items[0].steps["export"], plan.items[0].steps["evaluate"]
    assert (exports, evaluates) == ({"formats": ["trc", "mot"], "rate_hz": 50}, {"interval": [1, 2]})
    assert plan.items[0].steps["track"]["covariance"] is True


def test_a_subject_calibrated_once_goes_first_and_its_sessions_are_not_calibrated(folder: Path) -> None:
    (folder / "sessions.csv").write_text("session,subject\nanna/two,anna\nben/one,ben\n")
    plan = planned(
        folder,
        f"""
        [sessions]
        table = "sessions.csv"
        [subjects.anna]
        calibration = "anna/one"
        stature = 1.7
        measured = {{ shoulder_width = 0.36 }}
        [subjects.ben]
        sex = "m"
        {STEPS}""",
    )
    (first,) = plan.calibrations
    person = {"stature": 1.7, "measured": {"shoulder_width": 0.36}}
    assert (first.name, list(first.steps), first.person) == ("subject-anna", ["calibrate"], person)
    anna, ben = plan.items
    assert list(anna.steps) == ["track"]
    assert anna.subject_file == "OUT/items/subject-anna/calibrate/subject.toml"
    assert list(ben.steps) == ["calibrate", "track"]
    assert (ben.subject_file, ben.person) == (None, {"sex": "m"})


def test_a_table_ties_sessions_to_subjects_and_lengths(folder: Path) -> None:
    table = {"session": ["anna/one", "ben/one"], "name": ["a", None]}
    table |= {"stature": [1.7, None], "sex": ["f", None], "measured.trunk": [0.5, None]}
    pl.DataFrame(table).write_csv(folder / "sessions.csv")
    plan = planned(folder, f'[sessions]\ntable = "sessions.csv"\n{STEPS}')
    assert [item.name for item in plan.items] == ["a", "ben-one"]
    assert plan.items[0].person == {"stature": 1.7, "sex": "f", "measured": {"trunk": 0.5}}
    assert plan.items[1].person == {}


def test_items_keep_their_names_when_others_join(folder: Path) -> None:
    few = planned(folder, f'[sessions]\nfiles = ["anna/one"]\n{STEPS}')
    many = planned(folder, f'[sessions]\nfiles = ["**/session.toml"]\n{STEPS}')
    assert few.items[0].name in {item.name for item in many.items}


HEAD = '[sessions]\nfiles = "anna/*"\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (STEPS, "sessions is missing"),
        (f"[sessions]\n{STEPS}", "either files (globs) or table is needed"),
        (f'[sessions]\nfiles = ["nobody/*"]\n{STEPS}', "'nobody/*' finds nothing"),
        (f'[sessions]\nfile = "a"\n{STEPS}', "sessions.file is not a known key; did you mean 'files'?"),
        (f"{HEAD}[steps]\n", "no step"),
        (f"{HEAD}[steps.trak]\n", "did you mean 'track'?"),
        (f'{HEAD}[steps.track]\nmetod = "ncf"\n', "did you mean 'method'?"),
        (f"{HEAD}[steps.track]\nhelp = true\n", "steps.track.help is not a known key"),
        (f"{HEAD}[steps.track]\nversion = true\n", "steps.track.version is not a known key"),
        (
            f"{HEAD}[steps.track]\n[steps.export]\nrate-hz = 50",
            "export.rate-hz is not a known key; did you mean 'rate_hz'?",
        ),
        (f'{HEAD}[steps.track]\nmethod = "amek"\n', 'Did you mean "amekf"?'),
        (f"{HEAD}[steps.track]\ngaps = 3\n", 'gaps: unable to convert "3" into bool'),
        (f'{HEAD}[steps.track]\nsubject = "a"\n', "steps.track.subject is not a known key"),
        (f"{HEAD}[steps.evaluate]\n", "needs the step [steps.track]"),
        (
            f"{HEAD}[steps.track]\n[steps.evaluate]\ninterval = [2, 1]",
            "--interval 2 1: two times in seconds are needed",
        ),
        (f"{HEAD}[steps.track]\n[steps.export]\n", "'' is no format"),
        (f'{HEAD}[steps.track]\n[steps.export]\nformats = ["lerobot"]', "'lerobot' is no format of a person's motion"),
        (f'{HEAD}[steps.track]\n[steps.retarget]\nrobot = "pandda"', "did you mean 'panda'?"),
        (f'{HEAD}[steps.calibrate]\nprotocol = "clsp"', "did you mean 'clasp'?"),
        (f'{HEAD}subject = "ben"\n[subjects.anna]\n[steps.track]', "subject 'ben' is not in"),
        (f'{HEAD}subject = "a"\n[subjects.a]\nfile = "ben/one"\n[steps.calibrate]', "nothing to do: its subject is"),
        (
            f'{HEAD}subject = "a"\n[subjects.a]\ncalibration = "ben/one"\n[steps.track]',
            "needs the step [steps.calibrate]",
        ),
        (f'{HEAD}[subjects.anna]\nfile = "a"\ncalibration = "b"\n[steps.track]', "not both"),
        (f'{HEAD}[subjects.a]\nfile = "nobody"\n[steps.track]', "nobody: no such file"),
        (f"{HEAD}[subjects.a]\nmeasured = {{ arm = 1 }}\n[steps.track]", "measured.arm is not a known"),
        (f"{HEAD}[subjects.a]\nstature = 170\n[steps.track]", "subjects.a: stature 170 is not a body height"),
    ],
)
def test_a_mistake_gets_one_line_that_names_it(folder: Path, text: str, said: str) -> None:
    with pytest.raises(BadPlan) as error:
        planned(folder, text)
    assert said in str(error.value)
    assert "plan.toml" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("sesion\na", "row 1: session is empty; the columns are sesion"),
        ("session,age\na,3", "row 1.age is not a known key"),
        ("session,stature\na,178", "row 1: stature 178 is not a body height"),
        ("session,name\na,x\nb,x", "row 2: 'x' names two items"),
        ("session\na\na", "row 2: 'a' names two items"),
    ],
)
def test_a_mistake_in_the_table_gets_its_row(folder: Path, table: str, said: str) -> None:
    (folder / "sessions.csv").write_text(table)
    with pytest.raises(WeposeError) as error:
        planned(folder, f'[sessions]\ntable = "sessions.csv"\n{STEPS}')
    assert said in str(error.value)
    assert "sessions.csv" in str(error.value)
