"""One result, one file, in a format of others."""

from __future__ import annotations

import contextlib
import functools
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ..arguments import check_arguments
from ..diagnostics import Diagnostic
from ..documents import whole_file
from ..errors import BadData, BadOption, MissingFile, one_of
from ..kinematics import PosedBody, cut_pose
from ..recording import select_interval
from ..subject import Subject, load_subject
from ..tracking.tracked import TrackedRecording
from .bvh import write_bvh
from .c3d import write_c3d
from .motion import Motion, check_rate, resampled
from .motion_bids import parse_bids_name, write_motion_bids
from .opensim import OpenSenseFiles, write_mot, write_placement, write_setups, write_sto, write_trc
from .osim import write_osim
from .provenance import provenance_file, provenance_text
from .result import SUBJECT_URDF, format_urdf, read_result
from .tables import write_csv, write_parquet

Writer = Callable[[Path, Motion], list[Diagnostic]]  # gives what the file cannot hold

WRITERS: dict[str, Writer] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "mot": write_mot,
    "sto": write_sto,
    "placement": write_placement,
    "trc": write_trc,
    "bvh": write_bvh,
    "c3d": write_c3d,
}
BIDS = "motion-bids"
FORMATS = (*WRITERS, "osim", "urdf", BIDS)
WITHOUT_MOTION = ("urdf", "osim", "placement")
SUFFIXES = {"placement": ".sto", BIDS: ""}  # where it is not the format's name; a folder has none
NAMES = ("isb", "opensim")


class Exported(NamedTuple):
    """What was written: the format, and what it cannot hold."""

    format: str
    diagnostics: list[Diagnostic]

    def __repr__(self) -> str:
        return f"Exported({self.format!r}; {len(self.diagnostics)} diagnostics)"


def export(
    result: PosedBody | str | Path,
    file: str | Path,
    format: str | None = None,
    *,
    names: str | None = None,
    rate_hz: float | None = None,
    interval: tuple[float, float] | None = None,
    phase: str | None = None,
    osim_model: str | Path | None = None,
    bids_name: str | None = None,
    force: bool = False,
    provenance: Mapping[str, Any] | None = None,
) -> Exported:
    """Write a motion, or the body that moves, to a file for other programs, which appears whole or not at all.

    Parameters
    ----------
    result : PosedBody, str or Path
        What `track` or `load_result` gives, or a result folder.
    file : str or Path
        The file to write; of "motion-bids" a folder, to which a recording is added if it is a dataset.
    format : str, optional
        One of `FORMATS`: "csv", "parquet", "mot", "sto", "placement", "trc", "bvh", "c3d", "osim", "urdf",
        "motion-bids"; None: that of the file's suffix, which otherwise has to be the format's own.
    names : str, optional
        Of a .mot's columns: only the angles of the ISB, "isb", or only the coordinates of OpenSim's model, "opensim";
        None: both, the ISB's first.
    rate_hz : float, optional
        Resample the motion to so many samples a second first.
    interval, phase : optional
        Write only this interval, from and to [s], or this phase of the recording; of a phase with several intervals
        "NAME:2" is the second.
    osim_model : str or Path, optional
        The generic OpenSim model that an .osim is scaled from. With a .sto also the scaled model and the set-up files
        of OpenSense's tools are written beside it.
    bids_name : str, optional
        What the recording is called in a dataset of Motion-BIDS, such as "sub-01_task-reach_run-2"; what it lacks is
        taken from the names of subject and recording.
    force : bool
        Replace an existing file.
    provenance : mapping, optional
        Written beside the file, before it.

    Returns
    -------
    Exported
        The format, and as `diagnostics` what it cannot hold.

    Raises
    ------
    BadOption
        A format that is not known, or an option that it has not.
    MissingFile, BadData
        No result, or nothing in it that the format could hold.
    ExistingOutput
        The file is there and `force` is not given, or it cannot be written.

    Examples
    --------
    >>> wp.export(result, "circles.mot").format
    'mot'
    >>> wp.export("result", "circles.csv", rate_hz=50.0).diagnostics
    []
    """
    check_arguments(export, locals())
    file = Path(file)
    format = _format(file, format)
    if names is not None and format != "mot":
        raise BadOption(f"--names {names}: only a .mot has names to choose, and the format is {format}")
    if names not in (None, *NAMES):
        raise BadOption(f"--names {names}: not known; {one_of(NAMES, names)}")
    if rate_hz is not None:
        check_rate(rate_hz)
    if rate_hz is not None and format in WITHOUT_MOTION:
        raise BadOption(f"--rate-hz {rate_hz:g}: there is no motion in a file of format {format}")
    if (interval is not None or phase is not None) and format in WITHOUT_MOTION:
        option = "interval" if phase is None else "phase"
        raise BadOption(f"--{option}: there is no motion in a file of format {format}")
    _check_osim_model(osim_model, format)
    if bids_name is not None and format != BIDS:
        raise BadOption(f"--bids-name {bids_name}: only {BIDS} has such names, and the format is {format}")
    if format == BIDS:
        motion = _read_motion(result, interval, phase)
        motion = motion if rate_hz is None else resampled(motion, rate_hz)
        name = parse_bids_name(bids_name, motion.subject, motion.name)
        return Exported(format, write_motion_bids(file, motion, name, force, provenance))
    with contextlib.ExitStack() as files:

        def begin(path: Path) -> Path:
            return files.enter_context(whole_file(path, force))

        partial = begin(file)
        if provenance is not None:
            partial_provenance = files.enter_context(whole_file(provenance_file(file), True))
            partial_provenance.write_text(provenance_text(provenance), encoding="utf-8")
        if format == "urdf":
            _write_urdf(partial, result)
            return Exported(format, [])
        motion = _read_motion(result, interval, phase)
        if rate_hz is not None:
            motion = resampled(motion, rate_hz)
        if format == "osim":
            return Exported(format, write_osim(partial, motion, Path(str(osim_model))))
        write = WRITERS[format] if names is None else functools.partial(write_mot, names=names)
        diagnostics = write(partial, motion)
        if osim_model is not None:
            beside = OpenSenseFiles.beside(file)
            others = (beside.model, beside.placement, beside.placer, beside.ik)
            written = OpenSenseFiles(partial, *(begin(path) for path in others))
            diagnostics += write_osim(written.model, motion, Path(osim_model), begin=True)
            diagnostics += write_setups(beside, written, motion)
        return Exported(format, diagnostics)


