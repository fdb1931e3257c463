"""The steps of the guided session: the table, and a generator for each."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from ..calibration import Calibration, Protocol
from ..calibration.protocols import Step as ProtocolStep
from ..calibration.quality import ENOUGH_SAMPLES, format_longest
from ..diagnostics import render, render_all
from ..errors import BadData, WeposeError
from .assignment import ShakeDetector
from .guide import SILENCE_S, Calibrated, Guide, Step, StepRun, Turn
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
    needed = len(guide.needs)
    while True:
        count = len(guide.sending) - len(guide.silent)
        awaited = guide.source.describe_awaited([name for name in guide.source.sensors if name not in guide.sending])
        sentence = f"Strap the sensors on and switch them on: {count} of {needed} send."
        if count >= needed:
            sentence = f"{count} sensors send. Are all strapped on tightly?"
        elif awaited:
            sentence += f" Waiting for {awaited}."
        actions = (CONTINUE,) if count >= needed else ()
        progress = min(1.0, count / max(needed, 1))
        if (yield GuideView(sentence, guide.describe_problems(), progress=progress, actions=actions)) is CONTINUE:
            return Turn()


def assign_segments(guide: Guide, turn: Turn) -> StepRun:
    """Find by shaking which sensor sits on which segment; the ends of limbs first: the forearm moves with the arm."""
    if not turn.again:
        known = {name: name for name in guide.order} | dict(guide.options.known) | guide.segments
        known = {name: known[name] for name in guide.sending if name in known}
        if set(guide.needs) <= set(known.values()):
            guide.segments = known
            return Turn()
    parents = guide.options.model.parents

    def count_above(segment: str | None) -> int:
        return 0 if segment is None else 1 + count_above(parents.get(segment))

    order = sorted(guide.needs, key=count_above, reverse=True)
    guide.segments, shakes = {}, ShakeDetector()
    while True:
        shakes.push(guide.samples, guide.source.orientations)
        free = [name for name in guide.sending if name not in guide.segments]
        segments = [name for name in order if name not in guide.segments.values()]
        shaken = free[0] if len(free) == len(segments) == 1 else shakes.find(free)
        if shaken is not None:
            guide.segments[shaken] = segments.pop(0)
        if not segments:
            return Turn()
        note = ""
        if moving := shakes.list_moving():
            note = f"Too gentle, or not alone: {join_names(moving)}. Shake one harder, hold the others still."
            if not shakes.is_calm:
                note = f"Hold all sensors still for a moment. Moving: {join_names(moving)}."
        asked = yield GuideView(
            f"Shake the sensor on the {join_names(segments[:1])}.",
            guide.describe_problems() or note,
            progress=len(guide.segments) / len(guide.needs),
            highlight=segments[0],
            actions=(ANEW,) if guide.segments else (),
        )
        if asked is ANEW:
            guide.segments, shakes = {}, ShakeDetector()


class Stillness:
    """Waits in the ticks of the guide's attempt until no sensor has moved for some seconds."""

    def __init__(self, guide: Guide, seconds: float) -> None:
        self._guide, self._attempt, self._seconds = guide, guide.begin_attempt(), seconds
        self._pose: StillPose | None = None  # from the first tick on
        self.progress, self.moving = 0.0, ""  # 0 to 1; a sentence on segments that have just moved, empty: none

    def take(self) -> tuple[float, float] | None:
        """Take the newest ticks; return begin and end [s] of standing still once the seconds are full."""
        for ticks in self._guide.ticks:
            self._pose = pose = self._pose or StillPose(self._attempt.stream, self._seconds)
            row = pose.push_ticks(ticks)
            if row is not None:
                end = float(ticks.time[row])
                return end - self._seconds + 1.0 / self._attempt.stream.clock.rate_hz, end
            moved = [self._attempt.segments[k] for k in pose.moving] if pose.state == "moved" else []
            self.progress = pose.held_s / self._seconds
            self.moving = f"You moved ({join_names(moved)}). Once more: {self._seconds:.0f} s still." if moved else ""
        return None


