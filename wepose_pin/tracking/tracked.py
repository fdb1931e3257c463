"""`TrackOptions`: how a recording is tracked; `TrackedRecording`: its pose with inputs and intermediate results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..alignment import SegmentOrientations
from ..body.configuration import compute_orientation_residuals
from ..body.kinematics import PosedBody
from ..body.links import find_undetermined_joints
from ..errors import BadOption
from ..filters import BEST, OFFLINE, check_method
from ..filters.static import StaticTest
from ..recording import Intervals, Recording
from .headings import HeadingCorrection


@dataclass(frozen=True)
class TrackOptions:
    """What is chosen for `Tracker`, beside the person and the body model.

    Parameters
    ----------
    method : the orientation filter, a key of `wepose_pin.filters.METHODS`
    static_test : when a sensor counts as static; None: the default values
    open_loop : do not correct heading drift, neither by joint accelerations, hinges and joined hands, nor by the resets
        of a live session: orientations are the filter's from the start pose on
    causal : begin at the end of the start pose and look at nothing ahead, as a live session does
    limits : keep the limits of the model's joints of one axis

    Raises
    ------
    BadOption
        A method that is not known, or that needs the whole recording where `causal` is chosen.
    """

    method: str = BEST
    static_test: StaticTest | None = None
    open_loop: bool = False
    causal: bool = False
    limits: bool = True

    def __post_init__(self) -> None:
        check_method(self.method)
        if self.causal and self.method in OFFLINE:
            raise BadOption(f"method '{self.method}' needs the whole recording; 'amekf' looks at nothing ahead")


@dataclass(frozen=True, repr=False)
class TrackedRecording(PosedBody):
    """The pose of a recording or a chunk, with its inputs and intermediate results.

    Parameters
    ----------
    recording : the input; of a causal tracker the part after the start pose
    correction : of the headings so far; None where nothing can correct them
    """

    recording: Recording
    segments: SegmentOrientations
    options: TrackOptions
    correction: HeadingCorrection | None

    @property
    def phases(self) -> Mapping[str, Intervals]:
        """Name → intervals [s] of the recording."""
        return self.recording.phases

    def orientation_residual(self) -> dict[str, np.ndarray]:
        """Segment → angle (n,) [rad] between its measured orientation and the model's, where joints are too few."""
        return compute_orientation_residuals(self.model, self.q, self.segments.quat_WL)

    def find_undetermined_joints(self) -> list[str]:
        """The joints of a mechanism that the measured segments leave open, at least in part: they move little."""
        if not self.model.table.is_mechanism:
            return []
        return find_undetermined_joints(self.model, self.quat_WL)
