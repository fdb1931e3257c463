"""What the sensors measured: SI units, one even time base, sensors named by the segment they are strapped on.

`recording` holds the type and its checks. What a file or a live source gives becomes one in these steps: `clocks` (the
sensors' own times), `gaps` (lost samples), `resampling` (one time base), of a file; `arrivals` of a live source;
`faults` and `plausibility` say whether the sensors measured, by the `limits` of what sensors can.
"""

from .intervals import Intervals, check_phases, check_time, format_time, span_text
from .recording import CONFIGURATION, EACH_TIME, START_POSES, Recording, check, join
from .segments import SEGMENTS
from .sensors import AXES, ImuSensor, OrientationSensor, Sensor, axes_from_mount, mount_from_axes

__all__ = [
    "AXES",
    "CONFIGURATION",
    "EACH_TIME",
    "SEGMENTS",
    "START_POSES",
    "ImuSensor",
    "Intervals",
    "OrientationSensor",
    "Recording",
    "Sensor",
    "axes_from_mount",
    "check",
    "check_phases",
    "check_time",
    "format_time",
    "join",
    "mount_from_axes",
    "span_text",
]
