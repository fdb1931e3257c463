"""The repetitions of a movement, excursions of one angle out and back, and their time-normalised curves, 0 to 100 %."""

from typing import NamedTuple

import numpy as np

from ..filters.butterworth import low_pass
from .euler import count_turns
from .joints import JOINTS, MAX_NEAR_LOCK, Angles

POINTS = 101  # 0, 1, … 100 %
PERCENT = np.linspace(0.0, 100.0, POINTS)
# Found on the angle below this frequency [Hz]; voluntary motion of limbs is slower (Winter 2009, 2.2.3).
CUTOFF_HZ = 5.0
MIN_RANGE = np.radians(10.0)  # of the angle; what is smaller is sway, or noise
MIN_REPETITIONS = 3
# Rise and fall of an excursion: this share of the angle's range at first, then of the median excursion.
FIRST_SHARE, SHARE = 0.25, 0.5
MAX_SHARE = 2.0  # of the median excursion; what is larger is another movement, as standing up
# A movement begins and ends where the rate is this share of its peak, as in studies of reaching, and the angle has
# covered at most `LOW_SHARE` of the excursion: a stop on the way is part of the repetition, a rest between two is not.
ONSET_SHARE = 0.05
LOW_SHARE = 0.2
CUT_SHARE = 0.2  # of the peak rate; an excursion that is faster where the recording begins or ends is cut by it
# An excursion whose curve correlates less with the median curve is left out, as one with a long stop in it; where that
# is more than `MAX_LEFT_OUT` of them, or the rest has a lower `compute_cmc`, it is not one movement repeated.
MIN_CORRELATION = 0.8
MAX_LEFT_OUT = 0.25
MIN_CMC = 0.85
_REST_SHARE = 0.15  # of the range; nearer than this to an end of it the angle dwells there
_CLEARLY_LONGER = 1.5  # times as long at one end: the angle rests there
_NO_SPANS = np.empty((0, 2))
MAX_GAP = 0.2  # of the samples of a main angle
MAX_HIDDEN = 0.1  # of the samples of a repetition, which the main angle is not determined for


class Repetitions(NamedTuple):
    """Repetitions of a movement."""

    spans: np.ndarray  # (r, 2) [s], begin and end
    source: str  # the angle they were found by, as ``right_elbow_flexion``, or the phase that marks them; empty: none
    rising: bool | None = None  # the angle grows first; None where a phase marks them
    cmc: float = float("nan")  # of the curves of that angle; NaN where a phase marks them
    left_out: int = 0  # excursions of the angle that are unlike the others, or in gaps
    reason: str = ""  # why there are none; empty where there are some


def list_angles(angles: Angles) -> dict[str, tuple[str, int]]:
    """Angle, as ``right_elbow_flexion`` → its joint and place among the joint's three."""
    return {f"{joint}_{name}": (joint, k) for joint, each in angles.joints.items() for k, name in enumerate(each.names)}


def find_main_angle(angles: Angles) -> str | None:
    """Return the angle of the largest range (2 to 98 %) among those that are determined nearly throughout.

    Of joints between two segments; of thorax and pelvis in W only where there are no others, for a person who turns
    round has the largest range there. An angle that is near gimbal lock, or in gaps, for longer is left out
    (`MAX_NEAR_LOCK`, `MAX_GAP`), and so is one between two segments that went once around its lock. None where all are.
    """
    ranges: dict[str, tuple[bool, float]] = {}
    for angle, (joint, k) in list_angles(angles).items():
        each, hidden = angles[joint], angles[joint].hidden(k)
        if np.mean(hidden & ~each.gap) <= MAX_NEAR_LOCK and np.mean(each.gap) <= MAX_GAP:
            low, high = np.percentile(each.values[~hidden, k], [2.0, 98.0])
            between = JOINTS[joint].proximal != "world"
            if not between or high - low < 2.0 * np.pi:
                ranges[angle] = (between, float(high - low))
    return max(ranges, key=lambda angle: ranges[angle], default=None)


