"""The shoulder girdle of a simulated person: how the shoulder's centre follows the arm."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from .imperfections import Imperfections
from .signals import Process, rotate_about

# Regression of de Groot & Brand 2001 (Clin Biomech 16, 735; 10 people, 23 arm positions), with the rest angles of the
# Delft arm model: constant, slope in the plane of elevation, slope in elevation, gain of the angle at rest, that angle.
# Degrees; right shoulder, x to the right, y up, z backwards; a clavicle turns about y then z, a scapula about y, z, x.
_CLAVICLE = np.array(((-4.983, 0.120, -0.242, 0.851, -28.6), (3.917, -0.046, 0.123, 0.493, 11.7)))
_SCAPULA = np.array(
    ((-1.203, 0.140, -0.049, 0.901, 32.0), (3.095, -0.079, 0.396, 0.414, 10.7), (0.659, -0.028, 0.184, 0.886, -10.3))
)
_CLAVICLE_LENGTH = 0.150  # [m] Bernat 2014 (149 ± 10 mm), of a shoulder width of _WIDTH
_WIDTH = 0.340  # [m] between the shoulder centres of the arm model of Holzbaur 2005
_AC_TO_GH = np.array((0.008, -0.036, 0.003))  # [m] at rest, outer end of the clavicle to the shoulder's centre
_AC_TO_GH_SCAPULA = Rotation.from_euler("YZX", _SCAPULA[:, 4], degrees=True).inv().apply(_AC_TO_GH)
_ONSET_DEG = 15.0  # the regression holds from about 30 deg of elevation: below, its angles grow from those at rest
_PLANE_BLUR = np.sin(np.deg2rad(8.0))  # the plane of a hanging arm has no meaning: it is blurred there
_ROUND = np.deg2rad(3.0)
_PERSON = np.array((0.006, 0.005, 0.008))  # [m] x, y, z in T, at 90 deg: Matsuki 2011-14, Henninger 2020
_WANDER = np.array((0.007, 0.004, 0.008))  # [m] rms, assumption: 3 to 4 deg of girdle
_WANDER_S = 3.0  # its correlation time
_REST = np.array((0.018, 0.012, 0.013))  # [m] between people
_REST_CORRELATION = 0.7  # between left and right, assumption
_HYSTERESIS_RATE = 20.0  # [deg/s] of elevation, over which raising turns into lowering


def compute_girdle(along_T: np.ndarray, side: float, gain: np.ndarray | float = 1.0) -> np.ndarray:
    """Compute the displacement (n, 3) of a shoulder's centre in T from rest, of a clavicle of length 1/0.150 m.

    Parameters
    ----------
    along_T : (n, 3) unit, direction of the upper arm in T
    side : 1 left, -1 right
    gain : (n,) factor on the elevation
    """
    out, forward, up = side * along_T[:, 1], along_T[:, 0], along_T[:, 2]
    horizontal = np.hypot(out, forward)
    elevation = np.rad2deg(np.arctan2(horizontal, -up)) * gain
    # 0 sideways, 90 forwards, from the middle of that range, so that the jump of the angle is behind the body.
    a, b = (out + forward) / np.sqrt(2.0), (forward - out) / np.sqrt(2.0)
    plane = 45.0 + np.rad2deg(2.0 * np.arctan2(b, a + np.sqrt(horizontal**2 + _PLANE_BLUR**2)))
    onset = 1.0 - np.exp(-((elevation / _ONSET_DEG) ** 2))

    def locate(clavicle: np.ndarray, scapula: np.ndarray) -> np.ndarray:
        """Place (n, 3) [m] of the shoulder's centre by the angles (k, n) [deg] of clavicle and scapula."""
        clavicle, scapula = np.deg2rad(clavicle), np.deg2rad(scapula)
        outer_end = rotate_about(1, clavicle[0], rotate_about(2, clavicle[1], np.array((_CLAVICLE_LENGTH, 0.0, 0.0))))
        about_x = rotate_about(0, scapula[2], _AC_TO_GH_SCAPULA)
        return outer_end + rotate_about(1, scapula[0], rotate_about(2, scapula[1], about_x))

    def angles(rows: np.ndarray) -> np.ndarray:
        """Angles (k, n) [deg]."""
        constant, by_plane, by_elevation, by_rest, rest = (column[:, None] for column in rows.T)
        return rest + onset * (constant + by_plane * plane + by_elevation * elevation + (by_rest - 1.0) * rest)

    moved = locate(angles(_CLAVICLE), angles(_SCAPULA)) - locate(_CLAVICLE[:, 4:], _SCAPULA[:, 4:])
    return np.column_stack((-moved[:, 2], side * moved[:, 0], moved[:, 1]))


