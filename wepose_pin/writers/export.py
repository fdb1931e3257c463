"""A result, a person's or a robot's, as a file or a folder in a format of others."""

import contextlib
import functools
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import polars as pl

from ..angles import angle_table, diagnose_lock, joint_angles
from ..arguments import check_arguments
from ..body.kinematics import build_pose_table
from ..diagnostics import Diagnostic
from ..documents import whole_file, whole_folder
from ..errors import BadData, BadOption, one_of
from ..libraries import check_file, find_plugins, load_plugin
from ..tracking import TrackResult
from .joints import write_lerobot, write_mcap, write_rosbag, write_rrd
from .motion import ROBOT_URDF, HasJointMotion, check_rate, convert_person, read_joint_motion, resample
from .motion_capture import write_bvh, write_c3d
from .opensim import write_mot, write_placement, write_scale, write_setups, write_sto, write_trc
from .result import SUBJECT_URDF, TRAJECTORY, format_urdf, load_result, select_pose, write_table

Result = TrackResult | HasJointMotion | str | Path
# What a format is of: a person's motion; joints of a person or a robot; motions of robots; a body without a motion.
PERSON, JOINTS, ROBOTS, BODY = "a person's motion", "joints", "robots", "a body"
MOTION = ("rate_hz", "interval", "phase")  # options of a format with a motion


class Format(NamedTuple):
    """A format of others."""

    of: str  # what it holds: `PERSON`, `JOINTS`, `ROBOTS` or `BODY`
    # Path, motion and own options → what the file cannot hold, or None. A format of `ROBOTS` gets all motions, one of
    # `BODY` the result.
    write: Callable[..., list[Diagnostic] | None]
    options: tuple[str, ...] = MOTION  # that it has of those of `export`
    suffix: str | None = None  # of the file; None: the name of the format. Empty: a folder
    earlier: tuple[str, ...] = ()  # patterns of the files of an earlier run in the folder, which `force` replaces


def write_urdf(file: Path, result: Result) -> None:
    """Write the body of a person or a robot."""
    if isinstance(result, TrackResult):
        file.write_text(format_urdf(result.subject, result.model), encoding="utf-8")
    elif isinstance(result, HasJointMotion):
        file.write_text(result.joint_motion().urdf, encoding="utf-8")
    else:
        urdf = Path(result) / (ROBOT_URDF if _is_of_robot(result) else SUBJECT_URDF)
        check_file(urdf, "a folder that `wepose track` or `wepose retarget` wrote")
        shutil.copyfile(urdf, file)


def write_motion_table(path: Path, motion: TrackResult) -> list[Diagnostic]:
    """Write the table of the pose, and beside it that of the angles where a joint has both of its segments.

    Every number has all its bits. What is not known is empty in a CSV, NaN in Parquet.
    """
    rows, diagnostics = build_pose_table(motion.pose).with_columns(**motion.pose.joints), list[Diagnostic]()
    with contextlib.suppress(BadData):  # no joint has both
        angles = joint_angles(motion.pose)
        rows = pl.concat([rows, angle_table(angles).drop("time")], how="horizontal")
        diagnostics = diagnose_lock(angles)
    if not path.name.lower().removesuffix(".partial").endswith(".csv"):
        write_table(path, rows)
    else:
        with path.open("wb") as file:  # polars takes only a path in UTF-8
            rows.fill_nan(None).write_csv(file)
    return diagnostics


# pyproject.toml registers them as those of other distributions.
CSV = Format(PERSON, write_motion_table)
PARQUET = Format(PERSON, write_motion_table)
MOT = Format(PERSON, write_mot, (*MOTION, "names"))
STO = Format(PERSON, write_sto, (*MOTION, "osim_model"))
PLACEMENT = Format(PERSON, write_placement, (), ".sto")
TRC = Format(PERSON, write_trc)
BVH = Format(PERSON, write_bvh)
C3D = Format(PERSON, write_c3d)
SCALE = Format(PERSON, write_scale, ("osim_model",), ".xml")
URDF = Format(BODY, write_urdf, ())
ROSBAG = Format(JOINTS, write_rosbag, suffix="", earlier=("*.db3", "*.mcap", "metadata.yaml"))
MCAP = Format(JOINTS, write_mcap)
RRD = Format(JOINTS, write_rrd)
EPISODES = Format(ROBOTS, write_lerobot, (*MOTION, "episodes", "instruction"), "", ("data/**/*.parquet", "meta/**/*.*"))


@functools.cache
def list_formats() -> dict[str, Format]:
    """Name → format, ours first."""
    return {name: load_plugin("writers", name) for name in find_plugins("writers")}


class Exported(NamedTuple):
    """What `export` wrote."""

    format: str  # one of `list_formats`
    diagnostics: list[Diagnostic]  # what of the result the format cannot hold


