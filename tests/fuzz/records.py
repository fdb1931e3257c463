"""What wepose itself wrote earlier, or others for it, and reads again: plans and results."""

from __future__ import annotations

import contextlib
import functools
import io
from pathlib import Path

from . import seeds


def plan(folder: Path, data: bytes) -> object:
    """The input is the plan; two sessions and a table lie beside it."""
    from wepose_pin.batch.plan import read_plan

    _beside_a_plan(folder)
    (folder / "list.csv").write_bytes(seeds.PLAN_TABLE)
    (folder / "plan.toml").write_bytes(data)
    read = read_plan(folder / "plan.toml", "out/items")
    names = [item.name for item in (*read.calibrations, *read.items)]
    assert len(set(names)) == len(names)
    assert all(name and "/" not in name and name not in (".", "..") for name in names), names
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


# A result, to what is made of it ------------------------------------------------------------------------------------


def result(folder: Path, data: bytes) -> object:
    """The input is a pose as CSV, in a result that is well otherwise: exported to all formats, compared, shown."""
    import polars as pl

    from wepose_pin.body.pose_table import parse_pose_table
    from wepose_pin.data_tables import read_table
    from wepose_pin.errors import WeposeError
    from wepose_pin.evaluation import evaluate
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