class SimulatedGirdle:
    """The girdle of one person: regression, own deviation, wandering and rest place.

    The lengths of a simulated person are those of the mean place at rest: `shoulder_width` is the distance of the two
    centres along y, `trunk` their mean height. So the place at rest leaves each shoulder its own x, half of the
    left-right difference in z and a common shift in y.
    """

    def __init__(self, sizes: Imperfections, rngs: Mapping[str, np.random.Generator], shoulder_width: float) -> None:
        self.sizes = sizes
        self.scale = shoulder_width / _WIDTH
        draws = np.clip(rngs["girdle_person"].standard_normal((2, 3)), -2.5, 2.5)
        self.wander = Process(rngs["girdle_wander"], _WANDER_S, 6)
        common, left, right = np.clip(rngs["girdle_rest"].standard_normal((3, 3)), -2.5, 2.5)
        both = [np.sqrt(_REST_CORRELATION) * common + np.sqrt(1.0 - _REST_CORRELATION) * own for own in (left, right)]
        rest = sizes.girdle_rest * _REST * np.array(both)  # y is outwards here
        shift, tilt = 0.5 * (rest[0] - rest[1])[1:]
        rest[:, 1], rest[:, 2] = shift, (tilt, -tilt)
        self.rest = {1.0: rest[0], -1.0: rest[1]}  # y of the side -> (3,) [m] in T
        self.person = {1.0: draws[0], -1.0: draws[1]}

    @property
    def moves(self) -> bool:
        """True where a shoulder is not at its mean place at rest, or does not stay there."""
        sizes = self.sizes
        return any((sizes.girdle, sizes.girdle_person, sizes.girdle_wander, sizes.girdle_rest))

    def displace(self, along_T: np.ndarray, side: float, raising: np.ndarray) -> np.ndarray:
        """Displacement (n, 3) [m] in T of a shoulder by its arm.

        Parameters
        ----------
        along_T : (n, 3) unit, direction of the upper arm in T
        side : 1 left, -1 right
        raising : (n,) rate of elevation [deg/s]
        """
        sizes = self.sizes
        gain = 1.0 + sizes.girdle_hysteresis * np.tanh(raising / _HYSTERESIS_RATE)
        law = sizes.girdle * self.scale * compute_girdle(along_T, side, gain)
        horizontal = np.hypot(along_T[:, 0], along_T[:, 1])
        # An angle from hanging has a kink there: rounded off within a few degrees.
        elevation = np.hypot(np.arctan2(horizontal, -along_T[:, 2]), _ROUND) - _ROUND
        share = elevation / (0.5 * np.pi)
        return law + sizes.girdle_person * share[:, None] * _PERSON * self.person[side]

    def place(self, side: float, moving_time: np.ndarray) -> np.ndarray:
        """Displacement (n, 3) [m] in T of a shoulder whatever its arm does, after that time of motion (n,) [s]."""
        own = slice(0, 3) if side > 0.0 else slice(3, 6)
        return self.rest[side] + self.sizes.girdle_wander * _WANDER * self.wander(moving_time, own)
