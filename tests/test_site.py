"""What the pages show works: commands are understood and run, TOML and Python are what they say, links are checked."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pytest
from conftest import DATA
from packaging.version import Version

import wepose_pin as wp
from wepose_pin.commands.options import COMMANDS, parse
from wepose_pin.writers import write_session

ROOT = Path(__file__).resolve().parents[1]
FENCE = re.compile(r"^( *)```([\w{}-]*)\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
SHELL = ("", "console", "bash")
PAGES = [
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
    if not {"generated", "_build"} & set(path.parts)
]
# Pages whose commands run one after the other, each page in a folder with a recording and its result.
RUN = [
    *("README.md", "docs/start.md", "docs/calibrate.md", "docs/track.md", "docs/numbers.md", "docs/retargeting.md"),
    *("docs/angles.md", "docs/opensim.md", "docs/live.md", "docs/live-outputs.md", "docs/people.md", "docs/models.md"),
    *("docs/batch.md", "docs/formats.md", "docs/export.md"),
]
# What is not run on these pages, and why.
ELSEWHERE = {
    r"^(pip|make|cd|python3 -m venv) ": "sets up a machine: .ci/run does it",
    r"--source (udp|lsl)|--guide": "waits for sensors: tests/test_sources_*.py, test_guide.py",
    r"humanSubject01|arm\.(toml|urdf)": "a file of the reader's: benchmarks/bodies.py",
    r"ours\.toml|session\.toml --method smekf": "a file of the reader's: tests/test_reference.py, test_chain.py",
    r"before after|session.toml --model whole_body": "two sessions, legs: tests/test_repetitions.py, test_legs.py",
    r"take_2|study|plan\.toml": "takes and plans: tests/test_live_terminal.py, test_batch_plan.py",
    r"--activity tasks --seconds 600": "ten minutes: tests/test_people.py",
    r"panda_2": "several trajectories: tests/test_export_robot.py",
    r"\.rrd": "an extra of 170 MB and its viewer: tests/test_export_ros.py",
    r"…|examples/": "no whole command; tests/test_examples.py",
}
# Their Python runs too; tests/test_api.py has that of the README and docs/python.md.
PYTHON = ("docs/angles.md", "docs/export.md", "docs/opensim.md")
FILES = {"bvh": "HIERARCHY", "mot": "inDegrees", "sto": "DataType", "trc": "PathFileType"}  # a word of each shown file
PRELUDE = 'import wepose_pin as wp\nrecording, subject = wp.load_session("session.toml"), wp.load_subject("anna")\n'


class Command(NamedTuple):
    """A command of a page, with the lines that the page shows as its output."""

    words: str
    output: tuple[str, ...]


@cache
def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of each code block of a page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return [(kind, re.sub(rf"^{indent}", "", body, flags=re.MULTILINE)) for indent, kind, body in FENCE.findall(text)]


def commands(page: str) -> list[Command]:
    """The lines of a page's shell blocks that are commands: after $, or where a program's name begins the line."""
    shown: list[Command] = []
    for kind, body in blocks(page):
        prompt = kind == "console"
        for line in body.splitlines() if kind in SHELL else ():
            if line.startswith("$ "):
                shown.append(Command(re.sub(r"\s+#.*$", "", line[2:]), ()))
            elif prompt and shown:
                shown[-1] = shown[-1]._replace(output=(*shown[-1].output, line))
            elif re.match(r"(wepose|python3?|pip|make|cd) ", line):
                shown.append(Command(re.sub(r"\s+#.*$", "", line), ()))
    return shown


def wepose_calls(page: str) -> list[list[str]]:
    """The words after `wepose` of every call, without what stands for something that is left out."""
    lines = [part.strip() for command in commands(page) for part in re.split(r"&&|\|\|", command.words)]
    return [shlex.split(line)[1:] for line in lines if line.startswith("wepose ") and "…" not in line]


def test_pages_have_commands() -> None:
    assert sum(len(wepose_calls(page)) for page in PAGES) > 60
    assert set(RUN) <= set(PAGES)


@pytest.mark.parametrize("page", [page for page in PAGES if wepose_calls(page)])
def test_commands_of_a_page_are_understood(page: str) -> None:
    toys = {"levelled"}  # of the recipes, which the reader adds
    for name, *words in wepose_calls(page):
        if not name.startswith("-") and not toys & set(words) and "--help" not in words:
            assert name in COMMANDS
            if not re.search(r"humanSubject01|corner|xarm7|arm\.toml", " ".join(words)):  # the reader's files
                parse([name, *words])


def test_toml_of_pages_is_toml() -> None:
    read = [tomllib.loads(body) for page in PAGES for kind, body in blocks(page) if kind == "toml"]
    assert len(read) > 20


def test_python_of_pages_imports_what_is_there() -> None:
    for page in PAGES:
        for kind, body in blocks(page):
            if kind != "python" or body.startswith((" ", "# wepose_pin/")):  # parts of functions; tests/test_docs.py
                continue
            compile(body, page, "exec")
            for module, names in re.findall(r"^from (wepose_pin[\w.]*) import (.+)$", body, re.MULTILINE):
                assert all(hasattr(import_module(module), name.strip()) for name in names.split(",")), body


GENERIC = DATA / "osim" / "Rajagopal_2015.osim"  # OpenSim's model, which the pages ask the reader to have
STAND_S, CLASP = "[[0.5, 4.5]]", "[[7.6, 32.0]]"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recording of a person, as session and as CSV, what calibrating and tracking it gives."""
    folder = tmp_path_factory.mktemp("pages")
    lengths = {**wp.population_subject(1.78, "f").lengths, "shoulder_width": 0.83 * 0.41}
    simulation = wp.simulate(lengths, seed=1, clasp_s=25.0, circles=2)
    write_session(folder, simulation.recording(), simulation.truth())
    pl.read_parquet(folder / "recording.parquet").write_csv(folder / "trial.csv")
    bin_ = folder / "bin"
    bin_.mkdir()
    script = bin_ / "wepose"
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "from wepose_pin.commands import main; main()" "$@"\n')
    script.chmod(0o755)
    for line in (
        "wepose calibrate session.toml --measured biacromial=0.41 --stature 1.78 --sex f -o anna",
        "wepose track session.toml --subject anna -o result",
        "wepose export result -o circles.c3d && wepose export result -o circles.trc",
        "wepose live --source replay:session.toml --subject anna --record morning.mcap --speed max --no-page",
    ):
        assert run(line, folder, folder).returncode in (0, 3), line
    (folder / "made").symlink_to(folder)
    if GENERIC.exists():
        (folder / GENERIC.name).symlink_to(GENERIC)
    return folder


