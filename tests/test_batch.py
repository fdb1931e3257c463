"""`wepose batch`: each item by itself, whole or not at all, once; the page over them; on S3."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest
from studies import PLAN, QUICK, files, item, sessions_and_plan, three_sessions  # noqa: F401

from wepose_pin.batch import Item, items, read_plan, run_batch
from wepose_pin.batch.comparison import find_differences
from wepose_pin.batch.items import run_items
from wepose_pin.batch.page import build_study_page, find_outliers
from wepose_pin.batch.plan import step_options
from wepose_pin.batch.storage import DONE_FILE, create_folder, lock_folder
from wepose_pin.batch.study import STUDY, _claim_folder, build_table
from wepose_pin.errors import BadData, ExistingOutput
from wepose_pin.jobs.batch import BatchJob


@pytest.fixture(autouse=True)
def _one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """As workers have it, who set it for themselves."""
    monkeypatch.setenv("WEPOSE_THREADS", "1")


# One item ------------------------------------------------------------------------------------------------------------


def test_an_item_is_made_once_and_kept(study: Path) -> None:
    (row,) = run_items([item(study)], str(study / "items"))
    assert (row["status"], row["reused"]) == ("done", False)
    assert row["right_palm_error_mm"] < 100.0
    before = files(study / "items")
    (again,) = run_items([item(study)], str(study / "items"))
    assert again["reused"] is True
    assert {key: again[key] for key in row if key != "reused"} == {key: row[key] for key in row if key != "reused"}
    assert files(study / "items") == before


def test_a_file_that_was_only_touched_is_the_same(study: Path) -> None:
    run_items([item(study)], str(study / "items"))
    os.utime(study / "data" / "one" / "recording.parquet")
    assert run_items([item(study)], str(study / "items"))[0]["reused"] is True


@pytest.mark.parametrize(
    "change", ["recording", pytest.param("truth", marks=pytest.mark.slow), "options", "code", "subject"]
)
def test_what_has_changed_is_made_again_by_force_only(
    study: Path, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, changed = str(study / "items"), item(study)
    run_items([changed], place)
    before = files(study / "items")
    if change in ("recording", "truth"):
        file = study / "data" / "one" / f"{change}.parquet"
        table = pl.read_parquet(file)
        table.head(table.height - 5).write_parquet(file)
        reason = "another session"
    elif change == "options":
        changed = item(study, steps=QUICK | {"evaluate": {"interval": (6.0, 10.0)}})
        reason = "other options"
    elif change == "subject":
        shutil.copy(study / "items" / "one" / "track" / "subject.toml", study)
        changed = item(study, subject_file=str(study / "subject.toml"))
        reason = "other inputs"
    else:
        now = items.code() | {"code": "0" * 64, "version": "0.2.0"}
        monkeypatch.setattr(items, "code", lambda: now)
        reason = "other code, version 0.1.0"
    (row,) = run_items([changed], place)
    assert (row["status"], row["error"]) == ("changed", "ExistingOutput")
    assert reason in row["message"]
    assert "--force" in row["message"]
    assert row["samples"] > 0, "its figures stay in the table, as its folder does"
    assert files(study / "items") == before
    (row,) = run_items([changed], place, force=True)
    assert (row["status"], row["reused"]) == ("done", False)


def test_what_changes_while_an_item_is_made_is_seen_the_next_time(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_steps = items.run_steps

    def meanwhile(folder: Path, one: Item) -> object:
        result = run_steps(folder, one)
        with (study / "data" / "one" / "session.toml").open("a") as file:
            file.write("# changed\n")
        return result

    monkeypatch.setattr(items, "run_steps", meanwhile)
    assert run_items([item(study)], str(study / "items"))[0]["status"] == "done"
    (row,) = run_items([item(study)], str(study / "items"))
    assert (row["status"], "another session" in row["message"]) == ("changed", True)


def test_of_a_plan_that_changes_only_what_it_concerns_is_made_again(study: Path) -> None:
    steps = {name: item(study, name) for name in ("one", "two", "three")}
    run_items(list(steps.values()), str(study / "items"))
    before = files(study / "items")
    with (study / "data" / "two" / "session.toml").open("a") as file:
        file.write("# changed\n")
    rows = run_items(list(steps.values()), str(study / "items"), force=True)
    assert [row["reused"] for row in rows] == [True, False, True]
    after = files(study / "items")
    assert {path for path in before if after[path] != before[path]} == {
        path for path in before if "/items/two/" in path
    }


def test_a_task_ends_when_its_time_is_up_and_gives_what_it_has(study: Path) -> None:
    some = [item(study, name) for name in ("one", "two", "three")]
    assert [row["item"] for row in run_items(some, str(study / "items"), until=0.0)] == ["one"]


def test_one_that_fails_is_named_and_the_others_go_on(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (study / "data" / "one" / "session.toml").write_text("[data]\nfile = 3\n")
    (study / "data" / "two" / "truth.parquet").unlink()
    rows = run_items([item(study, name) for name in ("one", "two", "three", "four")], str(study / "items"))
    assert [row["status"] for row in rows] == ["failed", "failed", "done", "failed"]
    assert [row.get("error") for row in rows] == ["BadSession", "MissingFile", None, "MissingFile"]
    assert all(str(study) in row["message"] and "\n" not in row["message"] for row in rows if row["status"] != "done")
    assert sorted(path.name for path in (study / "items").iterdir()) == ["three"]

    def wrong(*_: object, **__: object) -> None:
        raise ZeroDivisionError("of ours\nand more")

    monkeypatch.setattr("wepose_pin.batch.steps.run_track", wrong)
    (row,) = run_items([item(study, session=str(study / "data" / "three"))], str(study / "items"))
    assert row["error"] == "ZeroDivisionError"
    assert row["message"].startswith("of ours and more (test_batch.py:")


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    with contextlib.suppress(ZeroDivisionError), create_folder(str(tmp_path / "items" / "a")) as folder:
        (folder / "half").write_text("")
        raise ZeroDivisionError
    assert list((tmp_path / "items").iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(ExistingOutput, match="cannot be written"), create_folder(str(tmp_path / "file" / "a")):
        pass


def test_a_done_file_cut_off_is_no_done_file(study: Path) -> None:
    run_items([item(study)], str(study / "items"))
    done = study / "items" / "one" / DONE_FILE
    done.write_text(done.read_text()[:100])
    assert run_items([item(study)], str(study / "items"))[0]["reused"] is False
    assert json.loads(done.read_text())["row"]["samples"] > 0


def test_steps_give_what_the_commands_give(study: Path) -> None:
    """The same bits, where the same BLAS threads are used: here one process."""
    from wepose_pin.cli import main

    steps = {
        "calibrate": step_options("calibrate"),
        **QUICK,
        "export": {"formats": ("trc",), "names": None, "rate_hz": None},
    }
    session = study / "data" / "one"
    (row,) = run_items([item(study, steps=steps)], str(study / "items"))
    for words in (
        ["calibrate", session, "-o", study / "s"],
        ["track", session, "--subject", study / "s", "-o", study / "r", "--no-report"],
        ["export", study / "r", "-o", study / "motion.trc"],
    ):
        with pytest.raises(SystemExit):
            main([str(word) for word in words])
    place = study / "items" / "one"
    assert pl.read_parquet(place / "track" / "pose.parquet").equals(pl.read_parquet(study / "r" / "pose.parquet"))
    for made_so, made_there in (("s", "calibrate"), ("r", "track")):
        for name in ("subject.toml", "subject.urdf"):
            assert (study / made_so / name).read_bytes() == (place / made_there / name).read_bytes()
    assert (study / "motion.trc").read_bytes() == (place / "export" / "motion.trc").read_bytes()
    assert row["quality"] in ("pass", "poor", "fail")
    assert row["page"] == "calibrate/report.html"


def test_a_pipe_in_place_of_a_session_holds_nobody_up(study: Path) -> None:
    (study / "data" / "one" / "session.toml").unlink()
    os.mkfifo(study / "data" / "one" / "session.toml")
    (row,) = run_items([item(study, session=str(study / "data" / "one" / "session.toml"))], str(study / "items"))
    assert (row["status"], row["error"]) == ("failed", "MissingFile")


def test_where_a_study_may_not_go(study: Path) -> None:
    with pytest.raises(ExistingOutput, match="no study of wepose batch"):
        run_batch(BatchJob(study / "plan.toml", str(study / "data")))
    with pytest.raises(ExistingOutput, match="is there and no study"):
        run_batch(BatchJob(study / "plan.toml", str(study / "plan.toml")))
    _claim_folder(str(study / "killed"), study / "plan.toml")
    (study / "killed" / STUDY).rename(study / "killed" / f".{STUDY}.partial")  # by a kill at its very beginning
    _claim_folder(str(study / "killed"), study / "plan.toml")
    assert (study / "killed" / STUDY).is_file()
    with (
        lock_folder(str(study)),
        pytest.raises(ExistingOutput, match="another wepose batch writes there"),
        lock_folder(str(study)),
    ):
        pass


def test_a_worker_with_another_version_is_refused(study: Path) -> None:
    with pytest.raises(BadData, match="another wepose-pin"):
        run_items([item(study)], str(study / "items"), same_code="0" * 64)


# The page ------------------------------------------------------------------------------------------------------------


def test_figures_that_stand_apart() -> None:
    rows = [{"item": f"i{k}", "status": "done", "gap_mm": 10.0 + 0.1 * (k % 7), "same": 1.0} for k in range(40)]
    rows[7]["gap_mm"], rows[9]["gap_mm"] = 30.0, float("nan")
    outliers = find_outliers(build_table(rows), ["gap_mm", "same"])
    assert [(each.item, each.column) for each in outliers] == [("i7", "gap_mm")]
    assert outliers[0].deviations == pytest.approx((30.0 - outliers[0].median) / (1.4826 * 0.2), rel=0.3)


def test_the_page_escapes_what_comes_from_files(study: Path) -> None:
    plan = read_plan(study / "plan.toml", "items")
    row = {"item": "a", "status": "failed", "error": "BadData", "message": "<script>x</script> [y](javascript:z)"}
    page = build_study_page(
        plan, build_table([row, {"item": "b", "status": "done", "page": "track/report.html", "seconds": 1.0}])
    )
    assert "<script>" not in page
    assert 'href="javascript' not in page
    assert '<a href="items/b/track/report.html">b</a>' in page


# S3 ------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bucket(recorded: Path) -> Iterator[str]:
    """s3://lab on a server of this machine, with the sessions in data/."""
    moto = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    server = moto.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        for name, value in {"ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b", "DEFAULT_REGION": "us-east-1"}.items():
            patch.setenv(f"AWS_{name}", value)
        s3fs.S3FileSystem.clear_instance_cache()
        system = s3fs.S3FileSystem()
        system.mkdir("lab")
        system.put(str(recorded), "lab/data", recursive=True)
        yield "s3://lab"
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


