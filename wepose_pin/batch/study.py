"""A study: the items of a plan on local processes or on a Dask scheduler, and the table of outcomes.

The steps of an item run in a new folder, which appears whole or not at all; what is done stays.
"""

import contextlib
import fcntl
import io
import json
import os
import shutil
import signal
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import polars as pl

from ..commands.options import parse
from ..documents import whole_file
from ..errors import BadData, BadOption, ExistingOutput, LostWorker, WeposeError, reason
from ..writers.result import as_json, code, file_hashes, list_named_files
from .plan import STEPS, Item, is_remote, open_filesystem, read_plan, write_words

DONE_FILE = "done.json"  # written last: an item's folder without it is not complete
CONNECT_S = 10.0  # for which a scheduler is waited for
DONE, FAILED, CHANGED = "done", "failed", "changed"  # status of an item
# Columns of every row, before those of its steps.
_COMMON = dict.fromkeys(("item", "session", "subject", "status", "error", "message"), pl.String)
# Processes of items share the machine: one thread each. The last bits of BLAS depend on its number of threads, too.
_ONE_THREAD = "NUMBA_NUM_THREADS POLARS_MAX_THREADS OMP_NUM_THREADS OPENBLAS_NUM_THREADS MKL_NUM_THREADS"

Row = dict[str, Any]  # of the table: column → value
RunItem = Callable[[Item], Row]


def _fail(error: str, message: str) -> Row:
    return {"status": FAILED, "error": error, "message": " ".join(message.split())}


_LOST = _fail(LostWorker.__name__, "the process of this item, or of one beside it, died; it may lack memory")


class Study(NamedTuple):
    """What came of a plan."""

    table: pl.DataFrame  # a row an item, in the order of the plan
    reused: int  # items that were done before


def run_batch(
    plan_file: Path,
    out: str,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    force: bool = False,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
) -> Study:
    """Run all items of a plan and write ``results.parquet``, in a folder or below a URL; options as those of `batch`.

    A mistake in the plan or the place is a `WeposeError`; the errors of an item are in its row.
    """
    if workers is not None and scheduler is not None:
        raise BadOption(f"--workers {workers}: leave it out; the workers of --scheduler are running already")
    out = out.rstrip("/")
    place = f"{out}/items" if is_remote(out) else str(Path(out).absolute() / "items")
    plan = read_plan(plan_file, place)
    planned = [item for items in plan for item in items]
    rows: dict[str, Row] = {}
    if not workers:  # Linux: a container or taskset may have fewer than the machine
        workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with _create_study(out):
        progress("starting workers", 0.0)
        for items in plan:  # sessions need the calibrations
            run = partial(run_item, place=place, force=force)
            rows_done = _run_on_scheduler(run, items, scheduler) if scheduler else _run_here(run, items, workers)
            with contextlib.closing(rows_done) as done:
                for item, row in done:
                    rows[item.name] = {"item": item.name, "session": item.session, "subject": item.subject} | row
                    failed = sum(each["status"] != DONE for each in rows.values())
                    progress(f"{len(rows)} of {len(planned)} items, {failed} failed", len(rows) / len(planned))
        reused = sum(row.pop("reused", False) for row in rows.values())
        ordered = [dict.fromkeys(_COMMON) | rows[item.name] for item in planned]
        table = pl.DataFrame(ordered, schema_overrides=_COMMON, infer_schema_length=None)
        _write_table(f"{out}/results.parquet", table)
    return Study(table, reused)


# Where items run ------------------------------------------------------------------------------------------------------


def _run_here(run: RunItem, items: Sequence[Item], count: int) -> Generator[tuple[Item, Row]]:
    """Items and their rows, in the order in which they are done, from `count` processes of this machine.

    A process that dies takes those beside it along: their items fail, and the others go on in new processes.
    """
    todo, before = list(items), set(active_children())
    while todo:
        pool = ProcessPoolExecutor(min(count, len(todo)), get_context("spawn"), _prepare_process)
        try:
            with patch.dict(os.environ, dict.fromkeys(_ONE_THREAD.split(), "1")):  # the processes begin here
                futures = {pool.submit(run, item): item for item in todo}
            for future in as_completed(futures):
                if future.exception() is None:
                    todo.remove(futures[future])
                    yield futures[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(active_children()) - before:  # when stopped, an item may have minutes to go
                process.terminate()
        # Items begin in their order: the first of those left were running.
        lost, todo = todo[:count], todo[count:]
        yield from ((item, dict(_LOST)) for item in lost)


def _run_on_scheduler(run: RunItem, items: Sequence[Item], address: str) -> Generator[tuple[Item, Row]]:
    """The same by the workers of a running Dask scheduler; `LostWorker` where it goes meanwhile."""
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise BadOption(f"wepose batch --scheduler: {error}: pip install dask distributed") from None
    try:
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise BadOption(f"--scheduler {address}: no scheduler there, as in tcp://HOST:8786: {reason(error)}") from None
    with client, client.get_executor(pure=False) as executor:
        futures = {executor.submit(run, item): item for item in items}
        for future in as_completed(futures):
            try:
                row = future.result()
            except KilledWorker:  # after several workers died at it
                row = dict(_LOST)
            except CancelledError:
                again = "the scheduler is gone; the same command goes on where it stopped"
                raise LostWorker(f"{address}: {again}") from None
            yield futures[future], row


def _prepare_process() -> None:
    """Ctrl-C in the terminal is for the parent; a process whose parent was killed ends itself."""

    def exit_with_parent() -> None:
        if (parent := parent_process()) is not None:
            parent.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, daemon=True).start()


