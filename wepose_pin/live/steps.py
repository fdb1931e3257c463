"""The steps of the guided session: the table, and a generator for each."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from ..calibration import Calibration, Protocol
from ..calibration.observability import format_longest
from ..calibration.protocols import Axis
from ..calibration.protocols import Step as ProtocolStep
from ..calibration.quality import ENOUGH_SAMPLES, find_open_intervals
from ..diagnostics import Diagnostic, render, render_all
from ..errors import BadData, WeposeError
from .assignment import ShakeDetector
from .guide import Calibrated, Guide, Step, StepRun, Turn
from .monitor import check_units
from .state import LENGTH_NAMES, Action, GuideView, LengthEstimate, join_names
from .ticks import StillPose

STATIC_S = 2.0  # [s] of standing still in which the sensors are checked
START_POSE_S = 4.0  # [s] where the protocol does not say how long
GET_READY_S = 8.0  # [s] to leave the keyboard and take the pose
RESUME_S = 3.0  # [s] after an interruption until the phase goes on
MOST_LOSS_S = 2.0  # [s] of a lost sensor after which its heading has to be found anew
SENTENCE_S = 9.0  # [s] for which each sentence of an instruction stands
FIRST_ESTIMATE_S, ESTIMATE_PERIOD_S = 12.0, 4.0  # [s] of motion before the first estimate, and between two
FINISH_AFTER_S = 15.0  # [s] of a phase after which it may be finished
MORE_S = 30.0  # [s] of motion that "more" adds
MOST_ADVICE = 2  # sentences at a time
APART_S, APART = 3.0, 0.10  # [s] newest motion, and its median gap [m] above which the closure seems open
STATURE = "stature"  # that a person may enter in place of a length
# Codes of reasons that more motion takes away, or begin so.
TOO_LITTLE = ("motion-", "scale-", "length-uncertain", "mount-heading-uncertain", "closure-open")
# Code → what to do, of those whose remedy is an option of a command: here it is asked for.
MEASURE_IT = "Measure what is asked for and enter it here."
REMEDIES = {
    "scale-uncertain": MEASURE_IT,
    "sensors-exchanged": "Exchange them here.",
    "length-uncertain": "Move further and faster, through the whole reach.",
}

CONTINUE = Action("next", "Continue", "n")
READY = Action("next", f"I am ready ({GET_READY_S:.0f} s to take the pose)", "n")
FINISH = Action("next", "Finish", "n")
AGAIN = Action("again", "Once more", "a")
ANEW = Action("again", "Assign all anew", "a")
RESTART = Action("restart", "All again from the start pose", "a")
SKIP = Action("skip", "Skip", "s")
KEEP = Action("skip", "Keep as it was", "s")
ACCEPT = Action("accept", "Accept and track", "y")
MORE = Action("more", f"{MORE_S:.0f} s more motion", "m")
EXCHANGE = Action("exchange", "Exchange these sensors", "x")
MEASURE = Action("measure", "Use this length", "l")  # its entry names the length

T = TypeVar("T")


def make_steps(protocol: Protocol) -> list[Step]:
    """The table of steps of a guided session with the motions of this protocol."""
    motions = [step for step in protocol.steps if step.phase != "start"]
    return [
        Step("sensors", "Sensors", find_sensors, before_attempt=True),
        Step("assignment", "Segments", assign_segments, before_attempt=True),
        Step("static", "Check", check_sensors),
        Step("start", "Start pose", hold_start_pose),
        *(Step(m.phase, m.phase.replace("_", " ").capitalize(), partial(perform_motion, m)) for m in motions),
        Step("quality", "Result", show_result, records=False),
    ]


# Before the motion ---------------------------------------------------------------------------------------------------


def find_sensors(guide: Guide, _: Turn) -> StepRun:
    """See which sensors are there."""
    needed, warnings = len(guide.needs), _warn_of_trackers(guide)
    while True:
        count = len(guide.sending) - len(guide.silent)
        awaited = guide.source.describe_awaited([name for name in guide.source.sensors if name not in guide.sending])
        sentence = f"Strap the sensors on and switch them on: {count} of {needed} send."
        if count >= needed:
            sentence = f"{count} sensors send. Are all strapped on tightly?"
        elif awaited:
            sentence += f" Waiting for {awaited}."
        asked = yield GuideView(
            sentence,
            guide.describe_problems(),
            progress=min(1.0, count / max(needed, 1)),
            reasons=warnings,
            actions=(CONTINUE,) if count >= needed else (),
        )
        if asked is CONTINUE:
            return Turn()


def _warn_of_trackers(guide: Guide) -> tuple[str, ...]:
    """What the motion cannot show of sensors that measure orientations in worlds of their own."""
    table, setup, protocol = guide.options.model.table, guide.options.setup, guide.options.protocol
    trackers = [name for name, aligned in guide.source.orientations.items() if not aligned]
    bows = any(isinstance(each, Axis) and each.segment == table.reference for each in protocol.conditions)
    if table.is_mechanism or not trackers or bows or table.reference in setup.mounts:
        return ()
    return (
        f"These sensors measure orientations and no accelerations: the motion does not show how the one on the "
        f"{join_names([table.reference])} is turned, and the calibration will not pass. Add a bow to the protocol "
        f"(+bow), or state that sensor's mount, as docs/live.md says.",
    )


def assign_segments(guide: Guide, turn: Turn) -> StepRun:
    """Find by shaking which sensor sits on which segment."""
    needs, before = set(guide.needs), dict[str, str]()
    if turn.again and needs <= set(guide.segments.values()):
        before = guide.segments
    elif not turn.again:
        known = {name: name for name in guide.order} | dict(guide.options.known) | guide.segments
        known = {name: known[name] for name in guide.sending if name in known}
        if needs <= set(known.values()):
            guide.segments = known
            return Turn()
    guide.segments, shakes = {}, ShakeDetector()
    while True:
        shakes.push(guide.samples, guide.source.orientations)
        free = [name for name in guide.sending if name not in guide.segments]
        shaken = shakes.find(free)
        if shaken is not None:
            guide.segments[shaken] = _list_open(guide)[0]
            free.remove(shaken)
        if len(free) == len(_list_open(guide)) == 1:
            guide.segments[free[0]] = _list_open(guide)[0]
        segments = _list_open(guide)
        if not segments:
            return Turn()
        asked = yield GuideView(
            f"Shake the sensor on the {join_names(segments[:1])}.",
            guide.describe_problems() or _describe_shaking(guide, shakes),
            progress=len(guide.segments) / len(guide.needs),
            highlight=segments[0],
            actions=(*[ANEW] * bool(guide.segments), *[KEEP] * bool(before)),
        )
        if asked is KEEP:
            guide.segments = before
            return Turn()
        if asked is ANEW:
            guide.segments, shakes = {}, ShakeDetector()


def _list_open(guide: Guide) -> list[str]:
    """Segments without a sensor, the ends of limbs first: the forearm moves when the upper arm is shaken."""

    def count_above(segment: str | None) -> int:
        return 0 if segment is None else 1 + count_above(guide.options.model.parents.get(segment))

    segments = [name for name in guide.needs if name not in guide.segments.values()]
    return sorted(segments, key=count_above, reverse=True)


def _describe_shaking(guide: Guide, shakes: ShakeDetector) -> str:
    """A sentence on motion that assigns no sensor; empty: there is none."""
    moving = shakes.list_moving()
    if not moving:
        return ""
    if not shakes.is_calm:
        return f"Hold all sensors still for a moment. Moving: {join_names(moving)}."
    shaken = [name for name in moving if shakes.is_shaken(name)]
    known = [guide.segments[name] for name in shaken if name in guide.segments]
    if len(shaken) - len(known) > 1:
        return "Several sensors move. Hold the others still."
    if len(shaken) == len(known) > 0:
        return f"This is the sensor on the {join_names(known[-1:])}, which is known already."
    return "" if shaken else f"Too gentle: {join_names(moving)}. Shake harder."


class Stillness:
    """Waits in the ticks of the guide's attempt until no sensor has moved for some seconds."""

    def __init__(self, guide: Guide, seconds: float) -> None:
        self._guide, self._attempt, self.seconds = guide, guide.begin_attempt(), seconds
        self._pose: StillPose | None = None  # from the first tick on

    def take(self) -> tuple[float, float] | None:
        """Take the newest ticks; return begin and end [s] of standing still once the seconds are full."""
        for ticks in self._guide.ticks:
            self._pose = self._pose or StillPose(self._attempt.stream, self.seconds)
            row = self._pose.push_ticks(ticks)
            if row is not None:
                end = float(ticks.time[row])
                return end - self.seconds + 1.0 / self._attempt.stream.clock.rate_hz, end
        return None

    @property
    def progress(self) -> float:
        return 0.0 if self._pose is None else self._pose.held_s / self.seconds

    @property
    def moving(self) -> str:
        """The segments that have just moved, as words; empty: none."""
        if self._pose is None or self._pose.state != "moved":
            return ""
        return join_names([self._attempt.segments[k] for k in self._pose.moving])


