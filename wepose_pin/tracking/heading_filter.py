"""A Kalman filter of heading errors over knots of a recording: it owns the headings and the biases about the vertical.

Time is cut into intervals of equal length, the knots. δ_i is the heading error of segment i, on the left in W:
R_WL,true = Rz(δ_i) R_WL. It changes by a random walk, by the scale of the gyroscope as the segment turns, and by a rate
that changes slowly, the bias about the vertical. An orientation filter corrects heading and bias by what its own sensor
shows, as in a static phase. The headings here are those without its corrections, and what it has learned of the bias is
one more observation. Differences of two or more δ are observed by (`wepose_pin.observations`):

- the acceleration of a joint, which two sensors measure, with their levers as unknowns;
- a hinge: the long axis of the segment below stays in the plane across the hinge's axis;
- two points that coincide: palms in a phase `clasp`.

Errors by soft tissue, tilted hinge axes and travelling joints are correlated over seconds or over the whole recording.
They are states, so that a long recording does not average them away.
"""

import contextlib
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from .. import rotations
from ..body import BodyModel
from ..body.mounts import (
    MOUNT_MOVED_STDS,
    MOUNT_WARNING_DEG,
    PALM_SLIP_STD,
    SEGMENT_ATTITUDE_STD,
    StartPose,
    compute_start_heading_var,
)
from ..body.subject import Hinge, Subject
from ..body.table import HingeJoint
from ..calibration import load_protocol
from ..calibration.headings import LEAST_MISMATCH, LEAST_S, SAMPLES_HZ, estimate_heading
from ..calibration.least_squares import LEAST_CORRELATION_S
from ..errors import BadSession
from ..filters.phases import SensorNoise
from ..observations import LEAST_RATE_HZ, PointPath, find_hinges, find_joint_pairs, linearize_hinge, linearize_joint
from ..recording import Recording
from ..rotations import wrap_angle

CLASP = "clasp"  # the phase in which the palms are joined, and its protocol
REFERENCE_START_STD = np.deg2rad(0.5)  # [rad] of the heading that defines x, at the end of the start pose; assumption
MEASURED_RATE_STD = np.deg2rad(0.1)  # [rad/s] at which a measured orientation drifts about the vertical; assumption
LEAST_MOUNT_VAR = np.deg2rad(0.01) ** 2  # [rad²] of a mount's heading, so that covariances can be inverted
# [s] between knots: causally what a knot observes is corrected by the end of the next one, offline each costs memory.
CAUSAL_KNOT_S, OFFLINE_KNOT_S = 0.5, 2.0
SAMPLE_RATE_HZ = 8.0
# Standard deviation of the delay of an accelerometer against its gyroscope: half a sample, over which it averages, and
# what filters inside the chips differ by [s]; assumption.
AVERAGED_SAMPLES, CHIP_DELAY_STD = 0.5, 0.002
UNKNOWN_DRIFT_PSD = np.deg2rad(3.0) ** 2 / 60.0  # [rad²/s] where a filter has no covariance: 3° in a minute; assumption
MIN_DRIFT_PSD = 1e-10  # [rad²/s]
# The heading variance of an orientation filter leaps where a knot adds more than this many times the largest recent
# growth; that is forgotten with a time constant [s].
LEAP_RATIO, GROWTH_MEMORY_S = 10.0, 60.0
# An orientation filter learns of a bias where its variance falls by at least this share, and is off by twice what it
# states: its motions are not as random as it assumes. Found by simulated people who walk, run, throw and reach.
LEAST_LEARNED, LEARNED_VARIANCE_RATIO = 1e-4, 4.0
MISFIT_MEMORY_S = 30.0  # time constant of the recent misfit of a joint's accelerations
# Share of the variance of a pelvis', leg's or head's heading that is by the torso's turn: 4 of 5° (docs/people.md).
TURN_VAR_SHARE = (4.0 / 5.0) ** 2
OUTLIER_STDS = 5.0  # standard deviations above which a gap between the palms is an outlier
HINGE_OUTLIER = np.deg2rad(30.0)  # [rad] off its plane, above which a segment shows a wrong mount and no heading
ITERATIONS = 2  # linearizations of an update
# A loss may leave a heading so uncertain that what is observed has several minima: above `SEARCH_STD` [rad] relative to
# others. It is searched on a circle of headings, each weighed by what is observed since, until it is known to
# `FOUND_STD`; only sensors whose tilt is known to `SEARCH_TILT_STD` tell of it.
SEARCH_STD, FOUND_STD, SEARCH_TILT_STD = np.deg2rad([35.0, 20.0, 8.0])
CIRCLE = np.deg2rad(np.arange(-180.0, 180.0, 5.0))  # [rad]
CELL_VAR = np.deg2rad(5.0) ** 2 / 12.0  # [rad²] of a heading between two of these
PEAK = np.deg2rad(60.0)  # [rad] from the likeliest heading, as far as its peak extends
TAIL = 4.0  # degrees of freedom of a hinge's error on that circle, whose distribution has long tails
MOUNTS_S = 120.0  # [s] after the start pose whose accelerations show a turned mount; headings drift little by then
# A heading may be feigned by no more than a share of the rms misfit; found by simulated people who walk, run, throw and
# reach.
LARGEST_COHERENT_SHARE = 0.5
# Jacobian of the angle and of the two sides of a joint by its columns (`HeadingFilter._pair_columns`).
_JOINT_JACOBIAN = np.zeros((15, 17))
_JOINT_JACOBIAN[0, :3], _JOINT_JACOBIAN[1:, 3:] = (1.0, -1.0, 1.0), np.eye(14)


