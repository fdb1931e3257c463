"""``wepose export``: a result's motion for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from . import Progress, no_progress
from .fields import field_values

if TYPE_CHECKING:
    from ..writers.export import Exported


@dataclass(frozen=True)
class ExportJob:
    """Write the motion of a person or of a robot for other programs: OpenSim, BVH, C3D, LeRobot, ROS 2 and others.

    What each file holds: docs/export.md.

    Parameters
    ----------
    result : RESULT
        Folder that `wepose track` or, of a robot, `wepose retarget` wrote.
    further : RESULT…
        Only for lerobot: further results, which become episodes of the same data set.
    out : FILE
        Write this file. Its suffix selects the format.
    format : FORMAT
        Write this format instead of that of the suffix. Of a person: csv, parquet (pose and joint angles), mot (joint
        angles for OpenSim), sto (orientations for OpenSense), placement (one sample of orientations for OpenSim's IMU
        Placer), scale (set-up of OpenSim's Scale Tool, .xml), trc (points, as markers), c3d (points and rotations of
        segments), bvh (skeleton and motion, for animation). Of a person or a robot: rosbag (for ROS 2, in a folder),
        mcap, rrd (for rerun), urdf. Of robots: lerobot (a data set of episodes, in a folder; joints in rad, not in
        units of LeRobot's drivers).
    names
        Only for .mot: write only the joint angles of the International Society of Biomechanics (isb), or only the
        coordinates of OpenSim's Rajagopal model (opensim). Without it both, the ISB's first.
    rate_hz : HZ
        Resample the motion at this rate.
    interval : FROM TO
        Write only this time of the recording, in seconds.
    phase : NAME
        Write only this phase of the recording. Of a phase with several intervals NAME:2 is the second.
    episodes : PHASE
        Only for lerobot: make each interval of this phase of the recording an episode, or, by the word
        repetitions, each repetition of the movement. Without it each result is an episode.
    instruction : TEXT
        Only for lerobot: the text that says what the robot does, in all episodes. Without it "follow", and the name of
        the recording.
    osim_model : FILE
        Only for .sto and scale. With .sto: write the set-up files of OpenSim's IMU Placer and IMU Inverse Kinematics
        for this model of the subject beside it. With scale: the generic model that is scaled. Without it
        Rajagopal_2015.osim. Only the name is used.
    force
        Replace an existing file.
    """

    result: Path
    out: Path
    further: tuple[Path, ...] = ()
    format: str | None = None
    names: Literal["isb", "opensim"] | None = None
    rate_hz: float | None = None
    interval: tuple[float, float] | None = None
    phase: str | None = None
    episodes: str | None = None
    instruction: str | None = None
    osim_model: Path | None = None
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where the rate or the interval is none."""
        from ..recording import check_selection
        from ..writers.motion import check_rate

        check_selection(self.interval, self.phase)
        if self.rate_hz is not None:
            check_rate(self.rate_hz)


def run_export(job: ExportJob, progress: Progress = no_progress) -> Exported:
    """Write a file, whole or not at all, and its provenance beside it.

    Raises
    ------
    WeposeError
        No result, or an option that the format does not have.
    """
    from ..writers.export import export
    from ..writers.provenance import collect_provenance

    job.check()
    progress("writing", 0.0)
    return export(
        [job.result, *job.further],
        job.out,
        job.format,
        names=job.names,
        rate_hz=job.rate_hz,
        interval=job.interval,
        phase=job.phase,
        episodes=job.episodes,
        instruction=job.instruction,
        osim_model=job.osim_model,
        force=job.force,
        provenance=collect_provenance("export", field_values(job)),
    )
