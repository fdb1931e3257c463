"""Folders of ours: a recording with its session, a calibration, and a result, which is read again; their provenance.

A result has ``pose.parquet``, ``subject.toml``, ``subject.urdf``, ``summary.json``; with a body other than the upper
body also ``model.toml``, its table; of a mechanism also ``joints.parquet``. A calibration has ``calibration.json`` in
place of the pose and the summary.
"""

import contextlib
import hashlib
import io
import json
import math
import platform
import re
import shutil
import subprocess
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
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
from ..calibration import Calibration
from ..data_tables import read_columns, read_table
from ..diagnostics import as_json as diagnostic_as_json
from ..diagnostics import from_json
from ..documents import toml_key, whole_folder
from ..errors import ExistingOutput, MissingFile
from ..libraries import asset, check_file, library_errors
from ..readers import format_keys
from ..recording import ImuSensor, Intervals, Recording, find_mount_axes, select_interval
from ..tracking import TrackResult, TrackSummary

POSE, TRAJECTORY = "pose.parquet", "trajectory.parquet"
JOINTS = "joints.parquet"
SUBJECT_URDF = "subject.urdf"
ROW_GROUP = 50_000  # rows of a table in chunks that are written at a time


def write_session(folder: Path, recording: Recording, truth: Pose | None = None) -> None:
    """``session.toml``, ``recording.parquet`` and, with a truth, ``truth.parquet`` into an existing folder."""
    model = str(Path(recording.model).absolute()) if Path(recording.model).is_file() else recording.model
    head = {"name": recording.name, "model": model, "start_pose": recording.start_pose}
    data = {"file": "recording.parquet", "time": "time", "gyro_unit": "rad/s", "accel_unit": "m/s^2"}
    phases = recording.phases.items()
    spans = {name: [[round(float(time), 3) for time in span] for span in each] for name, each in phases}
    tables: dict[str, Mapping[str, Any]] = {
        "data": data | ({} if truth is None else {"truth": "truth.parquet"}),
        "phases": spans,
        "joints": {name: float(value) for name, value in recording.joints.items()},
    }
    columns = {"time": recording.time}
    for segment, sensor in recording.sensors.items():
        if isinstance(sensor, ImuSensor):
            signals = {"gyro": ("gyr_", sensor.gyro_S), "accel": ("acc_", sensor.accel_S)}
        else:
            signals = {"orientation": ("q", sensor.quat_VS)}
        keys: dict[str, Any] = {}
        for key, (short, values) in signals.items():
            keys[key] = [f"{segment}_{short}{c}" for c in "xyzw"[: values.shape[1]]]
            columns |= {column: values[:, k] for k, column in enumerate(keys[key])}
        if sensor.aligned:
            keys["aligned"] = True
        if sensor.stated_quat_LS is not None:
            keys["mount"] = dict(zip(("up", "forward"), find_mount_axes(sensor.stated_quat_LS), strict=True))
        tables[f"sensors.{toml_key(segment)}"] = keys
    lines = format_keys({key: value for key, value in head.items() if value})
    lines += ["remounted = true"] if recording.remounted else []
    for name, own in tables.items():
        lines += ["", f"[{name}]", *format_keys(own)] if own else []
    write_table(folder / "recording.parquet", pl.DataFrame(columns))
    if truth is not None:
        write_table(folder / "truth.parquet", build_pose_table(truth))
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_calibration(folder: Path, calibration: Calibration, provenance: Mapping[str, Any]) -> None:
    """Write the subject and ``calibration.json``, with the provenance, into an existing folder."""
    write_subject(folder, calibration.subject, calibration.subject.shape(calibration.problem.model))
    content = {**as_json(_document(calibration)), "versions": versions(), "provenance": dict(provenance)}
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "calibration.json").write_text(text + "\n", encoding="utf-8")


