"""Live tracking: samples of a source → the loop → pose, page, terminal, other programs and a recording.

Outputs load when they are used: `page` for the browser, `terminal`, `outputs` for other programs and robots.
"""

from .loop import LiveLoop as LiveLoop
from .loop import SessionSummary as SessionSummary
from .loop import run_session as run_session
from .setup import SensorSetup as SensorSetup
from .setup import find_setup as find_setup
from .sources import open_source as open_source
from .state import LivePose as LivePose
from .state import Output as Output
from .state import Request as Request
from .state import SensorStatus as SensorStatus
from .state import Status as Status
from .state import StreamInfo as StreamInfo
