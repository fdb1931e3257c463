"""`wepose batch`: each item by itself, whole or not at all, once; on processes here, on a scheduler, below a URL."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import polars as pl
import pytest
from commands import run as command

from wepose_pin import BadOption, ExistingOutput, WeposeError, simulate, simulate_person
from wepose_pin.batch.study import run_batch
from wepose_pin.writers import write_session

WEPOSE = [sys.executable, "-m", "wepose_pin"]
NAMES = ["data-one", "data-three", "data-two"]
PLAN = """
[sessions]
files = ["data/*/session.toml"]
[steps.track]
view = false
report = false
[steps.evaluate]
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short sessions, one/ to three/."""
    folder = tmp_path_factory.mktemp("recorded")
    for seed, name in enumerate(("one", "two", "three"), 1):
        made_up = simulate(simulate_person(seed).lengths, seed=seed, clasp_s=8.0, circles=0)
        (folder / name).mkdir()
        write_session(folder / name, made_up.recording(name), made_up.truth())
    return folder


@pytest.fixture
def study(recorded: Path, tmp_path: Path) -> Path:
    shutil.copytree(recorded, tmp_path / "data")
    (tmp_path / "plan.toml").write_text(PLAN)
    return tmp_path


def files(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def run(study: Path, *, force: bool = False, plan: str | None = None, out: str = "out") -> pl.DataFrame:
    if plan is not None:
        (study / "plan.toml").write_text(plan)
    return run_batch(study / "plan.toml", str(study / out), workers=1, force=force).table


def test_a_study_is_made_once_and_what_has_changed_by_force_only(study: Path) -> None:
    (study / "data" / "bad").mkdir()
    (study / "data" / "bad" / "session.toml").write_text("[data]\nfile = 3\n")
    (study / "data" / "two" / "truth.parquet").unlink()
    calls: list[tuple[object, ...]] = []
    environment = dict(os.environ)

    def progress(*now: object) -> None:
        calls.append(now)
        with pytest.raises(ExistingOutput, match="out: another wepose batch runs there; wait until it ends"):
            run(study)

    outcome = run_batch(study / "plan.toml", str(study / "out"), workers=2, progress=progress)
    assert dict(os.environ) == environment
    table = outcome.table
    assert table.equals(pl.read_parquet(study / "out" / "results.parquet"))
    assert table["item"].to_list() == ["data-bad", *NAMES]
    assert table["status"].to_list() == ["failed", "done", "done", "failed"]
    assert table["error"].to_list() == ["BadSession", None, None, "MissingFile"]
    assert all(str(study) in text and "\n" not in text for text in table["message"].drop_nulls())
    assert table["right_palm_error_mm"].drop_nulls().max() < 100.0  # type: ignore[operator]
    assert (calls[0], calls[-1]) == (("starting workers", 0.0), ("4 of 4 items, 2 failed", 1.0))
    assert sorted(path.name for path in (study / "out" / "items").iterdir()) == ["data-one", "data-three"]
    one, three = (study / "out" / "items" / f"data-{name}" for name in ("one", "three"))
    before = files(three)
    (study / "data" / "bad" / "session.toml").unlink()
    shutil.rmtree(study / "data" / "two")
    (one / "done.json").write_text('{"key": ')
    file = study / "data" / "three" / "recording.parquet"
    os.utime(file)  # only touched
    again = run_batch(study / "plan.toml", str(study / "out"), workers=1)
    assert (again.reused, files(three)) == (1, before)
    assert json.loads((one / "done.json").read_text())["key"]
    recorded = pl.read_parquet(file)
    recorded.head(recorded.height - 5).write_parquet(file)
    plan = PLAN + "interval = [6.0, 10.0]\n"
    table = run(study, plan=plan)
    assert table["status"].to_list() == ["changed", "changed"]
    assert set(table["error"]) == {"ExistingOutput"}
    assert "has other options; --force" in table["message"][0]
    assert "has other options, input session; --force" in table["message"][1]
    assert table["samples"][0] > 0, "its figures stay in the table, as its folder does"
    file.write_bytes(b"")
    assert run(study, force=True, plan=plan)["status"].to_list() == ["done", "failed"]
    assert files(three) == before
    assert '"interval": [' in (one / "done.json").read_text()


@pytest.mark.slow
def test_steps_give_what_the_commands_give(study: Path) -> None:
    """The same bits. The subject is calibrated once, for all sessions; where that fails, they fail too."""
    subject = '[subjects.x]\ncalibration = "data/one"\n[steps.calibrate]\nreport = false\n'
    plan = (
        f'[sessions]\nfiles = "data/*"\nsubject = "x"\n{subject}'
        '[steps.track]\nreport = false\nview = false\n[steps.export]\nformats = ["trc"]\n'
    )
    table = run(study, plan=plan)
    assert table["item"].to_list() == ["subject-x", *NAMES]
    assert table["status"].to_list() == ["done"] * 4, table["message"].to_list()
    session = study / "data" / "one"
    assert command("calibrate", session, "-o", study / "s", "--no-report") in (0, 3, 4)
    assert command("track", session, "--subject", study / "s", "-o", study / "r", "--no-report", "--no-view") == 0
    assert command("export", study / "r", "-o", study / "motion.trc") == 0
    items = study / "out" / "items"
    pose = pl.read_parquet(items / "data-one" / "track" / "pose.parquet")
    assert pose.equals(pl.read_parquet(study / "r" / "pose.parquet"))
    assert (study / "s" / "subject.toml").read_bytes() == (items / "subject-x/calibrate/subject.toml").read_bytes()
    assert (study / "motion.trc").read_bytes() == (items / "data-one" / "export" / "motion.trc").read_bytes()
    (session / "session.toml").write_text("")
    shutil.rmtree(items / "subject-x")
    assert set(run(study, plan=plan)["status"]) == {"failed"}


def test_where_a_study_may_not_go(study: Path) -> None:
    with pytest.raises(ExistingOutput, match="is there and no study of wepose batch"):
        run(study, out="data")
    (study / "file").write_text("")
    with pytest.raises(ExistingOutput, match="is there and no study"):
        run(study, out="file")


def test_an_item_that_kills_its_process_is_named_and_the_others_go_on(
    study: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A module of the user's place that ends the process where the first of the sessions is read."""
    shutil.rmtree(study / "data" / "two")
    (study / "hook").mkdir()
    (study / "hook" / "sitecustomize.py").write_text(
        "import os, sys\n"
        "def end(event, arguments):\n"
        "    if event == 'open' and str(arguments[0]).endswith('one/session.toml') and 'spawn' in str(sys.orig_argv):\n"
        "        os._exit(9)\n"
        "sys.addaudithook(end)\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{study / 'hook'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    assert command("batch", study / "plan.toml", "-o", study / "out", "--workers", 1) == 3
    assert capfd.readouterr().err == ""
    table = pl.read_parquet(study / "out" / "results.parquet")
    assert table["status"].to_list() == ["failed", "done"]
    assert table["error"].to_list() == ["LostWorker", None]


@pytest.mark.kill
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_run_that_was_stopped_goes_on_where_it_stopped(study: Path, number: signal.Signals) -> None:
    words = [*WEPOSE, "batch", study / "plan.toml", "-o", study / "out", "--workers", "1"]
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    until = time.monotonic() + 120.0
    while not list((study / "out" / "items").glob("[!.]*/done.json")) and time.monotonic() < until:
        time.sleep(0.01)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
        out, err = process.communicate(timeout=30.0)
        assert (process.returncode, out) == (130, "")
        assert err == "wepose: stopped; what is done stays, and the same command goes on from there\n"
    else:
        process.kill()
        process.communicate(timeout=30.0)
    left, until = True, time.monotonic() + 10.0
    while left and time.monotonic() < until:  # soon nobody is left of its group
        time.sleep(0.1)
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            left = False
    assert not left
    before = {path: time for path, time in files(study / "out" / "items").items() if "/." not in path}
    done = sum(path.endswith("done.json") for path in before)
    again = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (again.returncode, again.stderr) == (0, "")
    assert f"3 of 3 items done, {done} of them before" in again.stdout
    after = files(study / "out" / "items")
    assert {path: after[path] for path in before} == before
    assert [path.name for path in (study / "out" / "items").glob(".*")] == []


# A scheduler, a URL ---------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def scheduler(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A Dask scheduler with a worker, in processes of their own."""
    pytest.importorskip("distributed")
    here = ["--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
    file = folder / "scheduler.json"
    first = [sys.executable, "-m", "distributed.cli.dask_scheduler", *here, "--port", "0", "--scheduler-file", file]
    second = [sys.executable, "-m", "distributed.cli.dask_worker", *here, "--scheduler-file", file, "--nthreads", "1"]
    with (folder / "log").open("wb") as log:
        started = [subprocess.Popen(words, stdout=log, stderr=log, start_new_session=True) for words in (first, second)]
    try:
        until = time.monotonic() + 60.0
        while not file.exists() and time.monotonic() < until:
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"], started[0]
    finally:
        for process in started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.cluster
def test_the_workers_of_a_scheduler_give_the_same(study: Path) -> None:
    here = run(study).drop("seconds")
    with scheduler(study) as (address, process):
        run_there = partial(run_batch, study / "plan.toml", str(study / "there"), scheduler=address)
        assert run_there().table.drop("seconds").equals(here)
        assert run_there().reused == 3
        os.killpg(process.pid, signal.SIGKILL)
        with pytest.raises(WeposeError, match="scheduler"):
            run_there()


def test_no_scheduler_at_an_address(study: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(BadOption, match="--scheduler nonsense: no scheduler there, as in tcp://HOST:8786"):
        run_batch(study / "plan.toml", str(study / "out"), scheduler="nonsense")


def test_a_study_below_a_url(study: Path) -> None:
    """fsspec's own scheme for local files stands for a store."""
    pytest.importorskip("fsspec")
    shutil.rmtree(study / "data" / "two")
    here = run(study).drop("seconds", "session")
    (study / "plan.toml").write_text(PLAN.replace("data/*", f"file://{study}/data/*"))
    run_there = partial(run_batch, study / "plan.toml", f"file://{study}/there", workers=1)
    there = run_there().table
    assert there["status"].to_list() == ["done", "done"], there["message"].to_list()
    ours = pl.read_parquet(study / "out" / "items" / "data-one" / "track" / "pose.parquet")
    (theirs,) = (study / "there" / "items").glob("*data-one/track/pose.parquet")
    assert pl.read_parquet(theirs).equals(ours)
    assert there.drop("seconds", "session", "item").equals(here.drop("item"))
    next((study / "there" / "items").glob("*data-one/done.json")).unlink()  # without it an item is not whole
    assert run_there().reused == 1
