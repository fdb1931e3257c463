"""Live tracking: samples of a source → the loop → pose, page, terminal, other programs and a recording.

Outputs load when they are used: `page` for the browser, `terminal`, `outputs` for other programs and robots.
"""

from .loop import LiveLoop, SessionSummary, run_session
from .setup import SensorSetup, find_setup
from .sources import open_source
from .state import LivePose, Output, Request, SensorStatus, Status, StreamInfo
