"""A pose as the live page draws it: the placement of each visible link, as bytes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin

from ..kinematics import LiveKinematics, find_known_links
from ..model import BodyModel
from ..report.viewer import visible
from .state import LivePose, StreamInfo


class PoseEncoder:
    """Encodes poses for the page.

    Attributes
    ----------
    links : visible links, in the order of the frames
    newest : the pose to draw; None: the N-pose
    measured : the links that the sensors determine; None before the start
    """

    def __init__(self, model: BodyModel) -> None:
        self.visuals = visible(model.visuals)
        self.links = tuple(dict.fromkeys(visual.link for visual in self.visuals))
        self.newest: LivePose | None = None
        self.measured: MeasuredLinks | None = None
        self._model = model

    def start(self, info: StreamInfo) -> None:
        self.newest = None  # it may be of another stream
        self.measured = MeasuredLinks(self._model, self.links, info)

    def encode(self, pose: LivePose | None) -> bytes:
        """Little endian: time (float64, NaN before the start), of each link R_WL row by row and p_WL (12 float32),
        points whose paths are drawn (3 float32 each), of each link whether its sensor is lost (1 byte). NaN: not known.
        """
        measured = self.measured
        if pose is None or measured is None or len(pose.quat_WL) != len(measured.segments):
            data = pin.Data(self._model.pin)
            pin.framesForwardKinematics(self._model.pin, data, pin.neutral(self._model.pin))
            placements = _stack([data.oMf[self._model.pin.getFrameId(link)] for link in self.links])
            if measured is not None:
                placements[~measured.known] = np.nan
            paths = np.full((len(self._model.table.paths), 3), np.nan)
            return _pack(math.nan, placements, paths, np.zeros(len(self.links), dtype=bool))
        placements, points = measured.place(pose.quat_WL), measured.find_path_points(pose.points)
        return _pack(pose.time, placements, points, measured.lost(pose.lost))


class MeasuredLinks:
    """The visible links of a body of which some segments are measured."""

    def __init__(self, model: BodyModel, links: tuple[str, ...], info: StreamInfo) -> None:
        self.segments = info.segments
        self._kinematics = LiveKinematics(model, info.segments)
        frames = [model.pin.getFrameId(link) for link in links]
        self._views = [self._kinematics.data.oMf[frame] for frame in frames]
        known = set(find_known_links(model, info.segments))
        self.known = np.array([link in known for link in links], dtype=bool)
        self._paths = [info.points.index(point) if point in info.points else -1 for point in model.table.paths]
        moved = {chain.joints[-1]: segment for segment, chain in model.chains.items() if chain.joints}
        self._rows = []  # of each link the sensor that places it; -1: none
        for frame in frames:
            joint = model.pin.frames[frame].parentJoint
            while joint and moved.get(joint) not in info.segments:
                joint = model.pin.parents[joint]
            self._rows.append(info.segments.index(moved[joint]) if joint else -1)

    def place(self, quat_WL: np.ndarray) -> np.ndarray:
        """Placements (m, 12) of the links; NaN where not known."""
        self._kinematics.compute_points(quat_WL)
        placements = _stack(self._views)
        placements[~self.known] = np.nan
        return placements

    def find_path_points(self, points: np.ndarray) -> np.ndarray:
        """Points (p, 3) [m] whose paths are drawn; NaN where not known."""
        return np.array([points[k] if k >= 0 else [np.nan] * 3 for k in self._paths]).reshape(-1, 3)

    def lost(self, lost: np.ndarray) -> np.ndarray:
        """(m,) bool: the sensor that places a link is lost."""
        return np.array([row >= 0 and bool(lost[row]) for row in self._rows], dtype=bool)


def _stack(views: list[Any]) -> np.ndarray:
    """(m, 12): R_WL row by row, p_WL."""
    placements = np.empty((len(views), 12), dtype="<f4")
    for k, view in enumerate(views):
        placements[k, :9] = view.rotation.ravel()
        placements[k, 9:] = view.translation
    return placements


def _pack(time: float, placements: np.ndarray, points: np.ndarray, lost: np.ndarray) -> bytes:
    return np.array(time, "<f8").tobytes() + placements.tobytes() + points.astype("<f4").tobytes() + lost.tobytes()
