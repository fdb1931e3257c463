"""A result, a person's or a robot's, as a file or a folder in a format of others."""

from __future__ import annotations

import contextlib
import functools
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..arguments import check_arguments
from ..diagnostics import Diagnostic, notebook_html
from ..documents import whole_file, whole_folder
from ..errors import BadData, BadOption, MissingFile, one_of
from ..kinematics import PosedBody, cut_pose
from ..recording import select_interval
from ..tracking.tracked import TrackedRecording
from .bvh import write_bvh
from .c3d import write_c3d
from .joint_motion import (
    ROBOT_URDF,
    TRAJECTORY,
    HasJointMotion,
    JointMotion,
    convert_person,
    read_joint_motion,
    resample_joints,
    select_motion,
)
from .lerobot import diagnose_episodes, list_episodes, write_lerobot
from .motion import Motion, check_rate, resampled
from .opensim import OpenSenseFiles, write_mot, write_placement, write_scale, write_setups, write_sto, write_trc
from .provenance import provenance_file, provenance_text, write_provenance
from .result import SUBJECT_URDF, format_urdf, read_result
from .ros import write_mcap, write_rosbag
from .rrd import write_rrd
from .tables import write_csv, write_parquet

Result = PosedBody | HasJointMotion | str | Path
Writer = Callable[[Path, Motion], list[Diagnostic]]  # gives what the file cannot hold
JointWriter = Callable[[Path, JointMotion], None]

# Of a person; of a person or a robot, by joints; of a robot alone.
WRITERS: dict[str, Writer] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "mot": write_mot,
    "sto": write_sto,
    "placement": write_placement,
    "trc": write_trc,
    "bvh": write_bvh,
    "c3d": write_c3d,
    "scale": write_scale,
}
JOINT_WRITERS: dict[str, JointWriter] = {"rosbag": write_rosbag, "mcap": write_mcap, "rrd": write_rrd}
LEROBOT = "lerobot"
FORMATS = (*WRITERS, "urdf", *JOINT_WRITERS, LEROBOT)
# Formats that are folders → what an earlier run left in one, which `force` replaces.
FOLDERS = {LEROBOT: ("data/**/*.parquet", "meta/**/*.*"), "rosbag": ("*.db3", "*.mcap", "metadata.yaml")}
SUFFIXES = {"placement": ".sto", "scale": ".xml", **dict.fromkeys(FOLDERS, "")}  # where it is not the format's name
# Format that was written before → what to do instead.
_OF_ROBOTS = "trajectory.csv of `wepose retarget` has the joints, and lerobot, mcap and rosbag are written"
REMOVED = {
    "osim": "--format scale -o NAME.xml writes the set-up of OpenSim's Scale Tool, which makes the model",
    "motion-bids": "csv has the same columns",
    **dict.fromkeys(("bvh-lafan1", "bvh-nokov", "bvh-soma", "bvh-xsens"), "bvh has the person's own skeleton"),
    **dict.fromkeys(("pkl", "npz", "csv-beyondmimic"), _OF_ROBOTS),
}
FILE_SUFFIXES = (*FORMATS, "bag", "db3")
WITHOUT_MOTION = ("urdf", "placement", "scale")
NAMES = ("isb", "opensim")


class Exported(NamedTuple):
    """What `export` wrote.

    Parameters
    ----------
    format : one of `FORMATS`
    diagnostics : what of the result the format cannot hold
    """

    format: str
    diagnostics: list[Diagnostic]

    def __repr__(self) -> str:
        return f"Exported({self.format!r}; {len(self.diagnostics)} diagnostics)"

    def _repr_html_(self) -> str:
        return notebook_html(self, self.diagnostics)


