"""The body: a URDF read into a `pin.Model` whose triples of revolute joints are spherical joints, with link lengths.

URDF has no spherical joint (Pinocchio rejects `type="spherical"`), so a body model spells each as three revolute
joints with intersecting orthogonal axes and massless links between them. They are joined here into one
`pin.JointModelSpherical`, whose frame at zero is that of the link it moves; a `floating` joint likewise, since W does
not travel. Other joints stay as they are.

`table` is what stands on a body, and its file; `tree` the joints and lengths, with links by the table's names in our
frames; `body` is what they make (`BodyModel`).
A person's numbers stand in `subject`, the lengths of all people in `table`; `mounts` finds how sensors are mounted
from the start pose. `configuration` solves for joints and points from orientations of segments (`KinematicsSolver`),
which make a `Pose`; `kinematics` has that, places links and points and says how well they are known.
"""

from .body import BodyModel, load_model
from .table import DEFAULT_BODY, ROOT, SEXES, BodyTable, Limb, convert_breadths, list_breadths, load_table
from .urdf import Visual
