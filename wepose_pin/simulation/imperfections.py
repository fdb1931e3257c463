"""Imperfections of subject and sensors, each with its size, source and switch."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np

from ..arguments import check_fields, format_settings
from ..errors import BadOption


@dataclass(frozen=True, repr=False)
class Imperfections:
    """Sizes of the imperfections; the defaults are `IDEAL_PRESET`, without any.

    `MILD_PRESET` is a careful subject with sensors strapped well. `PEOPLE_PRESET` has the sizes that the literature
    gives for people; [assumption] marks what it does not give.

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
    tissue_gain : the part of soft-tissue motion that follows the joints, times the literature's size; the gains are
        those of `soft_tissue.GAINS`. People: 1
    tissue_random : its random part, times the size of `soft_tissue.RANDOM_DEG`. People: 1
    breath_deg : pitch of the sensor on the sternum, rms, at about 0.25 Hz. People: 0.7 [assumption: quiet breath]
    creep_deg : random walk of each strap about each axis, after 10 min. People: 1 [assumption]
    strap_slip_deg : a strap slips about the long axis by this much, with probability 0.05 in 10 min. People: 3
        [assumption]
    wobble_deg : [deg per g] across a segment, under acceleration. People: 0.5, from the stiffness of skin (Karlsson &
        Tranberg 1999, Hum Mov Sci 18, 627) for 20 g of sensor
    upper_arm_place, forearm_place : of the sensor, as a share of the segment's length from its upper joint; 0:
        half-way. People: 0.6, 0.85
    girdle : the shoulder's centre follows the arm by the regression of de Groot & Brand 2001, Clin Biomech 16, 735,
        times this. People: 1
    girdle_person : what one shoulder does differently, in proportion to elevation, times (6, 5, 8) mm at 90 deg (the
        spread between people of Matsuki 2011-14, Henninger 2020). People: 1
    girdle_wander : shrugs and reaching, times (7, 4, 8) mm rms. People: 1 [assumption: 3 to 4 deg of girdle]
    girdle_hysteresis : share of elevation by which girdle angles lead while the arm is raised and lag while it is
        lowered. People: 0.03 (Braman 2009, J Shoulder Elbow Surg 18, 960)
    girdle_rest : a person's shoulders at rest, times (18, 12, 13) mm (same sources as girdle_person), correlation 0.7
        between left and right [assumption]. The lengths are those of the mean place: see `girdle`. People: 1
    carrying_angle : of the elbow, times 11.6 (3.2) deg for men and 16.7 (2.6) for women (Van Roy 2005, Ergonomics 48,
        1645), half in the humerus and half in the forearm. People: 1
    elbow_abduction_deg : what else the elbow does beside a hinge, rms over flexion. People: 1.5 [assumption]
    start_pose : offsets of the start pose, times `people.TRUNK_POSE` and `people.ARM_POSE`. People: 1
    start_heading_deg : the torso's heading against W in the start pose, standard deviation. W's x is then where
        the feet point, no longer where the torso faces. People: 4 [assumption]
    sway_tilt_deg : the slow part of a standing person's sway, rms about x and y together. People: 0.22, with which the
        whole sway has 0.3 deg [assumption]
    wrist_flexion_deg, wrist_deviation_deg : of the hands against straight wrists, rms over the clasp; four parts
        follow the distance of the hands from the chest, three wander (as 0.8 : 0.6). People: 12, 8 [assumption]
    gyro_warm_up_deg_s : most change of the bias in the first 15 min, log-uniform from a tenth of it. People: 0.2, a
        sensor that warms by 5 to 10 K under its strap, with data sheets of BMI055, BMI160, ICM-20602, ICM-42688
    clock_drift_ppm : standard deviation of each clock's rate. People: 5, after synchronisation
    accel_average : share of the sample interval, up to the sample, over which the accelerometer averages the specific
        force, as a device with a low-pass filter does; at 1 it is half a sample late. In no preset
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
    tissue_gain: float = 0.0
    tissue_random: float = 0.0
    breath_deg: float = 0.0
    creep_deg: float = 0.0  # per sqrt(10 min)
    strap_slip_deg: float = 0.0
    wobble_deg: float = 0.0  # per g
    upper_arm_place: float = 0.0
    forearm_place: float = 0.0
    girdle: float = 0.0
    girdle_person: float = 0.0
    girdle_wander: float = 0.0
    girdle_hysteresis: float = 0.0
    girdle_rest: float = 0.0
    carrying_angle: float = 0.0
    elbow_abduction_deg: float = 0.0
    start_pose: float = 0.0
    start_heading_deg: float = 0.0
    sway_tilt_deg: float = 0.0
    wrist_flexion_deg: float = 0.0
    wrist_deviation_deg: float = 0.0
    gyro_warm_up_deg_s: float = 0.0
    clock_drift_ppm: float = 0.0
    accel_average: float = 0.0

    def __repr__(self) -> str:
        return format_settings(self)

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
        for name, end in (("upper_arm_place", "segment"), ("forearm_place", "segment"), ("accel_average", "interval")):
            if getattr(self, name) > 1.0:
                raise BadOption(f"{name} {getattr(self, name)} must be at most 1, the end of the {end}")


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
PEOPLE_PRESET = replace(
    MILD_PRESET,
    soft_tissue_deg=0.0,  # tissue_… replace it
    shoulder_wander=0.0,  # girdle_… replace it
    start_elbow_deg=0.0,  # start_pose replaces these two
    start_segment_deg=0.0,
    palm_slip=0.010,  # [assumption]
    sway_deg_s=0.5,  # 0.5 torso, 0.7 a hanging arm in W [assumption]; the sternum's breath comes on top
    tissue_gain=1.0,
    tissue_random=1.0,
    breath_deg=0.7,
    creep_deg=1.0,
    strap_slip_deg=3.0,
    wobble_deg=0.5,
    upper_arm_place=0.6,
    forearm_place=0.85,
    girdle=1.0,
    girdle_person=1.0,
    girdle_wander=1.0,
    girdle_hysteresis=0.03,
    girdle_rest=1.0,
    carrying_angle=1.0,
    elbow_abduction_deg=1.5,
    start_pose=1.0,
    start_heading_deg=4.0,
    sway_tilt_deg=0.22,
    wrist_flexion_deg=12.0,
    wrist_deviation_deg=8.0,
    gyro_warm_up_deg_s=0.2,
    clock_drift_ppm=5.0,
)
PRESETS = {"ideal": IDEAL_PRESET, "mild": MILD_PRESET, "people": PEOPLE_PRESET}