def export(
    result: Result | Sequence[Result],
    file: str | Path,
    format: str | None = None,
    *,
    names: str | None = None,
    rate_hz: float | None = None,
    interval: tuple[float, float] | None = None,
    phase: str | None = None,
    episodes: str | None = None,
    instruction: str | None = None,
    osim_model: str | Path | None = None,
    force: bool = False,
    provenance: Mapping[str, Any] | None = None,
) -> Exported:
    """Write a motion, or the body that moves, to a file for other programs. On an error no part of it is left.

    Parameters
    ----------
    result : PosedBody, Trajectory, str or Path, or several
        A person's motion: what `track` or `load_result` gives, or a result folder. A robot's: what `retarget` gives, or
        a folder that `wepose retarget` wrote. Several only for "lerobot", which makes episodes of them.
    file : str or Path
        The file to write; of "lerobot" and "rosbag" the folder.
    format : str, optional
        One of `FORMATS`. Of a person: "csv", "parquet", "mot", "sto", "placement", "scale", "trc", "c3d", "bvh". Of
        either: "urdf", "rosbag", "mcap", "rrd". Of a robot: "lerobot". None: by the suffix of `file`; a stated format
        needs a file with its own suffix.
    names : str, optional
        Of a .mot's columns: only the angles of the ISB, "isb", or only the coordinates of OpenSim's model, "opensim";
        None: both, the ISB's first.
    rate_hz : float, optional
        Resample the motion to so many samples a second first.
    interval, phase : optional
        Write only this interval, from and to [s], or this phase of the recording; of a phase with several intervals
        "NAME:2" is the second.
    episodes : str, optional
        Of "lerobot": "repetitions" makes each repetition of the movement an episode, a phase each of its intervals;
        None: each result is one.
    instruction : str, optional
        Of "lerobot": what the robot does, in all episodes; None: "follow NAME".
    osim_model : str or Path, optional
        Of "sto": the subject's OpenSim model, to which OpenSense's set-up files are written beside it. Of "scale": the
        generic model that is scaled; None: "Rajagopal_2015.osim". Only its name is used.
    force : bool
        Replace an existing file, or a data set of the same format.
    provenance : mapping, optional
        What made the result (command, options, versions), written as JSON beside the file, or into it where it is a
        folder.

    Returns
    -------
    Exported
        `format`, and `diagnostics`: what of the result the format cannot hold.

    Raises
    ------
    BadOption
        An unknown format, or one that is not for this kind of result; an option that the format does not take.
    MissingFile, BadData
        There is no such result, or it has nothing that the format can hold.
    ExistingOutput
        The file is there and `force` is not given, or it cannot be written.

    Examples
    --------
    >>> wp.export(result, "circles.mot").format
    'mot'
    >>> [each.place for each in wp.export("result", "circles.csv", rate_hz=50.0).diagnostics]  # near gimbal lock
    ['left_shoulder', 'right_shoulder']
    """
    check_arguments(export, locals())
    results = [result] if isinstance(result, Result) else list(result)
    file = Path(file)
    format = _format(file, format)
    _check_options(
        format,
        names=names,
        rate_hz=rate_hz,
        interval=interval,
        phase=phase,
        episodes=episodes,
        instruction=instruction,
        osim_model=osim_model,
    )
    if len(results) != 1 and format != LEROBOT:
        raise BadOption(
            f"--format {format}: a file of {len(results)} results; only {LEROBOT} takes several, as episodes"
        )
    with contextlib.ExitStack() as files:
        if format in FOLDERS:
            partial = files.enter_context(_replaced_folder(file, FOLDERS[format], force))
        else:
            partial = files.enter_context(whole_file(file, force))
        if provenance is not None and format in FOLDERS:
            write_provenance(partial, provenance)
        elif provenance is not None:
            partial_provenance = files.enter_context(whole_file(provenance_file(file), True))
            partial_provenance.write_text(provenance_text(provenance), encoding="utf-8")
        if format == "urdf":
            _write_urdf(partial, results[0])
            return Exported(format, [])
        if format in WRITERS:
            motion = _read_motion(results[0], format, interval, phase, rate_hz)
            write = WRITERS[format]
            if names is not None:
                write = functools.partial(write_mot, names=names)
            if format == "scale" and osim_model is not None:
                write = functools.partial(write_scale, model=str(osim_model))
            diagnostics = write(partial, motion)
            if format == "sto" and osim_model is not None:
                beside = OpenSenseFiles.beside(file)
                others = (beside.placement, beside.placer, beside.ik)
                written = OpenSenseFiles(partial, *(files.enter_context(whole_file(path, force)) for path in others))
                write_setups(beside, written, motion, str(osim_model))
            return Exported(format, diagnostics)
        motions = [_read_joint_motion(each, format, interval, phase) for each in results]
        if rate_hz is not None:
            motions = [resample_joints(each, rate_hz) for each in motions]
        if format == LEROBOT:
            write_lerobot(partial, [one for each in motions for one in list_episodes(each, episodes, instruction)])
            return Exported(format, [one for each in motions for one in diagnose_episodes(each, episodes)])
        JOINT_WRITERS[format](partial, motions[0])
        return Exported(format, [])


def _check_options(format: str, **options: Any) -> None:
    """Raise `BadOption` for an option that the format does not have."""
    stated = {name.replace("_", "-"): value for name, value in options.items() if value is not None}
    names = stated.get("names")
    if names is not None and format != "mot":
        raise BadOption(f"--names {names}: only a .mot has names to choose, and the format is {format}")
    if names not in (None, *NAMES):
        raise BadOption(f"--names {names}: not known; {one_of(NAMES, names)}")
    rate_hz = stated.get("rate-hz")
    if rate_hz is not None:
        check_rate(rate_hz)
    for name in ("episodes", "instruction"):
        if name in stated and format != LEROBOT:
            raise BadOption(f"--{name} {stated[name]}: only of format {LEROBOT}, and the format is {format}")
    if format in WITHOUT_MOTION and (unused := [name for name in ("rate-hz", "interval", "phase") if name in stated]):
        value = f" {rate_hz:g}" if rate_hz is not None else ""
        raise BadOption(f"--{unused[0]}{value}: there is no motion in a file of format {format}")
    osim_model = stated.get("osim-model")
    if osim_model is not None and format not in ("sto", "scale"):
        raise BadOption(f"--osim-model {osim_model}: only of formats sto and scale, and the format is {format}")


