"""The start pose before tracking: searched in the ticks, with what to tell the person meanwhile."""

from __future__ import annotations

import numpy as np

from ..body import BodyTable
from ..body.table import NEUTRAL_POSE
from ..recording.arrivals import Ticks
from ..tracking.start_pose import START_POSE_HOLD_S
from .setup import SensorSetup
from .state import join_names
from .ticks import StillPose, TickStream

MAX_TICK_BLOCKS = 64  # blocks of ticks kept before those older than the start pose are dropped
BEGUN_S = 0.5  # [s] of standing still after which a person who moves is told so


class StartPoseSearch:
    """Finds the start pose in the ticks before tracking: stated by the session, or held for `START_POSE_HOLD_S`.

    Attributes
    ----------
    ticks : since before the start pose
    """

    def __init__(self, stream: TickStream, setup: SensorSetup, table: BodyTable) -> None:
        self._stream, self._pose = stream, StillPose(stream, START_POSE_HOLD_S)
        self._stated = next(iter(setup.phases.get("start", ())), None)
        self._instruction = f"Hold still in the start pose, {setup.start_pose}"
        if table.is_mechanism:
            self._instruction = f"{table.name} must stand still in its start configuration"
        elif setup.start_pose == NEUTRAL_POSE:
            self._instruction = "Stand upright and still, arms hanging, palms to the thighs"
        self._longest_s = 0.0  # [s] for which the person stood still
        self.ticks: list[Ticks] = []

    def push(self, ticks: Ticks) -> tuple[int, int, int] | None:
        """Add ticks; return the start pose's first and last tick and the row in `ticks` after it; None: not yet."""
        self.ticks.append(ticks)
        clock = self._stream.clock
        if self._stated is not None:
            (row,) = np.nonzero(ticks.time >= self._stated[1] - 0.5 / clock.rate_hz)
            if row.size:
                begin = max(0, round((self._stated[0] - clock.begin) * clock.rate_hz))
                return begin, ticks.first + int(row[0]), int(row[0]) + 1
            return None
        last = self._pose.push_ticks(ticks)
        if last is not None:
            return self._pose.begin, self._pose.end, last + 1
        if len(self.ticks) > MAX_TICK_BLOCKS:
            self.ticks = [each for each in self.ticks if each.first + len(each.time) > self._pose.begin]
        return None

    def describe(self, wrong_unit: str, lost: str) -> tuple[str, str, float]:
        """Return the state, the message to the person, and the progress, 0 to 1.

        Parameters
        ----------
        wrong_unit, lost : sentences on sensors in another unit, and on frozen ones; empty where there are none
        """
        pose, sensors = self._pose, self._stream.sensors
        if self._stated is not None:
            begin, end = self._stated
            progress = float(np.clip((self._stream.clock.newest - begin) / (end - begin), 0.0, 1.0))
            return "start_pose", f"{self._instruction}, until {end:g} s.", progress
        if pose.state == "waiting":
            return "waiting", lost or f"Waiting for {join_names([sensors[k] for k in pose.missing])}.", 0.0
        progress = min(1.0, pose.held_s / START_POSE_HOLD_S)
        if wrong_unit:
            return "moved", wrong_unit, progress
        self._longest_s = max(self._longest_s, pose.held_s)
        if pose.state != "moved":
            left_s = max(0.0, START_POSE_HOLD_S - pose.held_s)
            return "start_pose", f"{self._instruction}: {left_s:.0f} s more.", progress
        if self._longest_s < BEGUN_S:  # the person walks to the place, or takes the pose
            return "start_pose", f"{self._instruction}.", 0.0
        moved, again = join_names([sensors[k] for k in pose.moving]), self._instruction
        return "moved", f"You moved ({moved}). Once more: {again[0].lower()}{again[1:]}.", progress