def _document(calibration: Calibration) -> dict[str, Any]:
    """The content of ``calibration.json``; lengths [m], times [s], angles as named, checks and diagnostics SI."""
    subject, quality = calibration.subject, calibration.quality
    return {
        "quality": quality.quality,
        "diagnostics": [diagnostic_as_json(diagnostic) for diagnostic in quality.diagnostics],
        "checks": [
            {"code": check.diagnostic.code, "place": check.diagnostic.place, "quality": check.quality}
            | {"value": check.value, "passes": check.passes, "poor": check.poor}
            for check in quality.checks
        ],
        "protocol": calibration.problem.protocol.name,
        "measured": {name: metres for name, (metres, _) in calibration.problem.measured.items()},
        "scale_std": calibration.scale_std,
        "lengths": {n: {"value": v, "std": subject.std(n)} for n, v in subject.lengths.items()},
        "mounts": {
            segment: {
                **{key: float(v) for key, v in zip(("qx", "qy", "qz", "qw"), quat, strict=True)},
                "std_deg": [np.degrees(subject.std(f"mounts.{segment}.{axis}")) for axis in "xyz"],
            }
            for segment, quat in subject.mounts.items()
        },
        "start_pose_offset_deg": {name: np.degrees(offset[:2]) for name, offset in subject.start_pose_offset.items()},
        "heading_drift_deg_min": {name: 60.0 * np.degrees(drift[0]) for name, drift in subject.heading_drift.items()},
        "hinges": {
            joint: {"axis": subject.hinges[joint].axis, "rms_deg": np.degrees(rms)}
            for joint, rms in calibration.hinge_rms.items()
        },
        "gap_rms": calibration.rms_gap,
        "open_intervals": calibration.open_intervals,
        "effective_sample_size": calibration.effective_sample_size,
        "moved": dict(calibration.exchanged),
    }


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
        raise MissingFile(f"{folder}: no {POSE} in it; a folder that `wepose track` wrote is needed here")
    pose = parse_pose_table(read_table(folder / POSE), str(folder / POSE))
    if (folder / JOINTS).is_file():
        table, place = read_table(folder / JOINTS), str(folder / JOINTS)
        joints = {name: read_columns(table, [name], place, place)[:, 0] for name in table.columns if name != "time"}
        pose = replace(pose, joints=joints)
    file, summary = folder / "summary.json", dict[str, Any]()
    with library_errors(file, "the summary of a result"):
        summary |= json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
        diagnostics = tuple(from_json(each) for each in summary.get("diagnostics", ()))
    subject, model = load_subject(folder), load_model(folder / SUBJECT_URDF)
    if model.table.girdles:
        model = replace(model, girdles=subject.girdles)
    name, phases = str(summary.get("recording") or folder.name), read_phases(summary)
    return TrackResult(name, pose, model, subject, phases, folder, summary=summary, diagnostics=diagnostics)


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


def as_json(value: Any, digits: int | None = None) -> Any:
    """Named tuples and arrays as JSON values, with floats of so many decimals; null for what is not finite."""
    value = value._asdict() if hasattr(value, "_asdict") else value
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(value, Mapping):
        return {key: as_json(item, digits) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item, digits) for item in value]
    if isinstance(value, float):
        return None if not math.isfinite(value) else value if digits is None else round(value, digits)
    return value


# Provenance ----------------------------------------------------------------------------------------------------------

FORMAT = 1
CALL = "wepose_pin.track"  # in place of a command, of a result that `TrackResult.save` wrote
INSIDE = ("summary.json", "calibration.json")  # files of a result that hold its provenance
# Of a result folder, what others are made from; pages and what was exported into it are not.
_RESULT = ("pose.parquet", "joints.parquet", "subject.toml", "subject.urdf", "model.toml")
_PACKAGE = Path(__file__).resolve().parent.parent


