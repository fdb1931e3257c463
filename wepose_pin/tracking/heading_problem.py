"""The problem of the heading filter: what observes the headings of a recording, and the noise of that.

Time is cut into intervals of equal length, the knots. Headings are observed by joints between two sensors, by hinges
and by joined palms (`wepose_pin.observations`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyModel
from ..body.mounts import StartPose, compute_start_heading_var, find_mount_covariance
from ..body.subject import Subject
from ..calibration import load_protocol
from ..errors import BadSession
from ..filters.noise import SensorNoise
from ..observations.expressions import HingePlane, PointPath, find_hinges
from ..observations.joint_accelerations import LEAST_RATE_HZ, JointPair, find_joint_pairs
from ..recording import Recording

CLASP = "clasp"  # the phase in which the palms are joined, and its protocol
REFERENCE_START_STD = np.deg2rad(0.5)  # [rad] of the heading that defines x, at the end of the start pose; assumption
MEASURED_RATE_STD = np.deg2rad(0.1)  # [rad/s] at which a measured orientation drifts about the vertical; assumption
LEAST_MOUNT_VAR = np.deg2rad(0.01) ** 2  # [rad²] of a mount's heading, so that covariances can be inverted
# [s] between knots: causally what a knot observes is corrected by the end of the next one, offline each costs memory.
CAUSAL_KNOT_S, OFFLINE_KNOT_S = 0.5, 2.0
SAMPLE_RATE_HZ = 8.0
# Standard deviation of the delay of an accelerometer against its gyroscope: half a sample, over which it averages, and
# what filters inside the chips differ by [s]; assumption.
AVERAGED_SAMPLES, CHIP_DELAY_STD = 0.5, 0.002


@dataclass(frozen=True)
class HeadingNoise:
    """Standard deviations, power spectral densities and correlation times of the heading filter: those of a person."""

    drift_psd: float = float(np.deg2rad(0.12) ** 2)  # [rad²/s] of a heading in motion: scale errors, soft tissue
    rate_std: float = float(np.deg2rad(0.05))  # [rad/s] at which a heading drifts, apart from its gyroscope's bias
    rate_change_psd: float = float(np.deg2rad(0.1) ** 2 / 900.0)  # [rad²/s³] a sensor warms up under its strap
    # [rad] of the heading by a joint's acceleration: soft tissue and a travelling shoulder follow the motion.
    joint_std: float = float(np.deg2rad(0.5))
    girdle_std: float = float(np.deg2rad(0.9))
    joint_correlation_s: float = 60.0
    acceleration_std: float = 0.07  # [m/s²] least misfit of a joint's accelerations; the recent one where it is larger
    acceleration_correlation_s: float = 0.4
    # [m/s²] fixed in the sensor's frame: the tilt error of an orientation filter in motion, a degree, times gravity.
    force_std: float = float(np.deg2rad(1.0) * 9.81)
    force_correlation_s: float = 20.0
    twist_std: float = float(np.deg2rad(7.0))  # [rad] of a sensor about its segment's long axis by soft tissue
    twist_correlation_s: float = 4.0
    hinge_std: float = float(np.deg2rad(4.0))  # [rad] other errors between a hinge's plane and the segment below
    hinge_correlation_s: float = 5.0
    # [rad] of a calibrated hinge's axis about the long axis of the segment above, and about the direction across both.
    axis_std: float = float(np.deg2rad(5.0))
    tilt_std: float = float(np.deg2rad(2.0))
    range_std: float = float(np.deg2rad(10.0))  # [rad] of the limits of a hinge's range
    closure_correlation_s: float = 20.0


PERSON_NOISE = HeadingNoise()
MECHANISM_NOISE = HeadingNoise(
    rate_std=float(np.deg2rad(0.2)),
    girdle_std=float(np.deg2rad(0.5)),
    twist_std=float(np.deg2rad(0.5)),
    hinge_std=float(np.deg2rad(0.5)),
)


@dataclass(frozen=True)
class HeadingProblem:
    """What observes the headings of a recording, and how well they are known at the start."""

    names: tuple[str, ...]  # k segments with sensors
    model: BodyModel
    subject: Subject
    pairs: tuple[JointPair, ...]  # joints between two sensors
    hinges: tuple[HingePlane, ...]
    # (h, 3) [rad] of each hinge's axis about the long axis of the segment above and across, as in `HeadingNoise`, and
    # of the angle between its plane and the segment below.
    hinge_std: np.ndarray
    palms: PointPath | None  # which the phase `CLASP` joins
    noise: HeadingNoise
    sensor_rate_hz: float
    stride: int  # sensors' samples from one sample of a knot to the next
    samples_per_knot: int
    quat_SL: np.ndarray  # (k, 4) xyzw, from L' to the sensor
    measured: np.ndarray  # (k,) bool: the sensor measures orientations
    drift_psd: np.ndarray  # (k,) [rad²/s] largest growth of a heading's variance apart from that by its rate
    rate_std: np.ndarray  # (k,) [rad/s] at the start: gyroscopes' biases, or drift of measured orientations
    start_var: np.ndarray  # (k,) [rad²] of the headings at the end of the start pose, by the pose
    mount_var: np.ndarray  # (k,) [rad²] the same by the mounts
    delay_std: float  # [s] by which an accelerometer is late against its gyroscope
    causal: bool = False  # headings are corrected as samples come; a short clasp then counts as one observation

    @property
    def knot_s(self) -> float:
        """Length of a knot [s]."""
        return self.samples_per_knot * self.stride / self.sensor_rate_hz

    @property
    def rate_hz(self) -> float:
        """Of a knot's samples."""
        return self.samples_per_knot / self.knot_s


