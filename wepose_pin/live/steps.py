"""The steps of the guided session: the table, and a generator for each."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from ..body.subject import load_subject
from ..calibration import Calibration, Protocol
from ..calibration.protocols import Step as ProtocolStep
from ..calibration.quality import ENOUGH_SAMPLES, format_longest
from ..diagnostics import render, render_all
from ..errors import BadData, WeposeError
from ..recording.arrivals import Samples, unpack_orientations
from ..tracking.start_pose import StartPoseDetector
from .guide import STATURE, Guide, GuideOptions, Step, StepRun, Turn
from .loop import open_and_wait, warm_up
from .setup import AssignedSource, SensorSetup
from .sources.base import Source
from .state import Action, GuideView, LengthEstimate, Output, join_names
from .ticks import check_units

SHAKE_WINDOW_S = 0.8  # [s] newest samples by which a shake is detected
SHAKE_RATE = 2.5  # [rad/s] rms of a sensor that is shaken; a person who stands is below 0.1
SHAKE_RATIO = 1.6  # of the shaken sensor's rms to that of every other candidate
CALM_RATE = 0.6  # [rad/s] below which all must be before the next shake counts
SHORTEST_STEP_S = 2e-3  # [s] between two orientations: of a tracker that does not tell its time they come in bursts
START_POSE_S = 4.0  # [s] where the protocol does not say how long
GET_READY_S = 8.0  # [s] to leave the keyboard and take the pose
MOST_LOSS_S = 2.0  # [s] of a silent sensor after which its heading has to be estimated anew
SENTENCE_S = 9.0  # [s] for which each sentence of an instruction stands
FIRST_ESTIMATE_S, ESTIMATE_PERIOD_S = 12.0, 4.0  # [s] of motion before the first estimate, and between two
FINISH_AFTER_S = 15.0  # [s] of a phase after which it may be finished
MORE_S = 30.0  # [s] of motion that "more" adds
MOST_ADVICE = 2  # sentences at a time
APART_S, APART = 3.0, 0.10  # [s] newest motion, and its median gap [m] above which the closure seems open
LENGTH_NAMES = {"biacromial": "breadth of the shoulders, from acromion to acromion", STATURE: "body height"}
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


def run_guide(
    source: Source, options: GuideOptions, outputs: Sequence[Output], should_stop: Callable[[], bool]
) -> tuple[AssignedSource, SensorSetup] | None:
    """Lead the person to an accepted calibration, and save its subject; None where it was ended before.

    Returns the source and the setup to track with. The source, not open before, stays open then, the outputs always.
    """
    steps = make_steps(options.joined)
    threading.Thread(target=warm_up, args=(options.method,), daemon=True).start()  # tracking begins without a wait
    if not open_and_wait(source, outputs, should_stop):
        return None
    guide = Guide(source, options, steps, outputs)
    if guide.run(should_stop) is None:
        source.close()
        return None
    subject = load_subject(options.folder)
    return guide.assign_source(), replace(options.setup, subject=subject, remounted=False, mounts={})


def make_steps(protocol: Protocol) -> list[Step]:
    """The table of steps of a guided session with the motions of this protocol."""
    motions = [step for step in protocol.steps if step.phase != "start"]
    return [
        Step("sensors", "Sensors", find_sensors, before_attempt=True),
        Step("assignment", "Segments", assign_segments, before_attempt=True),
        Step("start", "Start pose", hold_start_pose),
        *(Step(m.phase, m.phase.replace("_", " ").capitalize(), partial(perform_motion, m)) for m in motions),
        Step("quality", "Result", show_result, records=False),
    ]


# Before the motion ---------------------------------------------------------------------------------------------------


class ShakeDetector:
    """Detects which sensor is shaken; after one was found, all must come to rest before the next."""

    def __init__(self) -> None:
        self.is_calm = False  # all have come to rest since the last shake: the next one counts
        self._recent: dict[str, deque[tuple[float, float]]] = {}  # sensor → time [s], squared rate [rad²/s²]
        self._last: dict[str, tuple[float, np.ndarray]] = {}  # sensor → time [s] and (4,) of its last orientation

    def push(self, samples: Iterable[Samples], measured: Collection[str] = ()) -> None:
        """Add samples of any sensors; those of `measured` are orientations."""
        for chunk in samples:
            squares = np.sum(chunk.gyro_S**2, axis=1)
            if chunk.sensor in measured:  # from each orientation to the next
                quat = unpack_orientations(chunk.gyro_S, chunk.accel_S)
                last_time, last_quat = self._last.get(chunk.sensor, (chunk.time[0], quat[0]))
                self._last[chunk.sensor] = float(chunk.time[-1]), quat[-1]
                cosine = np.abs(np.sum(np.concatenate([last_quat[None], quat[:-1]]) * quat, axis=1))
                step_s = np.maximum(np.diff(chunk.time, prepend=last_time), SHORTEST_STEP_S)
                squares = (2.0 * np.arccos(np.minimum(cosine, 1.0)) / step_s) ** 2
            recent = self._recent.setdefault(chunk.sensor, deque())
            recent.extend(zip(chunk.time.tolist(), squares.tolist(), strict=True))
            while recent[0][0] < recent[-1][0] - SHAKE_WINDOW_S:
                recent.popleft()

    def find(self, candidates: Sequence[str]) -> str | None:
        """The candidate that is shaken; None: none, several, or those of the last shake still move."""
        rates = self._find_rates()
        if not self.is_calm:
            self.is_calm = max(rates.values(), default=0.0) < CALM_RATE
            return None
        *_, second, first = sorted(["", "", *candidates], key=lambda sensor: rates.get(sensor, 0.0))
        if rates.get(first, 0.0) < max(SHAKE_RATE, SHAKE_RATIO * rates.get(second, 0.0)):
            return None
        self.is_calm = False
        return first

    def list_moving(self) -> list[str]:
        return [sensor for sensor, rate in self._find_rates().items() if rate > CALM_RATE]

    def _find_rates(self) -> dict[str, float]:
        """Sensor → rms rate [rad/s] of those that were seen for as long as a shake takes."""
        return {
            sensor: float(np.sqrt(np.mean([square for _, square in recent])))
            for sensor, recent in self._recent.items()
            if recent[-1][0] - recent[0][0] > 0.75 * SHAKE_WINDOW_S
        }


def find_sensors(guide: Guide, _: Turn) -> StepRun:
    needed = len(guide.needs)
    while True:
        sending = guide.monitor.sending
        count = len(sending) - len(guide.silent)
        awaited = guide.source.describe_awaited()
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
        known = {name: known[name] for name in guide.monitor.sending if name in known}
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
        free = [name for name in guide.monitor.sending if name not in guide.segments]
        segments = [name for name in order if name not in guide.segments.values()]
        shaken = free[0] if len(free) == len(segments) == 1 else shakes.find(free)
        if shaken is not None:
            guide.segments[shaken] = segments.pop(0)
        if not segments:
            return Turn()
        note = ""
        if moving := join_names(shakes.list_moving()):
            note = f"Too gentle, or not alone: {moving}. Shake one harder, hold the others still."
            if not shakes.is_calm:
                note = f"Hold all sensors still for a moment. Moving: {moving}."
        asked = yield GuideView(
            f"Shake the sensor on the {join_names(segments[:1])}.",
            guide.describe_problems() or note,
            progress=len(guide.segments) / len(guide.needs),
            highlight=segments[0],
            actions=(ANEW,) if guide.segments else (),
        )
        if asked is ANEW:
            guide.segments, shakes = {}, ShakeDetector()


def hold_start_pose(guide: Guide, turn: Turn) -> StepRun:
    """Wait until the person is ready, then until the start pose was held in right units; the motions begin anew."""
    attempt, reason, protocol = guide.begin_attempt(), turn.reason, guide.options.joined
    starts = [(step.seconds, step.do) for step in protocol.steps if step.phase == "start"]
    seconds, do = starts[0] if starts else (START_POSE_S, "Stand still in the start pose.")
    while True:
        asked = None
        while asked is not READY:
            asked = yield GuideView(do, reason or guide.describe_problems(), actions=(READY,))
        for phase in {"start", *(step.phase for step in protocol.steps)}:
            attempt.mark("discard", phase=phase)
        begin, reason, moved, progress = guide.now + GET_READY_S, "", "", 0.0
        pose: StartPoseDetector | None = None  # from the first tick on
        while not (asked is AGAIN or reason):
            for ticks in guide.ticks if guide.now >= begin else ():
                pose = pose or attempt.stream.detect_start_pose(seconds)
                row = pose.push(ticks.gyro_S, ticks.accel_S)
                progress, moving = pose.held_s / seconds, [[*attempt.segments.values()][k] for k in pose.moving]
                moved = f"You moved ({join_names(moving)}). Once more: {seconds:.0f} s still."
                moved = moved if pose.state == "moved" else ""
                if row is not None:
                    last = float(ticks.time[row])
                    first = last - seconds + 1.0 / attempt.stream.clock.rate_hz
                    try:
                        check_units(replace(attempt.recording(), phases={"static": ((first, last),)}), guide.source)
                    except BadData as error:
                        reason = str(error)
                        break
                    attempt.mark("begin", phase="start", time=first)
                    attempt.mark("end", phase="start", time=last)
                    return Turn()
            countdown = begin - guide.now if guide.now < begin else (1.0 - progress) * seconds
            note = guide.describe_problems() or moved
            asked = yield GuideView(do, reason or note, countdown, progress=progress, actions=(AGAIN,))


# The motion ----------------------------------------------------------------------------------------------------------


def perform_motion(motion: ProtocolStep, guide: Guide, turn: Turn) -> StepRun:
    """Record a phase of the protocol; the person sees what it has determined. A lost sensor needs the start pose."""
    attempt, phase, target_s = guide.begin_attempt(), motion.phase, motion.seconds
    if turn.again:
        target_s = max(target_s, attempt.measured_s(phase) + min(MORE_S, target_s))
    begin, running = guide.now + GET_READY_S, False
    estimate: Calibration | None = None  # of the motion so far
    future: Future[Calibration] | None = None  # the next one
    estimated_s, optional = 0.0, guide.options.optional
    try:
        while (done_s := attempt.measured_s(phase)) < target_s:
            if guide.monitor.list_silent(guide.segments, guide.now, MOST_LOSS_S):
                return Turn("start", reason=f"{guide.describe_problems()} Headings were lost: begin once more.")
            if not running and guide.now >= begin:
                attempt.mark("begin", phase=phase, time=attempt.newest)
                running = True
            if future is None and done_s >= max(FIRST_ESTIMATE_S, estimated_s + ESTIMATE_PERIOD_S):
                estimated_s, future = done_s, calculate(partial(guide.options.estimate, attempt.recording()))
            elif future is not None and future.done():
                with suppress(WeposeError):
                    estimate = future.result()
                future = None
            finish = [FINISH] * (done_s > min(FINISH_AFTER_S, motion.seconds))
            view = GuideView(
                _choose_sentence(motion, done_s),
                guide.describe_problems() if guide.silent else "",
                None if running else max(0.0, begin - guide.now),
                max(0.0, target_s - done_s),
                done_s / target_s,
                actions=(*finish, RESTART, *[SKIP] * (phase in optional)),
                demonstration=phase,
            )
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
        if running:
            attempt.mark("end", phase=phase, time=attempt.newest)


def _choose_sentence(motion: ProtocolStep, done_s: float) -> str:
    """First the first sentence of the instruction, then the others in turn."""
    sentences = [f"{part.strip().rstrip('.')}." for part in motion.do.replace("\n", " ").split(". ")]
    further, turn = sentences[1:] or sentences, int(done_s / SENTENCE_S)
    return sentences[0] if turn == 0 else further[(turn - 1) % len(further)]


def calculate(compute: Callable[[], Calibration]) -> Future[Calibration]:
    """Calculate in a thread of its own, which does not hold up the end of the program."""
    future = Future[Calibration]()

    def run() -> None:
        try:
            future.set_result(compute())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="calibration", daemon=True).start()
    return future


def _add_estimate(view: GuideView, calibration: Calibration, running: bool, motion: ProtocolStep) -> GuideView:
    """The view with what the motion has determined so far, and what to do while the person moves."""
    view = _add_lengths(view, calibration)
    if calibration.exchanged:
        note = view.note or "Some sensors seem to sit on other segments than assigned: finish, and see."
        return view._replace(note=note)
    newest = calibration.gap[calibration.time > calibration.time[-1] - APART_S]
    if running and np.isfinite(newest).any() and np.nanmedian(newest) > APART:
        view = view._replace(note=f"{_choose_sentence(motion, 0.0)} They seem to be apart.")
    elif running and calibration.quality.quality == "pass":
        view = view._replace(sentence="This is enough: finish, or go on for smaller uncertainties.")
    # About the parts of the motion that are too small, else the worst reason.
    reasons = [reason for reason in calibration.quality.reasons if not reason.code.startswith("scale-")]
    reasons = [reason for reason in reasons if reason.code.startswith("motion-")] or reasons[:1]
    advice = dict.fromkeys(REMEDIES.get(reason.code, render(reason).do) for reason in reasons)
    return view._replace(reasons=tuple(advice)[:MOST_ADVICE])


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
        future = calculate(partial(options.calibrate, attempt.path, dict(guide.measured)))
        while not future.done():
            view = GuideView("The motion is being evaluated. You may move freely.", note, actions=(RESTART,))
            if (yield view) is RESTART:
                return Turn("start")
        calibration, reason = None, ""
        try:
            calibration = future.result()
        except WeposeError as error:
            reason = str(error)
        if entered and reason:  # then without it
            del guide.measured[entered]
            entered, note = "", reason
            continue
        view, length = _view_result(guide, calibration, reason)
        while True:
            asked = yield view._replace(note=note)
            if asked is ACCEPT and calibration is not None:
                guide.accept(calibration)
            elif asked is MORE:
                motions = [step for step in options.joined.steps if step.phase != "start"]
                return Turn(max(motions, key=lambda step: step.seconds).phase, again=True)
            elif asked is RESTART:
                return Turn("start")
            elif asked is EXCHANGE and calibration is not None:
                moved = {label: segment for segment, label in calibration.exchanged.items()}
                attempt.mark("assign", segments={name: moved.get(own, own) for name, own in attempt.segments.items()})
                guide.segments = {name: moved.get(own, own) for name, own in guide.segments.items()}
                return Turn("quality")
            elif asked is not None and asked.name == MEASURE.name:
                try:
                    guide.measured[length] = 0.01 * float(guide.text.replace(",", "."))
                    entered, note = length, ""
                    break
                except ValueError:
                    note = f"'{guide.text}' is no length in cm, such as 38.5."


def _view_result(guide: Guide, calibration: Calibration | None, error: str) -> tuple[GuideView, str]:
    """What to say of the result, and the length that the person may measure; empty: none."""
    if calibration is None:
        sentence = "This motion cannot be evaluated."
        return GuideView(sentence, actions=(RESTART, MORE), quality="fail", reasons=(error,)), ""
    quality = calibration.quality
    codes, lengths_given = [reason.code for reason in quality.reasons], calibration.problem.scale_lengths
    diagnostics = [*quality.reasons, *(each for each in quality.further if each.code == "pose-contradicted")]
    begin = calibration.time[np.isfinite(calibration.gap)][:1].sum()  # of the motion: the person knows no other clock
    open_s = format_longest([(first - begin, last - begin) for first, last in calibration.open_intervals])
    counted = [replace(d, facts={**d.facts, "intervals": open_s}) if "intervals" in d.facts else d for d in diagnostics]
    reasons = [text.line() for _, text in render_all(counted, REMEDIES)]
    actions = [ACCEPT, MORE, RESTART]
    if calibration.exchanged:  # all other reasons follow from this one
        sentence = "Some sensors sit on other segments than assigned. The same motion will do."
        reasons, actions = reasons[:1], [EXCHANGE, RESTART]
    elif quality.quality == "pass":
        sentence = "The calibration is good."
    elif quality.quality == "poor":
        sentence = "The calibration can be used. More motion, or one measured length, makes it better."
    elif codes and all(code.startswith(TOO_LITTLE) for code in codes):
        sentence, actions = "There was too little of the motion. More of it may be enough.", [MORE, RESTART]
    else:
        sentence, actions = "This calibration must not be used.", [RESTART, MORE]
    length = ""
    if any(REMEDIES.get(code) == MEASURE_IT for code in codes):
        best = calibration.problem.measured_example.partition("=")[0]
        choices = (STATURE, best) if lengths_given else (best, STATURE)
        length = next((name for name in choices if name not in {*guide.options.stated, *guide.measured}), "")
    if length:
        name = LENGTH_NAMES.get(length, length.replace("_", " "))
        actions.append(MEASURE._replace(entry=f"{name} [cm]"))
    view = GuideView(sentence, progress=1.0, actions=tuple(actions), quality=quality.quality, reasons=tuple(reasons))
    return _add_lengths(view, calibration), length