@cache
def code() -> dict[str, str | None]:
    """Return version, commit where it is known (`+`: files were changed since), and the hash of code and data."""
    digest, commit = hashlib.sha256(), ""
    for folder in (_PACKAGE, asset("urdf", "upper_body.urdf").parent, asset("calibration", "clasp.toml").parent):
        files = (path.relative_to(folder) for path in folder.rglob("*") if path.suffix in (".py", ".toml", ".urdf"))
        for file in sorted(file for file in files if file.parts[0] != "_assets"):  # a wheel has the data in the package
            digest.update(file.as_posix().encode() + b"\0" + (folder / file).read_bytes() + b"\0")
    if (_PACKAGE.parent / ".git").exists() and shutil.which("git"):  # no wheel
        words = ["git", "-C", str(_PACKAGE.parent), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
        commit = subprocess.run(words, capture_output=True, text=True).stdout.strip()
    return {"version": __version__, "commit": commit or None, "code": digest.hexdigest()}


def collect_provenance(command: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Collect the provenance of what a command, or `CALL`, makes; of its options those that name files are inputs."""
    inputs, options = dict[str, Any](), dict[str, Any]()
    for name, value in ((name, value) for name, value in values.items() if name not in ("out", "force")):
        several = value if isinstance(value, tuple) else (value,)
        # A text may name a file, as that of --protocol.
        named = (isinstance(each, Path) or str(each).endswith((".toml", ".urdf")) for each in several)
        if not several or not all(named) or not all(Path(each).exists() for each in several):
            options[name] = value
            continue
        for k, path in enumerate(map(Path, several)):
            key = f"{name}.{k}" if isinstance(value, tuple) else name
            inputs[key] = {"path": str(path.absolute()), "files": file_hashes(path)}
    return {
        "format": FORMAT,
        "command": command,
        **code(),
        "options": json.loads(json.dumps(options, default=str)),
        "inputs": inputs,
        "packages": versions(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def file_hashes(path: Path, truth: bool = False) -> dict[str, str]:
    """Compute SHA-256 of all that an input consists of (`list_files`), by its name relative to the input's folder."""
    top = path if path.is_dir() else path.parent
    hashes = {}
    for file in list_files(path, truth):
        name = file.relative_to(top) if file.is_relative_to(top) else file
        check_file(file, "an input")
        with library_errors(file, "an input"), file.open("rb") as opened:
            hashes[name.as_posix()] = hashlib.file_digest(opened, "sha256").hexdigest()
    return hashes


def list_files(path: Path, truth: bool = False) -> list[Path]:
    """List the files that an input consists of, each followed by those that it needs: that it names or is read with."""
    if (path / "session.toml").is_file():
        path = path / "session.toml"
    if path.is_dir():
        return [path / name for name in _RESULT if (path / name).is_file()] or _list_folder(path)
    files = [path]
    for file in files:
        needed = [file.parent / name for name in list_named_files(file, truth)]
        if file.suffix == ".urdf":  # the map of a robot, or the table of a body, is read where it lies beside
            needed += [table for table in (file.with_suffix(".toml"), file.with_name("model.toml")) if table.is_file()]
        for each in needed:
            # A map may name a URDF of example-robot-data, which lies elsewhere and has a version of its own.
            new = _list_folder(each) if each.is_dir() else [each] if each.exists() or each.suffix != ".urdf" else []
            files += [file for file in new if file not in files]
    return files


def _list_folder(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))


def list_named_files(path: Path, truth: bool = False) -> list[str]:
    """List the files and folders that a session, or a model's table, names, as they stand there."""
    if path.suffix != ".toml" or not path.is_file():  # a pipe would block
        return []
    names, tables = set[str](), list[Mapping[str, Any]]()
    with contextlib.suppress(OSError, ValueError, RecursionError):  # its reader reports what is wrong
        tables.append(tomllib.loads(path.read_bytes().decode("utf-8-sig")))
    for table in tables:
        for key, value in table.items():
            if isinstance(value, dict):
                tables.append(value)
            elif isinstance(value, str) and (
                key in ("urdf", "file", *(("truth",) if truth else ()))
                or (key == "format" and value.endswith(".toml"))
                or (key == "model" and (path.parent / value).is_file())  # a body of the package is part of the code
            ):
                names.add(value)
    return sorted(names - {""})


def write_provenance(folder: Path, provenance: Mapping[str, Any]) -> None:
    """Write a provenance as a file of its own into a folder."""
    text = json.dumps(provenance, indent=1, ensure_ascii=False)
    # "backslashreplace": of a path that is not in UTF-8.
    (folder / "provenance.json").write_text(f"{text}\n", encoding="utf-8", errors="backslashreplace")


# Folders that hold an earlier result, or files of the user ---------------------------------------------------------


# Command → the file that tells its folder, and others that may be of an earlier run.
_WRITTEN = {
    "calibrate": ("calibration.json", "report.html"),
    "track": (POSE, "torques.parquet", "view.html", "report.html"),
    "retarget": (TRAJECTORY, "view.html", "report.html"),
}


@contextmanager
def result_folder(out: Path, force: bool, command: str) -> Iterator[Path]:
    """`whole_folder` of what a command writes; files of an earlier run do not stay.

    `ExistingOutput` is raised where the folder is of another command, a file of the user's would be read with the
    result, or an input be replaced.
    """
    for other, (name, *_) in _WRITTEN.items():
        if other != command and (out / name).exists():
            why = f"is of `wepose {other}`, whose files would be replaced"
            raise ExistingOutput(f"{out / name}: {why}; name another folder")
    inputs = {file.resolve() for file in list_files(out, truth=True)} if (out / "session.toml").is_file() else set()
    stale = [name for name in (MODEL_TABLE, JOINTS) if (out / name).exists()]
    if stale and not any((out / name).is_file() for name in INSIDE):
        why = "is of no earlier result, and would be read with the new one"
        raise ExistingOutput(f"{out / stale[0]}: {why}; rename it, or name another folder")
    stale = [name for name in stale if (out / name).resolve() not in inputs]
    with whole_folder(out, force, (*stale, *_WRITTEN[command])) as folder:
        yield folder
        for name in sorted(file.name for file in folder.iterdir()):
            if (out / name).resolve() in inputs:
                why = f"is an input of {out / 'session.toml'}, and would be replaced"
                raise ExistingOutput(f"{out / name}: {why}; name another folder")
