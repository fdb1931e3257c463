"""Any kinematic chain, a robot's arm say: sensors on links of a URDF → configuration.

The chain stands still in a configuration that is known, as a person does in the N-pose. Seen from there a link's frame
that equals W in that configuration is a segment's, and everything before this room holds for it: `mount` says which of
the sensor's axes points up and which along W's x there, gravity corrects its tilt, and what the start pose leaves open
is the turn about the vertical. That turn is where the chain helps: turned wrongly, the links' motion is none that the
joints can make. The turns that leave the least are found together with the configuration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from .. import so3
from ..alignment import Segments, segment_orientations
from ..errors import BadOption, BadSession, one_of
from ..filters import BEST
from ..model.fit import fit, unseen
from ..model.robot import joint_values, start_configuration
from ..recording import CONFIGURATION, Recording
from ..static import StaticTest

# A mount that is stated by its axes, squarely put on by hand, may be turned by this about the vertical [rad].
TURN_STD = np.deg2rad(10.0)
# What is left over a motion for other reasons [rad]: a link that flexes, a filter that drifts.
LEFT_STD = np.deg2rad(2.0)
_LOOKED_AT = 200  # frames from which the turns are found


@dataclass(frozen=True)
class TrackedChain:
    """A chain's motion.

    Parameters
    ----------
    time : (n,) [s]
    q : (n, nq) configuration of `model`
    quat_WL : link → (n, 4) xyzw as measured
    missed : link → (n,) [rad], angle between what was measured and the model
    segment_cov : link → (n, 3, 3) [rad²], error of `quat_WL` on the left, in W
    turned : link → [rad] by which its mount was turned about the vertical
    open : joints that the known links leave undetermined, at least in part: they move as little as they can
    """

    time: np.ndarray
    q: np.ndarray
    quat_WL: Mapping[str, np.ndarray]
    missed: Mapping[str, np.ndarray]
    segment_cov: Mapping[str, np.ndarray]
    turned: Mapping[str, float]
    open: tuple[str, ...]
    model: pin.Model
    recording: Recording
    segments: Segments
    method: str

    @property
    def joints(self) -> dict[str, np.ndarray]:
        """Joint → its value (n,) [rad or m]."""
        return joint_values(self.model, self.q)

    def orientations(self) -> dict[str, np.ndarray]:
        """Link → (n, 4) xyzw, as the model has it in `q`."""
        return _orientations(self.model, self.q, list(self.quat_WL))

    def summary(self) -> dict[str, Any]:
        """For ``summary.json``."""
        left = f"{', '.join(self.open)}: the links with sensors do not determine these joints; read them as one motion"
        return {
            "recording": self.recording.name,
            "session": str(self.recording.source) if self.recording.source else None,
            "method": self.method if self.segments.orientation else "ready orientations",
            "model": self.model.name,
            "samples": len(self.time),
            "rate_hz": round(self.recording.rate_hz, 4),
            "duration_s": round(float(self.time[-1] - self.time[0]), 3),
            "phases": {"start": list(self.segments.start), "still": list(self.segments.still)},
            "start": dict(self.recording.joints),
            "not_followed_rms_deg": {
                link: round(float(np.degrees(np.sqrt(np.mean(angle**2)))), 3) for link, angle in self.missed.items()
            },
            "mounts_turned_deg": {link: round(float(np.degrees(turn)), 3) for link, turn in self.turned.items()},
            "joints_left_open": list(self.open),
            "warnings": [*self.segments.warnings, *([left] if self.open else [])],
        }


def track_chain(
    recording: Recording,
    model: pin.Model,
    *,
    method: str = BEST,
    static_test: StaticTest | None = None,
    limits: bool = True,
    turn_mounts: bool = True,
) -> TrackedChain:
    """The motion of a chain whose links bear the sensors.

    Parameters
    ----------
    recording : with `start_pose` "configuration"; its sensors are named by links of the model
    model : `load_robot`; its universe is W, z up
    limits : keep the limits of joints
    turn_mounts : find by how much each mount, as it is stated, has to be turned about the vertical

    Raises
    ------
    WeposeError
        Another start pose; a link or joint that the model does not have; as `segment_orientations`.
    """
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
    segments = segment_orientations(recording, method=method, static_test=static_test)

    at_start = {link: Rotation.from_quat(quat[0]) for link, quat in _orientations(model, q_start[None], links).items()}
    since = {link: Rotation.from_quat(quat) for link, quat in segments.quat_WL.items()}
    joints = range(1, model.njoints)

    def turned_by(turns: np.ndarray, rows: np.ndarray | slice) -> dict[str, np.ndarray]:
        found = {}
        for (link, R), turn in zip(since.items(), turns, strict=True):
            Rz = Rotation.from_rotvec([0.0, 0.0, turn])
            found[link] = (Rz * R[rows] * (Rz.inv() * at_start[link])).as_quat()
        return found

    turns = np.zeros(len(since))
    if turn_mounts:
        rows = np.unique(np.linspace(0, len(recording) - 1, _LOOKED_AT).astype(int))

        def left(turns: np.ndarray) -> np.ndarray:
            wanted = turned_by(turns, rows)
            q = fit(model, wanted, joints, q_start[None], limits=limits)
            stands = _orientations(model, q, list(wanted))
            e = [so3.log(_between(stands[link], wanted[link])) for link in wanted]
            return np.concatenate([np.concatenate(e).ravel() / LEFT_STD / np.sqrt(len(rows)), turns / TURN_STD])

        turns = least_squares(left, turns, diff_step=1e-3, x_scale=TURN_STD, xtol=1e-5, ftol=1e-6).x
    quat_WL = turned_by(turns, slice(None))
    q = fit(model, quat_WL, joints, q_start[None], limits=limits)
    stands = _orientations(model, q, list(quat_WL))
    missed = {
        link: np.linalg.norm(so3.log(_between(stands[link], quat)), axis=1) for link, quat in quat_WL.items()
    }
    return TrackedChain(
        recording.time,
        q,
        {link: so3.continuous(quat) for link, quat in quat_WL.items()},
        missed,
        segments.covariance_W,
        dict(zip(since, turns.tolist(), strict=True)),
        tuple(unseen(model, list(quat_WL), q[len(q) // 2])),
        model,
        recording,
        segments,
        method,
    )


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (Rotation.from_quat(a).inv() * Rotation.from_quat(b)).as_quat()


def _orientations(model: pin.Model, q: np.ndarray, links: list[str]) -> dict[str, np.ndarray]:
    data = model.createData()
    frames = [model.getFrameId(link) for link in links]
    R = np.empty((len(q), len(links), 3, 3))
    for k, row in enumerate(q):
        pin.framesForwardKinematics(model, data, row)
        for i, frame in enumerate(frames):
            R[k, i] = data.oMf[frame].rotation
    return {link: so3.continuous(Rotation.from_matrix(R[:, i]).as_quat()) for i, link in enumerate(links)}
