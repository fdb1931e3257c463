"""The steps of the guided session: the table, and a generator for each."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from ..body.subject import load_subject
from ..calibration import Calibration, Protocol
from ..calibration.protocols import Step
from ..calibration.result import format_longest
from ..diagnostics import join_text, render, render_all
from ..errors import BadData, BadOption, BadPhase, ExistingOutput, WeposeError
from ..filters.phases import find_reference_phases
from ..recording.arrivals import unpack_orientations
from ..tracking.start_pose import StartPoseDetector
from .guide import STATURE, Guide, GuideOptions, GuideStep, StepRun
from .loop import open_and_wait, warm_up
from .setup import AssignedSource, SensorSetup
from .sources import Source
from .state import Action, GuideView, Output, join_names
from .ticks import Recorder, check_units

SHAKE_WINDOW_S = 0.8  # [s] newest samples by which a shake is detected
SHAKE_RATE = 2.5  # [rad/s] rms of a sensor that is shaken; a person who stands is below 0.1
SHAKE_RATIO = 1.6  # of the shaken sensor's rms to that of every other candidate
CALM_RATE = 0.6  # [rad/s] below which all must be before the next shake counts
SHORTEST_STEP_S = 2e-3  # [s] between two orientations: of a tracker that does not tell its time they come in bursts
START_POSE_S = 4.0  # [s] where the protocol does not say how long
GET_READY_S = 8.0  # [s] to leave the keyboard and take the pose
MOST_LOSS_S = 2.0  # [s] of a silent sensor after which its heading has to be estimated anew
FIRST_ESTIMATE_S, ESTIMATE_PERIOD_S = 12.0, 4.0  # [s] of motion before the first estimate, and between two
FINISH_AFTER_S = 15.0  # [s] of a phase after which it may be finished
MORE_S = 30.0  # [s] of motion that "more" adds
MOST_ADVICE = 2  # sentences at a time
APART_S, APART = 3.0, 0.10  # [s] newest motion, and its median gap [m] above which the closure seems open
LENGTH_NAMES = {"biacromial": "breadth of the shoulders, from acromion to acromion", STATURE: "body height"}
# Codes of reasons that more motion takes away, or begin so.
TOO_LITTLE = ("motion-", "scale-", "length-uncertain", "mount-heading-uncertain", "closure-open")
# Code → what to do, of those whose remedy is an option of a command: here it is asked for.
REMEDIES = {
    "scale-uncertain": "Measure what is asked for and enter it here.",
    "sensors-exchanged": "Go back to Segments, and shake each sensor that is asked for.",
    "closure-open": "Keep the points together all the time.",
    "length-uncertain": "Move further and faster, through the whole reach.",
}

# A step has the name of its phase, and hardly one of these.
CONTINUE = Action("guide-next", "Continue", "n")
READY = Action("guide-next", f"I am ready ({GET_READY_S:.0f} s to take the pose)", "n")
FINISH = Action("guide-next", "Finish", "n")
ACCEPT = Action("guide-accept", "Accept and track", "y")
# These repeat a step, whose name they have.
AGAIN = Action("start", "Once more", "a")
ANEW = Action("assignment", "Assign all anew", "a")
RESTART = Action("start", "All again from the start pose", "a")
MEASURE = Action("guide-measure", "Use this length", "l")  # its entry names the length


def run_guide(
    source: Source, options: GuideOptions, outputs: Sequence[Output], should_stop: Callable[[], bool]
) -> tuple[AssignedSource, SensorSetup] | None:
    """Lead the person to an accepted calibration, and save its subject; None where it was ended before.

    Returns the source and the setup to track with. The source, not open before, stays open, and so do the outputs.
    """
    options.joined.check_body(options.model.table)
    steps = make_steps(options.joined)
    threading.Thread(target=warm_up, args=(options.method,), daemon=True).start()  # tracking begins without a wait
    if not open_and_wait(source, outputs, should_stop):
        return None
    guide = Guide(source, options, steps, outputs)
    if guide.run(should_stop) is None:
        return None
    subject = load_subject(options.folder)
    return guide.assign_source(), replace(options.setup, subject=subject, remounted=False, mounts={})


def make_steps(protocol: Protocol) -> list[GuideStep]:
    """The table of steps of a guided session with the motions of this protocol."""
    motions = [step for step in protocol.steps if step.phase != "start"]
    if not motions:
        raise BadOption(f"--protocol {protocol.name}: has no motion that --guide could lead through; name another one")
    for phase in {motion.phase for motion in motions} & {"sensors", "assignment", "quality"}:
        raise BadOption(f"--protocol {protocol.name}: phase '{phase}' has the name of a step of --guide; rename it")
    return [
        GuideStep("sensors", "Sensors", find_sensors),
        GuideStep("assignment", "Segments", assign_segments),
        GuideStep("start", "Start pose", hold_start_pose),
        *(GuideStep(m.phase, m.phase.replace("_", " ").capitalize(), partial(perform_motion, m)) for m in motions),
        GuideStep("quality", "Result", show_result, records=False),
    ]


# Before the motion ---------------------------------------------------------------------------------------------------


def find_sensors(guide: Guide, _: bool) -> StepRun:
    guide.close()  # sensors may change: a new attempt begins
    needed = len(guide.options.joined.needs)
    while True:
        count, awaited = len(guide.monitor.sending) - len(guide.silent), guide.source.describe_awaited()
        sentence = f"{count} sensors send. Are all strapped on tightly?"
        if count < needed:
            where = f" Waiting for {awaited}." if awaited else ""
            sentence = f"Strap the sensors on and switch them on: {count} of {needed} send.{where}"
        actions, progress = (CONTINUE,)[: count >= needed], min(1.0, count / max(needed, 1))
        if (yield GuideView(sentence, guide.describe_problems(), progress=progress, actions=actions)):
            return ""


def assign_segments(guide: Guide, asked_for: bool) -> StepRun:
    """Find by shaking which sensor sits on which segment; the ends of limbs first: the forearm moves with the arm."""
    guide.close()
    needs, chains = guide.options.joined.needs, guide.options.model.chains
    order = sorted(needs, key=lambda name: chains[name][-1:], reverse=True)
    if not asked_for:
        known = {name: name for name in guide.options.model.table.segments} | dict(guide.options.known) | guide.segments
        known = {name: known[name] for name in guide.monitor.sending if name in known}
        if set(order) <= set(known.values()):
            guide.segments = known
            return ""
    guide.segments, is_calm = {}, False  # all have come to rest since the last shake: the next one counts
    while len(guide.segments) < len(order):
        rates = measure_shakes(guide)
        free = [name for name in guide.monitor.sending if name not in guide.segments]
        segment, *others = (name for name in order if name not in guide.segments.values())
        *_, second, first = sorted(["", "", *free], key=lambda sensor: rates.get(sensor, 0.0))
        is_shaken = is_calm and rates.get(first, 0.0) >= max(SHAKE_RATE, SHAKE_RATIO * rates.get(second, 0.0))
        is_calm = (is_calm or max(rates.values(), default=0.0) < CALM_RATE) and not is_shaken
        if is_shaken or (len(free) == 1 and not others):
            guide.segments[first] = segment
            continue
        note = ""
        if moving := join_names([sensor for sensor, rate in rates.items() if rate > CALM_RATE]):
            note = f"Too gentle, or not alone: {moving}. Shake one harder, hold the others still."
            if not is_calm:
                note = f"Hold all sensors still for a moment. Moving: {moving}."
        sentence, progress = f"Shake the sensor on the {join_names([segment])}.", len(guide.segments) / len(order)
        actions = (ANEW,) if guide.segments else ()
        note = guide.describe_problems() or note
        yield GuideView(sentence, note, progress=progress, highlight=segment, actions=actions)
    return ""


def measure_shakes(guide: Guide) -> dict[str, float]:
    """Measure each sensor's rms rate [rad/s] over its newest `SHAKE_WINDOW_S`, where it has sent for so long."""
    rates = {}
    for sensor, newest in guide.monitor.sending.items():
        _, time_s, gyro_S, accel_S = guide.monitor.collect(sensor, SHAKE_WINDOW_S)
        if guide.now - newest > SHAKE_WINDOW_S or not len(time_s) or np.ptp(time_s) < 0.75 * SHAKE_WINDOW_S:
            continue
        rate = np.linalg.norm(gyro_S, axis=1)
        if sensor in guide.source.orientations:  # from each orientation to the next
            quat = unpack_orientations(gyro_S, accel_S)
            cosine = np.minimum(np.abs(np.sum(quat[1:] * quat[:-1], axis=1)), 1.0)
            rate = 2.0 * np.arccos(cosine) / np.maximum(np.diff(time_s), SHORTEST_STEP_S)
        rates[sensor] = float(np.sqrt(np.mean(rate**2)))
    return rates


