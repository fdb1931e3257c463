"""`CalibrationProblem`: a recording with all that is stated about it, and the samples that its protocol observes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..body import BodyModel, list_breadths
from ..body.mounts import (
    MAX_MOUNT_ERROR_DEG,
    MEASURED_ORIENTATION_STD,
    MOUNT_WARNING_DEG,
    compute_heading_offset,
    compute_start_heading_var,
    find_mount_covariance,
    find_nominal_mount,
)
from ..body.soft_tissue import USUAL_POSE_SHARE
from ..body.subject import Subject
from ..body.table import NEUTRAL_POSE
from ..data_tables import read_columns, read_table
from ..diagnostics import WARNING, Diagnostic
from ..errors import BadPhase, BadSession
from ..filters import average_start
from ..recording import Recording, find_runs, format_span
from .equations import Gaussian, Layout
from .headings import Couplings, estimate_couplings
from .protocols import Closure, Condition, FreeMotion, Protocol

# Rate of the samples that the least squares takes [Hz]; errors of orientations are correlated over longer times.
SAMPLE_RATE_HZ = 8.0
MOST_SAMPLES = 2000  # of all conditions; longer ones are sampled at a lower rate
LEAST_S = 1.25  # [s] of each condition, in which all sensors measure
LONGEST_LOSS_S = 0.1  # [s] over which the rate of an arm is interpolated to some degrees
FREE_S = 120.0  # [s] at most of free motion after the start pose, where no phase states it: headings drift
# Standard deviations [rad] of a stated mount's heading, as mounts name sensor axes that are estimated by eye, and of an
# unknown heading: the whole circle.
STATED_STD, HEADING_STD = np.deg2rad(10.0), np.pi / np.sqrt(3.0)
BREADTH = "biacromial"  # the measurement that fixes the scale of joined hands best (docs/calibrate.md)
MOST_LAYOUTS = 4  # that are remembered
_layouts: dict[tuple[Any, ...], Layout] = {}


def find_layout(protocol: Protocol, model: BodyModel, recording: Recording) -> Layout:
    """Return the layout of a protocol on a body, an earlier one if it is the same: its functions take long to build."""
    joints, sensors = tuple(recording.joints.items()), tuple(recording.sensors)
    key = id(model), protocol, recording.start_pose, joints, sensors  # a layout keeps its model alive
    layout = _layouts.get(key) or Layout(protocol, model, recording)
    _layouts[key] = layout
    for oldest in list(_layouts)[:-MOST_LAYOUTS]:
        _layouts.pop(oldest, None)
    return layout


@dataclass(frozen=True)
class CalibrationProblem:
    """The inputs of a calibration, and what follows from them before anything is estimated."""

    recording: Recording  # the samples, with diagnostics of the start pose
    R_VS: Mapping[str, Rotation]  # segment → n orientations of its sensor, in its own world
    start: tuple[float, float]  # [s] of the start pose
    layout: Layout  # the unknowns of what the person did in which phase
    prior: Subject  # lengths with their covariance, and mounts
    measured: Mapping[str, tuple[float, float]]  # name of a length → value and standard deviation [m]
    # diagnostics of mounts that are not used, as gravity or the motion contradicts them
    unused_mounts: tuple[Diagnostic, ...] = ()
    exchanged: Mapping[str, str] = field(default_factory=dict)  # segment → label of the sensor on it, where they differ
    pose_share: float = 1.0  # of how far people are off the start pose (`estimate_pose_share`)

    @property
    def protocol(self) -> Protocol:
        return self.layout.protocol

    @property
    def model(self) -> BodyModel:
        return self.layout.model

    @property
    def scale_lengths(self) -> tuple[str, ...]:
        """The measured lengths that fix the scale; empty: the prior does."""
        # A length outside the chain, such as the trunk where the hands are joined, does not fix its scale.
        return tuple(name for name in self.measured if name in (self.layout.lengths_in_closures or self.model.lengths))

    @property
    def measured_example(self) -> str:
        """The best measurement of the scale, ``name=metres``: a breadth, then the longest length that counts."""
        lengths = self.layout.lengths_in_closures or self.model.lengths
        names = [name for name in lengths if name not in self.measured]
        if (BREADTH in list_breadths(self.model.table) and not self.measured) or not names:
            return f"{BREADTH}=0.41"
        return f"{max(names, key=self.model.lengths.__getitem__)}=METRES"

    # Mounts and labels ------------------------------------------------------------------------------------------------

    @cached_property
    def R_VS_start(self) -> dict[str, Rotation]:
        """Segment → mean orientation of its sensor in the start pose."""
        return average_start(self.recording, self.R_VS, self.start)

    def mount(self, segment: str) -> Rotation | None:
        """Return the mount of prior or session, with an L that equals W in the start pose; None: unknown."""
        start_pose = self.layout.start_pose
        mount = find_nominal_mount(self.recording, segment, self.prior, start_pose)
        return None if mount is None else start_pose.to_world(segment, Rotation.from_quat(mount))

    @cached_property
    def stated_headings(self) -> dict[str, float]:
        """Segment → ψ [rad] by its mount, of those whose mount is known."""
        starts = [(name, R_VS, self.mount(name)) for name, R_VS in self.R_VS_start.items()]
        return {name: compute_heading_offset(R_VS, mount) for name, R_VS, mount in starts if mount is not None}

    def sensor_prior(self, segment: str) -> Gaussian:
        """Return what start pose and mount tell of a sensor's (ε_x, ε_y, ψ): mean (3,) and information (3, 3).

        The person stands nearly in the start pose. A mount R_LS = exp(m) R_0 has a small error m = μ − ε + ψ e_z, with
        μ the misfit of the start pose at the heading nearest to R_0. An unknown heading is 0.
        """
        recording, own, mount = self.recording, self.model.table.segments[segment], self.mount(segment)
        R_start = self.layout.start_pose.rotation(segment)
        start_cov = self.pose_share**2 * R_start @ np.diag(np.square(own.start_std)) @ R_start.T
        mean, information = np.zeros(3), np.zeros((3, 3))
        information[:2, :2], information[2, 2] = np.linalg.inv(start_cov[:2, :2]), HEADING_STD**-2
        if recording.start_pose == NEUTRAL_POSE:
            mean[:2] = min(self.pose_share / USUAL_POSE_SHARE, 1.0) * np.array(own.start_mean[:2])
        if mount is None:
            return mean, information
        heading = [0.0, 0.0, self.stated_headings[segment]]
        covariance = find_mount_covariance(recording, segment, self.prior)
        if covariance is not None:
            # Headings are relative to the start pose, in which a person turns each segment.
            turned_var = compute_start_heading_var(recording, segment, self.prior, self.layout.start_pose)
            covariance = R_start @ covariance @ R_start.T + np.diag([0.0, 0.0, turned_var])
            of_mount = np.linalg.inv(covariance + 1e-12 * np.eye(3))
        elif segment in recording.imus and (recording.remounted or segment not in self.prior.mounts):
            of_mount = np.diag([0.0, 0.0, STATED_STD**-2])
        else:
            of_mount = np.eye(3) / MEASURED_ORIENTATION_STD**2
        misfit = (Rotation.from_rotvec(heading) * self.R_VS_start[segment] * mount.inv()).as_rotvec()
        signs = np.diag([-1.0, -1.0, 1.0])
        both = information + signs @ of_mount @ signs
        target = information @ mean - signs @ of_mount @ np.append(misfit[:2], 0.0)
        return np.linalg.solve(both + 1e-9 * np.eye(3), target) + heading, both

    def remove_mounts(self, segments: Collection[str]) -> CalibrationProblem:
        """Return the same problem without the mounts of these segments."""
        sensors = dict(self.recording.sensors)
        sensors |= {name: replace(sensors[name], stated_quat_LS=None) for name in segments}
        mounts = {name: mount for name, mount in self.prior.mounts.items() if name not in segments}
        recording, prior = replace(self.recording, sensors=sensors), replace(self.prior, mounts=mounts)
        return replace(self, recording=recording, prior=prior)

    def leave_out_mounts(self, estimated: Mapping[str, np.ndarray] | None = None) -> CalibrationProblem:
        """Return the same problem without the mounts that gravity, or mounts `estimated` by the motion, contradict."""
        limit, unused = float(np.deg2rad(MAX_MOUNT_ERROR_DEG if estimated is None else MOUNT_WARNING_DEG)), []
        for name in self.recording.imus:
            mount = self.mount(name)
            if mount is None or (estimated is not None and name not in estimated):
                continue
            if estimated is None:
                up_V = (self.R_VS_start[name] * mount.inv()).apply([0.0, 0.0, 1.0])
                angle = float(np.arccos(np.clip(up_V[2], -1.0, 1.0)))
            else:
                R_estimated = self.layout.start_pose.to_world(name, Rotation.from_quat(estimated[name]))
                angle = float((R_estimated * mount.inv()).magnitude())
            if angle > limit:
                unused.append(Diagnostic("mount-contradicted", WARNING, name, angle, limit, {"variant": "unused"}))
        problem = self.remove_mounts([each.place for each in unused])
        return replace(problem, unused_mounts=(*self.unused_mounts, *unused))

    def relabel(self, exchanged: Mapping[str, str]) -> CalibrationProblem:
        """Return the same problem with exchanged sensors, segment → label; a stated mount goes with its sensor."""

        def exchange(values: Mapping[str, Any]) -> dict[str, Any]:
            return {segment: values[exchanged.get(segment, segment)] for segment in values}

        recording = replace(self.recording, sensors=exchange(self.recording.sensors))
        return replace(self, recording=recording, R_VS=exchange(self.R_VS), exchanged=exchanged)

    def orient_segments(self, mounts: Mapping[str, np.ndarray], samples: np.ndarray) -> dict[str, np.ndarray]:
        """Return segment → `quat_WL` (n, 4) xyzw at samples (n,), with mounts `quat_LS`; headings not corrected."""
        quat_WL = {}
        for name in (name for name in self.R_VS if name in mounts):
            R_LS = Rotation.from_quat(mounts[name])
            psi = compute_heading_offset(self.R_VS_start[name], self.layout.start_pose.to_world(name, R_LS))
            quat_WL[name] = (Rotation.from_rotvec([0.0, 0.0, psi]) * self.R_VS[name][samples] * R_LS.inv()).as_quat()
        return quat_WL

    # Samples ----------------------------------------------------------------------------------------------------------
    # After lost samples a filter recovers the tilt from gravity, but never the heading.

    @cached_property
    def phase_samples(self) -> list[np.ndarray]:
        """The numbers of the samples of each condition's phase; `BadPhase` where the recording lacks a phase."""
        recording, begin, samples = self.recording, self.start[1], list[np.ndarray]()
        for condition in self.layout.conditions:
            free = ((begin, min(begin + FREE_S, float(recording.time[-1]))),)
            inside = np.zeros(len(recording), dtype=bool)  # each sample counts once where intervals overlap
            for interval in recording.phase(condition.phase) if condition.phase else free:
                inside[recording.span(interval)] = True
            samples.append(np.flatnonzero(inside))
        return samples

    @cached_property
    def connected(self) -> tuple[np.ndarray, str, tuple[float, float]]:
        """The samples (n,) bool between which and the start pose no sensor lost more than `LONGEST_LOSS_S`.

        Beside them the sensor whose loss ends them, else the one after whose loss they begin, and that loss [s]; empty:
        nothing was lost.
        """
        recording, n = self.recording, len(self.recording)
        begin, longest = recording.span(self.start).start, LONGEST_LOSS_S * recording.rate_hz
        gaps = {name: recording.imus[name].gap for name in self.layout.sensors if name in recording.imus}
        runs = [(a, b, name) for name, gap in gaps.items() if gap is not None for a, b in find_runs(gap)]
        losses = [(a, b, name) for a, b, name in runs if b - a > longest]
        before = max((loss for loss in losses if loss[0] < begin), key=lambda loss: loss[1], default=(0, 0, ""))
        after = min((loss for loss in losses if loss[0] >= begin), default=(n, n, ""))
        a, b, lost = after if after[2] else before
        interval = (float(recording.time[a]), float(recording.time[b - 1])) if lost else (np.nan, np.nan)
        samples = np.arange(n)
        return (samples >= before[1]) & (samples < after[0]), lost, interval

    @cached_property
    def usable(self) -> np.ndarray:
        """(n,) bool: the samples that all sensors measured, and that are connected with the start pose."""
        gaps = [sensor.gap for sensor in self.recording.sensors.values() if sensor.gap is not None]
        return self.connected[0] & ~np.any([np.zeros(len(self.recording), dtype=bool), *gaps], axis=0)

    @property
    def short_phases(self) -> dict[str, float]:
        """The phases of which less than `LEAST_S` is usable → how much is [s]."""
        phases = zip(self.layout.conditions, self.phase_samples, strict=True)
        seconds = {each.phase: float(self.usable[samples].sum()) / self.recording.rate_hz for each, samples in phases}
        return {phase: time for phase, time in seconds.items() if time < LEAST_S}

    @cached_property
    def couplings(self) -> Couplings | None:
        """The relative headings of neighbours by the acceleration of the joint between them."""
        phases = zip(self.layout.conditions, self.phase_samples, strict=True)
        moving = [phase for condition, phase in phases if isinstance(condition, Closure | FreeMotion)]
        samples = np.unique(np.concatenate([np.zeros(0, dtype=int), *moving]))
        return estimate_couplings(self.recording, self.R_VS, self.start, self.layout, samples[self.usable[samples]])

    def diagnose_losses(self) -> list[Diagnostic]:
        """Return what is not used of each phase, as a sensor was lost between it and the start pose."""
        diagnostics, (connected, lost, loss) = [], self.connected
        for condition, phase in zip(self.layout.conditions, self.phase_samples, strict=True):
            unused = float(np.sum(~connected[phase])) / self.recording.rate_hz
            if unused:
                facts = {"phase": _name_phase(condition), "interval": format_span(loss)}
                diagnostics.append(Diagnostic("samples-not-connected", WARNING, lost, unused, facts=facts))
        return diagnostics

    def observe(self, rate_hz: float = SAMPLE_RATE_HZ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return data and condition of n samples, as in `LeastSquares`, and their numbers (n,) in the recording.

        It raises `BadPhase` where a condition has too few samples with all sensors, connected with the start pose.
        """
        recording, layout = self.recording, self.layout
        (connected, lost, loss), parts, places = self.connected, list[np.ndarray](), list[np.ndarray]()
        stride = max(1, round(recording.rate_hz / rate_hz), sum(map(len, self.phase_samples)) // MOST_SAMPLES)
        for condition, phase in zip(layout.conditions, self.phase_samples, strict=True):
            samples = phase[::stride]
            samples = samples[self.usable[samples]]
            place = np.zeros((len(samples), 3))
            if isinstance(condition, Closure) and condition.kind == "recorded":
                place = read_recorded_places(recording, condition, recording.time[samples])
                known = np.isfinite(place).all(axis=1)
                samples, place = samples[known], place[known]
            parts.append(samples)
            places.append(place)
            seconds = len(samples) * stride / recording.rate_hz
            if seconds < LEAST_S:
                text = f"{_name_phase(condition)} has {seconds:.1f} s in which all sensors measure; at least "
                text += f"{LEAST_S:g} s are needed, better a minute"
                if not connected[phase].all():
                    text += f"; sensors.{lost} is lost from {format_span(loss)}, and its heading with it: name a start "
                    text += "pose and a motion with nothing lost between them, or record again"
                raise BadPhase(f"{recording.where()}: {text}")
        samples = np.concatenate(parts)
        since_start = [(self.R_VS[name][samples] * self.R_VS_start[name].inv()).as_quat().T for name in layout.sensors]
        recorded = np.concatenate(places).T[: layout.place.stop - layout.place.start]
        data = np.vstack([*since_start, recorded, recording.time[samples] - self.start[1]])
        condition_index = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        return data, condition_index, samples


def _name_phase(condition: Condition) -> str:
    return f"phases.{condition.phase}" if condition.phase else "the motion"


def read_recorded_places(recording: Recording, closure: Closure, time: np.ndarray) -> np.ndarray:
    """Return places (n, 3) [m] in W of the closure's point from its origin at `time` (n,) [s]; NaN where it was lost.

    Places are interpolated linearly between two rows of the session's truth file that both have them. It raises where
    there is no such file, or its columns and times are not as they should be.
    """
    [point] = closure.points
    columns = [f"{point}_{axis}" for axis in "xyz"]
    if recording.truth is None:
        raise BadSession(
            f"{recording.where()}: data.truth is missing; this protocol takes the place of {point} from it, a table "
            f"with the columns time, {', '.join(columns)}"
        )
    table, file, where = read_table(recording.truth), str(recording.truth), f"{recording.where()}: data.truth"
    known_time = read_columns(table, ["time"], file, where)[:, 0]
    places = read_columns(table, columns, file, where)
    if closure.origin:
        places = places - read_columns(table, [f"{closure.origin}_{axis}" for axis in "xyz"], file, where)
    if not (np.diff(known_time) > 0.0).all():
        raise BadSession(f"{where}: time of {recording.truth.name} does not increase from row to row")
    return np.column_stack([np.interp(time, known_time, column, left=np.nan, right=np.nan) for column in places.T])