def check_sensors(guide: Guide, _: Turn) -> StepRun:
    """Check the units of the sensors while the person stands still."""
    attempt, still = guide.begin_attempt(), Stillness(guide, STATIC_S)
    faults, actions = list[str](), [SKIP]
    while True:
        held = None if faults else still.take()
        if held is not None:
            recording = replace(attempt.recording(), phases={"static": ((held[1] - STATIC_S, held[1]),)})
            try:
                diagnostics = check_units(recording, guide.source)
            except BadData as error:
                faults, actions = [str(error)], [AGAIN]
            else:
                faults, actions = [render(d).line() for d in diagnostics if d.code == "accel-scale"], [AGAIN, SKIP]
                if not faults:
                    return Turn()
        moved = f"{still.moving.capitalize()} moved." if still.moving else ""
        note = guide.describe_problems() or moved
        view = GuideView("Stand still for a moment.", note, progress=still.progress, actions=tuple(actions))
        asked = yield view._replace(reasons=tuple(faults))
        if asked is SKIP:
            return Turn(skipped=True)
        if asked is AGAIN:
            still, faults, actions = Stillness(guide, STATIC_S), [], [SKIP]


def hold_start_pose(guide: Guide, turn: Turn) -> StepRun:
    """Wait until the person is ready, and until the start pose was held."""
    attempt, reason = guide.begin_attempt(), turn.reason
    stated = [step for step in guide.options.protocol.steps if step.phase == "start"]
    seconds = stated[0].seconds if stated else START_POSE_S
    do = stated[0].do if stated else "Stand still in the start pose."
    while True:
        asked = None
        while asked is not READY:
            offered = (READY, KEEP) if attempt.measured_s("start") > 0.0 else (READY,)
            asked = yield GuideView(do, guide.describe_problems() or reason, actions=offered)
            if asked is KEEP:
                return Turn()
        reason = ""
        guide.discard_phases()
        begin, still = guide.now + GET_READY_S, Stillness(guide, seconds)
        while asked is not AGAIN:
            countdown, note = begin - guide.now, guide.describe_problems()
            if countdown <= 0.0:
                held = still.take()
                if held is not None:
                    attempt.mark("begin", phase="start", time=held[0])
                    attempt.mark("end", phase="start", time=held[1])
                    return Turn()
                countdown = (1.0 - still.progress) * seconds
                if still.moving:
                    note = note or f"You moved ({still.moving}). Once more: {seconds:.0f} s still."
            asked = yield GuideView(do, note, countdown, progress=still.progress, actions=(AGAIN,))