def check_sensors(guide: Guide, _: Turn) -> StepRun:
    """Check the units of the sensors while the person stands still, again and again until they are right."""
    attempt, still, fault = guide.begin_attempt(), Stillness(guide, STATIC_S), ""
    while True:
        held = still.take()
        if held is not None:
            recording = replace(attempt.recording(), phases={"static": ((held[1] - STATIC_S, held[1]),)})
            try:
                scales = [d for d in check_units(recording, guide.source) if d.code == "accel-scale"]
                fault = " ".join(render(diagnostic).line() for diagnostic in scales)
            except BadData as error:
                fault = str(error)
            if not fault:
                return Turn()
            still = Stillness(guide, STATIC_S)
        note = guide.describe_problems() or fault or still.moving
        if (yield GuideView("Stand still for a moment.", note, progress=still.progress, actions=(SKIP,))) is SKIP:
            return Turn(skipped=True)


def hold_start_pose(guide: Guide, turn: Turn) -> StepRun:
    """Wait until the person is ready, and until the start pose was held; the motions begin anew."""
    attempt, reason = guide.begin_attempt(), turn.reason
    stated = [step for step in guide.options.protocol.steps if step.phase == "start"]
    seconds = stated[0].seconds if stated else START_POSE_S
    do = stated[0].do if stated else "Stand still in the start pose."
    while True:
        asked = None
        while asked is not READY:
            asked = yield GuideView(do, guide.describe_problems() or reason, actions=(READY,))
        reason = ""
        for phase in ("start", *(step.phase for step in guide.options.protocol.steps)):
            attempt.mark("discard", phase=phase)
        begin, still = guide.now + GET_READY_S, Stillness(guide, seconds)
        while asked is not AGAIN:
            countdown = begin - guide.now
            if countdown <= 0.0:
                held = still.take()
                if held is not None:
                    attempt.mark("begin", phase="start", time=held[0])
                    attempt.mark("end", phase="start", time=held[1])
                    return Turn()
                countdown = (1.0 - still.progress) * seconds
            note = guide.describe_problems() or still.moving
            asked = yield GuideView(do, note, countdown, progress=still.progress, actions=(AGAIN,))


# The motion ----------------------------------------------------------------------------------------------------------


def perform_motion(motion: ProtocolStep, guide: Guide, turn: Turn) -> StepRun:
    """Record a phase of the protocol, which pauses while a sensor is silent; the person sees what it has determined."""
    attempt, phase = guide.begin_attempt(), motion.phase
    target_s = motion.seconds
    if turn.again:
        target_s = max(target_s, attempt.measured_s(phase) + min(MORE_S, target_s))
    begin, running, lost = guide.now + GET_READY_S, False, set[str]()
    lost_s = lost_since = 0.0
    estimates = estimate_gradually(guide, phase)

    def pause() -> None:
        if running:
            attempt.mark("end", phase=phase, time=attempt.newest)

    try:
        while (done_s := attempt.measured_s(phase)) < target_s:
            note = ""
            if guide.silent:
                pause()
                lost_since = lost_since if lost else guide.now - SILENCE_S
                running, lost, lost_s = False, lost.union(guide.silent), guide.now - lost_since
                begin = max(begin, guide.now + RESUME_S)
            if lost:
                every = len(lost) == len(guide.segments)
                names = "any sensor" if every else join_names([guide.segments[name] for name in sorted(lost)])
                note = f"No samples from {names}: it goes on when they come again."
                if lost_s > MOST_LOSS_S and not guide.silent:
                    reason = f"No samples from {names} for {lost_s:.0f} s, and headings were lost with them"
                    return Turn("start", reason=f"{reason}: begin once more.")
            if not running and guide.now >= begin:
                attempt.mark("begin", phase=phase, time=attempt.newest)
                running, lost, note = True, set(), ""
            finish = [FINISH] * (done_s > min(FINISH_AFTER_S, motion.seconds))
            view = GuideView(
                _choose_sentence(motion, done_s),
                note,
                None if running else max(0.0, begin - guide.now),
                max(0.0, target_s - done_s),
                done_s / target_s,
                actions=(*finish, RESTART, *[SKIP] * (phase in guide.options.optional)),
                demonstration=phase,
            )
            estimate = next(estimates)
            asked = yield view if estimate is None else _add_estimate(view, estimate, running, motion)
            if asked is FINISH:
                return Turn()
            if asked is RESTART:
                return Turn("start")
            if asked is SKIP:
                attempt.mark("discard", phase=phase)
                running = False
                return Turn(skipped=True)
        return Turn()
    finally:
        pause()