def run(line: str, folder: Path, place: Path) -> subprocess.CompletedProcess[str]:
    paths = {"PATH": f"{place / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    environment = {**os.environ, **paths, "BROWSER": "true", "COLUMNS": "100"}
    return subprocess.run(
        ["bash", "-c", line], cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def prepare(line: str, folder: Path) -> str:
    """The line as it is run here: its output may be there, and a live session needs neither page nor real time."""
    for out in re.findall(r"-o (\S+)", line):
        if "--force" not in line and (folder / out).is_symlink():
            (folder / out).unlink()
        elif "--force" not in line and (folder / out).exists():
            subprocess.run(["rm", "-r", str(folder / out)], check=True)
        elif (folder / out).is_symlink():
            target = (folder / out).resolve()
            (folder / out).unlink()
            subprocess.run(["cp", "-r", str(target), str(folder / out)], check=True)
    speed = "10" if "--robot" in line else "max"  # a robot follows a multiple of the replay's own speed
    return f"{line} --speed {speed} --no-page" if "live --source replay" in line else line


def complete_session(folder: Path) -> None:
    """Put into the session that `wepose info --write` wrote what the pages ask the reader for."""
    file = folder / "session.toml"
    text = file.read_text(encoding="utf-8")
    text = re.sub(r"^start = .*$", f"start = {STAND_S}\nclasp = {CLASP}", text, flags=re.MULTILINE)
    text = re.sub(r"^# (mount = \{.*?\}).*$", r"\1", text, flags=re.MULTILINE)
    file.write_text(text.replace('forward = "?"', 'forward = "-z"'), encoding="utf-8")


def mask(line: str) -> str:
    """A line without its figures, axes and spaces, which differ by recording and version."""
    return "".join(re.sub(r"[-+]?\d+(\.\d+)?|[-+][xyz]\b", "0", line).split())


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN)
def test_commands_of_a_page_run(page: str, workplace: Path, tmp_path: Path) -> None:
    for file in workplace.iterdir():
        if file.name != "bin":
            (tmp_path / file.name).symlink_to(file)
    for command in commands(page):
        line = command.words
        if any(re.search(pattern, line) for pattern in ELSEWHERE):
            continue
        if "--robot panda" in line:
            pytest.importorskip("daqp")
        if GENERIC.name in line and not GENERIC.exists():
            continue
        if "info trial.csv --write" in line:
            (tmp_path / "session.toml").unlink()
        done = run(prepare(line, tmp_path), tmp_path, workplace)
        assert done.returncode in ((0, 3, 4) if "wepose calibrate" in line else (0,)), f"{line}\n{done.stdout}"
        printed = mask(done.stdout)
        assert [each for each in command.output if mask(each) not in printed] == [], f"{line}\n{done.stdout}"
        if "info trial.csv --write" in line:
            complete_session(tmp_path)
    for kind, body in blocks(page):
        if "import opensim" in body and not (GENERIC.exists() and find_spec("opensim")):
            continue
        if kind == "python" and page in PYTHON:
            prelude = "" if "import opensim" in body else PRELUDE  # whose casadi and ours cannot live in one process
            (tmp_path / "block.py").write_text(prelude + body, encoding="utf-8")
            done = run(f"{sys.executable} block.py", tmp_path, workplace)
            assert done.returncode == 0, done.stdout
            if "import opensim" in body:
                ours, theirs = (read_mot(tmp_path / f"{name}.mot") for name in ("circles", "circles_ik"))
                ours = ours.filter(pl.col("time").is_between(theirs["time"].min() - 1e-6, theirs["time"].max() + 1e-6))
                compared = [name for name in ours.columns if name in theirs.columns]
                assert {"time", "arm_flex_l", "pro_sup_r"} <= set(compared)
                assert np.abs((ours.select(compared) - theirs.select(compared)).to_numpy()).max() < 0.2


def read_mot(file: Path) -> pl.DataFrame:
    names, *rows = map(str.split, file.read_text(encoding="utf-8").partition("endheader\n")[2].strip().splitlines())
    return pl.DataFrame(np.array(rows, dtype=float), schema=names)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FILES)