# The motion ----------------------------------------------------------------------------------------------------------


class PhaseMarker:
    """Marks a phase in an attempt: it begins at a time, pauses where sensors are lost, and goes on after that.

    Attributes
    ----------
    begin : [s] at which it begins, or goes on
    running : whether the phase is open
    interruption : what the person should know of it; empty: there is none
    """

    def __init__(self, guide: Guide, phase: str) -> None:
        self._guide, self._attempt, self._phase = guide, guide.begin_attempt(), phase
        self.begin, self.running, self.interruption = guide.now + GET_READY_S, False, ""
        self._lost: set[str] = set()
        self._lost_time = (0.0, 0.0)  # [s] when the interruption began, and when a sensor was lost last

    def update(self) -> str:
        """Pause or go on, as sensors send; return why the start pose is needed again, empty where it is not."""
        guide, attempt = self._guide, self._attempt
        for ticks in guide.ticks:
            if ticks.lost.any():
                rows, sensors = np.nonzero(ticks.lost)
                self._interrupt([attempt.segments[k] for k in np.unique(sensors)], float(ticks.time[rows[0]]))
        if guide.silent:
            self._interrupt([guide.segments[name] for name in guide.silent], attempt.newest)
        elif not self.running and guide.now >= self.begin:
            loss_s = self._lost_time[1] - self._lost_time[0]
            if loss_s > MOST_LOSS_S:
                return (
                    f"No samples from {self._join_lost()} for {loss_s:.0f} s, and headings were lost with them: "
                    f"begin once more."
                )
            attempt.mark("begin", phase=self._phase, time=attempt.newest)
            self.running, self.interruption = True, ""
        return ""

    def pause(self, time: float) -> None:
        """End the phase at a time [s] for now."""
        if self.running:
            self._attempt.mark("end", phase=self._phase, time=time)
        self.running = False

    def _interrupt(self, segments: Sequence[str], time: float) -> None:
        """Pause at a time [s] until all sensors send again."""
        self.pause(time)
        if not self.interruption:
            self._lost, self._lost_time = set(), (time, time)
        self._lost |= set(segments)
        self._lost_time = self._lost_time[0], self._guide.now
        self.interruption = f"No samples from {self._join_lost()}: it goes on when they come again."
        self.begin = max(self.begin, self._guide.now + RESUME_S)

    def _join_lost(self) -> str:
        return self._guide.join_sensors([name for name in self._guide.order if name in self._lost])