@pytest.mark.cluster
def test_a_study_on_s3(bucket: str, tmp_path: Path, recorded: Path) -> None:
    (tmp_path / "plan.toml").write_text(PLAN.replace("data/*", f"{bucket}/data/*"))
    done = run_batch(BatchJob(tmp_path / "plan.toml", f"{bucket}/out", workers=2))
    assert done.table["item"].to_list() == ["data-one", "data-three", "data-two"]
    assert done.table["status"].to_list() == ["done"] * 3, done.table["message"].to_list()
    import s3fs

    system = s3fs.S3FileSystem()
    assert {path.rpartition("/")[2] for path in system.ls("lab/out")} == {
        *("items", "study.json", "results.parquet", "report.html")
    }
    with system.open("lab/out/results.parquet") as file:
        assert pl.read_parquet(file.read()).equals(done.table)
    here = Item("one", str(recorded / "one"), QUICK)
    run_items([here], str(tmp_path / "items"))
    system.get_file("lab/out/items/data-one/track/pose.parquet", str(tmp_path / "pose.parquet"))
    local = pl.read_parquet(tmp_path / "items" / "one" / "track" / "pose.parquet")
    assert pl.read_parquet(tmp_path / "pose.parquet").equals(local)
    assert run_batch(BatchJob(tmp_path / "plan.toml", f"{bucket}/out", workers=1)).reused == 3
    # Without its done.json an item is not whole, and a changed recording is another one.
    system.rm_file("lab/out/items/data-one/done.json")
    system.pipe_file("lab/data/two/recording.parquet", b"nothing")
    table = run_batch(BatchJob(tmp_path / "plan.toml", f"{bucket}/out", workers=1)).table
    assert table["status"].to_list() == ["done", "done", "changed"]
    assert "another session" in table["message"][2]