def export(
    result: Result | Sequence[Result],
    file: str | Path,
    format: str | None = None,
    *,
    names: Literal["isb", "opensim"] | None = None,
    rate_hz: float | None = None,
    interval: tuple[float, float] | None = None,
    phase: str | None = None,
    episodes: str | None = None,
    instruction: str | None = None,
    osim_model: str | Path | None = None,
    force: bool = False,
) -> Exported:
    """Write a motion, or the body that moves, to a file for other programs. On an error no part of it is left.

    Parameters
    ----------
    result : TrackResult, Trajectory, str or Path, or several
        A person's motion: what `track` or `load_result` gives, or a result folder. A robot's: what `retarget` gives, or
        a folder that `wepose retarget` wrote. Several only for "lerobot", which makes episodes of them.
    file : str or Path
        The file to write; of "lerobot" and "rosbag" the folder.
    format : str, optional
        Write this format instead of that of the suffix. Of a person: csv, parquet (pose and joint angles), mot (joint
        angles for OpenSim), sto (orientations for OpenSense), placement (of OpenSim's IMU Placer), scale (of OpenSim's
        Scale Tool, .xml), trc, c3d, bvh. Of a person or a robot: rosbag (for ROS 2, in a folder), mcap, rrd (for
        rerun), urdf. Of robots: lerobot (a data set of episodes, in a folder; joints in rad). Plug-ins may add others.
    names : "isb" or "opensim", optional
        Only for .mot: write only the joint angles of the International Society of Biomechanics (isb), or only the
        coordinates of OpenSim's Rajagopal model (opensim). Without it both, the ISB's first.
    rate_hz : float, optional
        Resample the motion at this rate.
    interval : (float, float), optional
        Use only this time of the recording, from and to in seconds.
    phase : str, optional
        Use only this phase of the recording. If it has several intervals, NAME:2 is the second one.
    episodes : str, optional
        Only for lerobot: make each interval of this phase of the recording an episode. Without it each result is one.
    instruction : str, optional
        Only for lerobot: describe what the robot does by this text. Without it "follow" and the name of the recording.
    osim_model : str or Path, optional
        Only for .sto and scale: name this model in the set-up files that are written; with .sto, these are OpenSim's
        IMU Placer and IMU Inverse Kinematics. Without it, scale names Rajagopal_2015.osim.
    force : bool
        Replace an existing file, or a data set of the same format.

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
    results, file = [result] if isinstance(result, Result) else list(result), Path(file)
    name, formats = _choose_format(file, format), list_formats()
    kind = formats[name]
    stated: dict[str, Any] = {"names": names, "rate_hz": rate_hz, "interval": interval, "phase": phase}
    stated |= {"episodes": episodes, "instruction": instruction, "osim_model": osim_model}
    own = {option: value for option, value in stated.items() if value is not None}
    for option, value in own.items():
        if option not in kind.options:
            having = " and ".join(each for each, other in formats.items() if option in other.options)
            reason = "there is no motion in it" if option in MOTION else f"only of format {having}"
            raise BadOption(f"`{option}` {value}: not of format {name}; {reason}")
    if rate_hz is not None:
        check_rate(rate_hz)
    if len(results) != 1 and kind.of != ROBOTS:
        raise BadOption(f"`format` {name}: a file of {len(results)} results; only lerobot takes several, as episodes")
    own = {option: value for option, value in own.items() if option not in MOTION}
    with contextlib.ExitStack() as files:
        whole = whole_folder(file, force, kind.earlier) if kind.earlier else whole_file(file, force)
        partial = files.enter_context(whole)
        motions = [] if kind.of == BODY else [_read_motion(each, name, interval, phase, rate_hz) for each in results]
        if name == "sto" and own:
            model = str(own.pop("osim_model"))
            write_setups(file, motions[0], model, lambda path: files.enter_context(whole_file(path, force)))
        source = results[0] if kind.of == BODY else motions if kind.of == ROBOTS else motions[0]
        return Exported(name, kind.write(partial, source, **own) or [])


def _is_of_robot(result: Result) -> bool:
    if isinstance(result, str | Path):
        return (Path(result) / TRAJECTORY).is_file()
    return isinstance(result, HasJointMotion)


def _read_motion(
    result: Result, format: str, interval: tuple[float, float] | None, phase: str | None, rate_hz: float | None
) -> Any:
    """Read the selected part of a motion, resampled: a `TrackResult` for formats of a person, or `JointMotion`."""
    of = list_formats()[format].of
    if _is_of_robot(result):
        if of == PERSON:
            others = ", ".join(each for each, other in list_formats().items() if other.of != PERSON)
            raise BadOption(f"`format` {format}: {result} is a robot's trajectory, for {others}")
        robot = result.joint_motion() if isinstance(result, HasJointMotion) else read_joint_motion(Path(str(result)))
        robot = robot.select(interval, phase)
        return robot if rate_hz is None else robot.resample(rate_hz)
    if of == ROBOTS:
        raise BadOption(f"`format` {format}: is of robots, as `wepose retarget` writes them; {result} is none")
    motion = result if isinstance(result, TrackResult) else load_result(Path(str(result)))
    motion = replace(motion, pose=select_pose(motion, interval, phase))
    if len(motion.time) < 2:
        raise BadData(f"{motion.where}: a pose of {len(motion.time)} samples; a motion has at least 2")
    motion = motion if rate_hz is None else resample(motion, rate_hz)
    return motion if of == PERSON else convert_person(motion)


def _choose_format(file: Path, name: str | None) -> str:
    formats, suffix = list_formats(), file.suffix.lower()
    if name is None and suffix.removeprefix(".") not in formats:
        raise BadOption(f"{file}: '{suffix}' is no format's suffix; state it by `format`; {one_of(formats)}")
    name = name or suffix.removeprefix(".")
    if name not in formats:
        raise BadOption(f"`format` {name}: not known; {one_of(formats, name)}")
    needed = f".{name}" if formats[name].suffix is None else formats[name].suffix
    if not needed and suffix.removeprefix(".") in (*formats, "bag", "db3"):  # readers would take it for a file
        raise BadOption(f"{file}: format {name} is a folder; name it {file.stem}")
    if needed and suffix != needed:
        raise BadOption(f"{file}: format {name} is for programs that go by the suffix: name it {file.stem}{needed}")
    return name
