"""Motion-BIDS: a dataset of motion as neuroscience shares it, or one more recording in an existing dataset.

Source: Brain Imaging Data Structure, version 1.10, modality-specific files, motion; Jeung et al. 2024, Scientific Data
11:716, doi 10.1038/s41597-024-03559-8. A motion.tsv has no header: its columns are the rows of channels.tsv, in that
order.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from .. import __version__
from ..angles import Angles, diagnose_lock, joint_angles
from ..diagnostics import Diagnostic
from ..documents import whole_folder
from ..errors import BadData, BadOption, ExistingOutput
from ..recording import format_time
from .motion import Motion, diagnose_gaps

BIDS_VERSION = "1.10.0"
TRACKSYS = "imu"
_DESCRIPTION, _PARTICIPANTS = "dataset_description.json", "participants.tsv"
_ENTITIES = ("sub", "ses", "task", "tracksys", "acq", "run")  # in the order of BIDS
_MISSING = "n/a"
_README = """# Motion from wearable inertial sensors

Written by wepose-pin {version}. Orientations (quaternions) and positions are in one frame W: x forward, y left, z up,
its origin midway between the hips, which stay in place. Joint angles are those of the International Society of
Biomechanics. How a column is called and what it holds is in the channels.tsv beside it.
"""
_HEADER = ("name", "component", "type", "tracked_point", "units", "sampling_frequency", "reference_frame")
# That motion.json counts.
_TYPES = ("ACCEL", "ANGACCEL", "GYRO", "JNTANG", "LATENCY", "MAGN", "MISC", "ORNT", "POS", "VEL")
_FRAME = "W"
_EVENTS = {
    "onset": {"Description": "Time from the first sample of motion.tsv", "Units": "s"},
    "duration": {"Description": "Duration of a phase; 0 of what was marked at a moment", "Units": "s"},
    "trial_type": {"Description": "Name of a phase of the recording, or a text that was marked while it ran"},
}


class BidsName(NamedTuple):
    """What a recording is called in a dataset: entity → label, in the order of BIDS."""

    entities: Mapping[str, str]

    @property
    def folder(self) -> str:
        """The folder of its files in the dataset."""
        parts = [f"{entity}-{self.entities[entity]}" for entity in ("sub", "ses") if entity in self.entities]
        return "/".join((*parts, "motion"))

    def stem(self, without: str = "") -> str:
        """The beginning of its files' names."""
        return "_".join(f"{key}-{label}" for key, label in self.entities.items() if key != without)


class Channel(NamedTuple):
    """A column of the motion.tsv."""

    name: str
    component: str
    type: str
    tracked_point: str
    units: str
    values: np.ndarray  # (n,)


class Event(NamedTuple):
    """A row of the events.tsv."""

    onset: float  # [s] from the first sample; negative where a phase began before the part that is written
    duration: float  # [s]; 0 of a marked text
    trial_type: str  # name of the phase, or the text


def parse_bids_name(text: str | None, subject: str, task: str) -> BidsName:
    """The name that a text such as ``sub-01_task-reach_run-2`` gives; what it lacks is of the subject and the task.

    Raises
    ------
    BadOption
        An entity that motion does not have, or a label that is not of letters and digits.
    """
    entities = {"sub": _make_label(subject) or "01", "task": _make_label(task) or "motion", "tracksys": TRACKSYS}
    for pair in text.split("_") if text else ():
        entity, _, label = pair.partition("-")
        if (
            entity not in _ENTITIES
            or not re.fullmatch("[0-9a-zA-Z]+", label)
            or (entity == "run" and not label.isdecimal())
        ):
            raise BadOption(
                f"--bids-name {text}: '{pair}' is no entity with a label of letters and digits; such as "
                f"sub-01_ses-1_task-reach_acq-left_run-2"
            )
        entities[entity] = label
    return BidsName({entity: entities[entity] for entity in _ENTITIES if entity in entities})


def _make_label(text: str) -> str:
    """The letters and digits of a text, the words of which begin with capitals: labels have nothing else."""
    first, *others = re.findall("[0-9a-zA-Z]+", text) or [""]
    return first + "".join(word[0].upper() + word[1:] for word in others)


