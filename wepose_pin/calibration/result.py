"""`Calibration`: the result of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..diagnostics import Diagnostic
from ..model import BodyModel
from ..subject import Subject
from .anatomy import LabelCheck, LimbMotion, measure_limbs
from .conditions import Constraint, StartPose
from .weights import MIN_CONTACT, MeasuredLength


@dataclass(frozen=True)
class Calibration:
    """The estimates of a calibration; n samples are those of the least squares.

    Parameters
    ----------
    subject : lengths and mounts with their joint covariance
    prior : what was known before
    rms_gap : palm-to-palm residual [m], root mean square of its length, where the palms touch
    prior_rms_gap : the same with the prior's lengths
    effective_sample_size : effective sample size of the gap
    measured : the measured lengths [m]; empty: the scale is the prior's
    scale_std : relative standard deviation of the overall scale, with the proportions as estimated
    diagnostics : what the user should know besides its quality, see `assess`
    time, gap, prior_gap : (n,) [s], (n,) [m] the residual's length at each sample, and with the prior's lengths
    contact : (n,) the weight of each sample's gap, near 0 where the palms are apart
    start_pose_offset : segment → (2,) [rad] about x and y of W, how far it was off the start pose
    heading_drift : segment → [rad/s] of its sensor's heading
    hinge_axes : joint → (3,) its axis in the frame of the segment above, unit length
    hinge_rms : joint → [rad] of the segment below against the plane of that hinge
    information_shares : name as in the subject's covariance, or ``left_forearm + left_hand`` → (n,) share of the
        information on it that each sample brings; their sum and the prior's share make 1
    prior_covariance : (k, k) before the motion, in the order of the subject's
    quat_WL : segment → (n, 4) xyzw at each sample, as tracking gives it
    protocol : its name
    closure : the kind of its closure, as in `protocols.KINDS`; empty where it has none
    measured_example : the length that would fix the scale best, as ``name=metres``
    measured_lengths : each measured length beside what is known without it
    labels : whether the sensors sit where the session says
    unused_mounts : stated mounts that gravity or the motion contradicts
    scale_lengths : measured lengths that fix the scale; empty: the prior does
    model, start_pose, conditions : the body, its links in the start pose, and the protocol's conditions on it
    formulation : "full" or "paper"
    """

    subject: Subject
    prior: Subject
    model: BodyModel
    start_pose: StartPose
    conditions: tuple[Constraint, ...]
    rms_gap: float
    prior_rms_gap: float
    effective_sample_size: float
    measured: Mapping[str, float]
    scale_std: float
    diagnostics: tuple[Diagnostic, ...]
    time: np.ndarray
    gap: np.ndarray
    prior_gap: np.ndarray
    contact: np.ndarray
    start_pose_offset: Mapping[str, np.ndarray]
    heading_drift: Mapping[str, float]
    hinge_axes: Mapping[str, np.ndarray]
    hinge_rms: Mapping[str, float]
    information_shares: Mapping[str, np.ndarray] = field(default_factory=dict)
    prior_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    quat_WL: Mapping[str, np.ndarray] = field(default_factory=dict)
    protocol: str = "clasp"
    closure: str = "coincide"
    measured_example: str = ""
    measured_lengths: Mapping[str, MeasuredLength] = field(default_factory=dict)
    labels: LabelCheck = field(default_factory=LabelCheck)
    unused_mounts: tuple[Diagnostic, ...] = ()
    scale_lengths: tuple[str, ...] = ()
    formulation: str = "full"

    @property
    def variant(self) -> str:
        """Which words fit: of a mechanism, of the kind of closure, or none without a closure."""
        return "mechanism" if self.model.table.is_mechanism else self.closure

    @property
    def body(self) -> BodyModel:
        """The body with the estimated lengths."""
        return self.subject.shape(self.model)

    def limbs(self) -> LimbMotion:
        """How the limbs moved while the chain was closed."""
        closed = np.isfinite(self.gap)
        rows = closed & (self.contact > MIN_CONTACT) if closed.any() else np.ones(len(self.gap), dtype=bool)
        gap = np.sqrt(np.average(self.gap[closed] ** 2, weights=self.contact[closed])) if closed.any() else 0.0
        quat_WL = {name: quat[rows] for name, quat in self.quat_WL.items()}
        return measure_limbs(self, quat_WL, float(gap))
