"""Live: samples from a stream → the loop → pose, page, terminal, streams and a recording.

Only what is asked for is loaded: `sources` one file a kind, `page` the browser, `terminal`, `out` other programs.
"""

from __future__ import annotations

from .loop import Ended, LiveLoop, Output
from .session import run_session, wearing_of
from .sources import open_source
from .state import LivePose, SensorStatus, Stage, Status
from .wearing import Wearing, read_wearing

__all__ = [
    "Ended",
    "LiveLoop",
    "LivePose",
    "Output",
    "SensorStatus",
    "Stage",
    "Status",
    "Wearing",
    "open_source",
    "read_wearing",
    "run_session",
    "wearing_of",
]