def write_motion_bids(
    out: Path, motion: Motion, name: BidsName, force: bool = False, provenance: Mapping[str, Any] | None = None
) -> list[Diagnostic]:
    """Write a dataset of one recording, or add the recording to the dataset that is there.

    Raises
    ------
    ExistingOutput
        The dataset has the recording and `force` is not given, or the folder holds other things.
    BadData
        The existing dataset is damaged.
    """
    exists = (out / _DESCRIPTION).is_file()
    stem, folder = name.stem(), Path(name.folder)
    if exists and not force and any((out / folder).glob(f"{stem}_*")):
        raise ExistingOutput(
            f"{out / folder / stem}_motion.tsv: exists; --force replaces it, --bids-name names another"
        )
    participants = _add_participant(out / _PARTICIPANTS, f"sub-{name.entities['sub']}")
    angles = joint_angles(motion.pose)
    channels, events = list(_list_channels(motion, angles)), list_events(motion)
    with whole_folder(out, force or exists) as partial:
        files = partial / folder
        files.mkdir(parents=True)
        columns = {channel.name: channel.values for channel in channels}
        pl.DataFrame(columns).fill_nan(None).write_csv(
            files / f"{stem}_motion.tsv", separator="\t", include_header=False, null_value=_MISSING, float_precision=9
        )
        _write_json(files / f"{stem}_motion.json", _describe(motion, name, channels, provenance))
        rows = ["\t".join(_HEADER), *("\t".join(_channel_row(channel, motion.rate_hz)) for channel in channels)]
        (files / f"{stem}_channels.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        _write_json(files / f"{stem}_channels.json", _describe_channels())
        if events:
            _write_events(files / f"{stem}_events.tsv", events)
            _write_json(files / f"{stem}_events.json", _EVENTS)
        (partial / _PARTICIPANTS).write_text(participants, encoding="utf-8")
        if not exists:
            _write_json(partial / _DESCRIPTION, _describe_dataset(motion))
            (partial / "README.md").write_text(_README.format(version=__version__), encoding="utf-8")
    if not events:  # those of a recording that is replaced
        for ending in ("tsv", "json"):
            (out / folder / f"{stem}_events.{ending}").unlink(missing_ok=True)
    return diagnose_gaps(motion) + diagnose_lock(angles)


def list_events(motion: Motion) -> list[Event]:
    """The phases and marked texts of a recording that lie in the motion, at least in part, in the order of time."""
    begin, end = float(motion.pose.time[0]), float(motion.pose.time[-1])
    spans = [(span, name) for name, intervals in motion.phases.items() for span in intervals]
    spans += [((mark.time, mark.time), mark.text) for mark in motion.marks]
    return [
        Event(first - begin, last - first, " ".join(text.split()) or _MISSING)
        for (first, last), text in sorted(spans)
        if first <= end and last >= begin
    ]


def _write_events(path: Path, events: list[Event]) -> None:
    rows = ["\t".join((*(format_time(seconds, 6) for seconds in event[:2]), event.trial_type)) for event in events]
    path.write_text("\n".join(["\t".join(Event._fields), *rows]) + "\n", encoding="utf-8")


def _list_channels(motion: Motion, angles: Angles) -> Iterator[Channel]:
    """Time, orientations, positions and joint angles of a motion."""
    pose = motion.pose
    yield Channel("latency", _MISSING, "LATENCY", _MISSING, "s", pose.time - pose.time[0])
    for segment, quat_WL in pose.quat_WL.items():
        for k, axis in enumerate("xyzw"):
            yield Channel(f"{segment}_q{axis}", f"quat_{axis}", "ORNT", segment, _MISSING, quat_WL[:, k])
    for point, p_W in pose.points.items():
        for k, axis in enumerate("xyz"):
            yield Channel(f"{point}_{axis}", axis, "POS", point, "m", p_W[:, k])
    for name, joint in angles.joints.items():
        for angle in joint:
            yield Channel(f"{name}_{angle}", _MISSING, "JNTANG", name, "deg", np.degrees(joint[angle]))
        yield Channel(f"{name}_near_lock", _MISSING, "MISC", name, _MISSING, joint.near_lock.astype(int))


def _channel_row(channel: Channel, rate_hz: float) -> tuple[str, ...]:
    frame = _FRAME if channel.type in ("ORNT", "POS") else _MISSING
    return (*channel[:5], f"{rate_hz:g}", frame)


def _describe(
    motion: Motion, name: BidsName, channels: list[Channel], provenance: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The motion.json."""
    time, counts = motion.pose.time, Counter(channel.type for channel in channels)
    described: dict[str, Any] = {
        "TaskName": name.entities["task"],
        "TaskDescription": motion.name,
        "SamplingFrequency": motion.rate_hz,
        "SamplingFrequencyEffective": float(f"{(len(time) - 1) / (time[-1] - time[0]):.9g}"),
        "RecordingDuration": float(time[-1] - time[0]),
        "RecordingType": "continuous",
        "TrackingSystemName": name.entities["tracksys"],
        "SoftwareVersions": f"wepose-pin {__version__}",
        "MissingValues": _MISSING,
        "TrackedPointsCount": len({channel.tracked_point for channel in channels} - {_MISSING}),
        "MotionChannelCount": len(channels),
        **{f"{kind}ChannelCount": counts[kind] for kind in _TYPES},
    }
    if provenance:  # without the user's paths: datasets are shared
        inputs = {name: entry["files"] for name, entry in provenance["inputs"].items()}
        described["Provenance"] = {**provenance, "inputs": inputs}
    return described


def _describe_channels() -> dict[str, Any]:
    """The channels.json."""
    text = (
        "World frame: x forward (where the torso faces in the start pose), y left, z up; origin midway between the hips"
    )
    frame = {"SpatialAxes": "ALS", "RotationRule": "right-hand", "RotationOrder": _MISSING, "Description": text}
    return {"reference_frame": {"Description": "The frame that values are in", "Levels": {_FRAME: frame}}}


def _describe_dataset(motion: Motion) -> dict[str, Any]:
    return {
        "Name": motion.name,
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "raw",
        "GeneratedBy": [{"Name": "wepose-pin", "Version": __version__}],
    }


def _add_participant(path: Path, participant: str) -> str:
    """The text of participants.tsv with a row for a participant, who has one or gets one."""
    try:
        text = path.read_text(encoding="utf-8-sig") if path.is_file() else "participant_id\n"
    except (OSError, UnicodeDecodeError) as error:
        raise BadData(f"{path}: cannot be read: {error}") from error
    lines = [line for line in text.splitlines() if line.strip()]
    header = lines[0].split("\t") if lines else [""]
    if header[0] != "participant_id":
        raise BadData(f"{path}: begins with the column '{header[0][:40]}'; participant_id is needed")
    if participant not in [line.split("\t")[0] for line in lines[1:]]:
        lines.append("\t".join((participant, *[_MISSING] * (len(header) - 1))))
    return "\n".join(lines) + "\n"


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(values, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
