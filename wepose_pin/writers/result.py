"""The result folder: ``pose.parquet``, ``subject.toml``, ``subject.urdf``, ``summary.json``.

With a body other than the upper body also ``model.toml``, its table; of a mechanism also ``joints.parquet``.
"""

from __future__ import annotations

import contextlib
import io
import json
import platform
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np
import polars as pl

from .. import __version__
from ..angles.torques import Torques, torque_table
from ..arguments import check_arguments
from ..body import BodyModel, load_model, load_table
from ..body.kinematics import Pose, build_pose_table, find_samples, parse_pose_table
from ..body.subject import Subject, load_subject, subject_toml
from ..body.table import MODEL_TABLE, format_table
from ..data_tables import read_columns, read_table
from ..diagnostics import from_json
from ..errors import MissingFile
from ..libraries import library_errors
from ..recording import Intervals, Mark, select_interval
from ..tracking import TrackResult, TrackSummary

POSE = "pose.parquet"
JOINTS = "joints.parquet"
SUBJECT_URDF = "subject.urdf"
ROW_GROUP = 50_000  # rows of a table in chunks that are written at a time


def write_poses(folder: Path, chunks: Iterable[TrackResult], covariance: bool = False) -> None:
    """Write ``pose.parquet``, and of a mechanism ``joints.parquet``, of consecutive chunks, one in memory at a time.

    With `covariance` they have its entries besides standard deviations.
    """
    parts: dict[str, list[Path]] = {}
    for tracked in chunks:
        tables = {POSE: build_pose_table(tracked.pose, covariance)}
        if tracked.joints:
            tables[JOINTS] = pl.DataFrame({"time": tracked.pose.time, **tracked.pose.joints})
        for name, table in tables.items():
            files = parts.setdefault(name, [])
            files.append(folder / f"{name}.{len(files):06d}")
            write_table(files[-1], table)
    for name, files in parts.items():
        if len(files) == 1:
            files[0].rename(folder / name)
            continue
        with contextlib.ExitStack() as stack:
            out = stack.enter_context((folder / name).open("wb"))
            # Of a path polars takes [ and * for a pattern, and only UTF-8.
            opened: list[IO[bytes]] = [stack.enter_context(file.open("rb")) for file in files]
            pl.scan_parquet(opened).sink_parquet(out, row_group_size=ROW_GROUP)
        for file in files:
            file.unlink()