@pytest.mark.cluster
def test_a_study_on_s3_is_that_of_a_local_folder(bucket: str, study: Path) -> None:
    import s3fs

    system = s3fs.S3FileSystem(use_listings_cache=False)
    system.mkdir("other")
    system.put(str(study / "data"), "other/data", recursive=True)
    (study / "there.toml").write_text(PLAN.replace("data/*", f"{bucket.replace('lab', 'other')}/data/*"))
    here = run_batch(BatchJob(study / "plan.toml", str(study / "out"), workers=1)).table
    there = run_batch(BatchJob(study / "there.toml", f"{bucket}/same", workers=1)).table
    differ = {name for name in here.columns if not here[name].equals(there[name])}
    assert differ <= {"session", "seconds", "memory_mb", "track_s", "evaluate_s"}
    system.get("lab/same/items", str(study / "fetched"), recursive=True)
    assert find_differences(study / "out" / "items", study / "fetched") == []


@pytest.mark.cluster
def test_a_long_lived_worker_sees_what_changes_on_s3(bucket: str) -> None:
    import s3fs

    system = s3fs.S3FileSystem(use_listings_cache=False)
    system.copy("lab/data/one", "lab/changing/one", recursive=True)
    one = Item("one", f"{bucket}/changing/one/session.toml", QUICK)
    place = f"{bucket}/changing-out/items"
    assert [row["reused"] for _ in range(2) for row in run_items([one], place)] == [False, True]
    system.pipe_file("lab/changing/one/session.toml", system.cat_file("lab/changing/one/session.toml") + b"# changed\n")
    (row,) = run_items([one], place)
    assert (row["status"], "another session" in row["message"]) == ("changed", True)


@pytest.mark.cluster
def test_what_is_not_there_on_s3_is_named(bucket: str, tmp_path: Path) -> None:
    lost = Item("lost", f"{bucket}/nobody/session.toml", QUICK)
    (row,) = run_items([lost], str(tmp_path / "items"))
    assert (row["error"], row["message"]) == ("MissingFile", f"{bucket}/nobody/session.toml: no such file")
    (tmp_path / "session.toml").write_text('[data]\nfile = "../secret.csv"\n')
    import s3fs

    s3fs.S3FileSystem().put_file(str(tmp_path / "session.toml"), "lab/out/session.toml")
    (row,) = run_items([Item("out", f"{bucket}/out", QUICK)], str(tmp_path / "items"))
    assert (row["error"], "outside its own folder" in row["message"]) == ("BadData", True)