# One item -------------------------------------------------------------------------------------------------------------


def run_item(item: Item, place: str, force: bool) -> Row:
    """Run an item unless it is done, into a folder below `place`; its row of the table, errors included.

    `force`: run it again where its inputs, options or code have changed; otherwise it is `CHANGED`.
    """
    begin = time.perf_counter()
    try:
        row = _run_unless_done(item, f"{place}/{item.name}", force)
    except Exception as error:
        message = str(error)
        if not isinstance(error, WeposeError | OSError):  # a bug of ours: the table says where it is
            last = traceback.extract_tb(error.__traceback__)[-1]
            message += f" ({Path(last.filename).name}:{last.lineno})"
        row = _fail(type(error).__name__, message)
    return {"seconds": time.perf_counter() - begin} | row


def _run_unless_done(item: Item, target: str, force: bool) -> Row:
    begin = time.perf_counter()
    inputs = {"session": item.session, "subject_file": item.subject_file}
    for step, options in item.steps.items():
        for name in ("model", "prior", "protocol", "robot"):
            if Path(str(options.get(name, ""))).is_file():
                inputs[f"{step}.{name}"] = str(options[name])
    with tempfile.TemporaryDirectory(prefix="wepose-") as fetched:
        local: dict[str, Path] = {}
        key: dict[str, Any] = {"code": code()["code"], "options": [list(item.steps.items()), item.person]}
        for name, url in sorted(inputs.items()):
            if not url:
                continue
            with_truth = name == "session" and "evaluate" in item.steps  # the reference that it names
            local[name] = _fetch(url, Path(fetched), with_truth)
            key[f"input {name}"] = file_hashes(local[name], with_truth)
        key = json.loads(json.dumps(key))
        done: Any = None
        with contextlib.suppress(ValueError):  # a damaged file is none
            done = json.loads(_read_bytes(f"{target}/{DONE_FILE}") or b"null")
        changed = [name for name in key if done and done["key"].get(name) != key[name]]
        if done and not changed:
            return done["row"] | {"status": DONE, "reused": True}
        if changed and not force:
            message = f"{target}: has other {', '.join(changed)}; --force runs it again, -o names another folder"
            return done["row"] | {"status": CHANGED, "error": ExistingOutput.__name__, "message": message}
        with _create_folder(target) as folder:
            row = _run_steps(item, local["session"], local.get("subject_file"), folder)
            row["seconds"] = time.perf_counter() - begin
            text = json.dumps({"key": key, "row": row}, indent=1, ensure_ascii=False)
            (folder / DONE_FILE).write_text(text, encoding="utf-8")
    return row | {"status": DONE}


def _run_steps(item: Item, session: Path, subject: Path | None, folder: Path) -> Row:
    """Run the steps by the commands of their names, each into a folder of its name; column → value."""
    row: Row = {}
    places = {"session": str(session), "result": str(folder / "track"), "truth": str(session)}
    for step, options in item.steps.items():
        out, inputs = folder / step, [places[name] for name in STEPS[step]]
        if step == "calibrate":
            calibration = _run_command(step, inputs, {**options, **item.person, "out": out}).result
            row |= {"quality": calibration.quality.quality, "gap_mm": 1e3 * calibration.rms_gap}
            for name, value in calibration.subject.lengths.items():
                row |= {f"{name}_mm": 1e3 * value, f"{name}_std_mm": 1e3 * calibration.subject.std(name)}
            subject = out
        elif step == "track":
            summary = _run_command(step, inputs, {**options, "out": out} | ({"subject": subject} if subject else {}))
            row |= {name: summary[name] for name in ("samples", "rate_hz", "duration_s")}
            row["diagnostics"] = len(summary["diagnostics"])
        elif step == "retarget":
            checks = _run_command(step, inputs, {**options, "out": out}).result
            row["trajectory_within_limits"] = checks["within_limits"]
            row["trajectory_self_collisions"] = checks["self_collisions"]["samples"]
        elif step == "export":
            out.mkdir()
            row["export_diagnostics"] = sum(_export(each, inputs, options, out) for each in options["formats"])
        else:
            errors = _run_command(step, inputs, options)
            out.mkdir()
            text = json.dumps(as_json(asdict(errors)), indent=2)
            (out / "errors.json").write_text(text + "\n", encoding="utf-8")
            row |= {f"{point}_limb_error_mm": error.mean for point, error in errors.position_on_limb.items()}
            row |= {f"{point}_error_mm": error.mean for point, error in errors.position.items()}
            row |= {f"{segment}_error_deg": error.total_rmse for segment, error in errors.attitude.items()}
    return {name: None if isinstance(value, float) and not np.isfinite(value) else value for name, value in row.items()}


