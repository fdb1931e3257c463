"""`wepose batch` on workers: those that die, runs that are killed or stopped, clusters of one's own, who listens."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import polars as pl
import pytest
from studies import PLAN, files, item, sessions_and_plan, three_sessions  # noqa: F401

from benchmarks.batch import separate_cluster
from wepose_pin.batch import cluster, run_batch
from wepose_pin.batch.cluster import connect, run_on_cluster
from wepose_pin.batch.comparison import find_differences
from wepose_pin.batch.isolation import run_isolated
from wepose_pin.batch.storage import DONE_FILE
from wepose_pin.errors import BadData, BadOption, LostWorker
from wepose_pin.jobs.batch import BatchJob

pytestmark = pytest.mark.cluster
WEPOSE = [sys.executable, "-m", "wepose_pin.cli"]
APART = ("seconds", "memory_mb", "track_s", "evaluate_s")  # columns that are not the same twice


def test_a_study_on_this_machine(study: Path) -> None:
    (study / "data" / "bad").mkdir()
    (study / "data" / "bad" / "session.toml").write_text("")
    text = PLAN.replace("report = false", "report = true")
    (study / "plan.toml").write_text(
        f'{text}[subjects.x]\ncalibration = "data/three"\n[steps.calibrate]\n'.replace(
            '["data/*/session.toml"]', '["data/*/session.toml"]\nsubject = "x"'
        )
    )
    calls = []
    job = BatchJob(study / "plan.toml", str(study / "out"), workers=2)
    done = run_batch(job, lambda *counts: calls.append(counts))
    assert calls[0] == (0, 0, 5)
    assert calls[-1] == (5, 1, 5)
    table = pl.read_parquet(study / "out" / "results.parquet")
    assert table.equals(done.table)
    assert table["item"].to_list() == ["subject-x", "data-bad", "data-one", "data-three", "data-two"]
    assert table["status"].to_list() == ["done", "failed", "done", "done", "done"]
    assert (table["error"][1], table["subject"].to_list()) == ("BadSession", ["x"] * 5)
    page = (study / "out" / "report.html").read_text()
    for word in ("4 of 5 items are done", "BadSession", '<a href="items/data-one/track/report.html">data-one</a>'):
        assert word in page
    assert (study / "out" / "items" / "data-one" / "track" / "report.html").is_file()
    before = files(study / "out" / "items")
    assert run_batch(BatchJob(study / "plan.toml", str(study / "out"), workers=1)).reused == 4
    assert files(study / "out" / "items") == before

    (study / "data" / "three" / "session.toml").write_text("")
    shutil.rmtree(study / "out" / "items" / "subject-x")
    table = run_batch(BatchJob(study / "plan.toml", str(study / "out"), workers=1)).table
    assert table["status"].to_list() == ["failed"] * 5
    assert "its subject 'x' has no calibration, see item subject-x" in table["message"][2]


def test_workers_listen_on_this_machine_only() -> None:
    if not Path("/proc/net/tcp").exists():
        pytest.skip("no /proc/net/tcp to look at")

    def listening() -> dict[str, str]:
        lines = [
            line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()
        ]
        return {line[9]: line[1].split(":")[0] for line in lines if line[3] == "0A"}  # inode → address

    def mine(pids: list[int]) -> set[str]:
        inodes = set()
        for link in [link for pid in pids for link in Path(f"/proc/{pid}/fd").iterdir()]:
            with contextlib.suppress(FileNotFoundError):  # closed meanwhile
                inodes.add(os.readlink(link).removeprefix("socket:[").removesuffix("]"))
        return inodes

    with connect(workers=1) as client:
        assert client.scheduler.address.startswith("tls://127.0.0.1:")
        pids = [os.getpid(), *client.run(os.getpid).values()]
        address_of = listening()
        addresses = [address_of[inode] for inode in mine(pids) if inode in address_of]
    assert len(addresses) >= 2
    assert set(addresses) == {"0100007F"}


def killing(client: Any) -> Thread:
    """Stop the one worker, and kill it when it has been given something to do."""
    (pid,) = client.run(os.getpid).values()
    os.kill(pid, signal.SIGSTOP)

    def kill() -> None:
        until = time.monotonic() + 60.0
        while not any(client.processing().values()) and time.monotonic() < until:
            time.sleep(0.05)
        os.kill(pid, signal.SIGKILL)

    killer = Thread(target=kill)
    killer.start()
    return killer


def test_an_item_runs_again_when_its_worker_dies(study: Path) -> None:
    with connect(workers=1) as client:
        (before,) = client.run(os.getpid).values()
        killer = killing(client)
        rows = [
            row
            for some in run_on_cluster(client, [item(study), item(study, "two")], str(study / "items"))
            for row in some
        ]
        killer.join()
        (after,) = client.run(os.getpid).values()
    assert sorted((row["item"], row["status"], row["reused"]) for row in rows) == [
        ("one", "done", False),
        ("two", "done", False),
    ]
    assert after != before
    assert sorted(path.name for path in (study / "items").iterdir()) == ["one", "two"]


def test_who_lay_beside_a_worker_that_died_is_not_to_blame(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Dask gives up both tasks of the worker, each of two items; all four are made, in processes of their own."""
    monkeypatch.setitem(cluster.SETTINGS, "distributed.scheduler.allowed-failures", 0)
    some = [item(study, name) for name in ("one", "two", "three")]
    with connect(workers=1) as client:
        killer = killing(client)
        results = [row for rows in run_on_cluster(client, some, str(study / "items")) for row in rows]
        killer.join()
    assert sorted((row["item"], row["status"]) for row in results) == [(n, "done") for n in ("one", "three", "two")]


