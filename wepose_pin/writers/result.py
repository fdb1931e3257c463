"""The result folder: ``pose.parquet``, ``subject.toml``, ``subject.urdf``, ``summary.json``."""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from .. import __version__
from ..errors import BadData, ExistingOutput, MissingFile
from ..kinematics import Pose, build_pose_table, parse_pose_table
from ..model import BodyModel, load_model
from ..readers.tables import read_table
from ..subject import Subject, subject_toml
from ..tracking import TrackedRecording

if TYPE_CHECKING:  # it loads scipy.signal, which few results need
    from ..angles.torques import Torques


def write_result(
    folder: Path,
    tracked: TrackedRecording,
    covariance: bool = False,
    phases: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    torques: Torques | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a tracked recording into an existing folder; with `covariance` its entries besides standard deviations.

    `phases` of the recording go to the summary, so that a page made from the folder shows them too. `torques` become
    ``torques.parquet``, `provenance` part of the summary.
    """
    write_table(folder / "pose.parquet", build_pose_table(tracked.pose, covariance))
    summary = tracked.summary()
    if torques is not None:
        from ..angles.torques import torque_table

        write_table(folder / "torques.parquet", torque_table(torques))
        summary["torques"] = torques.summary()
    write_about(folder, tracked, summary, phases, provenance)


def write_about(
    folder: Path,
    tracked: TrackedRecording,
    summary: Mapping[str, Any],
    phases: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write the files of a result beside its tables: the subject as used, and ``summary.json``."""
    write_subject(folder, tracked.subject, tracked.model)
    spans = {name: [[float(a), float(b)] for a, b in intervals] for name, intervals in (phases or {}).items()}
    about = {**summary, "recorded_phases": spans, "versions": versions()}
    if provenance is not None:
        about["provenance"] = dict(provenance)
    (folder / "summary.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def write_table(path: Path, table: pl.DataFrame) -> None:
    """A Parquet file.

    Raises
    ------
    ExistingOutput
        It cannot be written: a full disk, say.
    """
    try:
        with path.open("wb") as file:  # polars takes no path that is not in UTF-8
            table.write_parquet(file)
    except (pl.exceptions.PolarsError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise ExistingOutput(f"{path.name}: cannot be written: {reason}; nothing was written") from error


def write_subject(folder: Path, subject: Subject, model: BodyModel) -> None:
    """``subject.toml``, and ``subject.urdf``: the body with the subject's lengths."""
    (folder / "subject.toml").write_text(subject_toml(subject), encoding="utf-8")
    head, _, body = model.urdf().partition("\n")
    text = "; ".join(
        f"{name} {value:.4f}" + (f" ± {subject.std(name):.4f}" if np.isfinite(subject.std(name)) else "")
        for name, value in subject.lengths.items()
    )
    comment = re.sub(
        "-(?=-)", "- ", f"{subject.name}: lengths in metres ± one standard deviation. {text}"
    )  # no -- in XML
    (folder / "subject.urdf").write_text(f"{head}\n<!-- {comment} -->\n{body}", encoding="utf-8")


def read_result(folder: Path) -> tuple[Pose, BodyModel, dict[str, Any]]:
    """Pose, body and summary of a result folder.

    Raises
    ------
    WeposeError
        It is no result folder, or its files are damaged.
    """
    if not (folder / "pose.parquet").is_file():
        raise MissingFile(f"{folder}: no pose.parquet in it; a folder that `wepose track` wrote is wanted here")
    if (folder / "joints.parquet").is_file():
        raise BadData(f"{folder}: of a chain, its motion is in joints.parquet; a person's result is wanted here")
    pose = parse_pose_table(read_table(folder / "pose.parquet"), str(folder / "pose.parquet"))
    summary_file = folder / "summary.json"
    try:
        summary = json.loads(summary_file.read_text(encoding="utf-8")) if summary_file.is_file() else {}
    except (ValueError, RecursionError) as error:
        raise BadData(f"{summary_file}: is damaged, no JSON: {error}") from error
    if not isinstance(summary, dict):
        raise BadData(f"{summary_file}: is damaged: {str(summary)[:40]!r} in place of an object")
    return pose, load_model(folder / "subject.urdf"), summary


@cache
def versions() -> dict[str, str]:
    """Package → version, for the provenance of a result."""
    packages = ("pin", "casadi", "numpy", "scipy", "numba", "polars")
    return {
        "wepose-pin": __version__,
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def as_json(value: Any) -> Any:
    """Named tuples and arrays as JSON values."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {key: as_json(item) for key, item in value._asdict().items()}
    if isinstance(value, dict):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value