# Standard deviations, power spectral densities and correlation times.
DRIFT_PSD = np.deg2rad(0.12) ** 2  # [rad²/s] of a heading in motion: soft tissue
SCALE_STD = 0.002  # of a gyroscope's scale about the vertical; what the filters assume
RATE_CHANGE_PSD = np.deg2rad(0.1) ** 2 / 900.0  # [rad²/s³] a sensor warms up under its strap
# [m/s²] least misfit of a joint's accelerations; the recent one where it is larger.
ACCELERATION_STD, ACCELERATION_CORRELATION_S = 0.07, 0.4
# [m/s²] fixed in the sensor's frame: the tilt error of an orientation filter in motion, a degree, times gravity.
FORCE_STD, FORCE_CORRELATION_S = np.deg2rad(1.0) * 9.81, 20.0
JOINT_CORRELATION_S, HINGE_CORRELATION_S, CLOSURE_CORRELATION_S = 60.0, 5.0, 20.0
# [rad] of a calibrated hinge's axis about the long axis of the segment above, and about the direction across both.
AXIS_STD, TILT_STD = float(np.deg2rad(5.0)), float(np.deg2rad(2.0))
RANGE_STD = np.deg2rad(10.0)  # [rad] of the limits of a hinge's range, within which a lost heading is searched
# Those of a person and of a mechanism, in this order: [rad/s] at which a heading drifts, apart from its gyroscope's
# bias; [rad] of the heading by a joint's acceleration, as soft tissue follows the motion and shoulders travel; [rad]
# between a hinge's plane and the segment below: a person's soft tissue turns the sensor above by 7 deg about its
# segment, all else is 4 deg.
RATE_STD, JOINT_STD, HINGE_STD = np.deg2rad([[0.05, 0.2], [0.9, 0.5], [8.0, 0.7]])