def find_repetitions(angles: Angles, main_angle: str | None = None, rising: bool | None = None) -> Repetitions:
    """Find the repetitions of a movement: excursions of one angle, out and back.

    The angle is low-passed for this purpose alone. A repetition begins where it rests, at that end of its range near
    which it spends clearly more time, else at the one nearer to zero. Excursions that the recording cuts, or that are
    far larger or smaller than the others, unlike them, or in gaps, are left out; if these are too many, the movement
    does not repeat. Of random motions three in a hundred are taken for repetitions.

    Parameters
    ----------
    main_angle : of `list_angles`, as ``right_elbow_flexion``; None: that of `find_main_angle`
    rising : the angle grows first in a repetition; None: by where it rests
    """
    places = list_angles(angles)
    source = main_angle or find_main_angle(angles)
    if source is None:
        limits = f"{100 * MAX_NEAR_LOCK:g} % of the time, or in gaps for over {100 * MAX_GAP:g} %"
        return Repetitions(_NO_SPANS, "", reason=f"each angle is near gimbal lock for over {limits}")
    joint, k = places[source]
    values, hidden = angles[joint].values[:, k], angles[joint].hidden(k)
    none = Repetitions(_NO_SPANS, source)
    if np.count_nonzero(~hidden) < 10:
        return none._replace(reason="the angle is not determined for even 10 samples")
    rate_hz = 1.0 / float(np.median(np.diff(angles.time)))
    known = np.interp(angles.time, angles.time[~hidden], values[~hidden])
    signal = low_pass(known, min(CUTOFF_HZ, 0.4 * rate_hz), rate_hz)
    low, high = np.percentile(signal, [2.0, 98.0])
    if high - low < MIN_RANGE:
        reason = f"the angle has a range of {np.degrees(high - low):.1f}°, and {np.degrees(MIN_RANGE):.0f}° are needed"
        return none._replace(reason=reason)
    none = none._replace(rising=_rests_low(signal, low, high) if rising is None else rising)
    spans = _find_spans(angles.time, signal if none.rising else -signal, float(high - low))
    if len(spans) < MIN_REPETITIONS:
        times = ("no time", "once", "twice")[len(spans)]
        return none._replace(reason=f"the angle goes out and back {times}, and {MIN_REPETITIONS} times are needed")
    curves, lost = np.moveaxis(normalize_time(angles.time, np.column_stack([signal, hidden]), spans), 2, 0)
    alike = _are_alike(curves) & (lost.mean(axis=1) <= MAX_HIDDEN)
    left_out, cmc = int(np.count_nonzero(~alike)), compute_cmc(curves[alike])
    none = none._replace(cmc=cmc, left_out=left_out)
    if left_out > MAX_LEFT_OUT * len(spans) or np.count_nonzero(alike) < MIN_REPETITIONS:
        return none._replace(reason=f"{left_out} of its {len(spans)} excursions are unlike the others")
    if cmc < MIN_CMC:
        reason = f"its {len(spans)} excursions are not alike: their CMC is {cmc:.3f}, and {MIN_CMC} is needed"
        return none._replace(reason=reason)
    return none._replace(spans=spans[alike])


def _are_alike(curves: np.ndarray) -> np.ndarray:
    """(r,) bool, which of the curves (r, p) correlate with the median curve."""
    centred = curves - curves.mean(axis=1, keepdims=True)
    usual = np.median(centred, axis=0) - np.median(centred, axis=0).mean()
    size = np.linalg.norm(centred, axis=1) * np.linalg.norm(usual)
    return np.asarray(centred @ usual >= MIN_CORRELATION * np.maximum(size, 1e-12))


def _rests_low(signal: np.ndarray, low: float, high: float) -> bool:
    """Whether the angle rests at the low end of its range; where it rests at neither, at the one nearer to zero."""
    margin = _REST_SHARE * (high - low)
    at_low, at_high = np.count_nonzero(signal < low + margin), np.count_nonzero(signal > high - margin)
    if max(at_low, at_high) > _CLEARLY_LONGER * min(at_low, at_high):
        return bool(at_low > at_high)
    return bool(abs(low) <= abs(high))


def _find_spans(time: np.ndarray, signal: np.ndarray, full_range: float) -> np.ndarray:
    """Spans (r, 2) [s] of the excursions upwards of a signal."""
    excursions = _find_excursions(signal, FIRST_SHARE * full_range)
    if not excursions:
        return _NO_SPANS
    usual = float(np.median([signal[peak] - 0.5 * (signal[a] + signal[b]) for a, peak, b in excursions]))
    rate = np.gradient(signal, time)
    spans = []
    for before, peak, after in _find_excursions(signal, SHARE * usual):
        up, down = slice(before, peak + 1), slice(peak, after + 1)
        start = _find_onset(signal[up], rate[up], cut=before == 0)
        end = _find_onset(signal[down][::-1], -rate[down][::-1], cut=after == len(signal) - 1)
        size = signal[peak] - 0.5 * (signal[before] + signal[after])
        if start is not None and end is not None and size <= MAX_SHARE * usual:
            spans.append((time[before + start], time[after - end]))
    return np.array(spans).reshape(-1, 2)