def _choose_sentence(motion: ProtocolStep, done_s: float) -> str:
    """The sentence of the instruction after so much of the motion: first the first, then the others in turn."""
    sentences = [f"{part.strip().rstrip('.')}." for part in motion.do.replace("\n", " ").split(". ")]
    further, turn = sentences[1:] or sentences, int(done_s / SENTENCE_S)
    return sentences[0] if turn == 0 else further[(turn - 1) % len(further)]


def calculate(compute: Callable[[], T]) -> Future[T | WeposeError]:
    """Calculate in a thread of its own, which does not hold up the end of the program; the result, or its error."""
    future = Future[T | WeposeError]()

    def run() -> None:
        try:
            future.set_result(compute())
        except WeposeError as error:
            future.set_result(error)
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="calibration", daemon=True).start()
    return future


def estimate_gradually(guide: Guide, phase: str) -> Iterator[Calibration | None]:
    """Calibrate the recording so far again and again; iterate over the newest result, None where there is none."""
    attempt, newest, estimated_s = guide.begin_attempt(), None, 0.0
    future: Future[Calibration | WeposeError] | None = None
    while True:
        done_s = attempt.measured_s(phase)
        if future is not None and future.done():
            outcome, future = future.result(), None
            newest = outcome if isinstance(outcome, Calibration) else newest
        elif future is None and done_s >= max(FIRST_ESTIMATE_S, estimated_s + ESTIMATE_PERIOD_S):
            estimated_s, future = done_s, calculate(partial(guide.options.estimate, attempt.recording()))
        yield newest


def _add_estimate(view: GuideView, calibration: Calibration, running: bool, motion: ProtocolStep) -> GuideView:
    """The view with what the motion has determined so far, and what to do while the person moves."""
    newest = calibration.gap[calibration.time > calibration.time[-1] - APART_S]
    if calibration.exchanged:
        note = view.note or "Some sensors seem to sit on other segments than assigned: finish, and see."
        return _add_lengths(view._replace(note=note), calibration)
    if running and np.isfinite(newest).any() and np.nanmedian(newest) > APART:
        view = view._replace(note=f"{_choose_sentence(motion, 0.0)} They seem to be apart.")
    elif running and calibration.quality.quality == "pass":
        view = view._replace(sentence="This is enough: finish, or go on for smaller uncertainties.")
    # About the parts of the motion that are too small, else the worst reason.
    reasons = [reason for reason in calibration.quality.reasons if not reason.code.startswith("scale-")]
    reasons = [reason for reason in reasons if reason.code.startswith("motion-")] or reasons[:1]
    advice = dict.fromkeys(REMEDIES.get(reason.code, render(reason).do) for reason in reasons)
    return _add_lengths(view, calibration)._replace(reasons=tuple(advice)[:MOST_ADVICE])


def _add_lengths(view: GuideView, calibration: Calibration) -> GuideView:
    subject = calibration.subject
    lengths = tuple(LengthEstimate(name, metres, subject.std(name)) for name, metres in subject.lengths.items())
    return view._replace(lengths=lengths, sample_size=(calibration.effective_sample_size, ENOUGH_SAMPLES))


# The result ----------------------------------------------------------------------------------------------------------


