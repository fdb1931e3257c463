"""Imperfections of subject and sensors, each with its size, source and switch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arguments import check_fields
from ..errors import BadOption


@dataclass(frozen=True, repr=False)
class Imperfections:
    """Sizes of the imperfections; the defaults are `IDEAL_PRESET`, without any.

    Those of the body are multiples of what the literature gives for people, so 1 is `PEOPLE_PRESET`; [assumption] marks
    what it does not give. `MILD_PRESET` is the same person at 0.3 of it.

    An imperfection is off at zero, or a range at infinity. Each has its own stream of random numbers, and the number of
    draws does not depend on the size: a change of one imperfection does not change the draws of the others, of the
    motion, the mounts or the noise.

    Parameters
    ----------
    tissue_gain : sensors turn on their segments as the joints turn, by `soft_tissue.GAINS`
    tissue_random : their other turns on the segments: at random while the segment moves (`soft_tissue.RANDOM_DEG`), by
        creep of the strap (1 deg about each axis after 10 min [assumption]) and across the segment under acceleration
        (0.5 deg per g, from the stiffness of skin, Karlsson & Tranberg 1999, Hum Mov Sci 18, 627, for 20 g of sensor)
    sensor_place : sensors sit half-way along a segment at 0, at 0.6 of the upper arm and 0.85 of the forearm at 1
    girdle : the shoulder's centre follows the arm by the regression of de Groot & Brand 2001, Clin Biomech 16, 735;
        shoulders differ from it by (6, 5, 8) mm at 90 deg, wander by (7, 4, 8) mm rms [assumption: 3 to 4 deg of
        girdle] and are at rest (18, 12, 13) mm from their mean place (Matsuki 2011-14, Henninger 2020)
    elbow : carrying angle of 11.6 (3.2) deg for men and 16.7 (2.6) for women (Van Roy 2005, Ergonomics 48, 1645), half
        in the humerus and half in the forearm, and an abduction of 1.5 deg rms over flexion [assumption]
    wrists : bent by 12 deg of flexion and 8 of deviation, rms over the clasp [assumption]
    start_pose : offsets of the start pose, `people.TRUNK_POSE` and `people.ARM_POSE`, and of other poses
    sway : a standing person sways by 0.5 deg/s and 0.22 deg more slowly, rms, a hanging arm against the torso by 0.5
        deg/s [assumption]; breath turns the sensor on the sternum by 0.7 deg rms [assumption]
    palm_slip : [m] palm to palm in the clasp, rms of the vector's length over the clasp, each axis of the torso has
        1/√3 of it; starts and ends at zero. Half each palm. Mild and people: 8 and 10 mm [assumption]
    start_heading_deg : the torso's heading against W in the start pose, standard deviation. W's x is then where
        the feet point, no longer where the torso faces. People: 4 [assumption]
    mount : "stated": within 10 deg of stated axes; "any": uniformly random, nothing stated
    gyro_scale, accel_scale : scale factor's error, standard deviation of each axis, a share. Mild: 0.001, 0.005,
        the non-linearities of the MTi 1-series data sheet taken for scale errors
    misalignment_deg : of each sensing axis towards each other axis, standard deviation, gyroscope and accelerometer
        each its own. Mild: 0.05 deg, alignment error of the MTi 1-series data sheet
    g_sensitivity_deg_s : [deg/s per g] what specific force adds to the gyroscope, standard deviation of each entry of
        the matrix. Mild: 0.001 [assumption]
    gyro_warm_up_deg_s : most change of the bias in the first 15 min, log-uniform from a tenth of it. People: 0.2, a
        sensor that warms by 5 to 10 K under its strap, with data sheets of BMI055, BMI160, ICM-20602, ICM-42688
    gyro_range_deg_s, accel_range_g : full scale, cut off beyond. Mild: 2000 deg/s, 16 g (MTi-3)
    bits : of a sample over the full scale; 0: not quantised. Mild: 16
    clock_jitter : [s] standard deviation of each sampling time, at most a quarter of a step. The file states the even
        time, as devices do that count samples, so that it stays in the data. Mild: 0.1 ms [assumption]
    clock_offset : [s] standard deviation of each sensor's clock against the stated time, unknown to the user as well.
        Mild: 1 ms [assumption], of a wireless set that synchronises itself
    clock_drift_ppm : standard deviation of each clock's rate. People: 5, after synchronisation
    dropped : share of samples that each sensor loses, in runs of up to 50 ms (mean 20 ms, one sample at least).
        Mild: 0.002 [assumption]
    accel_average : share of the sample interval, up to the sample, over which the accelerometer averages the specific
        force, as a device with a low-pass filter does; at 1 it is half a sample late. In no preset
    """

    tissue_gain: float = 0.0
    tissue_random: float = 0.0
    sensor_place: float = 0.0
    girdle: float = 0.0
    elbow: float = 0.0
    wrists: float = 0.0
    start_pose: float = 0.0
    sway: float = 0.0
    palm_slip: float = 0.0  # [m]
    start_heading_deg: float = 0.0
    mount: Literal["stated", "any"] = "stated"
    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    misalignment_deg: float = 0.0
    g_sensitivity_deg_s: float = 0.0  # per g
    gyro_warm_up_deg_s: float = 0.0
    gyro_range_deg_s: float = np.inf
    accel_range_g: float = np.inf
    bits: int = 0
    clock_jitter: float = 0.0  # [s]
    clock_offset: float = 0.0  # [s]
    clock_drift_ppm: float = 0.0
    dropped: float = 0.0
    accel_average: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, "")
        for name, value in vars(self).items():
            off = np.inf if "range" in name else 0.0
            if name != "mount" and value != off and not 0.0 < value < np.inf:
                raise BadOption(f"{name} {value} must be above 0, or 0 for off (a range: infinity)")
        if self.bits and not np.isfinite([self.gyro_range_deg_s, self.accel_range_g]).all():
            raise BadOption(f"bits {self.bits} need a finite gyro_range_deg_s and accel_range_g")
        for name, most in (("dropped", 0.2), ("sensor_place", 1.0), ("accel_average", 1.0)):
            if getattr(self, name) > most:
                raise BadOption(f"{name} {getattr(self, name)} must be at most {most:g}")


_BODY = ("tissue_gain", "tissue_random", "girdle", "elbow", "wrists", "start_pose", "sway")  # of the literature's size
IDEAL_PRESET = Imperfections()
MILD_PRESET = Imperfections(
    **dict.fromkeys(_BODY, 0.3),  # type: ignore[arg-type]
    sensor_place=1.0,
    palm_slip=0.008,
    gyro_scale=0.001,
    accel_scale=0.005,
    misalignment_deg=0.05,
    g_sensitivity_deg_s=0.001,
    gyro_range_deg_s=2000.0,
    accel_range_g=16.0,
    bits=16,
    clock_jitter=0.1e-3,
    clock_offset=1e-3,
    dropped=0.002,
)
PEOPLE_PRESET = replace(
    MILD_PRESET,
    **dict.fromkeys(_BODY, 1.0),  # type: ignore[arg-type]
    palm_slip=0.010,
    start_heading_deg=4.0,
    gyro_warm_up_deg_s=0.2,
    clock_drift_ppm=5.0,
)
PRESETS = {"ideal": IDEAL_PRESET, "mild": MILD_PRESET, "people": PEOPLE_PRESET}