def _export(format: str, inputs: list[str], options: Mapping[str, Any], folder: Path) -> int:
    """Write a format, with those options that it has; the number of its diagnostics."""
    from ..writers.export import list_formats

    kind = list_formats()[format]
    file = folder / (f"motion.{format}" if kind.suffix is None else f"{format}{kind.suffix}")
    own = {name: value for name, value in options.items() if name in kind.options}
    return len(_run_command("export", inputs, own | {"out": file, "format": format}).diagnostics)


def _run_command(step: str, places: list[str], options: Mapping[str, Any]) -> Any:
    """What the command of a step returns; what it prints is dropped."""
    command, bound = parse(write_words(step, places, options))
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return command(*bound.args, **bound.kwargs)


# Places, paths or URLs ------------------------------------------------------------------------------------------------


def _read_bytes(url: str) -> bytes | None:
    """Contents of a file; None where there is none."""
    if not is_remote(url):
        return Path(url).read_bytes() if Path(url).is_file() else None
    with open_filesystem(url) as (system, path):
        return bytes(system.cat_file(path)) if system.exists(path) else None


def _write_table(url: str, table: pl.DataFrame) -> None:
    content = io.BytesIO()
    table.write_parquet(content)
    if is_remote(url):
        with open_filesystem(url) as (system, path):
            system.pipe_file(path, content.getvalue())
        return
    with whole_file(Path(url), force=True) as partial_file:
        partial_file.write_bytes(content.getvalue())


@contextlib.contextmanager
def _create_study(url: str) -> Iterator[None]:
    """Make the folder of a study; `ExistingOutput`: it holds something else, cannot be made, or another batch runs."""
    if is_remote(url):
        yield
        return
    place, items = Path(url), Path(url) / "items"
    if place.exists() and not items.is_dir() and not (place.is_dir() and not any(place.iterdir())):
        raise ExistingOutput(f"{url}: is there and no study of wepose batch; name another folder")
    try:
        items.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExistingOutput(f"{url}: cannot be written: {error.strerror}") from error
    with contextlib.ExitStack() as stack:
        lock = os.open(items, os.O_RDONLY)
        stack.callback(os.close, lock)  # which the system does, too, when this process dies
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            message = f"{url}: another wepose batch runs there; wait until it ends, or name another folder"
            raise ExistingOutput(message) from None
        except OSError:
            pass  # a file system without locks
        yield


def _fetch(url: str, into: Path, truth: bool = False) -> Path:
    """Local path of a session or another file; a remote one is copied `into` a folder, with the files that it names."""
    if not is_remote(url):
        return Path(url)
    with open_filesystem(url) as (system, path):
        if system.isdir(path):
            path = f"{path.rstrip('/')}/session.toml"
        top, into = path.rpartition("/")[0], Path(tempfile.mkdtemp(dir=into))
        local = into / path.rpartition("/")[2]
        system.get_file(path, str(local))
        for name in list_named_files(local, truth):
            if not (into / name).resolve().is_relative_to(into.resolve()):
                raise BadData(f"{url}: names '{name}', outside its own folder; only files below it are fetched")
            system.get(f"{top}/{name}", str(into / name), recursive=True)
    return local


@contextlib.contextmanager
def _create_folder(url: str) -> Iterator[Path]:
    """A folder to write into, which becomes `url`, in place of what is there, when the block succeeds.

    To a URL its files are copied, with `DONE_FILE` last.
    """
    if not is_remote(url):
        place, prefix = Path(url), f".{Path(url).name}.partial-"
        for left in place.parent.glob(f"{prefix}*"):  # by a run that was stopped
            shutil.rmtree(left, ignore_errors=True)
        with tempfile.TemporaryDirectory(prefix=prefix, dir=place.parent, ignore_cleanup_errors=True) as temporary:
            folder = Path(temporary) / "whole"  # with the user's usual permissions
            folder.mkdir()
            yield folder
            with contextlib.suppress(FileNotFoundError):
                place.rename(Path(temporary) / "earlier")  # a killed process leaves no part of it at its place
            folder.rename(place)
        return
    with tempfile.TemporaryDirectory(prefix="wepose-") as temporary:
        yield Path(temporary)
        done = (Path(temporary) / DONE_FILE).read_bytes()
        (Path(temporary) / DONE_FILE).unlink()
        with open_filesystem(url) as (system, path):
            if system.exists(path):
                system.rm(path, recursive=True)
            system.put(f"{temporary}/", f"{path}/", recursive=True)
            system.pipe_file(f"{path}/{DONE_FILE}", done)
