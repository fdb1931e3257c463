"""`Calibration`: the result of a calibration, and what its quality is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..body.subject import Quality, Subject
from ..diagnostics import Diagnostic, notebook_html, render
from ..recording.gaps import find_runs
from .problem import CalibrationProblem

MIN_CONTACT = 0.1  # weight of a sample's gap below which the palms are apart


class MeasuredLength(NamedTuple):
    """A measured length beside the estimate without it, from the motion, the prior and other measured lengths."""

    metres: float  # [m] as measured
    expected: float  # [m] without it
    std: float  # [m] of that
    measured_std: float  # [m]

    @property
    def deviation(self) -> float:
        """By how many standard deviations the two differ."""
        return abs(self.metres - self.expected) / float(np.hypot(self.std, self.measured_std))


class Check(NamedTuple):
    """One number against its limits, from which on it passes, or is poor, where `passes` is the larger one."""

    diagnostic: Diagnostic  # what is checked: its value, and `passes` as limit
    quality: Quality
    passes: float  # up to which it passes
    poor: float  # up to which it is poor
    cause: Diagnostic | None = None  # the motion that was too small

    @property
    def value(self) -> float:
        """Of the diagnostic; NaN where it has none."""
        return float("nan") if self.diagnostic.value is None else self.diagnostic.value

    @property
    def excess(self) -> float:
        """The ratio of value and limit, above 1 where it does not pass."""
        value, limit = (self.passes, self.value) if self.passes > self.poor else (self.value, self.passes)
        return value / max(limit, 1e-9)


@dataclass(frozen=True)
class CalibrationQuality:
    """The quality of a calibration: its checks, and what the user should know."""

    quality: Quality = "fail"  # the worst of all checks
    checks: tuple[Check, ...] = ()  # all of them, in the order of the results
    reasons: tuple[Diagnostic, ...] = ()  # why it does not pass, the worst first, each followed by its cause
    further: tuple[Diagnostic, ...] = ()  # what else the user should know

    def __repr__(self) -> str:
        failing = sum(check.quality != "pass" for check in self.checks)
        return f"CalibrationQuality({self.quality!r}: {failing} of {len(self.checks)} checks do not pass)"

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """All that a user should know of the calibration."""
        return (*self.reasons, *self.further)


@dataclass(frozen=True)
class Calibration:
    """What `calibrate` returns: the calibrated subject, the quality of the calibration and its diagnostics.

    It prints itself in one line, with what to do first where it does not pass. Most users need `subject`, `quality` and
    `diagnostics`; the rest is for reports. The least squares takes n samples of the recording, about 8 a second. The
    gap is the residual of the closure: the vector between the palms of joined hands, or what another protocol closes.
    """

    problem: CalibrationProblem  # that was solved, without what is not used
    subject: Subject  # calibrated
    effective_sample_size: float  # of the gap
    scale_std: float  # relative standard deviation of the common scale of all lengths
    remarks: tuple[Diagnostic, ...]  # what is worth knowing, without what the quality says
    time: np.ndarray  # (n,) [s] of the samples
    gap: np.ndarray  # (n,) [m] size of the gap as estimated; NaN outside of closures
    prior_gap: np.ndarray  # (n,) [m] the same with the prior's lengths
    contact: np.ndarray  # (n,) weight of each sample's gap, near 0 where the palms are apart
    quat_WL: Mapping[str, np.ndarray]  # segment → (n, 4) xyzw at each sample, as tracking gives it
    measured_lengths: Mapping[str, MeasuredLength]  # beside the estimates without them
    hinge_rms: Mapping[str, float] = field(default_factory=dict)  # joint → [rad] of the segment below off its plane
    exchanged: Mapping[str, str] = field(default_factory=dict)  # segment → label of the sensor on it, where they differ
    posed: Mapping[str, float] = field(default_factory=dict)  # phase of poses → standard deviations off all else
    formulation: str = "full"  # or "paper"
    quality: CalibrationQuality = field(default_factory=CalibrationQuality)

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """What the user should know: the reasons of its quality first, then the remarks."""
        return self.quality.diagnostics

    @property
    def closed(self) -> np.ndarray:
        """(n,) bool: samples of a closure."""
        return np.isfinite(self.gap)

    @property
    def touching(self) -> np.ndarray:
        """(n,) bool: samples at which the palms touch."""
        return self.closed & (self.contact > MIN_CONTACT)

    @property
    def open_intervals(self) -> list[tuple[float, float]]:
        """Intervals [s] in which the palms were apart."""
        runs = find_runs(self.closed & (self.contact < MIN_CONTACT))
        return [(round(float(self.time[a]), 3), round(float(self.time[b - 1]), 3)) for a, b in runs]

    @property
    def rms_gap(self) -> float:
        """[m] root mean square of the gap's length, where the hands are joined; NaN without a closure."""
        return self._average(self.gap)

    @property
    def prior_rms_gap(self) -> float:
        """[m] the same with the prior's lengths."""
        return self._average(self.prior_gap)

    def _average(self, gap: np.ndarray) -> float:
        return float(np.sqrt(np.mean(gap[self.touching] ** 2))) if self.touching.any() else np.nan

    def __repr__(self) -> str:
        stds = [1e3 * std for name in self.subject.lengths if np.isfinite(std := self.subject.std(name))]
        lengths = f"{len(self.subject.lengths)} lengths"
        lengths += f" ± {min(stds):.0f} to {max(stds):.0f} mm" if stds else ""
        remedy = f"; first: {render(self.quality.reasons[0]).do}" if self.quality.reasons else ""
        return f"Calibration({self.subject.name!r}: {self.quality.quality}; {lengths}{remedy})"

    def _repr_html_(self) -> str:
        return notebook_html(self, self.diagnostics, [self.subject.lengths_html()])