def _check_osim_model(osim_model: str | Path | None, format: str) -> None:
    if osim_model is None and format == "osim":
        raise BadOption("--format osim: scales a model; --osim-model names a generic one, such as Rajagopal's")
    if osim_model is not None and format not in ("osim", "sto"):
        raise BadOption(f"--osim-model {osim_model}: only an .osim and a .sto have use for it; the format is {format}")


def _write_urdf(file: Path, result: PosedBody | str | Path) -> None:
    if isinstance(result, PosedBody):
        file.write_text(format_urdf(result.subject, result.model), encoding="utf-8")
        return
    urdf = Path(result) / SUBJECT_URDF
    if not urdf.is_file():
        raise MissingFile(f"{result}: no subject.urdf in it; a folder that `wepose track` wrote is wanted here")
    shutil.copyfile(urdf, file)


def _read_motion(result: PosedBody | str | Path, interval: tuple[float, float] | None, phase: str | None) -> Motion:
    """The motion of a result, or the selected part of it, of at least two samples."""
    if isinstance(result, PosedBody):
        phases = result.recording.phases if isinstance(result, TrackedRecording) else getattr(result, "phases", {})
        selected = select_interval(result.time, phases, interval, phase)
        pose = result.pose if selected is None else cut_pose(result.pose, selected)
        motion = Motion(pose, result.model, result.name, result.name, _name_person(result.subject))
    else:
        folder = Path(result)
        pose, model, summary = read_result(folder, interval, phase)
        subject = load_subject(folder) if (folder / "subject.toml").is_file() else None
        motion = Motion(pose, model, str(summary.get("recording") or folder.name), str(folder), _name_person(subject))
    if len(motion.pose.time) < 2:
        raise BadData(f"{motion.where}: a pose of {len(motion.pose.time)} samples; a motion has at least 2")
    return motion


def _name_person(subject: Subject | None) -> str:
    """The name of a subject; empty where none was stated."""
    return "" if subject is None or subject.is_population else subject.name


def _format(file: Path, format: str | None) -> str:
    if format is None:
        format = file.suffix.lower().removeprefix(".")
        if format not in FORMATS:
            raise BadOption(
                f"-o {file}: '{file.suffix}' is no format's suffix; state it by --format; {one_of(FORMATS)}"
            )
    if format not in FORMATS:
        raise BadOption(f"--format {format}: not known; {one_of(FORMATS, format)}")
    suffix = SUFFIXES.get(format, f".{format}")
    if suffix and file.suffix.lower() != suffix:
        raise BadOption(
            f"-o {file}: format {format} is for programs that go by the suffix: name it {file.stem}{suffix}"
        )
    return format