def test_files_begin_as_the_pages_show(suffix: str, workplace: Path, tmp_path: Path) -> None:
    texts = [body for page in ("docs/opensim.md", "docs/export.md") for kind, body in blocks(page) if kind == "text"]
    [shown] = [body for body in texts if FILES[suffix] in body]
    wp.export(workplace / "result", tmp_path / f"circles.{suffix}")
    written = mask((tmp_path / f"circles.{suffix}").read_text(encoding="utf-8"))
    parts = [mask(part) for line in shown.splitlines() for part in line.split("…")]
    assert [part for part in parts if part not in written] == []


@pytest.mark.slow
def test_the_live_session_of_python_runs(workplace: Path, tmp_path: Path) -> None:
    """docs/live.md, with a replay in place of the sensors."""
    (tmp_path / "made").symlink_to(workplace)
    (tmp_path / "anna").symlink_to(workplace / "anna")
    [body] = [body for kind, body in blocks("docs/live.md") if kind == "python"]
    replay = body.replace('open_source("udp:9000")', 'open_source("replay:made", speed="max")')
    assert replay != body
    (tmp_path / "block.py").write_text(replay, encoding="utf-8")
    done = run(f"{sys.executable} -W error block.py", tmp_path, workplace)
    assert done.returncode == 0, done.stdout
    assert "'right_palm': array" in done.stdout
    assert (tmp_path / "morning.mcap").is_file()


def lower_bounds(lines: list[str], separator: str) -> dict[str, Version]:
    """Package → its lowest version."""
    pairs = (line.partition(separator) for line in lines)
    return {name.strip().lower(): Version(version) for name, _, version in pairs if version}


def test_oldest_versions_are_those_of_the_package() -> None:
    """`make oldest` tests them, and the conda recipe asks for the same."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    bounds = lower_bounds(project["dependencies"], ">=")
    assert bounds == lower_bounds((ROOT / "tests/oldest.txt").read_text(encoding="utf-8").splitlines(), "==")
    recipe = (ROOT / "conda/recipe.yaml").read_text(encoding="utf-8")
    run = re.findall(r"^ +- ([\w-]+ >=[\d.]+)$", recipe.partition("  run:")[2], re.MULTILINE)
    names = {"pinocchio": "pin", "meshcat-python": "meshcat", "matplotlib-base": "matplotlib"}
    conda = {names.get(name, name): bound for name, bound in lower_bounds(run, ">=").items() if name != "python"}
    assert conda == bounds
    assert f'version: "{project["version"]}"' in recipe
    assert f"- wepose = {project['scripts']['wepose']}\n" in recipe