def write_about(
    folder: Path,
    tracked: TrackResult,
    summary: TrackSummary,
    torques: Torques | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write the files of a result beside its poses; `tracked` is the last chunk."""
    write_subject(folder, tracked.subject, tracked.model)
    about = dict(summary.content)
    if torques is not None:
        write_table(folder / "torques.parquet", torque_table(torques))
        about["torques"] = torques.summary()
    spans = {name: [[float(a), float(b)] for a, b in intervals] for name, intervals in tracked.phases.items()}
    about |= {"recorded_phases": spans, "versions": versions()}
    if tracked.marks:
        about["recorded_marks"] = [[mark.time, mark.text] for mark in tracked.marks]
    if provenance is not None:
        about["provenance"] = dict(provenance)
    (folder / "summary.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def write_table(path: Path, table: pl.DataFrame) -> None:
    """Write a Parquet file."""
    content = io.BytesIO()  # polars takes no path that is not in UTF-8, and has errors of its own for a full disk
    table.write_parquet(content)
    path.write_bytes(content.getbuffer())


def write_subject(folder: Path, subject: Subject, model: BodyModel) -> None:
    """``subject.toml``, and ``subject.urdf``: the body with the subject's lengths; of another body ``model.toml``."""
    (folder / "subject.toml").write_text(subject_toml(subject), encoding="utf-8")
    (folder / SUBJECT_URDF).write_text(format_urdf(subject, model), encoding="utf-8")
    own, upper_body = (replace(table, name="", where="") for table in (model.table, load_table()))
    if own != upper_body:
        (folder / MODEL_TABLE).write_text(format_table(model.table, SUBJECT_URDF), encoding="utf-8")


def format_urdf(subject: Subject, model: BodyModel) -> str:
    """The text of ``subject.urdf``."""
    head, _, body = model.urdf().partition("\n")
    text = "; ".join(
        f"{name} {value:.4f}" + (f" ± {subject.std(name):.4f}" if np.isfinite(subject.std(name)) else "")
        for name, value in subject.lengths.items()
    )
    text = f"{subject.name}: lengths in metres ± one standard deviation. {text}"
    comment = re.sub("-(?=-)", "- ", text)  # no -- in XML
    return f"{head}\n<!-- {comment} -->\n{body}"


def load_result(folder: str | Path) -> TrackResult:
    """Read a result folder, as `wepose track` and `TrackResult.save` write it.

    Parameters
    ----------
    folder : str or Path
        Holds ``pose.parquet``, ``subject.toml``, ``subject.urdf`` and ``summary.json``.

    Returns
    -------
    TrackResult
        The content of its files. These have no covariances but standard deviations, the same for all axes, unless
        `wepose track --covariance` wrote them.

    Raises
    ------
    MissingFile, BadData, BadSubject, BadModel
        The folder is not there or lacks a file, or a file is damaged.

    Examples
    --------
    >>> wp.load_result("result")
    TrackResult('simulated': 22.5 s at 100 Hz, 5 segments, 8 points, amekf, 0 warnings)
    """
    check_arguments(load_result, locals())
    folder = Path(folder)
    if not (folder / POSE).is_file():
        raise MissingFile(f"{folder}: no {POSE} in it; a folder that `wepose track` wrote is wanted here")
    pose = parse_pose_table(read_table(folder / POSE), str(folder / POSE))
    if (folder / JOINTS).is_file():
        table, place = read_table(folder / JOINTS), str(folder / JOINTS)
        joints = {name: read_columns(table, [name], place, place)[:, 0] for name in table.columns if name != "time"}
        pose = replace(pose, joints=joints)
    file, summary = folder / "summary.json", dict[str, Any]()
    with library_errors(file, "the summary of a result"):
        summary |= json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
        diagnostics = tuple(from_json(each) for each in summary.get("diagnostics", ()))
        marks = tuple(Mark(float(time), str(text)) for time, text in summary.get("recorded_marks", ()))
    subject, model = load_subject(folder), load_model(folder / SUBJECT_URDF)
    if model.table.girdles:
        model = replace(model, girdles=subject.girdles)
    name, phases = str(summary.get("recording") or folder.name), read_phases(summary)
    return TrackResult(
        name, pose, model, subject, phases, marks, source=folder, summary=summary, diagnostics=diagnostics
    )


def select_pose(result: TrackResult, interval: tuple[float, float] | None, phase: str | None) -> Pose:
    """Select an interval [s] or a phase of a motion; `WeposeError`: it is not in the recording."""
    selected = select_interval(result.time, result.phases, interval, phase)
    return result.pose if selected is None else result.pose.cut(find_samples(result.time, selected))


def read_phases(summary: Mapping[str, Any]) -> dict[str, Intervals]:
    """Read the phases of the recording from a result's summary."""
    with library_errors(Path("summary.json"), "the summary of a result"):
        recorded = summary.get("recorded_phases", {})
        return {name: tuple((float(begin), float(end)) for begin, end in spans) for name, spans in recorded.items()}


@cache
def versions() -> dict[str, str]:
    """Package → version, for the provenance of a result."""
    packages = {name: version(name) for name in ("pin", "casadi", "numpy", "scipy", "numba", "polars")}
    return {"wepose-pin": __version__, "python": platform.python_version(), **packages}


def as_json(value: Any) -> Any:
    """Named tuples and arrays as JSON values."""
    value = value._asdict() if hasattr(value, "_asdict") else value
    if isinstance(value, dict):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value