@contextlib.contextmanager
def _replaced_folder(out: Path, own: Sequence[str], force: bool) -> Iterator[Path]:
    """`whole_folder` of a data set: with `force` an earlier one goes, all other files stay."""
    with whole_folder(out, force) as folder:
        yield folder
        written = {path.relative_to(folder) for path in folder.rglob("*")}
    for pattern in own:
        for path in out.glob(pattern):
            if path.relative_to(out) not in written:
                path.unlink()


def _write_urdf(file: Path, result: Result) -> None:
    if isinstance(result, PosedBody):
        file.write_text(format_urdf(result.subject, result.model), encoding="utf-8")
    elif isinstance(result, HasJointMotion):
        file.write_text(result.joint_motion().urdf, encoding="utf-8")
    else:
        folder = Path(str(result))
        urdf = folder / (ROBOT_URDF if _is_of_robot(result) else SUBJECT_URDF)
        if not urdf.is_file():
            raise MissingFile(f"{result}: no {urdf.name} in it; a folder that `wepose track` wrote is wanted here")
        shutil.copyfile(urdf, file)


def _is_of_robot(result: Result) -> bool:
    """Whether a result is a robot's trajectory, and not a person's motion."""
    if isinstance(result, str | Path):
        return (Path(result) / TRAJECTORY).is_file()
    return not isinstance(result, PosedBody)


def _read_joint_motion(
    result: Result, format: str, interval: tuple[float, float] | None, phase: str | None
) -> JointMotion:
    """The motion of a robot, or of a person by joints, or the selected part of it."""
    if isinstance(result, HasJointMotion):
        return select_motion(result.joint_motion(), interval, phase)
    if isinstance(result, str | Path) and (format == LEROBOT or _is_of_robot(result)):
        return select_motion(read_joint_motion(Path(result)), interval, phase)
    if format == LEROBOT:
        raise BadOption(f"--format {format}: is of robots, and this is a person's motion; `wepose retarget` makes one")
    return convert_person(_read_motion(result, format, interval, phase))


def _read_motion(
    result: Result,
    format: str,
    interval: tuple[float, float] | None,
    phase: str | None,
    rate_hz: float | None = None,
) -> Motion:
    """The motion of a person, or the selected part of it, of at least two samples; resampled where a rate is given."""
    if _is_of_robot(result):
        raise BadOption(
            f"--format {format}: is of a person's motion, and this is a robot's trajectory; "
            f"of that there is: {', '.join(FORMATS[len(WRITERS) :])}"
        )
    if isinstance(result, PosedBody):
        recorded = result.recording if isinstance(result, TrackedRecording) else result
        phases = getattr(recorded, "phases", {})
        selected = select_interval(result.time, phases, interval, phase)
        pose = result.pose if selected is None else cut_pose(result.pose, selected)
        motion = Motion(pose, result.model, result.name, result.name)
    else:
        folder = Path(str(result))
        pose, model, summary = read_result(folder, interval, phase)
        motion = Motion(pose, model, str(summary.get("recording") or folder.name), str(folder))
    if len(motion.pose.time) < 2:
        raise BadData(f"{motion.where}: a pose of {len(motion.pose.time)} samples; a motion has at least 2")
    return motion if rate_hz is None else resampled(motion, rate_hz)


def _format(file: Path, format: str | None) -> str:
    if format is None:
        format = file.suffix.lower().removeprefix(".")
        if format not in FORMATS and format not in REMOVED:
            raise BadOption(
                f"-o {file}: '{file.suffix}' is no format's suffix; state it by --format; {one_of(FORMATS)}"
            )
    if format in REMOVED:
        raise BadOption(f"--format {format}: no longer written; {REMOVED[format]}")
    if format not in FORMATS:
        raise BadOption(f"--format {format}: not known; {one_of(FORMATS, format)}")
    suffix = SUFFIXES.get(format, f".{format}")
    if format in FOLDERS:
        if file.suffix.lower().removeprefix(".") in FILE_SUFFIXES:  # readers would take the folder for a file
            raise BadOption(f"-o {file}: format {format} is a folder; name it {file.stem}")
    elif file.suffix.lower() != suffix:
        raise BadOption(
            f"-o {file}: format {format} is for programs that go by the suffix: name it {file.stem}{suffix}"
        )
    return format
