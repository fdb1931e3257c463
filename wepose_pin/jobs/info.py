"""``wepose info``: what a file is, and a session for it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import BadOption
from . import Progress, no_progress

if TYPE_CHECKING:
    from ..readers.describe import Description


@dataclass(frozen=True)
class InfoJob:
    """Describe a file, its sensors, rates and gaps, and propose a session file for it.

    Prints the description and the proposal; writes nothing without --write or -o. Reads CSV, Parquet, HDF5 and MATLAB;
    Xsens MVNX and text files of MT Manager, Movella DOT, x-IMU3, APDM, Shimmer, Delsys, Noraxon, phones (Sensor Logger,
    phyphox), ROS bags, XDF and OpenSim's orientations, .sto (docs/formats.md); recordings of `wepose live`, sessions,
    subjects and results. Entries of the proposed session that are guesses are marked CHECK.

    Parameters
    ----------
    file : FILE
        A file, or a folder: of one recording, or of files of one sensor each.
    write
        Write the session to session.toml beside the file.
    out : FILE
        Write the session to this file.
    model : URDF|TOML|NAME
        Propose the segments of this body: a URDF, a TOML that names one, or the name of a body of the package, such as
        whole_body (docs/models.md). Without it those of the upper body.
    force
        Replace an existing session.
    """

    file: Path
    write: bool = False
    out: Path | None = None
    model: Path | None = None
    force: bool = False


class InfoOutcome(NamedTuple):
    """What came of an `InfoJob`."""

    description: Description
    session_file: Path  # where the session is written, or would be
    written: bool


def run_info(job: InfoJob, progress: Progress = no_progress) -> InfoOutcome:
    """Describe a file and, where it is asked for, write a session for it, whole or not at all.

    Raises
    ------
    WeposeError
        No such file, or of no kind that is known; a session that exists or cannot be written, or that there is none of.
    """
    from ..documents import check_file, whole_file
    from ..model import load_model
    from ..readers.describe import describe_file, find_file
    from ..readers.propose import Wearer

    progress("reading", 0.0)
    wearer = Wearer(load_model(job.model).table, job.model) if job.model is not None else None
    file = find_file(job.file, wearer)
    session = job.out or file.absolute().parent / "session.toml"
    if job.write or job.out:
        check_file(session, job.force)
    description = describe_file(file, session.absolute().parent, wearer)
    if not (job.write or job.out):
        return InfoOutcome(description, session, False)
    if description.session is None:
        raise BadOption(f"--write: there is no session to write for {description.what}")
    with whole_file(session, job.force) as partial:
        partial.write_text(description.session, encoding="utf-8")
    return InfoOutcome(description, session, True)
