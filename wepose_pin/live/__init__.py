"""Live: samples from a stream → the loop → pose, page, terminal, streams and a recording.

Only what is asked for is loaded: `sources` one file a kind, `page` the browser, `terminal`, `out` other programs.
"""

from __future__ import annotations

from .loop import Ended, LiveLoop, Output
from .session import find_setup, run_session
from .setup import SensorSetup, read_setup
from .sources import open_source
from .state import LivePose, SensorStatus, Stage, Status

__all__ = [
    "Ended",
    "LiveLoop",
    "LivePose",
    "Output",
    "SensorSetup",
    "SensorStatus",
    "Stage",
    "Status",
    "find_setup",
    "open_source",
    "read_setup",
    "run_session",
]
