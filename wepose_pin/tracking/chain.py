"""Any kinematic chain, a robot's arm say: sensors on links of a URDF → configuration.

The chain is static in a known configuration, as a person is in the N-pose. A link's frame
that equals W in that configuration is a segment's, so that alignment works as for a person: `mount` states which of the
sensor's axes points up and which along W's x there, and gravity corrects its tilt. The fit over all links removes
rotations that the joints cannot make: on a robot's arm that is most of the filters' error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from .. import rotations
from ..alignment import SegmentOrientations
from ..arguments import check_arguments
from ..diagnostics import WARNING, Diagnostic, as_json
from ..errors import BadOption, BadSession, one_of
from ..filters import BEST, check_method
from ..filters.static import StaticTest
from ..model.fit import find_undetermined_joints, fit
from ..model.robot import joint_values, start_configuration
from ..recording import CONFIGURATION, Recording
from .segments import estimate_segments


@dataclass(frozen=True)
class TrackedChain:
    """A chain's motion.

    Parameters
    ----------
    time : (n,) [s]
    q : (n, nq) configuration of `model`
    quat_WL : link → (n, 4) xyzw as measured
    residual : link → (n,) [rad], angle between what was measured and the model
    segment_cov : link → (n, 3, 3) [rad²], error of `quat_WL` on the left, in W
    open : joints that the known links leave undetermined, at least in part: they move as little as they can
    """

    time: np.ndarray
    q: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    residual: Mapping[str, np.ndarray]
    segment_cov: Mapping[str, np.ndarray]
    open: tuple[str, ...]
    model: pin.Model
    recording: Recording
    segments: SegmentOrientations
    method: str

    @property
    def joints(self) -> dict[str, np.ndarray]:
        """Joint → its value (n,) [rad or m]."""
        return joint_values(self.model, self.q)

    def orientations(self) -> dict[str, np.ndarray]:
        """Link → (n, 4) xyzw, as the model has it in `q`."""
        return _orientations(self.model, self.q, list(self.quat_WL))

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """What the user should know."""
        if not self.open:
            return self.segments.diagnostics
        undetermined = Diagnostic("joints-undetermined", WARNING, facts={"joints": ", ".join(self.open)})
        return (*self.segments.diagnostics, undetermined)

    def summary(self) -> dict[str, Any]:
        """For ``summary.json``."""
        return {
            "recording": self.recording.name,
            "session": str(self.recording.source) if self.recording.source else None,
            "method": self.method if self.segments.orientation else "measured orientations",
            "model": self.model.name,
            "samples": len(self.time),
            "rate_hz": round(self.recording.rate_hz, 4),
            "duration_s": round(float(self.time[-1] - self.time[0]), 3),
            "phases": {"start": list(self.segments.start), "static": list(self.segments.static_phase)},
            "start": dict(self.recording.joints),
            "orientation_residual_rms_deg": {
                link: round(float(np.degrees(np.sqrt(np.mean(angle**2)))), 3) for link, angle in self.residual.items()
            },
            "joints_left_open": list(self.open),
            "diagnostics": [as_json(diagnostic) for diagnostic in self.diagnostics],
        }


def track_chain(
    recording: Recording,
    model: pin.Model,
    *,
    method: str = BEST,
    static_test: StaticTest | None = None,
    limits: bool = True,
) -> TrackedChain:
    """The motion of a chain whose links bear the sensors.

    Parameters
    ----------
    recording : with `start_pose` "configuration"; its sensors are named by links of the model
    model : `load_robot`; its universe is W, z up
    limits : keep the limits of joints

    Raises
    ------
    WeposeError
        Another start pose; a link or joint that the model does not have; as `estimate_segments`.
    """
    check_arguments(track_chain, locals())
    check_method(method)
    where = recording.where()
    if recording.start_pose != CONFIGURATION:
        raise BadOption(f'{where}: start_pose = "{recording.start_pose}" is a person\'s; "{CONFIGURATION}" is needed')
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    for link, sensor in recording.sensors.items():
        if link not in links:
            raise BadSession(f"{where}: sensors.{link} is no link of {model.name}; {one_of(links, link)}")
        if sensor.aligned:
            raise BadSession(f"{where}: sensors.{link}.aligned is for a person's segments; leave it out")
    q_start = start_configuration(model, recording.joints, where)
    segments = estimate_segments(recording, method=method, static_test=static_test)

    at_start = {link: Rotation.from_quat(quat[0]) for link, quat in _orientations(model, q_start[None], links).items()}
    quat_WL = {link: (Rotation.from_quat(quat) * at_start[link]).as_quat() for link, quat in segments.quat_WL.items()}
    q = fit(model, quat_WL, range(1, model.njoints), q_start[None], limits=limits)
    stands = _orientations(model, q, list(quat_WL))
    residual = {
        link: (Rotation.from_quat(stands[link]).inv() * Rotation.from_quat(quat)).magnitude()
        for link, quat in quat_WL.items()
    }
    return TrackedChain(
        recording.time,
        q,
        {link: rotations.unwrap_signs(quat) for link, quat in quat_WL.items()},
        residual,
        segments.covariance_W,
        tuple(find_undetermined_joints(model, list(quat_WL), q[len(q) // 2])),
        model,
        recording,
        segments,
        method,
    )


def _orientations(model: pin.Model, q: np.ndarray, links: list[str]) -> dict[str, np.ndarray]:
    data = model.createData()
    frames = [model.getFrameId(link) for link in links]
    R = np.empty((len(q), len(links), 3, 3))
    for k, row in enumerate(q):
        pin.framesForwardKinematics(model, data, row)
        for i, frame in enumerate(frames):
            R[k, i] = data.oMf[frame].rotation
    return {link: rotations.unwrap_signs(Rotation.from_matrix(R[:, i]).as_quat()) for i, link in enumerate(links)}