class HeadingFilter:
    """What observes the headings of k sensors, and the state and its covariance, knot by knot.

    What the orientation filters of the sensors know after a sample is `filters` (5, k): the variance [rad²] of the
    heading, the columns of `Orientation.about_vertical`, and the variance [rad²] of the tilt; NaN without a covariance.

    Parameters
    ----------
    first : the first chunk, or the one that ends with the start pose
    quat_LS : segment → (4,) xyzw of its sensor, the mount used
    noises : of sensors with a filter
    subject, model : the person, and the body with the person's lengths
    start : `filters` at the end of the start pose
    repeat_share : as of `StartPose`
    causal : headings are corrected as samples come; a short clasp then counts as one observation

    Attributes
    ----------
    pairs, hinges, palms : joints between two sensors, hinges, and the points that the phase `CLASP` joins
    is_observed : whether one of them tells of the headings
    start_cov, mount_cov : (k, k) each [rad²] of headings at the end of the start pose, by the pose and by the mounts
    stride : sensors' samples from one sample of a knot to the next
    x, P : (n,), (n, n); the first k are δ [rad]
    process : how x changes in the last knot besides what it does by itself, the variance of that; (n,) each; and the
        rotations (k,) [rad] about the vertical
    """

    def __init__(
        self,
        first: Recording,
        quat_LS: Mapping[str, np.ndarray],
        noises: Mapping[str, SensorNoise],
        subject: Subject,
        model: BodyModel,
        start: np.ndarray,
        repeat_share: float,
        *,
        causal: bool,
    ) -> None:
        self.names, self.causal, self._last, k = tuple(quat_LS), causal, start, len(quat_LS)
        kind, start_pose = int(model.table.is_mechanism), StartPose(model.neutral_rotations)
        self._rate_var = RATE_STD[kind] ** 2
        raw = {name: quat for name, quat in quat_LS.items() if name in first.imus}
        self.pairs, levers, lever_std = find_joint_pairs(model, raw if first.rate_hz >= LEAST_RATE_HZ else {})
        hinges = _list_hinges(model, start_pose, self.names, {} if first.remounted else subject.hinges)
        self.hinges = tuple(hinge for hinge, *_ in hinges)
        axis_stds, tilt_stds, plane_stds = np.array([stds for _, *stds in hinges]).reshape(-1, 3).T
        self._hinge_std = np.maximum(plane_stds, HINGE_STD[kind])
        [closure] = load_protocol(CLASP).closures
        self.palms, (left, right) = None, closure.points
        if {left, right} <= set(model.table.points):
            with contextlib.suppress(BadSession):  # the sensors do not tell where they are
                points = (left, 1.0), (right, -1.0)
                self.palms = PointPath(model, start_pose, self.names, points)
        self.is_observed = bool(self.pairs or self.hinges or (self.palms and first.phases.get(CLASP)))
        self.sensor_rate_hz, self.stride = first.rate_hz, max(1, round(first.rate_hz / SAMPLE_RATE_HZ))
        knot_s = CAUSAL_KNOT_S if causal else OFFLINE_KNOT_S
        self.samples_per_knot = max(1, round(knot_s * first.rate_hz / self.stride))
        self.knot_s = self.samples_per_knot * self.stride / first.rate_hz
        self.rate_hz = self.samples_per_knot / self.knot_s  # of a knot's samples
        neutral = Rotation.from_matrix([model.neutral_rotations[name] for name in self.names])  # L to L'
        mounts = Rotation.from_quat([quat_LS[name] for name in self.names])
        self.quat_SL = (neutral * mounts).inv().as_quat()  # (k, 4) xyzw, from L' to the sensor
        # (k,) [rad²/s] largest growth of a heading's variance apart from that by its rate, which is at first [rad/s] a
        # gyroscope's bias, or the drift of measured orientations.
        self._drift_psd, rate_std = np.full(k, DRIFT_PSD), np.full(k, MEASURED_RATE_STD)
        for i, name in enumerate(self.names):
            if name in noises:  # a gyroscope's white noise may be more
                gyro_psd = float(np.trace(noises[name].gyro_cov)) / (3.0 * first.rate_hz)
                self._drift_psd[i] = max(DRIFT_PSD, gyro_psd)
                rate_std[i] = np.sqrt(float(np.trace(noises[name].gyro_bias_cov)) / 3.0)
        # After the start pose, and after another one than that of the calibration.
        self.start_cov, self._again_cov = (
            _compute_start_covariance(first, self.names, subject, model, share) for share in (repeat_share, 1.0)
        )
        # (k, k) [rad²]; a calibration knows the headings of mounts against each other better than that of each.
        self.mount_cov = LEAST_MOUNT_VAR * np.eye(k)
        if not first.remounted:
            self.mount_cov += subject.lengths_covariance([f"mounts.{name}.z" for name in self.names])
        # Each state with its standard deviation at the start, and for how long [s] it is correlated.
        always, known = np.inf, np.sqrt(start[3])
        rate_std = np.hypot(RATE_STD[kind], np.where(np.isfinite(known), known, rate_std))
        joint_std = np.full(len(self.pairs), JOINT_STD[kind])
        delay_std = np.full(k, AVERAGED_SAMPLES / first.rate_hz + CHIP_DELAY_STD)
        states = {
            "heading": (np.zeros(k), always),  # δ [rad]
            "rate": (rate_std, always),  # [rad/s] at which δ drifts
            "scale": (np.full(k, SCALE_STD), always),  # of a gyroscope
            "joint": (joint_std, JOINT_CORRELATION_S),  # [rad] of the heading by a joint's acceleration
            "axis": (axis_stds, always),  # [rad] of a hinge about the long axis of the segment above
            "tilt": (tilt_stds, always),  # [rad] of a hinge about the direction across
            "mount": (np.zeros(k), always),  # [rad] of a mount's heading
            "force": (np.full((k, 3), FORCE_STD), FORCE_CORRELATION_S),  # [m/s²] fixed in the sensor's frame
            "delay": (delay_std, always),  # [s] of an accelerometer against its gyroscope
            "lever": (np.tile(lever_std[:, None], 6), always),  # [m] of the near and the far sensor from the joint
        }
        self._set_states(states)
        self.x[self._columns["lever"]], self._levers = levers, (levers, lever_std)
        self._pair_columns, self._hinge_columns = self._find_columns()
        self._shape_cov = subject.shape_covariance(model.table)
        self.reset(np.zeros(k))
        # Recent misfit e of each joint's accelerations, with its force f: sums of e fᵀ (9), e² (3) and f² (3) [m²/s⁴]
        # over samples, in which older ones count less, and how many count.
        self._misfits = np.zeros((len(self.pairs), 16))
        # Whether a sensor has lost a sample in the last knot, and whether its tilt is lost since a loss.
        self._lost_before, self._tilt_lost = np.zeros((2, k), dtype=bool)
        # Of the first `MOUNTS_S`: the sides of sensors (m, k, 3, 4) by their headings of the start pose, NaN where they
        # are lost, and the variance (k,) [rad²] that drift gives these headings.
        self._first_sides, self._first_drift_var = list[np.ndarray](), np.zeros(k)
        # Of a heading that is searched: its log-likelihood around the circle, whose zero is the estimate less `_turned`
        # [rad], and the sensor to which it is relative, a step nearer to the one that is best known.
        self._log_likelihood, self._turned = np.zeros((k, len(CIRCLE))), np.zeros(k)
        self._relative_to = np.zeros(k, dtype=int)
        self._recent_growth = np.zeros(k)  # [rad²] of the orientation filter's variance in a knot, the largest
        self._last_quat: np.ndarray | None = None  # (1, k, 4) of the last knot
        self._clasped_before = False  # whether the palms were joined in the last knot

    def _set_states(self, states: Mapping[str, tuple[np.ndarray, float]]) -> None:
        """Lay out x by the standard deviations of the `states` and their correlation times [s]."""
        ends = np.cumsum([std.size for std, _ in states.values()])
        places = np.split(np.arange(ends[-1]), ends[:-1])
        self._columns = {
            name: own.reshape(std.shape) for own, (name, (std, _)) in zip(places, states.items(), strict=True)
        }
        std = np.concatenate([std.ravel() for std, _ in states.values()])
        self._decay = np.concatenate([np.full(std.size, np.exp(-self.knot_s / t)) for std, t in states.values()])
        self._process_var = (1.0 - self._decay**2) * std**2
        self._process_var[self._columns["rate"]] = RATE_CHANGE_PSD * self.knot_s
        self.x, self.P = np.zeros(len(std)), np.diag(std**2)

    def _find_columns(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Find the columns of x that each pair and each hinge observes.

        Of a pair (17,): headings of its segments, joint; lever, force and delay near and far. Of a hinge (4,): headings
        of the segments below and above, axis, tilt.
        """
        c, index, pairs = self._columns, self.names.index, []
        for i, pair in enumerate(self.pairs):
            near, far, lever = index(pair[0]), index(pair[1]), c["lever"][i]
            sides = [(*own, *c["force"][at], c["delay"][at]) for own, at in ((lever[:3], near), (lever[3:], far))]
            pairs.append(np.array([near, far, c["joint"][i], *sides[0], *sides[1]]))
        hinges = [
            np.array([index(hinge.moves), index(hinge.on), c["axis"][i], c["tilt"][i]])
            for i, hinge in enumerate(self.hinges)
        ]
        return pairs, hinges

    def reset(self, headings: np.ndarray, *, again: bool = False) -> None:
        """Set δ = s − ε_z (k,) [rad] after a start pose with errors s, with the errors ε_z of mounts.

        `again`: it is another start pose than that of the calibration, whatever the first one was.
        """
        self.start_cov = self._again_cov if again else self.start_cov
        heading, mount = self._columns["heading"], self._columns["mount"]
        self.x[heading], both = headings, np.concatenate([heading, mount])
        self.P[both, :], self.P[:, both] = 0.0, 0.0
        cov = [[self.start_cov + self.mount_cov, -self.mount_cov], [-self.mount_cov, self.mount_cov]]
        self.P[np.ix_(both, both)] = np.block(cov)
        self._searched = np.zeros(len(headings), dtype=bool)

    def step(
        self, quat_WL: np.ndarray, sides: np.ndarray, clasped: np.ndarray, lost: np.ndarray, filters: np.ndarray
    ) -> None:
        """Predict to the end of a knot of m samples with uncorrected headings, and update by its observations.

        Parameters
        ----------
        quat_WL : (m, k, 4) xyzw of L'
        sides : (m, k, 3, 8) of each sensor at its joints, as `compute_sides`, band-passed; (0, …): not known
        clasped : (m,) bool: the palms are joined
        lost : (k,) bool: the sensor has lost a sample
        filters : (5, k) at the end
        """
        leapt = filters[4] - self._last[4] > SEARCH_TILT_STD**2  # false for NaN
        self._tilt_lost = (lost | leapt | self._tilt_lost) & (filters[4] > SEARCH_TILT_STD**2)
        lost = lost | self._tilt_lost
        self.process, leaps = self._find_process(filters, lost, quat_WL)
        self.predict(self.process)
        unreliable, lost_now = lost | self._lost_before, lost  # after a loss the tilt may be wrong
        if len(sides) and len(self._first_sides) * self.knot_s < MOUNTS_S:
            self._first_sides.append(np.where(unreliable[:, None, None], np.nan, sides[..., :4]))
            self._first_drift_var = np.nan_to_num(filters[0])
        order = self._find_searched(leaps)
        tilted, unreliable, lost = unreliable, unreliable | self._searched, lost | self._searched
        palms = self.palms if clasped.any() else None
        if palms is not None and unreliable[[self.names.index(name) for name in palms.segments]].any():
            palms = None
        x, misfits, identity = self.x, self._misfits, np.eye(len(self.x))
        for _ in range(ITERATIONS):
            self._matrix, self._vector = np.zeros(self.P.shape), np.zeros(x.shape)
            misfits = self._add_joints(x, sides, lost)
            self._add_biases(x, filters)
            self._add_hinges(x, quat_WL, unreliable)
            if palms is not None:
                correlated = max(1.0, CLOSURE_CORRELATION_S * self.rate_hz)
                if self.causal and not self._clasped_before:
                    # Causally all of a clasp's first knot is one observation: a clasp may be shorter than that.
                    correlated = float(len(quat_WL))
                self._add_gap(palms.linearize(quat_WL[clasped], x[: len(lost)]), correlated)
            right = self.P @ (self._matrix @ (x - self.x) - self._vector)
            x = np.asarray(self.x + np.linalg.solve(identity + self.P @ self._matrix, right))
        self.x, self.P = x, symmetric(np.linalg.solve(identity + self.P @ self._matrix, self.P))
        self._misfits, self._clasped_before, self._last = misfits, bool(clasped.any()), filters
        self._lost_before = lost_now
        self._search(order, quat_WL, sides, tilted)

    def _find_process(
        self, filters: np.ndarray, lost: np.ndarray, quat_WL: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Find the `process` of a knot, and the sensors (k,) whose heading's variance leaps.

        The heading variance of an orientation filter grows by the bias and the scale of its gyroscope too, which are
        states here. So its growth counts up to `drift_psd`. As a whole it counts where it leaps: samples were lost, or
        the gyroscope was saturated. What the filter has corrected of its heading and its bias is taken back. A bias is
        less certain where another axis of the sensor becomes vertical, up to what the filter knows of it by itself.
        """
        heading, rate = self._columns["heading"], self._columns["rate"]
        gained_var, corrected, corrected_rate, gained_rate_var = (filters - self._last)[:4]
        least = self._drift_psd * self.knot_s
        gained = np.maximum(gained_var, MIN_DRIFT_PSD * self.knot_s)
        known = np.isfinite(gained)
        leaps = gained > np.where(lost, least, LEAP_RATIO * np.maximum(self._recent_growth, least))
        remembered = self._recent_growth * np.exp(-self.knot_s / GROWTH_MEMORY_S)
        self._recent_growth = np.maximum(remembered, np.where(known, gained, 0.0))
        change, variance = np.zeros(len(self.x)), self._process_var.copy()
        change[heading], change[rate] = -np.nan_to_num(corrected), np.nan_to_num(corrected_rate)
        drift = np.where(leaps, gained, np.minimum(gained, least))
        variance[heading] += np.where(known, drift, UNKNOWN_DRIFT_PSD * self.knot_s)
        room = filters[3] + self._rate_var - np.diag(self.P)[rate]
        variance[rate] += np.nan_to_num(np.maximum(np.minimum(gained_rate_var, room), 0.0))
        quat = np.concatenate([quat_WL[:1] if self._last_quat is None else self._last_quat, quat_WL])
        self._last_quat = quat[-1:]
        turns = rotations.log(rotations.multiply(quat[1:], rotations.conjugate(quat[:-1])))
        return (change, variance, np.sum(turns[:, :, 2], axis=0)), leaps

    def advance(self, values: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Return F v of one knot for v (n,) or (n, m); `turn` (k,) [rad] is the rotation about the vertical.

        Correlated states decay, headings change by their rates and by the scales of their gyroscopes.
        """
        advanced = np.asarray((self._decay * values.T).T)
        rate, scale = (values[self._columns[name]].T for name in ("rate", "scale"))
        advanced[self._columns["heading"]] += (self.knot_s * rate + turn * scale).T
        return advanced

    def predict(self, process: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        """Predict state and covariance at the end of the next knot."""
        change, variance, turn = process
        self.x = self.advance(self.x, turn) + change
        self.P = self.advance(self.advance(self.P, turn).T, turn).T + np.diag(variance)

    def _add(self, columns: np.ndarray, H: np.ndarray, r: np.ndarray, weight: np.ndarray | float) -> None:
        """Add rows 0 = r + H (y − x) + e of these columns of the state y, with weights of one over their variance.

        r is (m,), H (m, c); the sums are Σ Hᵀ W H (n, n) and Σ Hᵀ W r (n,).
        """
        weighted = weight * H.T
        self._matrix[columns[:, None], columns] += weighted @ H
        self._vector[columns] += weighted @ r

    def _add_biases(self, x: np.ndarray, filters: np.ndarray) -> None:
        """Add what the orientation filters have learned of the biases about the vertical.

        A filter that corrects a bias by c while its variance falls from v to v (1 − K) has observed c/K with the
        variance v (1 − K)/K. The rate here already has c; it is the bias and `rate_std`, which is no bias.
        """
        columns, other_var = self._columns["rate"], self._rate_var
        rate_var, last_rate_var = filters[3] + other_var, self._last[3] + other_var
        learned = 1.0 - rate_var / last_rate_var
        learns = learned > LEAST_LEARNED  # false for NaN
        share = np.where(learns, learned, 1.0)
        correction = np.where(learns, filters[2] - self._last[2], 0.0)
        var = LEARNED_VARIANCE_RATIO * np.where(learns, rate_var, 1.0) / share
        self._add(columns, np.eye(len(columns)), x[columns] + correction * (1.0 / share - 1.0), learns / var)

    def _add_joints(self, x: np.ndarray, sides: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """Add the accelerations of joints; return the recent misfits with those of the knot."""
        misfits = self._misfits.copy()
        correlated = max(1.0, ACCELERATION_CORRELATION_S * self.rate_hz)
        decay = np.exp(-self.knot_s / MISFIT_MEMORY_S)
        for misfit, columns in zip(misfits, self._pair_columns, strict=True):
            near, far, joint = columns[:3]
            if lost[near] or lost[far] or not len(sides):
                continue
            angle = x[near] - x[far] + x[joint]
            e, jacobian, f = linearize_joint(sides[:, near], sides[:, far], angle, x[columns[3:10]], x[columns[10:]])
            sums = (e.T @ f).ravel(), np.sum(e**2, axis=0), np.sum(f**2, axis=0), [len(e)]
            misfit[:] = decay * misfit + np.concatenate(sums)
            r, H = e.ravel(), jacobian.reshape(-1, len(_JOINT_JACOBIAN)) @ _JOINT_JACOBIAN
            self._add(columns, H, r, _weigh_joint(misfit, float(np.mean(r**2)), H, correlated))
        return misfits

    def _add_hinges(self, x: np.ndarray, quat_WL: np.ndarray, unreliable: np.ndarray) -> None:
        """Add the hinges, without outliers."""
        samples = max(1.0, HINGE_CORRELATION_S * self.rate_hz)
        for hinge, columns, std in zip(self.hinges, self._hinge_columns, self._hinge_std, strict=True):
            moves, on = columns[:2]
            if unreliable[on] or unreliable[moves]:
                continue
            r, H, _ = linearize_hinge(hinge, quat_WL[:, on], quat_WL[:, moves], x[columns[:2]])
            r = r + H[:, 2:] @ x[columns[2:]]
            self._add(columns, H, r, (np.abs(r) < HINGE_OUTLIER) / (std**2 * samples))

    def _add_gap(self, rows: tuple[np.ndarray, ...], correlated: float) -> None:
        """Add the gap between the palms, without outliers; so many samples are one observation."""
        gap, H, by_shape, by_attitude, off_law = rows
        covariance = PALM_SLIP_STD**2 * np.eye(3) + SEGMENT_ATTITUDE_STD**2 * by_attitude + off_law
        covariance += by_shape @ self._shape_cov @ by_shape.swapaxes(1, 2)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        r, H = (whiten @ gap[:, :, None])[..., 0], whiten @ H
        is_inlier = np.sum(r**2, axis=1) < OUTLIER_STDS**2 * 3.0  # three axes
        r, H = r[is_inlier].ravel(), H[is_inlier].reshape(-1, H.shape[2])
        self._add(self._columns["heading"], H, r, 1.0 / correlated)

    def _find_searched(self, leaps: np.ndarray) -> list[int]:
        """Find the sensors whose heading is searched, and return the order (k,) in which, after all others."""
        relative_var = self._relative_var()
        is_narrow = relative_var < SEARCH_STD**2
        best = int(np.lexsort((np.diag(self.P)[: len(leaps)], -is_narrow.sum(axis=1)))[0])  # known to most others
        begins = leaps & ~is_narrow[best]
        searched = begins | self._searched
        searched[best] = False  # even if it was: after a loss of all sensors the others are relative to it
        order, relative_to = np.flatnonzero(~searched).tolist(), np.full(len(leaps), best)
        joined = [(near, far) for near, far, *_ in (*self._pair_columns, *self._hinge_columns)]
        for known in order if searched.any() else ():
            for i in (a + b - known for a, b in joined if known in (a, b)):
                if i not in order:
                    order.append(i)
                    relative_to[i] = known
        order += [i for i in range(len(leaps)) if i not in order]
        begins |= searched & (relative_to != self._relative_to)
        for i in (i for i in order if searched[i]):
            var = relative_var[i, relative_to[i]]
            if begins[i]:
                self._turned[i], self._log_likelihood[i] = 0.0, -0.5 * CIRCLE**2 / var
            else:
                searched[i] = var > FOUND_STD**2 or searched[relative_to[i]]
        self._searched, self._relative_to = searched, relative_to
        return order

    def _relative_var(self) -> np.ndarray:
        """Return the variance (k, k) [rad²] of each heading relative to each other one."""
        P = self.P[: len(self.names), : len(self.names)]
        return np.asarray(np.diag(P)[:, None] + np.diag(P) - 2.0 * P)

    def _search(self, order: list[int], quat_WL: np.ndarray, sides: np.ndarray, tilted: np.ndarray) -> None:
        """Search headings by the observations of a knot: estimate each by its likeliest peak, and by the second moment
        about that, to which all the others contribute.
        """
        x, relative_var = self.x.copy(), self._relative_var()
        for i in (i for i in order if self._searched[i]):
            other = self._relative_to[i]
            relative = x[i] - x[other]
            var = np.where(tilted | (relative_var[other] > SEARCH_STD**2), np.inf, relative_var[other])
            log_likelihood = self._log_likelihood[i]
            if not tilted[i]:
                log_likelihood += self._weigh_headings(x, i, CIRCLE - self._turned[i], var, quat_WL, sides)
            probability = np.exp(log_likelihood - log_likelihood.max())
            probability /= probability.sum()
            off = wrap_angle(CIRCLE - CIRCLE[np.argmax(probability)])
            in_peak = np.where(np.abs(off) < PEAK, probability, 0.0)
            mean = CIRCLE[np.argmax(probability)] + in_peak @ off / in_peak.sum()
            variance = CELL_VAR + probability @ wrap_angle(CIRCLE - mean) ** 2
            turned = wrap_angle(mean - self._turned[i])
            self._turned[i] += turned
            self.x[i] = self.x[other] + relative + turned
            self.P[i], self.P[:, i] = self.P[other], self.P[:, other]
            self.P[i, i] += variance

    def _weigh_headings(
        self, x: np.ndarray, i: int, turns: np.ndarray, var: np.ndarray, quat_WL: np.ndarray, sides: np.ndarray
    ) -> np.ndarray:
        """Return the log-likelihood (g,) of x with sensor i's heading turned by each of (g,) [rad].

        `var` (k,) [rad²] is that of the other headings; of an infinite one nothing is observed.
        """
        total, m, g = np.zeros(len(turns)), len(quat_WL), len(turns)
        correlated = max(1.0, ACCELERATION_CORRELATION_S * self.rate_hz)
        for misfit, columns in zip(self._misfits, self._pair_columns, strict=True):
            near, far, joint = columns[:3]
            if i not in (near, far) or not np.isfinite(var[near + far - i]) or not len(sides):
                continue
            angle = x[near] - x[far] + x[joint]
            e, jacobian, f = linearize_joint(sides[:, near], sides[:, far], angle, x[columns[3:10]], x[columns[10:]])
            H = jacobian.reshape(-1, len(_JOINT_JACOBIAN)) @ _JOINT_JACOBIAN
            # |e|² when f is turned about the vertical by u: far² + f² − 2 far · f.
            u, far_f = turns * (1.0 if i == near else -1.0), e + f
            along, across = np.sum(f[:, :2] * far_f[:, :2]), np.sum(f[:, 0] * far_f[:, 1] - f[:, 1] * far_f[:, 0])
            squares = np.sum(e**2) + 2.0 * along - 2.0 * (along * np.cos(u) + across * np.sin(u))
            weight = _weigh_joint(misfit, float(squares.min()) / e.size, H, correlated)
            # What is constant about the sensors is off by as much for long.
            P = self.P[np.ix_(columns[2:], columns[2:])]
            constant_var = float(np.mean(np.sum(H[:, 2:] @ P * H[:, 2:], axis=1)))
            weight /= 1.0 + weight * constant_var * FORCE_CORRELATION_S * self.rate_hz
            total -= 0.5 * weight * squares
        for hinge, columns, std in zip(self.hinges, self._hinge_columns, self._hinge_std, strict=True):
            moves, on = columns[:2]
            other = moves + on - i
            if i not in (moves, on) or not np.isfinite(var[other]):
                continue
            headings = np.tile(x[columns[:2]], (m, g, 1))
            headings[:, :, 0 if i == moves else 1] += turns
            quat_on, quat_moves = (np.repeat(quat_WL[:, at], g, axis=0) for at in (on, moves))
            r, H, excess = linearize_hinge(hinge, quat_on, quat_moves, headings.reshape(-1, 2))
            by_other, H = H[:, 0 if other == moves else 1], H[:, 2:]
            r = r + H @ x[columns[2:]]
            r_var = std**2 + var[other] * by_other**2 + np.sum(H @ self.P[np.ix_(columns[2:], columns[2:])] * H, axis=1)
            misfit = np.log1p(r**2 / (TAIL * r_var)) + np.log1p(excess**2 / (TAIL * RANGE_STD**2))
            total -= 0.5 * TAIL * misfit.reshape(m, g).sum(axis=0) / max(1.0, HINGE_CORRELATION_S * self.rate_hz)
        return total

    def find_turned_mounts(self) -> dict[str, tuple[float, float]]:
        """Find the sensors with a mount that is wrong by a rotation about the vertical of the start pose, which gravity
        does not show: segment → that rotation [rad] and its limit.

        Of two sensors that disagree the one is wrong whose rotation brings it nearer to more of its neighbours, or else
        the one below.
        """
        turns = self._compare_neighbours()
        wrong = {pair for pair, (turn, limit) in turns.items() if abs(turn) > limit}

        def count_nearer(pair: tuple[str, str]) -> tuple[float, int, int]:
            own = np.array([turn for (name, _), (turn, _) in turns.items() if name == pair[0]])
            nearer = int(np.sum(np.abs(wrap_angle(own - turns[pair][0])) < np.abs(own)))
            return nearer / len(own), nearer, self.names.index(pair[0])

        turned = dict[str, tuple[float, float]]()
        while wrong:
            best = max(sorted(wrong), key=count_nearer)
            turned[best[0]] = turns[best]
            wrong = {pair for pair in wrong if best[0] not in pair}
        return turned

    def _compare_neighbours(self) -> dict[tuple[str, str], tuple[float, float]]:
        """Return the rotation [rad] of a sensor against its neighbour by the accelerations of their joint, whatever is
        stated, less that by their mounts, and the limit [rad] of what else may feign it.
        """
        turns = dict[tuple[str, str], tuple[float, float]]()
        cov = self.start_cov + self.mount_cov + np.diag(self._first_drift_var)
        # In units in which no two sensors agree better than `ACCELERATION_STD`.
        unit, weight = ACCELERATION_STD / LEAST_MISMATCH, LEAST_MISMATCH * np.sqrt(LEAST_CORRELATION_S * SAMPLES_HZ)
        for (near, far), levers, lever_std in zip(self.pairs if self._first_sides else (), *self._levers, strict=False):
            at = [self.names.index(name) for name in (near, far)]
            sides = np.concatenate([first[:, at] for first in self._first_sides]) / unit
            sides = sides[np.isfinite(sides).all(axis=(1, 2, 3))]
            if len(sides) < LEAST_S * self.rate_hz:
                continue
            # Levers are near the usual ones, by one more sample each: a person who spins may seem to have any others.
            sides[..., 0] += np.einsum("mkac,kc->mka", sides[..., 1:], levers.reshape(2, 3))
            usual = np.zeros((2, 2, 3, 4))
            usual[[0, 1], [0, 1], :, 1:] = weight / lever_std * np.eye(3)
            heading, std = estimate_heading(*np.concatenate([sides, usual]).swapaxes(0, 1))
            # That is of independent observations; what is coherent in their misfit does not average out.
            coherent = 2.0 * LARGEST_COHERENT_SHARE**2 * len(sides) / (LEAST_CORRELATION_S * SAMPLES_HZ)
            std *= float(np.sqrt(1.0 + coherent))
            limit = MOUNT_MOVED_STDS * float(np.sqrt([1.0, -1.0] @ cov[np.ix_(at, at)] @ [1.0, -1.0] + std**2))
            turn, limit = float(wrap_angle(np.array(heading))), max(limit, float(np.deg2rad(MOUNT_WARNING_DEG)))
            if MOUNT_MOVED_STDS * std < 0.5 * np.pi:  # else the opposite heading may explain them too
                turns |= {(far, near): (turn, limit), (near, far): (-turn, limit)}
        return turns

    def estimate(self, x: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return δ (k,) [rad], its covariance (k, k) [rad²], and that of the segments' headings near the start pose.

        δ begins at s − ε_z, by errors s of the start pose and ε_z of the mount, and grows by the drift; a segment that
        hangs is off by δ + ε_z.
        """
        heading, mount = self._columns["heading"], self._columns["mount"]
        cov, both = P[np.ix_(heading, heading)], P[np.ix_(heading, mount)]
        return x[heading], cov, cov + P[np.ix_(mount, mount)] + both + both.T


def _list_hinges(
    model: BodyModel, start_pose: StartPose, names: Sequence[str], calibrated: Mapping[str, Hinge]
) -> list[tuple[HingeJoint, float, float, float]]:
    """List the hinges between two sensors, each with three standard deviations [rad]: of its axis about the long axis
    of the segment above, of its axis across, and of the angle between its plane and the segment below.

    A `calibrated` axis is relative to the calibrated mounts and holds as long as they do.
    """
    hinges = list[tuple[HingeJoint, float, float, float]]()
    for hinge in find_hinges(model, start_pose, names):
        if (own := calibrated.get(hinge.name)) is not None:
            hinge = hinge._replace(axis=start_pose.turn(hinge.on, own.axis), per_twist=own.per_twist or 0.0)
            hinges.append((hinge, AXIS_STD, TILT_STD, own.std))
        elif not model.table.is_mechanism:
            axis_std = float(np.hypot(hinge.common_std, hinge.mirror_std))
            hinges.append((hinge, axis_std, hinge.tilt_std, hinge.softness))
    return hinges


def _compute_start_covariance(
    first: Recording, names: Sequence[str], subject: Subject, model: BodyModel, repeat_share: float
) -> np.ndarray:
    """Compute the covariance (k, k) [rad²] of the headings at the end of the start pose, by the pose."""
    table, var = model.table, np.full(len(names), REFERENCE_START_STD**2)
    for i, name in enumerate(names):
        if name != table.reference:
            start_pose = StartPose(table=table, repeat_share=repeat_share)
            var[i] = compute_start_heading_var(first, name, subject, start_pose)
    # Since W's x is where the torso faces, its turn is an error of all headings that it does not carry with it.
    carried = [table.is_mechanism or model.find_trunk(name) in (None, table.reference) for name in names]
    shares = TURN_VAR_SHARE * np.outer(np.logical_not(carried), np.logical_not(carried))
    np.fill_diagonal(shares, 1.0)
    return np.asarray(shares * np.minimum.outer(var, var))


def _weigh_joint(misfit: np.ndarray, squares: float, H: np.ndarray, correlated_samples: float) -> float:
    """Return the weight [s⁴/m²] of a joint's rows in a knot, of slope H and mean square [m²/s⁴]."""
    variance, coherent_var = _split_misfit(misfit, correlated_samples) if misfit[-1] else (0.0, 0.0)
    weight = 1.0 / (max(squares, variance, ACCELERATION_STD**2) * correlated_samples)
    # What is coherent counts as one observation over the time that is remembered.
    return float(weight / (1.0 + weight * float(H[:, 0] @ H[:, 0]) * coherent_var * (misfit[-1] / (len(H) // 3))))


def _split_misfit(misfit: np.ndarray, correlated_samples: float) -> tuple[float, float]:
    """Return the variance [m²/s⁴] of a joint's recent misfit, and that [rad²] of the heading that it can feign.

    Some of a misfit repeats with the motion, as that of soft tissue with the gait: it is coherent with the joint's
    force and does not average out. A heading explains one coherent misfit, which turns the force about the vertical.
    The other ones, which stretch it or mix it with the vertical, show how large coherent misfits are in this motion.

    Parameters
    ----------
    misfit : (16,) of `HeadingFilter`
    correlated_samples : are one observation; so many of them have coherent parts by chance
    """
    products, squares, force, samples = misfit[:9].reshape(3, 3), misfit[9:12], misfit[12:15], misfit[15]
    variance = float(squares.sum() / (3.0 * samples))
    horizontal = force[0] + force[1]
    if not horizontal:
        return variance, 0.0
    E = products / horizontal
    mixed = E[:2, 2] * np.sqrt(horizontal / max(force[2], 1e-9 * horizontal))
    parts = np.array([E[0, 0] + E[1, 1], E[0, 0] - E[1, 1], E[0, 1] + E[1, 0], *mixed, *E[2, :2]])
    by_chance = variance / horizontal * correlated_samples / samples
    coherent = max(float(np.mean(parts**2)) - by_chance, 0.0)
    return variance, min(coherent, LARGEST_COHERENT_SHARE**2 * variance * 2.0 * samples / horizontal)


def symmetric(P: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (P + P.T))
