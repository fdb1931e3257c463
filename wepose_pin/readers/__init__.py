"""Readers: a session and the files it names give a checked `Recording`; `formats/` describes tables of devices."""

from __future__ import annotations

from pathlib import Path

from ..arguments import check_arguments
from ..recording import Recording
from .live_log import is_live_log, read_live_log
from .session import read_session

__all__ = ["is_live_log", "load_session", "read_live_log"]


def load_session(path: str | Path, gaps: bool = False) -> Recording:
    """Read ``session.toml`` and the data it names, or a recording of `wepose live`.

    Parameters
    ----------
    path : str or Path
        The session file, or its folder; a file of `wepose live --record`.
    gaps : bool
        Accept gaps of more than 50 ms: interpolate them, and mark them as `gap` in the recording and the pose. Without
        it such a gap is an error, except in a live recording.

    Returns
    -------
    Recording
        `time` (n,) [s], evenly spaced, and `sensors`, segment → samples in SI units.

    Raises
    ------
    WeposeError
        With one line that names the file, the key or column, the value found and what would be right.

    Examples
    --------
    >>> recording = wp.load_session("session.toml")
    >>> recording
    Recording('simulated': 22.5 s at 100 Hz, 5 sensors, phases start, clasp, rest)
    >>> recording.sensors["torso"].gyro_S.shape == (len(recording.time), 3)  # [rad/s]
    True
    """
    check_arguments(load_session, locals())
    if is_live_log(Path(path)):
        return read_live_log(Path(path)).recording
    return read_session(Path(path), gaps)