def perform_motion(motion: ProtocolStep, guide: Guide, turn: Turn) -> StepRun:
    """Record a phase of the protocol; the person sees what the motion has determined so far."""
    attempt, phase = guide.begin_attempt(), motion.phase
    target_s, done_s = motion.seconds, attempt.measured_s(phase)
    if turn.again:
        target_s = max(target_s, done_s + min(MORE_S, target_s))
    elif done_s >= target_s:  # the person came back to an earlier step, and kept it
        return Turn()
    marker, estimates = PhaseMarker(guide, phase), estimate_gradually(guide, phase)
    try:
        while True:
            reason = marker.update()
            if reason:
                guide.discard_phases()
                return Turn("start", reason=reason)
            done_s = attempt.measured_s(phase)
            if done_s >= target_s:
                return Turn()
            finish = [FINISH] * (done_s > min(FINISH_AFTER_S, motion.seconds))
            view = GuideView(
                _choose_sentence(motion, done_s),
                marker.interruption,
                None if marker.running else max(0.0, marker.begin - guide.now),
                max(0.0, target_s - done_s),
                done_s / target_s,
                actions=(*finish, RESTART, *[SKIP] * (phase in guide.options.optional)),
                demonstration=phase,
            )
            estimate = next(estimates)
            asked = yield view if estimate is None else _add_estimate(view, estimate, marker, motion)
            if asked is FINISH:
                return Turn()
            if asked is RESTART:
                return Turn("start")
            if asked is SKIP:
                marker.pause(attempt.newest)
                attempt.mark("discard", phase=phase)
                return Turn(skipped=True)
    finally:
        marker.pause(attempt.newest)


def _choose_sentence(motion: ProtocolStep, done_s: float) -> str:
    """The sentence of the instruction after so much of the motion: first the first, then the others in turn."""
    sentences = [f"{part.strip().rstrip('.')}." for part in motion.do.replace("\n", " ").split(". ")]
    further, turn = sentences[1:] or sentences, int(done_s / SENTENCE_S)
    return sentences[0] if turn == 0 else further[(turn - 1) % len(further)]