def make_heading_problem(
    recording: Recording,
    quat_LS: Mapping[str, np.ndarray],
    noises: Mapping[str, SensorNoise],
    subject: Subject,
    model: BodyModel,
    *,
    causal: bool,
) -> HeadingProblem | None:
    """Return what observes the headings of these segments, and how well they are known at the start; None: nothing.

    `recording` is the first chunk, or the one that ends with the start pose, `quat_LS` (4,) xyzw the mounts used, and
    `noises` are those of sensors with a filter.
    """
    names, rate_hz = tuple(quat_LS), recording.rate_hz
    noise = MECHANISM_NOISE if model.table.is_mechanism else PERSON_NOISE
    raw = {name: quat for name, quat in quat_LS.items() if name in recording.imus}
    pairs = find_joint_pairs(model, raw) if rate_hz >= LEAST_RATE_HZ else ()
    start = StartPose(model.neutral_rotations)
    # A calibrated axis is relative to the calibrated mounts and holds as long as they do.
    calibrated, hinges, hinge_std = {} if recording.remounted else subject.hinges, [], []
    for plane in find_hinges(model, start, names):
        hinge = model.table.hinges[plane.name]
        if plane.name in calibrated:
            axis, std = start.turn(plane.on, calibrated[plane.name].axis), calibrated[plane.name].std
            hinges.append(plane._replace(axis=axis))
            hinge_std.append((noise.axis_std, noise.tilt_std, max(std, noise.hinge_std)))
        elif not model.table.is_mechanism:
            hinges.append(plane)
            axis_std = float(np.hypot(hinge.common_std, hinge.mirror_std))
            hinge_std.append((axis_std, hinge.tilt_std, max(hinge.softness, noise.hinge_std)))
    [closure] = load_protocol(CLASP).closures
    palms, (left, right) = None, closure.points
    if {left, right} <= set(model.table.points):
        with contextlib.suppress(BadSession):  # the sensors do not tell where they are
            palms = PointPath(model, start, names, ((left, 1.0), (right, -1.0)))
    if not (pairs or hinges or (palms and recording.phases.get(CLASP))):
        return None
    stride = max(1, round(rate_hz / SAMPLE_RATE_HZ))
    drift_psd, rate_std = np.full(len(names), noise.drift_psd), np.full(len(names), MEASURED_RATE_STD)
    for i, name in enumerate(names):
        if name in noises:  # a gyroscope's white noise may be more
            drift_psd[i] = max(noise.drift_psd, float(np.trace(noises[name].gyro_cov)) / (3.0 * rate_hz))
            rate_std[i] = np.sqrt(float(np.trace(noises[name].gyro_bias_cov)) / 3.0)
    start_var, mount_var = np.array([find_start_variances(recording, name, subject, model) for name in names]).T
    neutral = Rotation.from_matrix([model.neutral_rotations[name] for name in names])  # L to L'
    mounts = Rotation.from_quat([quat_LS[name] for name in names])
    return HeadingProblem(
        names,
        model,
        subject,
        pairs,
        tuple(hinges),
        np.array(hinge_std).reshape(-1, 3),
        palms,
        noise,
        sensor_rate_hz=rate_hz,
        stride=stride,
        samples_per_knot=max(1, round((CAUSAL_KNOT_S if causal else OFFLINE_KNOT_S) * rate_hz / stride)),
        quat_SL=(neutral * mounts).inv().as_quat(),
        measured=np.array([name not in raw for name in names]),
        drift_psd=drift_psd,
        rate_std=rate_std,
        start_var=start_var,
        mount_var=mount_var,
        delay_std=AVERAGED_SAMPLES / rate_hz + CHIP_DELAY_STD,
        causal=causal,
    )


def find_start_variances(recording: Recording, segment: str, subject: Subject, model: BodyModel) -> tuple[float, float]:
    """Find the variances [rad²] of a sensor's heading after the start pose: by the pose, and by the mount's heading."""
    table = model.table
    mount_cov = find_mount_covariance(recording, segment, subject)
    mount_var = LEAST_MOUNT_VAR if mount_cov is None else max(float(mount_cov[2, 2]), LEAST_MOUNT_VAR)
    if segment == table.reference:
        return float(REFERENCE_START_STD**2), mount_var
    return compute_start_heading_var(recording, segment, subject, StartPose(table=table)), mount_var
