"""The shoulder girdle: the centre of the shoulder moves on the trunk as the arm is raised.

A `Girdle` is a part of the body's table: three joints of the URDF that slide along x, y and z of the segment on which
the limb hangs, and follow the direction of the limb by a law. With e the limb's angle off hanging (at most
`MAX_ELEVATION`), s = e / 90° and cos φ the outward part of its direction over sin e:

    up = (a + b cos φ) s        back = c s² + d (1 − exp(−e / ε)) cos φ        middle = (f + g cos φ) s

A person differs from the law by seven parameters: the share by which the law is more or less, and along x, y and z of
that segment [m] a place at rest, and a displacement at 90° that grows with s.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np

from ..compilation import inlined, kernel
from ..documents import Key
from ..recording import AXES
from ..rotations import product

MAX_ELEVATION = np.deg2rad(130.0)  # [rad] up to which the law holds; it stays there beyond
# Of a person: a share of the law, then [m].
PARAMETERS = ("law", "rest_x", "rest_y", "rest_z", "raised_x", "raised_y", "raised_z")
FIXED = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # of shoulders that do not move on the trunk
# s that stands for the limb's elevation where it has no sensor: arms at 50 ± 35° in mixed planes.
MEAN_RAISED = 0.55
_LEAST_SINE = 1e-9  # squared; keeps the slope finite at rest, where the law is below a micrometre

Direction = Annotated[
    tuple[float, float, float], Key(words={name: tuple(map(float, axis)) for name, axis in AXES.items()})
]
SegmentName = Annotated[str, Key(of="segments")]
_Pair = Annotated[tuple[float, float], Key(unit="mm", least=-1e3)]
_Std = Annotated[tuple[float, float, float], Key(unit="mm", least=0.0)]


class Girdle(NamedTuple):
    """How the first point of a limb moves on the segment on which the limb hangs; std: one standard deviation."""

    on: SegmentName  # on which the limb hangs
    moves: SegmentName  # with which the limb begins
    joints: tuple[str, str, str]  # of the URDF, which slide along x, y and z of `on`
    outward: Direction  # axis of `on` that points away from the body's middle
    up: _Pair  # [m] (a, b) of the law
    middle: _Pair  # [m] (f, g)
    back: _Pair  # [m] (c, d)
    back_angle: Annotated[float, Key(unit="deg", least=0.01)]  # ε [rad]
    scaled_by: Annotated[str, Key(of="lengths")] = ""  # length that scales the law; empty: it is not scaled
    scale: Annotated[float, Key("scale", "m", least=1e-3)] = 1.0  # [m] that length where the law's scale is one
    law_std: Annotated[float, Key(least=0.0)] = 0.0  # of the share by which a person's law is more or less
    rest_std: _Std = (0.0, 0.0, 0.0)  # [m] of a person's other parameters
    raised_std: _Std = (0.0, 0.0, 0.0)
    alike: Annotated[float, Key(least=-0.999, most=0.999)] = 0.0  # correlation of both sides' law and place at rest
    residual_std: _Std = (0.0, 0.0, 0.0)  # [m] by which the point leaves law and parameters

    @property
    def law(self) -> tuple[float, ...]:
        """(10,) the numbers of the law: `outward`, `up`, `middle`, `back`, `back_angle`."""
        return (*self.outward, *self.up, *self.middle, *self.back, self.back_angle)

    def find_scale(self, lengths: Mapping[str, float]) -> float:
        """Return the law's scale for a body of these lengths [m]."""
        return lengths[self.scaled_by] / self.scale if self.scaled_by in lengths else 1.0


def make_law(sqrt: Any, arctan2: Any, fmin: Any, exp: Any) -> Any:
    """Make the law of these functions, of numbers or of CasADi's symbols.

    It returns the displacement x, y, z [m] in the frame of `on`, and s, by `Girdle.law`, the limb's unit direction x,
    y, z there, from its first point on, and the scale.
    """

    def law(g, x, y, z, scale):  # type: ignore[no-untyped-def]
        sine = sqrt(x * x + y * y + _LEAST_SINE)
        e = fmin(arctan2(sine, -z), MAX_ELEVATION)
        s, cos_phi = e / (0.5 * np.pi), (x * g[0] + y * g[1] + z * g[2]) / sine
        up, middle = (g[3] + g[4] * cos_phi) * s, (g[5] + g[6] * cos_phi) * s
        back = g[7] * s * s + g[8] * (1.0 - exp(-e / g[9])) * cos_phi
        return scale * (-back - middle * g[0]), -scale * middle * g[1], scale * (up - middle * g[2]), s

    return law


_displace = inlined(make_law(math.sqrt, math.atan2, min, math.exp))


@kernel
def follow_law(quat, on, moves, along, law, scale, own, out):  # type: ignore[no-untyped-def]
    """Write a girdle's displacement (3,) [m], that of the law alone (3,) and s into `out` (n, 7).

    `quat` (n, k, 4) xyzw has the segments in the columns `on` and `moves`; without it, -1, the girdle is at rest.
    `along`, `own` : (3,) the limb in its segment, (7,) what the person differs by
    """
    for i in range(len(quat)):
        dx, dy, dz, s = 0.0, 0.0, 0.0, 0.0
        if moves >= 0:
            a, b = quat[i, on], quat[i, moves]
            x, y, z, w = product(-a[0], -a[1], -a[2], a[3], b[0], b[1], b[2], b[3])
            tx, ty, tz, tw = product(x, y, z, w, along[0], along[1], along[2], 0.0)
            rx, ry, rz, _ = product(tx, ty, tz, tw, -x, -y, -z, w)
            norm = x * x + y * y + z * z + w * w
            dx, dy, dz, s = _displace(law, rx / norm, ry / norm, rz / norm, scale)
        out[i, 0] = (1.0 + own[0]) * dx + own[1] + s * own[4]
        out[i, 1] = (1.0 + own[0]) * dy + own[2] + s * own[5]
        out[i, 2] = (1.0 + own[0]) * dz + own[3] + s * own[6]
        out[i, 3], out[i, 4], out[i, 5], out[i, 6] = dx, dy, dz, s
