"""``wepose export``: a result's motion for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from .options import MORE, ExportHz, File, Force, Interval, Name, OutFile, PhaseName, Text, described_by
from .output import print_diagnostics, progress_bar, say


@described_by("writers/export.py:export")
def export(
    result: Path,
    /,
    *further: Path,
    out: OutFile,
    format: Name | None = None,
    rate_hz: ExportHz | None = None,
    interval: Interval | None = None,
    phase: PhaseName | None = None,
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
    """
    from ..writers import export as room

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
        )
    print_diagnostics(written.diagnostics)
    say(f"Written: {out}  ({written.format})")
    return written