def show_result(guide: Guide, _: Turn) -> StepRun:
    attempt, options = guide.begin_attempt(), guide.options
    attempt.log.flush()
    entered = note = ""  # a length that was entered, and why it cannot be
    while True:
        future = calculate(partial(options.calibrate, attempt.log.path, dict(guide.measured)))
        while not future.done():
            view = GuideView("The motion is being evaluated. You may move freely.", note, actions=(RESTART,))
            if (yield view) is RESTART:
                return Turn("start")
        result: Calibrated | WeposeError | None = future.result()
        if entered and isinstance(result, WeposeError):  # then without it
            del guide.measured[entered]
            entered, note = "", str(result)
            continue
        view, length = _view_result(guide, result)
        while result is not None:
            asked = yield view._replace(note=note)
            if asked is ACCEPT and isinstance(result, Calibrated):
                guide.accepted, guide.is_over = result, True
            elif asked is MORE:
                motions = [step for step in options.protocol.steps if step.phase != "start"]
                return Turn(max(motions, key=lambda step: step.seconds).phase, again=True)
            elif asked is RESTART:
                return Turn("start")
            elif asked is EXCHANGE and isinstance(result, Calibrated):
                moved = {label: segment for segment, label in result.calibration.exchanged.items()}
                attempt.exchange(moved)
                guide.segments = {sensor: moved.get(segment, segment) for sensor, segment in guide.segments.items()}
                return Turn("quality")
            elif asked is not None and asked.name == MEASURE.name:
                try:
                    guide.measured[length] = 0.01 * float(guide.text.replace(",", "."))
                    entered, note, result = length, "", None
                except ValueError:
                    note = f"'{guide.text}' is no length in cm, such as 38.5."


def _view_result(guide: Guide, result: Calibrated | WeposeError | None) -> tuple[GuideView, str]:
    """What to say of the result, and the length that the person may measure; empty: none."""
    if not isinstance(result, Calibrated):
        sentence = "This motion cannot be evaluated."
        return GuideView(sentence, actions=(RESTART, MORE), quality="fail", reasons=(str(result),)), ""
    calibration, quality = result.calibration, result.calibration.quality
    codes, lengths_given = [reason.code for reason in quality.reasons], calibration.problem.scale_lengths
    actions = [ACCEPT, MORE, RESTART]
    if quality.quality == "pass":
        sentence = "The calibration is good."
    elif quality.quality == "poor":
        sentence = "The calibration can be used, and more motion makes it better."
        if all(code.startswith("scale-") for code in codes):
            sentence = "The proportions are good. One measured length gives the scale too."
            sentence = "The proportions are good. The scale is still uncertain." if lengths_given else sentence
    elif codes and all(code.startswith(TOO_LITTLE) for code in codes):
        sentence, actions = "There was too little of the motion. More of it may be enough.", [MORE, RESTART]
    else:
        sentence, actions = "This calibration must not be used.", [RESTART, MORE]
    diagnostics = [*quality.reasons, *(each for each in quality.further if each.code == "pose-contradicted")]
    begin = calibration.time[np.isfinite(calibration.gap)][:1].sum()  # of the motion: the person knows no other clock
    open_s = format_longest([(first - begin, last - begin) for first, last in calibration.open_intervals])
    counted = [replace(d, facts={**d.facts, "intervals": open_s}) if "intervals" in d.facts else d for d in diagnostics]
    reasons = [text.line() for _, text in render_all(counted, REMEDIES)]
    if calibration.exchanged:  # all other reasons follow from this one
        sentence = "Some sensors sit on other segments than assigned. The same motion will do."
        reasons, actions = reasons[:1], [EXCHANGE, RESTART]
    length = ""
    if any(REMEDIES.get(code) == MEASURE_IT for code in codes):
        best = calibration.problem.measured_example.partition("=")[0]
        choices = (STATURE, best) if lengths_given else (best, STATURE)
        length = next((name for name in choices if name not in {*guide.options.measured, *guide.measured}), "")
    if length:
        name = LENGTH_NAMES.get(length, length.replace("_", " "))
        actions.append(MEASURE._replace(entry=f"{name} [cm]"))
    view = GuideView(sentence, progress=1.0, actions=tuple(actions), quality=quality.quality, reasons=tuple(reasons))
    return _add_lengths(view, calibration), length
