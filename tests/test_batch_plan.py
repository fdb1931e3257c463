"""`PLAN.toml`: what it may say, whose sessions are whose, and what is said of mistakes."""

from pathlib import Path

import polars as pl
import pytest
from commands import run

STEPS = "[steps.calibrate]\n[steps.track]\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("anna/one", "anna/two", "ben/one"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "session.toml").write_text("[")
    return tmp_path


def plan(folder: Path, text: str) -> int:
    """The exit code of `wepose batch`; 3: the items ran, and failed, as their sessions are no TOML."""
    (folder / "plan.toml").write_text(text)
    return run("batch", folder / "plan.toml", "-o", folder / "out", "--workers", 1)


def items(folder: Path) -> pl.DataFrame:
    return pl.read_parquet(folder / "out" / "results.parquet")


def test_globs_give_items_named_by_their_folders(folder: Path) -> None:
    assert plan(folder, f'[sessions]\nfiles = ["*/one", "anna/two/session.toml"]\n{STEPS}') == 3
    assert items(folder)["item"].to_list() == ["anna-one", "ben-one", "anna-two"]
    assert items(folder)["status"].to_list() == ["failed"] * 3


def test_a_subject_calibrated_once_goes_first_and_its_sessions_follow(folder: Path) -> None:
    (folder / "sessions.csv").write_text("session,subject,name\nanna/two,anna,\nben/one,ben,b\n")
    subjects = '[subjects.anna]\ncalibration = "anna/one"\nstature = 1.7\n[subjects.ben]\nsex = "m"\n'
    assert plan(folder, f'[sessions]\ntable = "sessions.csv"\n{subjects}{STEPS}') == 3
    table = items(folder)
    assert set(table["item"]) == {"subject-anna", "anna-two", "b"}
    told = dict(zip(table["item"], table["message"], strict=True))
    assert "subject-anna" in told["anna-two"]  # which has none without it
    assert "ben" in told["b"]


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
        (f'{HEAD}[steps.track]\nmodel = "arm.urdf"', "steps.track: --model arm.urdf: no such file"),
        (f"{HEAD}[subjects.a]\nstature = 0\n[steps.track]", "subjects.a: stature 0 is not a body height"),
        (f"{HEAD}[subjects.a]\nstature = 170\n[steps.track]", "subjects.a: stature 170 is not a body height"),
    ],
)
def test_a_mistake_gets_one_line_that_names_it(
    folder: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plan(folder, text) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert "plan.toml" in line
    assert not (folder / "out").exists()


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
def test_a_mistake_in_the_table_gets_its_row(
    folder: Path, table: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "sessions.csv").write_text(table)
    assert plan(folder, f'[sessions]\ntable = "sessions.csv"\n{STEPS}') == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert "sessions.csv" in line