def hold_start_pose(guide: Guide, _: bool) -> StepRun:
    """Wait until the person is ready, then until the start pose was held in right units; the motions begin anew."""
    if guide.attempt is not None and guide.attempt.log.problem:  # the file has ended: into a new one
        guide.close()
    attempt, protocol = guide.begin_attempt(), guide.options.joined
    reason, guide.reason = guide.reason, ""
    starts = [(step.seconds, " ".join(step.do.split())) for step in protocol.steps if step.phase == "start"]
    seconds, do = (*starts, (START_POSE_S, "Stand still in the start pose."))[0]
    while True:
        while (yield GuideView(do, reason or guide.describe_problems(), actions=(READY,))) is None:
            pass
        for phase in {"start", *(step.phase for step in protocol.steps)}:
            attempt.mark("discard", phase=phase)
        begin, reason, moved, progress = guide.now + GET_READY_S, "", "", 0.0
        pose: StartPoseDetector | None = None  # from the first tick on
        while not reason:
            for ticks in guide.ticks if guide.now >= begin else ():
                pose = pose or attempt.detect_start_pose(seconds)
                row = pose.push(ticks.gyro_S, ticks.accel_S)
                progress, moving = pose.held_s / seconds, join_names([attempt.sensors[k] for k in pose.moving])
                moved = f"You moved ({moving}). Once more: {seconds:.0f} s still." if pose.state == "moved" else ""
                if row is not None:
                    last = float(ticks.time[row])
                    first = last - seconds + 1.0 / attempt.clock.rate_hz
                    try:
                        static = replace(attempt.make_recording(), phases={"static": ((first, last),)})
                        check_units(static.check())
                        find_reference_phases(replace(static, phases={"start": ((first, last),)}), sways=True)
                    except BadPhase:  # by which the calibration would refuse it in the end
                        reason = f"You swayed too much. Once more: {seconds:.0f} s still."
                        break
                    except BadData as error:
                        reason = str(error)
                        break
                    attempt.mark("begin", phase="start", time=first)
                    attempt.mark("end", phase="start", time=last)
                    return ""
            countdown = begin - guide.now if guide.now < begin else (1.0 - progress) * seconds
            note = guide.describe_problems() or moved
            yield GuideView(do, reason or note, countdown, progress=progress, actions=(AGAIN,))


