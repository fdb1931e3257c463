"""``wepose export``: a result's motion for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from .options import MORE, ExportHz, File, Force, Interval, Name, OutFile, Phase, PhaseName, Text
from .output import print_diagnostics, progress_bar, say


def export(
    result: Path,
    /,
    *further: Path,
    out: OutFile,
    format: Name | None = None,
    rate_hz: ExportHz | None = None,
    interval: Interval | None = None,
    phase: Phase | None = None,
    force: Force = False,
    names: Annotated[Literal["isb", "opensim"] | None, MORE] = None,
    osim_model: Annotated[File | None, MORE] = None,
    episodes: Annotated[PhaseName | None, MORE] = None,
    instruction: Annotated[Text | None, MORE] = None,
) -> Any:  # an Exported, whose room loads late
    """Write the motion of a person or of a robot for other programs: OpenSim, BVH, C3D, LeRobot, ROS 2 and others.

    What each file holds: docs/export.md.

    Example: wepose export result -o circles.trc

    Parameters
    ----------
    result
        Folder that `wepose track` or, of a robot, `wepose retarget` wrote.
    further
        Only for lerobot: further results, which become episodes of the same data set.
    out
        Write this file. Its suffix selects the format.
    format
        Write this format instead of that of the suffix. Of a person: csv, parquet (pose and joint angles), mot (joint
        angles for OpenSim), sto (orientations for OpenSense), placement (of OpenSim's IMU Placer), scale (of OpenSim's
        Scale Tool, .xml), trc, c3d, bvh. Of a person or a robot: rosbag (for ROS 2, in a folder), mcap, rrd (for
        rerun), urdf. Of robots: lerobot (a data set of episodes, in a folder; joints in rad).
    rate_hz
        Resample the motion at this rate.
    names
        Only for .mot: write only the joint angles of the International Society of Biomechanics (isb), or only the
        coordinates of OpenSim's Rajagopal model (opensim). Without it both, the ISB's first.
    osim_model
        Only for .sto and scale: name this model in the set-up files that are written, with .sto those of OpenSim's IMU
        Placer and IMU Inverse Kinematics. Without it scale names Rajagopal_2015.osim.
    episodes
        Only for lerobot: make each interval of this phase of the recording an episode, or, by the word repetitions,
        each repetition of the movement. Without it each result is an episode.
    instruction
        Only for lerobot: say what the robot does by this text. Without it "follow", and the name of the recording.
    """
    options = dict(locals())
    from ..writers import export as room
    from ..writers.provenance import collect_provenance

    with progress_bar() as progress:
        progress("writing", 0.0)
        written = room.export(
            [result, *further],
            out,
            format,
            names=names,
            rate_hz=rate_hz,
            interval=interval,
            phase=phase,
            episodes=episodes,
            instruction=instruction,
            osim_model=osim_model,
            force=force,
            provenance=collect_provenance("export", options),
        )
    print_diagnostics(written.diagnostics)
    say(f"Written: {out}  ({written.format})")
    return written