def _find_onset(signal: np.ndarray, rate: np.ndarray, *, cut: bool) -> int | None:
    """The last sample of rest on the way from a valley to a peak (n,); `cut`: the valley is an end of the recording.

    None where the recording begins on the way.
    """
    rests = (signal <= signal[0] + LOW_SHARE * (signal[-1] - signal[0])) & (rate <= ONSET_SHARE * rate.max())
    if rests.any():
        return int(np.flatnonzero(rests)[-1])
    return None if cut and rate[0] > CUT_SHARE * rate.max() else 0


def _find_excursions(signal: np.ndarray, least: float) -> list[tuple[int, int, int]]:
    """Valley, peak and valley of each excursion that rises and falls by at least `least`."""
    from scipy.signal import find_peaks  # half a second to load

    peaks: list[int] = []
    for peak in find_peaks(signal, prominence=least)[0].tolist():
        if peaks and min(signal[peaks[-1]], signal[peak]) - signal[peaks[-1] : peak].min() < least:
            peaks[-1] = max(peaks[-1], peak, key=signal.__getitem__)  # two of one height
        else:
            peaks.append(peak)
    ends = [0, *peaks, len(signal) - 1]
    return [
        (first + int(np.argmin(signal[first : peak + 1])), peak, peak + int(np.argmin(signal[peak : last + 1])))
        for first, peak, last in zip(ends, ends[1:], ends[2:], strict=False)
    ]


# Curves ------------------------------------------------------------------------------------------------------------


class MeanCurve(NamedTuple):
    """The curves of one angle over repetitions; NaN where fewer than two, or half of them, are determined."""

    curves: np.ndarray  # (r, POINTS) [rad], NaN where a repetition is not determined
    mean: np.ndarray  # (POINTS,) [rad]
    sd: np.ndarray  # (POINTS,) [rad], between repetitions, with r − 1
    std: np.ndarray  # (POINTS,) [rad], what the pose states for one repetition, root mean square
    n: np.ndarray  # (POINTS,) repetitions that are determined
    cmc: float  # `compute_cmc`


def normalize_time(time: np.ndarray, values: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Return values (n, k) at `POINTS` even times of each span (r, 2) [s], linear between samples: (r, POINTS, k)."""
    at = spans[:, :1] + np.diff(spans, axis=1) * PERCENT / 100.0
    return np.stack([np.interp(at, time, column) for column in values.T], axis=2)


def compute_cmc(curves: np.ndarray) -> float:
    """Compute the coefficient of multiple correlation of curves (r, p) of one session, 1 where they are equal.

    Kadaba et al. 1989, "Repeatability of kinematic, kinetic, and electromyographic data in normal adult gait", Journal
    of Orthopaedic Research 7:849–860, its adjusted coefficient within a day. 0 where the curves differ from each other
    by as much as they move; NaN of fewer than two curves, or without a point that all have.
    """
    curves = curves[:, np.isfinite(curves).all(axis=0)]
    r, p = curves.shape
    if r < 2 or p < 2:
        return float("nan")
    within = np.square(curves - curves.mean(axis=0)).sum() / (p * (r - 1))
    total = np.square(curves - curves.mean()).sum() / (r * p - 1)
    return float(np.sqrt(max(0.0, 1.0 - within / total))) if total > 0.0 else float("nan")


def compute_mean_curves(angles: Angles, spans: np.ndarray) -> dict[str, tuple[MeanCurve, ...]]:
    """Compute joint → the curves of its three angles over the repetitions `spans` (r, 2) [s]."""
    curves = {}
    for name, joint in angles.joints.items():
        variance = np.full_like(joint.values, np.nan) if joint.std is None else joint.std**2
        hidden = np.column_stack([joint.hidden(k) for k in range(3)])
        values, variances = (
            normalize_time(angles.time, np.where(hidden, np.nan, each), spans) for each in (joint.values, variance)
        )
        curves[name] = tuple(_mean_curve(values[:, :, k], variances[:, :, k]) for k in range(3))
    return curves


def _mean_curve(curves: np.ndarray, variances: np.ndarray) -> MeanCurve:
    known = np.isfinite(curves)
    means = np.where(known, curves, 0.0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
    curves = curves - count_turns(means)[:, None]
    n = known.sum(axis=0)
    enough = (n >= 2) & (2 * n >= len(curves))
    mean = np.where(known, curves, 0.0).sum(axis=0) / np.maximum(n, 1)
    sd = np.sqrt(np.where(known, np.square(curves - mean), 0.0).sum(axis=0) / np.maximum(n - 1, 1))
    std = np.sqrt(np.where(known, variances, 0.0).sum(axis=0) / np.maximum(n, 1))
    mean, sd, std = (np.where(enough, each, np.nan) for each in (mean, sd, std))
    return MeanCurve(curves, mean, sd, std, n, compute_cmc(curves))
