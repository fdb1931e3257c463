"""What wepose itself wrote earlier, or others for it, and reads again: plans, provenance, figures, trials, results."""

from __future__ import annotations

import contextlib
import functools
import io
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest import mock

from . import seeds
from .target import file

REPRODUCED = ("track", "calibrate", "simulate", "retarget", "demo", "export", "angles")


def plan(folder: Path, data: bytes) -> object:
    """The input is the plan; two sessions and a table lie beside it."""
    from wepose_pin.batch.items import compute_key
    from wepose_pin.batch.plan import read_plan

    _beside_a_plan(folder)
    (folder / "list.csv").write_bytes(seeds.PLAN_TABLE)
    (folder / "plan.toml").write_bytes(data)
    read = read_plan(folder / "plan.toml", "out/items")
    names = [item.name for item in (*read.calibrations, *read.items)]
    assert len(set(names)) == len(names)
    assert all(name and "/" not in name and name not in (".", "..") for name in names), names
    for item in read.items:
        compute_key(item)
    return read


def plan_table(folder: Path, data: bytes) -> object:
    """The input is the table that a plan names."""
    from wepose_pin.batch.plan import read_plan

    _beside_a_plan(folder)
    (folder / "list.csv").write_bytes(data)
    (folder / "plan.toml").write_bytes(seeds.PLAN.replace(b'files = ["*/session.toml"]', b'table = "list.csv"'))
    read = read_plan(folder / "plan.toml", "out/items")
    assert all(item.name and "/" not in item.name for item in read.items), [item.name for item in read.items]
    return read


def _beside_a_plan(folder: Path) -> None:
    for name in ("one", "two"):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "session.toml").write_text(seeds.SESSION, encoding="utf-8")
    (folder / "anna.toml").write_bytes(seeds.subject())
    (folder / "arm.urdf").write_text(seeds.ARM, encoding="utf-8")
    (folder / "arm.toml").write_bytes(seeds.ARM_MAP)


def _silently(do: Callable[[], object]) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        do()


def _validation(path: Path) -> object:
    from wepose_pin.cli.validate import print_experiments
    from wepose_pin.validation import read_document

    document = read_document(path)
    _silently(lambda: print_experiments(document))
    return document


validation = file("validation.json", _validation)


def provenance(folder: Path, data: bytes) -> object:
    """The input is what a result says made it; what would make it again copies another."""
    from wepose_pin.batch import reproduction
    from wepose_pin.jobs.reproduce import ReproduceJob

    result, made = folder / "result", folder / "made"
    for place in (result, made):
        if not place.is_dir():
            place.mkdir()
            (place / "pose.parquet").write_bytes(seeds.pose())
    (folder / "session.toml").write_text(seeds.SESSION, encoding="utf-8")
    (result / "provenance.json").write_bytes(data.replace(b"FOLDER", str(folder).encode()))
    copies = {name: (kind, lambda job: shutil.copytree(made, job.out)) for name, (kind, _) in _reproducible().items()}
    with mock.patch.dict(reproduction.REPRODUCIBLE, copies):
        return reproduction.run_reproduce(ReproduceJob(result))


def _reproducible() -> dict[str, tuple[type, Callable[..., object]]]:
    from wepose_pin.batch.reproduction import REPRODUCIBLE

    assert set(REPRODUCIBLE) == set(REPRODUCED), "a stranger's record runs only what makes a result"
    return REPRODUCIBLE


def done(folder: Path, data: bytes) -> object:
    """The input is what an item of a batch says made it; read as batch does before it makes it again."""
    from wepose_pin.batch.items import _find_change, _read_done, read_item
    from wepose_pin.batch.reproduction import _read_item_provenance

    (folder / "item").mkdir(exist_ok=True)
    (folder / "session.toml").write_text(seeds.SESSION, encoding="utf-8")
    (folder / "item" / "done.json").write_bytes(data.replace(b"FOLDER", str(folder).encode()))
    record = _read_done(str(folder / "item"))
    item = read_item(_read_item_provenance(folder / "item"))
    return None if record is None else _find_change(item, "", record)


# Recordings with a truth, for `wepose validate --data` ------------------------------------------------------------


def _broad(path: Path) -> object:
    from wepose_pin.readers.trials import read_broad

    return read_broad(path)


def _authors(path: Path) -> object:
    from wepose_pin.readers.trials import read_authors_trial

    return read_authors_trial(path)


broad = file("trial.mat", _broad)
authors = file("prova_HR.txt", _authors)


def ring(folder: Path, data: bytes) -> object:
    """One text for all three tables."""
    from wepose_pin.readers.trials import RING_MOUNTS, RingFiles, read_ring

    for name in ("omc", "imu_rigid", "imu_nonrigid"):
        (folder / f"{name}.csv").write_bytes(data)
    imu = dict(zip(RING_MOUNTS, (folder / "imu_rigid.csv", folder / "imu_nonrigid.csv"), strict=True))
    return read_ring(RingFiles(folder, folder / "omc.csv", imu))


def ur5(folder: Path, data: bytes) -> object:
    from wepose_pin.readers.trials import Ur5Files, read_ur5

    for name in ("imu/a/radius_adx.csv", "encoder/a/radius.csv"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return read_ur5(Ur5Files("a", "radius", folder / "imu/a/radius_adx.csv", folder / "encoder/a/radius.csv"))


# A result, to what is made of it ------------------------------------------------------------------------------------


def result(folder: Path, data: bytes) -> object:
    """The input is a pose as CSV, in a result that is well otherwise: exported to all formats, compared, shown."""
    import polars as pl

    from wepose_pin.errors import WeposeError
    from wepose_pin.evaluation import evaluate
    from wepose_pin.kinematics import parse_pose_table
    from wepose_pin.readers.tables import read_table
    from wepose_pin.report.viewer import pose_html
    from wepose_pin.writers.export import export
    from wepose_pin.writers.result import read_result

    if not (folder / "subject.urdf").is_file():
        (folder / "subject.urdf").write_bytes(seeds.shipped("urdf/upper_body.urdf")[0])
    (folder / "summary.json").write_bytes(b"{}")
    (folder / "pose.csv").write_bytes(data)
    table = read_table(folder / "pose.csv")
    with contextlib.suppress(pl.exceptions.PolarsError):  # of names that Parquet has not
        table.write_parquet(folder / "pose.parquet")
    pose, model, _ = read_result(folder)
    pose_html(model, pose, title="a")
    refused: WeposeError | None = None
    truth = parse_pose_table(pl.read_parquet(io.BytesIO(seeds.pose())), "truth")
    for do in (lambda: evaluate(pose, truth), *(functools.partial(_exported, folder, name) for name in EXPORTS)):
        try:
            do()
        except WeposeError as error:
            refused = error
    if refused is not None:
        raise refused
    return export


EXPORTS = ("csv", "parquet", "mot", "sto", "trc", "bvh")


def _exported(folder: Path, format: str) -> None:
    from wepose_pin.writers.export import export

    export(folder, folder / f"motion.{format}", format, force=True)
    assert (folder / f"motion.{format}").stat().st_size
