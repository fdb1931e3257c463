"""A subject with known truth and the IMU data that its motion gives.

The motion is a closed form of continuous time, so that it is known exactly between the samples as well. That of a
protocol shares no code with the model room: what the tests compare against is written here and nowhere else. That of
an activity of the whole body gives orientations; the model places the segments. Frames
as everywhere: W is z up, x forward, y left, origin at the root of the trunk; each segment frame equals W in
the N-pose; the arm runs along -z.

By default a perfect world: no soft tissue, an exact N-pose, palms that coincide in the clasp, hands that are static on
the table, and sensors with noise and bias only. `Imperfections` add those of real people and sensors.
"""

from .activities import ACTIVITIES, simulate_activity
from .imperfections import IDEAL_PRESET, MILD_PRESET, PEOPLE_PRESET, PRESETS, Imperfections
from .imu import MTI_3, NOISE_FREE, ImuNoise
from .motion import CIRCLING_POINT, SEGMENTS
from .people import SIDES
from .subject import MEASURED_LENGTHS, MEASURED_STD, PEOPLE_MEASURED_STD, Person, Simulation, simulate, simulate_person

__all__ = [
    "ACTIVITIES",
    "CIRCLING_POINT",
    "IDEAL_PRESET",
    "MEASURED_LENGTHS",
    "MEASURED_STD",
    "MILD_PRESET",
    "MTI_3",
    "NOISE_FREE",
    "PEOPLE_MEASURED_STD",
    "PEOPLE_PRESET",
    "PRESETS",
    "SEGMENTS",
    "SIDES",
    "Imperfections",
    "ImuNoise",
    "Person",
    "Simulation",
    "simulate",
    "simulate_activity",
    "simulate_person",
]
