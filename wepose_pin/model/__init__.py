"""The body: a URDF read into a `pin.Model` whose triples of revolute joints are spherical joints, with link lengths.

URDF has no spherical joint (Pinocchio rejects `type="spherical"`), so a body model spells each as three revolute
joints with intersecting orthogonal axes and massless links between them. They are joined here into one
`pin.JointModelSpherical`, whose frame at zero is that of the link it moves; a `floating` joint likewise, since W does
not travel. Other joints stay as they are.

Every body has links named after our segments, in our frames, and `POINTS` are origins of links. A body of others gets
them from a table (`LinkTable`): massless links, fixed to its own.

`tree` reads the joints, `table` names the links, `lengths` measures and stretches, `chains` turns a segment's
orientation into joint values, `visuals` reads the shapes of the links.
"""

from .body import DEFAULT_URDF, BodyModel, load_model
from .chains import Chain, chains
from .table import POINTS, LinkTable, SegmentLink, read_table
from .tree import AxisLimits
from .visuals import Visual

__all__ = [
    "DEFAULT_URDF",
    "POINTS",
    "AxisLimits",
    "BodyModel",
    "Chain",
    "LinkTable",
    "SegmentLink",
    "Visual",
    "chains",
    "load_model",
    "read_table",
]
