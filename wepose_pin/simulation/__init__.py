"""A subject with known truth and the IMU data that its motion gives.

The motion is a closed form of continuous time, so that it is known exactly between the samples as well. That of a
protocol shares no code with the model room: what the tests compare against is written here and nowhere else. That of
an activity of the whole body gives orientations; the model places the segments. Frames
as everywhere: W is z up, x forward, y left, origin at the root of the trunk; each segment frame equals W in
the N-pose; the arm runs along -z.

By default a perfect world: no soft tissue, an exact N-pose, palms that coincide in the clasp, hands that are static on
the table, and sensors with noise and bias only. `Imperfections` add those of real people and sensors.
"""

from .activities import ACTIVITIES as ACTIVITIES
from .imperfections import IDEAL_PRESET as IDEAL_PRESET
from .imperfections import MILD_PRESET as MILD_PRESET
from .imperfections import MTI_3 as MTI_3
from .imperfections import NOISE_FREE as NOISE_FREE
from .imperfections import PEOPLE_PRESET as PEOPLE_PRESET
from .imperfections import PRESETS as PRESETS
from .imperfections import Imperfections as Imperfections
from .imperfections import ImuNoise as ImuNoise
from .motion import CIRCLING_POINT as CIRCLING_POINT
from .people import SIDES as SIDES
from .subject import MEASURED_LENGTHS as MEASURED_LENGTHS
from .subject import MEASURED_STD as MEASURED_STD
from .subject import PEOPLE_MEASURED_STD as PEOPLE_MEASURED_STD
from .subject import Person as Person
from .subject import Simulation as Simulation
from .subject import simulate as simulate
from .subject import simulate_activity as simulate_activity
from .subject import simulate_person as simulate_person