# The motion ----------------------------------------------------------------------------------------------------------


def perform_motion(motion: Step, guide: Guide, asked_for: bool) -> StepRun:
    """Record a phase of the protocol; the person sees what it has determined. A lost sensor needs the start pose."""
    attempt, phase, target_s = guide.begin_attempt(), motion.phase, motion.seconds
    if asked_for and motion is find_longest(guide.options.joined):
        target_s = max(target_s, measure_phase(attempt, phase) + min(MORE_S, target_s))
    elif asked_for:  # a pose that was another one
        attempt.mark("discard", phase=phase)
    begin, running = guide.now + GET_READY_S, False
    estimate: Calibration | None = None  # of the motion so far
    future: Future[Calibration] | None = None  # the next one
    estimated_s = 0.0
    try:
        while (done_s := measure_phase(attempt, phase)) < target_s:
            if guide.monitor.list_silent(guide.segments, guide.now, MOST_LOSS_S):
                guide.reason = f"{guide.describe_problems()} Headings were lost: begin once more."
                return "start"
            if not running and guide.now >= begin:
                attempt.mark("begin", phase=phase, time=attempt.newest)
                running = True
            if future is None and done_s >= max(FIRST_ESTIMATE_S, estimated_s + ESTIMATE_PERIOD_S):
                estimated_s, future = done_s, calculate(partial(guide.options.calibrate, attempt.make_recording()))
            elif future is not None and future.done():
                with suppress(WeposeError):
                    estimate = future.result()
                future = None
            do, note = " ".join(motion.do.split()), guide.describe_problems() if guide.silent else ""
            countdown, left_s = None if running else max(0.0, begin - guide.now), max(0.0, target_s - done_s)
            actions = (FINISH, RESTART) if done_s > min(FINISH_AFTER_S, motion.seconds) else (RESTART,)
            view = GuideView(do, note, countdown, left_s, done_s / target_s, actions=actions, demonstration=phase)
            if (yield view if estimate is None else _add_estimate(view, estimate, running)):
                return ""
        return ""
    finally:
        if running:
            attempt.mark("end", phase=phase, time=attempt.newest)


def find_longest(protocol: Protocol) -> Step:
    """The longest motion, of which the guide offers more."""
    return max((step for step in protocol.steps if step.phase != "start"), key=lambda step: step.seconds)


def measure_phase(attempt: Recorder, phase: str) -> float:
    """Duration [s] of a phase so far."""
    return sum(last - first for first, last in attempt.list_phases().get(phase, ()))


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


