"""`Calibration`: the result of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..diagnostics import Diagnostic, notebook_html, render
from ..model import BodyModel
from ..subject import Subject
from .anatomy import LabelCheck, LimbMotion, measure_limbs, measure_rotation
from .conditions import Constraint, Loop, StartPose, choose_variant
from .weights import MIN_CONTACT, MeasuredLength

if TYPE_CHECKING:
    from .quality import CalibrationQuality


@dataclass(frozen=True)
class Calibration:
    """What `calibrate` returns: the calibrated subject, the quality of the calibration and its diagnostics.

    It prints itself in one line, with what to do first where it does not pass. Most users need `subject`, `quality` and
    `diagnostics`; the rest is for reports. The least squares takes n samples of the recording, about 8 a second. The
    gap is the residual of the closure: the vector between the palms of joined hands, or what another protocol closes.

    Parameters
    ----------
    subject : lengths and mounts with their joint covariance; its `quality` is that of the calibration
    prior : the subject before the calibration
    rms_gap : [m] root mean square of the gap's length, where the hands are joined
    prior_rms_gap : the same with the prior's lengths
    effective_sample_size : number of independent samples with as much information as the gaps
    measured : name → measured length [m]; empty: the scale is the prior's
    scale_std : relative standard deviation of the overall scale, with the proportions as estimated
    remarks : diagnostics of the estimation, without those of its quality; `diagnostics` has both
    time : (n,) [s] of the samples
    gap, prior_gap : (n,) [m] length of the gap, as estimated and with the prior's lengths; NaN outside of closures
    contact : (n,) weight of each sample's gap, near 0 where the palms are apart
    start_pose_offset : segment → (2,) [rad] about x and y of W, by which it was off the start pose
    heading_drift : segment → [rad/s] drift of its sensor's heading
    hinge_axes : joint → (3,) its axis in the frame of the segment above, unit length
    hinge_rms : joint → [rad] rms angle of the segment below to the plane across that axis
    information_shares : name as in the subject's covariance, or ``left_forearm + left_hand`` → (n,) share of the
        information on it that each sample brings; their sum and the prior's share make 1
    prior_covariance : (k, k) before the motion, rows as `subject.order`
    quat_WL : segment → (n, 4) xyzw at each sample, as tracking gives it
    protocol : its name
    closure : the kind of its closure, "coincide" for joined hands; empty where it has none
    measured_example : the length that would fix the scale best, as ``name=metres``
    measured_lengths : name → measured length beside the estimate without it
    labels : the check that each sensor is on the segment that the session states
    posed : phase of poses → by how many standard deviations it deviates from what is known without it; where no
        closure tells which of them is wrong
    unused_mounts : diagnostics of stated mounts that gravity or the motion contradicts
    scale_lengths : names of the measured lengths that fix the scale; empty: the prior does
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
    remarks: tuple[Diagnostic, ...]
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
    posed: Mapping[str, float] = field(default_factory=dict)
    unused_mounts: tuple[Diagnostic, ...] = ()
    scale_lengths: tuple[str, ...] = ()
    formulation: str = "full"

    @cached_property
    def quality(self) -> CalibrationQuality:
        """The quality, `quality.quality` "pass", "poor" or "fail", with all checks and reasons."""
        from .quality import assess

        return assess(self)

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """What the user should know: the reasons of its quality first, then the remarks."""
        return self.quality.diagnostics

    def state_quality(self) -> Calibration:
        """Return the same calibration with a subject that states its quality."""
        return replace(self, subject=replace(self.subject, quality=self.quality.quality))

    def __repr__(self) -> str:
        stds = [1e3 * std for name in self.subject.lengths if np.isfinite(std := self.subject.std(name))]
        lengths = f"{len(self.subject.lengths)} lengths"
        lengths += f" ± {min(stds):.0f} to {max(stds):.0f} mm" if stds else ""
        remedy = f"; first: {render(self.quality.reasons[0]).do}" if self.quality.reasons else ""
        return f"Calibration({self.subject.name!r}: {self.quality.quality}; {lengths}{remedy})"

    def _repr_html_(self) -> str:
        return notebook_html(self, self.diagnostics, [self.subject.lengths_html()])

    @property
    def variant(self) -> str:
        """The variant of texts about it: the kind of its closure, or "general"; empty without a closure."""
        table = self.model.table
        variants = {choose_variant(each.closure, table) for each in self.conditions if isinstance(each, Loop)}
        return "general" if table.is_mechanism or "general" in variants else self.closure

    @property
    def body(self) -> BodyModel:
        """The body with the estimated lengths."""
        return self.subject.shape(self.model)

    @property
    def rotation(self) -> float:
        """How far the segments turned [rad] while the closure held; NaN without one."""
        closed = np.isfinite(self.gap)
        return measure_rotation({name: quat[closed] for name, quat in self.quat_WL.items()}) if closed.any() else np.nan

    def limbs(self) -> LimbMotion:
        """Return how the limbs moved while the closure held; without a closure, in all samples."""
        closed = np.isfinite(self.gap)
        rows = closed & (self.contact > MIN_CONTACT) if closed.any() else np.ones(len(self.gap), dtype=bool)
        gap = np.sqrt(np.average(self.gap[closed] ** 2, weights=self.contact[closed])) if closed.any() else 0.0
        quat_WL = {name: quat[rows] for name, quat in self.quat_WL.items()}
        return measure_limbs(self, quat_WL, float(gap))
