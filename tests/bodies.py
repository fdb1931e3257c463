"""Names of the upper body, for tests of it."""

import numpy as np

from wepose_pin.body import load_table
from wepose_pin.body.girdle import PARAMETERS

TABLE = load_table()
SEGMENTS = tuple(TABLE.segments)
LENGTHS = tuple(TABLE.lengths)
POINTS = {name: point.link for name, point in TABLE.points.items()}
# Girdles of a person whose shoulders do not move on the torso, as those of ideal and mild simulated people: no law.
RIGID_SHOULDERS = dict.fromkeys(TABLE.girdles, -np.eye(len(PARAMETERS))[PARAMETERS.index("law")])