class Calculation(Generic[T]):
    """A calculation in a thread of its own, which does not hold up the end of the program."""

    def __init__(self, compute: Callable[[], T]) -> None:
        self._compute, self._future = compute, Future[T]()
        threading.Thread(target=self._run, name="calibration", daemon=True).start()

    def _run(self) -> None:
        try:
            self._future.set_result(self._compute())
        except BaseException as error:
            self._future.set_exception(error)

    def take(self) -> T | WeposeError | None:
        """The result, or its `WeposeError`, or None while it is calculated; other errors are raised."""
        try:
            return self._future.result() if self._future.done() else None
        except WeposeError as error:
            return error


def estimate_gradually(guide: Guide, phase: str) -> Iterator[Calibration | None]:
    """Calibrate the recording so far again and again; iterate over the newest result, None where there is none."""
    attempt, newest, estimated_s = guide.begin_attempt(), None, 0.0
    calculation: Calculation[Calibration] | None = None
    while True:
        done_s = attempt.measured_s(phase)
        outcome = None if calculation is None else calculation.take()
        if outcome is not None:
            calculation, newest = None, outcome if isinstance(outcome, Calibration) else newest
        elif calculation is None and done_s >= max(FIRST_ESTIMATE_S, estimated_s + ESTIMATE_PERIOD_S):
            estimated_s = done_s
            calculation = Calculation(partial(guide.options.estimate, attempt.recording()))
        yield newest


def _add_estimate(view: GuideView, calibration: Calibration, marker: PhaseMarker, motion: ProtocolStep) -> GuideView:
    """The view with what the motion has determined so far."""
    newest = calibration.gap[calibration.time > calibration.time[-1] - APART_S]
    if calibration.exchanged and not marker.interruption:
        view = view._replace(note="Some sensors seem to sit on other segments than assigned: finish, and see.")
    elif marker.running and np.isfinite(newest).any() and np.nanmedian(newest) > APART:
        view = view._replace(note=f"{_choose_sentence(motion, 0.0)} They seem to be apart.")
    elif marker.running and calibration.quality.quality == "pass":
        view = view._replace(sentence="This is enough: finish, or go on for smaller uncertainties.")
    return _add_lengths(view, calibration)._replace(reasons=() if calibration.exchanged else _advise(calibration))


def _add_lengths(view: GuideView, calibration: Calibration) -> GuideView:
    subject = calibration.subject
    lengths = tuple(LengthEstimate(name, metres, subject.std(name)) for name, metres in subject.lengths.items())
    return view._replace(lengths=lengths, sample_size=(calibration.effective_sample_size, ENOUGH_SAMPLES))


def _advise(calibration: Calibration) -> tuple[str, ...]:
    """What to do while the person moves: about the parts of the motion that are too small, else the worst reason."""
    reasons = [reason for reason in calibration.quality.reasons if not reason.code.startswith("scale-")]
    motion = [reason for reason in reasons if reason.code.startswith("motion-")]
    advice = [REMEDIES.get(reason.code, render(reason).do) for reason in motion or reasons[:1]]
    return tuple(dict.fromkeys(advice))[:MOST_ADVICE]


# The result ----------------------------------------------------------------------------------------------------------


def show_result(guide: Guide, _: Turn) -> StepRun:
    """Calibrate the recording, and ask whether the result is accepted."""
    attempt, options = guide.begin_attempt(), guide.options
    attempt.log.flush()

    def calibrate() -> Calculation[Calibrated]:
        return Calculation(partial(options.calibrate, attempt.log.path, dict(guide.measured)))

    calculation, result, before = calibrate(), None, None  # `before`: the result before a length was entered
    entered = refused = ""  # its name, and why it cannot be
    while True:
        if result is None:
            result = calculation.take()
            if entered and isinstance(result, WeposeError):  # the result before it stays
                del guide.measured[entered]
                refused, result, entered = str(result), before, ""
        view, length = _view_result(guide, result)
        asked = yield view._replace(note=refused)
        if asked is ACCEPT and isinstance(result, Calibrated):
            guide.accept(result)
        elif asked is MORE:
            motions = [step for step in options.protocol.steps if step.phase != "start"]
            return Turn(max(motions, key=lambda step: step.seconds).phase, again=True)
        elif asked is RESTART:
            return Turn("start")
        elif asked is EXCHANGE and isinstance(result, Calibrated):
            _exchange(guide, result.calibration)
            return Turn("quality", again=True)
        elif asked is not None and asked.name == MEASURE.name:
            try:
                guide.measured[length] = 0.01 * float(guide.text.replace(",", "."))
            except ValueError:
                refused = f"'{guide.text}' is no length in cm, such as 38.5."
            else:
                entered, before, result, refused = length, result, None, ""
                calculation = calibrate()


