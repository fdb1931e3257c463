"""Names of the upper body, for tests of it."""

from wepose_pin.model import load_table

TABLE = load_table()
SEGMENTS = tuple(TABLE.segments)
LENGTHS = tuple(TABLE.lengths)
POINTS = {name: point.link for name, point in TABLE.points.items()}
