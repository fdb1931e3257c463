"""The body as the live page draws it: a pose → where each link is, as bytes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin

from ..model import BodyModel
from ..model.chains import chains
from ..pose import LiveKinematics, known_links
from ..report.viewer import visible
from .state import LivePose, Stage

HANDS = ("left_hand", "right_hand")


class Figure:
    """The body as a page draws it: a pose → where each link is, as bytes.

    Attributes
    ----------
    links : what can be seen, in the order in which frames hold it
    newest : the pose to draw; None: the N-pose
    staged : what is measured; None: not known yet
    """

    def __init__(self, model: BodyModel) -> None:
        self.visuals = visible(model.visuals)
        self.links = tuple(dict.fromkeys(visual.link for visual in self.visuals))
        self.newest: LivePose | None = None
        self.staged: Staged | None = None
        self._model = model

    def begin(self, stage: Stage) -> None:
        self.newest = None  # it may be of another stage
        self.staged = Staged(self._model, self.links, stage)

    def frame(self, pose: LivePose | None) -> bytes:
        """Little endian: time (float64, NaN before the start), of each link R_WL row by row and p_WL (12 float32),
        both hands (6 float32), of each link whether its sensor is lost (1 byte). NaN: not known.
        """
        stage = self.staged
        if pose is None or stage is None or len(pose.quat_WL) != len(stage.segments):
            data = pin.Data(self._model.pin)
            pin.framesForwardKinematics(self._model.pin, data, pin.neutral(self._model.pin))
            placed = _placed([data.oMf[self._model.pin.getFrameId(link)] for link in self.links])
            if stage is not None:
                placed[~stage.known] = np.nan
            return _packed(math.nan, placed, np.full((2, 3), np.nan), np.zeros(len(self.links), dtype=bool))
        return _packed(pose.time, stage.placed(pose.quat_WL), stage.hands(pose.points), stage.lost(pose.lost))


class Staged:
    """A figure's links once it is known what is measured."""

    def __init__(self, model: BodyModel, links: tuple[str, ...], stage: Stage) -> None:
        self.segments = stage.segments
        self._kinematics = LiveKinematics(model, stage.segments)
        frames = [model.pin.getFrameId(link) for link in links]
        self._views = [self._kinematics.data.oMf[frame] for frame in frames]
        known = set(known_links(model, stage.segments))
        self.known = np.array([link in known for link in links], dtype=bool)
        self._hands = [stage.points.index(hand) if hand in stage.points else -1 for hand in HANDS]
        moved = {chain.joints[-1]: segment for segment, chain in chains(model.pin).items() if chain.joints}
        self._rows = []  # of each link the sensor that places it, −1: none
        for frame in frames:
            joint = model.pin.frames[frame].parentJoint
            while joint and moved.get(joint) not in stage.segments:
                joint = model.pin.parents[joint]
            self._rows.append(stage.segments.index(moved[joint]) if joint else -1)

    def placed(self, quat_WL: np.ndarray) -> np.ndarray:
        """(m, 12)"""
        self._kinematics.points_of(quat_WL)
        placed = _placed(self._views)
        placed[~self.known] = np.nan
        return placed

    def hands(self, points: np.ndarray) -> np.ndarray:
        """(2, 3)"""
        return np.array([points[k] if k >= 0 else [np.nan] * 3 for k in self._hands])

    def lost(self, lost: np.ndarray) -> np.ndarray:
        """(m,) bool"""
        return np.array([row >= 0 and bool(lost[row]) for row in self._rows], dtype=bool)


def _placed(views: list[Any]) -> np.ndarray:
    """(m, 12): R_WL row by row, p_WL."""
    placed = np.empty((len(views), 12), dtype="<f4")
    for k, view in enumerate(views):
        placed[k, :9] = view.rotation.ravel()
        placed[k, 9:] = view.translation
    return placed


def _packed(time: float, placed: np.ndarray, hands: np.ndarray, lost: np.ndarray) -> bytes:
    return np.array(time, "<f8").tobytes() + placed.tobytes() + hands.astype("<f4").tobytes() + lost.tobytes()