def _add_estimate(view: GuideView, calibration: Calibration, running: bool) -> GuideView:
    """The view with what the motion has determined so far, and what to do while the person moves."""
    view = view._replace(lengths=_list_lengths(calibration))
    if calibration.exchanged:
        exchanged = "Some sensors seem to sit on other segments. Finish the motion; the result will name them."
        return view._replace(note=view.note or exchanged)
    newest = calibration.gap[calibration.time > calibration.time[-1] - APART_S]
    if running and np.isfinite(newest).any() and np.nanmedian(newest) > APART:
        view = view._replace(note=f"{view.sentence.partition('. ')[0]}. They seem to be apart.")
    elif running and calibration.quality.quality == "pass":
        view = view._replace(sentence="This is enough: finish, or go on for smaller uncertainties.")
    # About the parts of the motion that are too small, else the worst reason.
    reasons = [reason for reason in calibration.quality.reasons if not reason.code.startswith("scale-")]
    reasons = [reason for reason in reasons if reason.code.startswith("motion-")] or reasons[:1]
    advice = dict.fromkeys(REMEDIES.get(reason.code, render(reason)["do"]) for reason in reasons)
    return view._replace(reasons=tuple(advice)[:MOST_ADVICE])


def _list_lengths(calibration: Calibration) -> dict[str, tuple[float, float]]:
    return {name: (metres, calibration.subject.std(name)) for name, metres in calibration.subject.lengths.items()}


# The result ----------------------------------------------------------------------------------------------------------


def show_result(guide: Guide, _: bool) -> StepRun:
    attempt, options = guide.begin_attempt(), guide.options
    assert attempt.log.path is not None
    path = attempt.log.path
    attempt.log.flush()
    entered = note = ""  # a length that was entered, and why it cannot be
    while True:
        future = calculate(partial(options.calibrate, path, dict(guide.measured)))
        while not future.done():
            yield GuideView("The motion is being evaluated. You may move freely.", note, actions=(RESTART,))
        calibration, reason = None, ""
        try:
            calibration = future.result()
        except (WeposeError, OSError) as error:
            reason = str(error)
        if entered and reason:  # then without it
            del guide.measured[entered]
            entered, note = "", reason
            continue
        view, length = _view_result(guide, calibration, reason)
        while True:
            asked = yield view._replace(note=note)
            if asked is ACCEPT and calibration is not None:
                try:
                    guide.accept(calibration, path.with_suffix(""))
                except (ExistingOutput, OSError) as error:  # such as a full disk: the person may try again
                    note = str(error)
            elif asked is not None:
                try:
                    guide.measured[length] = 0.01 * float(guide.text.replace(",", "."))
                    entered, note = length, ""
                    break
                except ValueError:
                    note = f"'{guide.text}' is no length in cm, such as 38.5."


def _view_result(guide: Guide, calibration: Calibration | None, error: str) -> tuple[GuideView, str]:
    """What to say of the result, and the length that the person may measure; empty: none."""
    options = guide.options
    more = Action(find_longest(options.joined).phase, f"{MORE_S:.0f} s more motion", "m")
    if calibration is None:
        sentence = "This motion cannot be evaluated."
        return GuideView(sentence, actions=(RESTART, more), quality="fail", reasons=(error,)), ""
    quality = calibration.quality
    diagnostics = [*quality.reasons, *(each for each in quality.further if each.code == "pose-contradicted")]
    begin = calibration.time[np.isfinite(calibration.gap)][:1].sum()  # of the motion: the person knows no other clock
    open_s = format_longest([(first - begin, last - begin) for first, last in calibration.open_intervals])
    counted = [replace(d, facts={**d.facts, "intervals": open_s}) if "intervals" in d.facts else d for d in diagnostics]
    reasons = [join_text(text) for _, text in render_all(counted, REMEDIES)]
    codes, actions = [reason.code for reason in quality.reasons], [ACCEPT, more, RESTART]
    if calibration.exchanged:  # all other reasons follow from this one
        sentence = "Some sensors sit on other segments than assigned."
        reasons, actions = reasons[:1], [RESTART]
    elif quality.quality == "pass":
        sentence = "The calibration is good."
    elif quality.quality == "poor":
        sentence = "The calibration can be used. More motion, or one measured length, makes it better."
    elif codes and all(code.startswith(TOO_LITTLE) for code in codes):
        sentence, actions = "There was too little of the motion. More of it may be enough.", [more, RESTART]
    else:
        sentence, actions = "This calibration must not be used.", [RESTART, more]
    length = ""
    if "scale-uncertain" in codes:
        best = calibration.problem.measured_example.partition("=")[0]
        known = {*options.measured, *guide.measured}
        known |= {STATURE} if options.stature is not None or options.subject is not None else set()
        choices = (STATURE, best) if calibration.problem.scale_lengths else (best, STATURE)
        length = next((name for name in choices if name not in known), "")
    if length:
        name = LENGTH_NAMES.get(length, length.replace("_", " "))
        actions.append(MEASURE._replace(entry=f"{name} [cm]"))
    view = GuideView(sentence, progress=1.0, actions=tuple(actions), quality=quality.quality, reasons=tuple(reasons))
    return view._replace(lengths=_list_lengths(calibration)), length