def _exchange(guide: Guide, calibration: Calibration) -> None:
    """Assign the sensors as the calibration found them."""
    segments = {label: segment for segment, label in calibration.exchanged.items()}
    guide.begin_attempt().exchange(segments)
    guide.segments = {sensor: segments.get(segment, segment) for sensor, segment in guide.segments.items()}


def _view_result(guide: Guide, result: Calibrated | WeposeError | None) -> tuple[GuideView, str]:
    """What to say of the result, and the length that the person may measure; empty: none."""
    if result is None:
        return GuideView("The motion is being evaluated. You may move freely.", actions=(RESTART,)), ""
    if isinstance(result, WeposeError):
        sentence = "This motion cannot be evaluated."
        return GuideView(sentence, actions=(RESTART, MORE), quality="fail", reasons=(str(result),)), ""
    calibration, quality = result.calibration, result.calibration.quality
    lacks_motion = bool(quality.reasons) and all(reason.code.startswith(TOO_LITTLE) for reason in quality.reasons)
    actions = [ACCEPT, MORE, RESTART]
    sentence = {
        "pass": "The calibration is good.",
        "poor": "The calibration can be used, and more motion makes it better.",
        "fail": "This calibration must not be used.",
    }[quality.quality]
    if quality.quality == "poor" and all(reason.code.startswith("scale-") for reason in quality.reasons):
        sentence = "The proportions are good. One measured length gives the scale too."
        if calibration.problem.scale_lengths:
            sentence = "The proportions are good. The scale is still uncertain."
    elif quality.quality == "fail":
        actions = [MORE, RESTART] if lacks_motion else [RESTART, MORE]
        if lacks_motion:
            sentence = "There was too little of the motion. More of it may be enough."
    diagnostics = [*quality.reasons, *(each for each in quality.further if each.code == "pose-contradicted")]
    counted = [count_from_begin(each, calibration) for each in diagnostics]
    reasons = [text.line() for _, text in render_all(counted, REMEDIES)]
    if calibration.exchanged:  # all other reasons follow from this one
        sentence = "Some sensors sit on other segments than assigned. The same motion will do."
        reasons, actions = reasons[:1], [EXCHANGE, RESTART]
    length = _choose_length(guide, calibration)
    if length:
        name = LENGTH_NAMES.get(length, length.replace("_", " "))
        actions.append(MEASURE._replace(entry=f"{name} [cm]"))
    view = GuideView(sentence, progress=1.0, actions=tuple(actions), quality=quality.quality, reasons=tuple(reasons))
    return _add_lengths(view, calibration), length


def _choose_length(guide: Guide, calibration: Calibration) -> str:
    """What to measure next for the scale, where it is uncertain; empty: nothing."""
    if not any(REMEDIES.get(reason.code) == MEASURE_IT for reason in calibration.quality.reasons):
        return ""
    best = calibration.problem.measured_example.partition("=")[0]
    choices = (STATURE, best) if calibration.problem.scale_lengths else (best, STATURE)
    return next((name for name in choices if name not in {*guide.options.measured, *guide.measured}), "")


def count_from_begin(reason: Diagnostic, calibration: Calibration) -> Diagnostic:
    """The reason with intervals counted from the begin of the motion: the person knows no clock of the source."""
    if "intervals" not in reason.facts:
        return reason
    begin = calibration.time[np.isfinite(calibration.gap)][0]
    intervals = [(first - begin, last - begin) for first, last in find_open_intervals(calibration)]
    return replace(reason, facts={**reason.facts, "intervals": format_longest(intervals)})
