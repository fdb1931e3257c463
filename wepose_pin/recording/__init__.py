"""What the sensors measured: SI units, one even time base, sensors named by the segment that they are on.

`recording` holds the type and its checks. What a file or a live source gives becomes one in these steps: `clocks` (the
sensors' own times), `gaps` (lost samples, resampling), of a file; `arrivals` of a live source;
`faults` and `plausibility` say whether the sensors measured, by the `limits` of what sensors can.
"""

from .recording import (
    CONFIGURATION,
    EACH_TIME,
    Intervals,
    Mark,
    Recording,
    check_phases,
    check_recording,
    check_selection,
    check_time,
    format_span,
    format_time,
    join_recordings,
    select_interval,
)
from .sensors import AXES, ImuSensor, OrientationSensor, Sensor, compute_mount, find_mount_axes

__all__ = [
    "AXES",
    "CONFIGURATION",
    "EACH_TIME",
    "ImuSensor",
    "Intervals",
    "Mark",
    "OrientationSensor",
    "Recording",
    "Sensor",
    "check_phases",
    "check_recording",
    "check_selection",
    "check_time",
    "compute_mount",
    "find_mount_axes",
    "format_span",
    "format_time",
    "join_recordings",
    "select_interval",
]