def test_an_item_that_is_too_much_for_a_worker_is_given_up_by_name(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = study / "data" / "two" / "recording.parquet"
    table, rows = pl.read_parquet(file), 3_000_000
    columns = {name: np.resize(table[name].to_numpy(), rows) for name in table.columns}
    pl.DataFrame(columns | {"time": 0.01 * np.arange(rows)}).write_parquet(file, compression="snappy")
    import distributed  # takes a second, which runs of the first tier need not wait for

    monkeypatch.setattr(distributed, "LocalCluster", partial(distributed.LocalCluster, memory_limit="600MB"))
    told = run_batch(BatchJob(study / "plan.toml", str(study / "out"), workers=1)).table
    assert told["item"].to_list() == ["data-one", "data-three", "data-two"]
    assert told["status"].to_list() == ["done", "done", "failed"], told["message"].to_list()
    assert told["error"][2] == "LostWorker"
    assert "too much for a worker's memory" in told["message"][2]
    assert told["memory_mb"].max() < 600.0  # type: ignore[operator]
    assert sorted(path.name for path in (study / "out" / "items").iterdir()) == ["data-one", "data-three"]


def test_an_item_in_a_process_of_its_own(study: Path) -> None:
    row = run_isolated(item(study), str(study / "items"))
    assert (row["status"], (study / "items" / "one" / DONE_FILE).is_file()) == ("done", True)
    assert run_isolated(item(study, "nobody"), str(study / "items"))["error"] == "MissingFile"
    with pytest.raises(BadData, match="another wepose-pin"):
        run_isolated(item(study), str(study / "items"), same_code="0" * 64)


def test_without_any_worker_the_run_ends(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "WAIT_S", 1.0)
    monkeypatch.setattr(cluster, "POLL_S", 0.2)
    with connect(workers=1) as client:
        client.cluster.scale(0)
        with pytest.raises(LostWorker, match="has had no worker for 1 s; start one"):
            list(run_on_cluster(client, [item(study)], str(study / "items")))


@pytest.mark.kill
def test_a_run_that_was_killed_goes_on_where_it_stopped(study: Path) -> None:
    command = [sys.executable, "-m", "wepose_pin.cli", "batch", str(study / "plan.toml"), "-o", str(study / "out")]
    command += ["--workers", "1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 120.0
    while not list((study / "out" / "items").glob(f"[!.]*/{DONE_FILE}")) and time.monotonic() < until:
        time.sleep(0.01)
    process.kill()
    process.wait()
    time.sleep(1.0)  # its worker notices
    before = {path: time for path, time in files(study / "out" / "items").items() if "/." not in path}
    done = sum(path.endswith(DONE_FILE) for path in before)
    assert 1 <= done < 3
    assert not (study / "out" / "results.parquet").exists()
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert f"3 of 3 items done, {done} of them before" in run.stdout
    after = files(study / "out" / "items")
    assert {path: after[path] for path in before} == before
    assert [path.name for path in (study / "out" / "items").glob(".*")] == []
    assert pl.read_parquet(study / "out" / "results.parquet")["item"].to_list() == [
        "data-one",
        "data-three",
        "data-two",
    ]


def test_no_scheduler_at_an_address() -> None:
    for address in ("tcp://127.0.0.1:9", "nonsense"):
        with pytest.raises(BadOption, match=f"--scheduler {address}: no scheduler there"), connect(address):
            pass


KILLS = int(os.environ.get("WEPOSE_KILLS", "0"))


@pytest.mark.kill
@pytest.mark.skipif(not KILLS, reason="WEPOSE_KILLS says how many; the test above kills once")
def test_killed_at_random_moments_nothing_is_lost_and_nothing_half_written(study: Path) -> None:
    """The whole process group each time, on and on until it comes to its end."""
    command = [*WEPOSE, "batch", study / "plan.toml", "--workers", "2", "-o"]
    begun = time.monotonic()
    subprocess.run([*command, study / "undisturbed"], check=True, capture_output=True)
    takes = time.monotonic() - begun
    right = pl.read_parquet(study / "undisturbed" / "results.parquet").drop(*APART)
    moment, out, killed, ended = random.Random(1), study / "out", 0, 0
    before: dict[str, int] = {}
    while killed < KILLS or not ended:
        process = subprocess.Popen(
            [*command, out], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        try:
            process.wait(moment.uniform(0.0, takes) if killed < KILLS else 300.0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            killed += 1
        after = files(out)
        assert before.items() <= after.items(), "what was done is neither lost nor made again"
        done = [place for place in (out / "items").glob("[!.]*") if (out / "items").exists()]
        for place in done:
            assert find_differences(study / "undisturbed" / "items" / place.name, place) == []
        before = {str(file): after[str(file)] for place in done for file in place.rglob("*") if file.is_file()}
        if process.returncode == 0:
            assert pl.read_parquet(out / "results.parquet").drop(*APART).equals(right)
            assert [path.name for path in (out / "items").glob(".*")] == []
            shutil.rmtree(out)
            before, ended = {}, ended + 1
    assert killed == KILLS


def test_stopped_by_ctrl_c_it_ends_at_once_and_goes_on_later(study: Path) -> None:
    command = [*WEPOSE, "batch", study / "plan.toml", "--workers", "1", "-o", study / "out"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    until = time.monotonic() + 120.0
    while not list((study / "out" / "items").glob(f"[!.]*/{DONE_FILE}")) and time.monotonic() < until:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30.0)
    assert (process.returncode, out) == (130, "")
    assert err == "wepose: stopped; what is done stays, and the same command goes on from there\n"
    left, until = True, time.monotonic() + 10.0
    while left and time.monotonic() < until:  # soon nobody is left of its group
        time.sleep(0.1)
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            left = False
    assert not left
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert "3 of 3 items done, " in run.stdout


def test_a_cluster_of_ones_own_one_of_whose_workers_is_killed(study: Path) -> None:
    alone = run_batch(BatchJob(study / "plan.toml", str(study / "alone"), workers=1)).table.drop(*APART)
    killed: list[int] = []

    def progress(done: int, _failed: int, _total: int) -> None:
        if done and not killed:
            kill()
            killed.append(done)

    with separate_cluster(study) as (address, kill):
        outcome = run_batch(BatchJob(study / "plan.toml", str(study / "out"), scheduler=address), progress)
        assert killed
        assert outcome.table.drop(*APART).equals(alone)
        assert outcome.table["item"].n_unique() == 3
        assert run_batch(BatchJob(study / "plan.toml", str(study / "out"), scheduler=address)).reused == 3


@pytest.mark.parametrize("when", ["before", "meanwhile"])
def test_a_scheduler_that_goes_ends_the_run_by_name(study: Path, when: str) -> None:
    with contextlib.ExitStack() as stack:
        address, _ = stack.enter_context(separate_cluster(study))
        with connect(address) as client:
            rows = run_on_cluster(client, [item(study, name) for name in ("one", "two", "three")], str(study / "items"))
            if when == "meanwhile":
                next(rows)
            stack.close()
            with pytest.raises(LostWorker, match="scheduler is gone"):
                list(rows)
