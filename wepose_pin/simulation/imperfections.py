"""Imperfections of subject and sensors, each with its size, source and switch."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from ..arguments import check_fields
from ..errors import BadOption


@dataclass(frozen=True)
class Imperfections:
    """Sizes of the imperfections; the defaults are `IDEAL_PRESET`, without any, and `MILD_PRESET` has usual sizes.

    An imperfection is off at zero, or a range at infinity. Each has its own stream of random numbers, and the number of
    draws does not depend on the size: a change of one imperfection does not change the draws of the others, of the
    motion, the mounts or the noise.

    Parameters
    ----------
    soft_tissue_deg : the sensor turns on its segment, rms of the whole turn from the clasp to the last rest; an axis
        has 1/√3 of it. Half of the variance follows the movement (specific force and rate of the segment, each axis a
        fixed mixture), half is a wandering that stops when the segments do. Mild: 1.5 deg, an assumption for
        sensors that are strapped well and away from joints and bellies of muscles: of the humerus' axial rotation the
        skin alone loses much more (Cutti et al. 2005, Gait & Posture 21, 341-349)
    palm_slip : [m] palm to palm in the clasp, rms of the vector's length over the clasp, each axis of the torso has
        1/√3 of it; starts and ends at zero. Half each palm. Mild: 8 mm, assumption
    shoulder_wander : [m] of each shoulder's centre in the torso at 90 deg of elevation of the upper arm, in proportion
        to 1 − cos(elevation): up, inwards and a little back, the direction drawn. Mild: 4 mm, assumption, what
        remains beside a mean centre; the girdle's own travel over the whole range is centimetres
    start_elbow_deg : bend of the elbows in the start pose, each drawn around it with a fifth of it as standard
        deviation. Mild: 5 deg, assumption
    start_segment_deg : each arm segment's turn off the start pose, rms of the whole turn. Mild: 1.5 deg,
        assumption
    sway_deg_s : a standing person sways: rms rate, about x and y, of the torso in W and, while it hangs, of each arm
        against the torso, at 0.3 to 0.5 Hz, from before the first sample to the last. Mild: 0.1 deg/s, assumption
    gyro_scale, accel_scale : scale factor's error, standard deviation of each axis, a share. Mild: 0.001, 0.005,
        the non-linearities of the MTi 1-series data sheet taken for scale errors
    misalignment_deg : of each sensing axis towards each other axis, standard deviation, gyroscope and accelerometer
        each its own. Mild: 0.05 deg, alignment error of the MTi 1-series data sheet
    g_sensitivity_deg_s : [deg/s per g] what specific force adds to the gyroscope, standard deviation of each entry of
        the matrix. Mild: 0.001, assumption
    gyro_range_deg_s, accel_range_g : full scale, cut off beyond. Mild: 2000 deg/s, 16 g (MTi-3)
    bits : of a sample over the full scale; 0: not quantised. Mild: 16
    clock_jitter : [s] standard deviation of each sampling time, at most a quarter of a step. The file states the even
        time, as devices do that count samples, so that it stays in the data. Mild: 0.1 ms, assumption
    clock_offset : [s] standard deviation of each sensor's clock against the stated time, unknown to the user as well.
        Mild: 1 ms, assumption, of a wireless set that synchronises itself
    dropped : share of samples that each sensor loses, in runs of up to 50 ms (mean 20 ms, one sample at least).
        Mild: 0.002, assumption
    mount : "stated": within 10 deg of stated axes; "any": uniformly random, nothing stated. Mild: "stated"
    """

    soft_tissue_deg: float = 0.0
    palm_slip: float = 0.0  # [m]
    shoulder_wander: float = 0.0  # [m]
    start_elbow_deg: float = 0.0
    start_segment_deg: float = 0.0
    sway_deg_s: float = 0.0
    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    misalignment_deg: float = 0.0
    g_sensitivity_deg_s: float = 0.0  # per g
    gyro_range_deg_s: float = np.inf
    accel_range_g: float = np.inf
    bits: int = 0
    clock_jitter: float = 0.0  # [s]
    clock_offset: float = 0.0  # [s]
    dropped: float = 0.0
    mount: Literal["stated", "any"] = "stated"

    def __post_init__(self) -> None:
        check_fields(self, "")
        for field in fields(self):
            value = getattr(self, field.name)
            off = np.inf if "range" in field.name else 0.0
            if field.name != "mount" and value != off and not 0.0 < value < np.inf:
                raise BadOption(f"{field.name} {value} must be above 0, or 0 for off (a range: infinity)")
        if self.bits and not np.isfinite([self.gyro_range_deg_s, self.accel_range_g]).all():
            raise BadOption(f"bits {self.bits} need a finite gyro_range_deg_s and accel_range_g")
        if self.dropped > 0.2:
            raise BadOption(f"dropped {self.dropped} must be at most 0.2: runs of 50 ms would meet")


IDEAL_PRESET = Imperfections()
MILD_PRESET = Imperfections(
    soft_tissue_deg=1.5,
    palm_slip=0.008,
    shoulder_wander=0.004,
    start_elbow_deg=5.0,
    start_segment_deg=1.5,
    sway_deg_s=0.1,
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
PRESETS = {"ideal": IDEAL_PRESET, "mild": MILD_PRESET}
