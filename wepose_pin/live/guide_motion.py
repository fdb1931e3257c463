"""Steps of the guide from the motion on: a phase of the protocol, the calibration and its result."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..calibration import Calibration, CalibrationQuality
from ..calibration.observability import format_longest
from ..calibration.quality import ENOUGH_SAMPLES, find_open_intervals
from ..diagnostics import Diagnostic, render, render_all
from ..errors import WeposeError
from ..recording.arrivals import Ticks
from .guide import GET_READY_S, RESTART, SKIP, Calibrated, Guide, Step
from .state import GuideAction, GuideView, LengthEstimate
from .worker import Worker

RESUME_S = 3.0  # [s] after an interruption until the phase goes on
SENTENCE_S = 9.0  # [s] for which each sentence of an instruction stands
ESTIMATE_PERIOD_S = 4.0  # [s] of motion between two estimates
FIRST_ESTIMATE_S = 12.0  # [s] of motion before the first estimate
FINISH_AFTER_S = 15.0  # [s] of a phase after which it may be finished
STATURE = "stature"  # that a person may enter in place of a length
MORE_S = 30.0  # [s] of motion that "more" adds
MOST_ADVICE = 2  # sentences at a time
APART_S, APART = 3.0, 0.10  # [s] newest motion, and its median gap [m] above which the closure seems open
# Codes of reasons that more motion takes away, or begin so.
TOO_LITTLE = ("motion-", "scale-", "length-uncertain", "mount-heading-uncertain", "closure-open")
# Code → what to do, of those whose remedy is an option of a command: here it is asked for.
MEASURE = "Measure what is asked for and enter it here."
REMEDIES = dict.fromkeys(("scale-from-prior", "scale-uncertain", "limb-scale-from-prior"), MEASURE) | {
    "sensors-exchanged": "Exchange them here.",
    "length-uncertain": "Move further and faster, through the whole reach.",
}
MOST_LOSS_S = 2.0  # [s] of a lost sensor after which its heading has to be found anew

FINISH = GuideAction("next", "Finish", "n")
MORE = GuideAction("more", f"{MORE_S:.0f} s more motion", "m")
ACCEPT = GuideAction("accept", "Accept and track", "y")
EXCHANGE = GuideAction("exchange", "Exchange these sensors", "x")


class ExerciseStep(Step):
    """A phase of the protocol: the person moves, and sees what the motion has determined so far."""

    def __init__(self, guide: Guide, phase: str, seconds: float, do: str) -> None:
        super().__init__(guide)
        self.name, self.title = phase, phase.replace("_", " ").capitalize()
        self._seconds = self._target_s = seconds
        self._sentences = [f"{part.strip().rstrip('.')}." for part in do.replace("\n", " ").split(". ")]
        self._worker: Worker[tuple[Calibration, CalibrationQuality]] = Worker()
        self._estimate: tuple[Calibration, CalibrationQuality] | None = None

    def enter(self) -> None:
        if self._measured_s >= self._seconds:  # the person came back to an earlier step, and kept it
            self.guide.go_on()
        else:
            self._start(self._seconds)

    def repeat(self) -> None:
        self._start(max(self._seconds, self._measured_s + min(MORE_S, self._seconds)))

    @property
    def seconds(self) -> float:
        """Duration that the protocol asks for."""
        return self._seconds

    @property
    def _measured_s(self) -> float:
        return 0.0 if self.guide.attempt is None else self.guide.attempt.measured_s(self.name)

    def _start(self, target_s: float) -> None:
        """Begin, or go on until so many seconds of the motion are recorded."""
        if self._measured_s == 0.0:
            self._estimate = None
        self._target_s = target_s
        self._begin = self.guide.now + GET_READY_S
        self._running = False
        self._estimated_s = 0.0
        self._interruption, self._lost_segments = "", set[str]()
        self._lost = (0.0, 0.0)  # [s] when the interruption began, and when a sensor was lost last

    def leave(self) -> None:
        if self.guide.attempt is not None:
            self._pause(self.guide.attempt.newest)

    def push_ticks(self, ticks: Ticks) -> None:
        attempt = self.guide.attempt
        if not ticks.lost.any() or attempt is None:
            return
        rows, sensors = np.nonzero(ticks.lost)
        self._interrupt([attempt.segments[k] for k in np.unique(sensors)], float(ticks.time[rows[0]]))

    def update(self) -> None:
        attempt = self.guide.begin_attempt()
        if self.guide.silent:
            self._interrupt([self.guide.segments[name] for name in self.guide.silent], attempt.newest)
        elif not self._running and self.guide.now >= self._begin:
            loss_s = self._lost[1] - self._lost[0]
            if loss_s > MOST_LOSS_S:
                lost = f"No samples from {self._join_lost()} for {loss_s:.0f} s"
                self.guide.restart(f"{lost}, and headings were lost with them: begin once more.")
                return
            attempt.mark("begin", phase=self.name, time=attempt.newest)
            self._running, self._interruption = True, ""
        measured_s = attempt.measured_s(self.name)
        if measured_s >= max(FIRST_ESTIMATE_S, self._estimated_s + ESTIMATE_PERIOD_S) and not self._worker.busy:
            self._estimated_s = measured_s
            recording = attempt.recording()
            self._worker.start(lambda: self.guide.options.estimate(recording))
        outcome = self._worker.take()
        if isinstance(outcome, tuple):
            self._estimate = outcome
        if measured_s >= self._target_s:
            self.guide.go_on()

    def _pause(self, time: float) -> None:
        if self._running and self.guide.attempt is not None:
            self.guide.attempt.mark("end", phase=self.name, time=time)
        self._running = False

    def _interrupt(self, segments: Sequence[str], time: float) -> None:
        """Pause at a time [s] until all sensors send again."""
        self._pause(time)
        if not self._interruption:
            self._lost_segments = set[str]()
        self._lost_segments |= set(segments)
        now = self.guide.now
        self._lost = (self._lost[0] if self._interruption else time, now)
        self._interruption = f"No samples from {self._join_lost()}: it goes on when they come again."
        self._begin = max(self._begin, now + RESUME_S)

    def _join_lost(self) -> str:
        return self.guide.join_sensors([name for name in self.guide.order if name in self._lost_segments])

    def actions(self) -> list[GuideAction]:
        finish = [FINISH] if self._measured_s > min(FINISH_AFTER_S, self._seconds) else []
        return [*finish, RESTART, *([SKIP] if self.name in self.guide.options.optional else [])]

    def act(self, action: str) -> None:
        if action == "next":
            self.guide.go_on()
        elif action == "skip" and self.guide.attempt is not None:
            self._pause(self.guide.attempt.newest)
            self.guide.attempt.mark("discard", phase=self.name)
            self.guide.go_on()
        else:
            self.guide.restart()

    def view(self) -> GuideView:
        measured_s = self._measured_s
        countdown = None if self._running else max(0.0, self._begin - self.guide.now)
        further = self._sentences[1:] or self._sentences
        turn = int(measured_s / SENTENCE_S)
        view = GuideView(
            self._sentences[0] if turn == 0 else further[(turn - 1) % len(further)],
            self._interruption,
            countdown,
            max(0.0, self._target_s - measured_s),
            measured_s / self._target_s,
            demonstration=self.name,
        )
        if self._estimate is None:
            return view
        calibration, quality = self._estimate
        newest = calibration.gap[calibration.time > calibration.time[-1] - APART_S]
        if not self._interruption:
            if calibration.labels.moved:
                view = view._replace(note="Some sensors seem to sit on other segments than assigned: finish, and see.")
            elif self._running and np.isfinite(newest).any() and np.nanmedian(newest) > APART:
                view = view._replace(note=f"{self._sentences[0]} They seem to be apart.")
            elif self._running and quality.quality == "pass":
                view = view._replace(sentence="This is enough: finish, or go on for smaller uncertainties.")
        return view._replace(
            lengths=_list_lengths(calibration),
            sample_size=(calibration.effective_sample_size, ENOUGH_SAMPLES),
            reasons=() if calibration.labels.moved else _advise(quality),
        )


class CalibrationStep(Step):
    """Calibrates the recording, and asks whether the result is accepted."""

    name, title, records = "quality", "Result", False

    def __init__(self, guide: Guide) -> None:
        super().__init__(guide)
        self._worker: Worker[Calibrated] = Worker()
        self._measured: dict[str, float] = {}  # lengths [m] that the person entered
        self._before: Calibrated | WeposeError | None = None  # the result before the newest of them
        self._entered, self._refused = "", ""  # its name, and why it cannot be

    def enter(self) -> None:
        self._entered, self._before, self._refused = "", None, ""
        self._calibrate()

    def _calibrate(self) -> None:
        self._result: Calibrated | WeposeError | None = None
        attempt = self.guide.begin_attempt()
        attempt.log.flush()
        path, measured = attempt.path, dict(self._measured)
        self._worker.start(lambda: self.guide.options.calibrate(path, measured))

    def leave(self) -> None:
        self._worker.forget()

    def update(self) -> None:
        self._result = self._worker.take() or self._result
        if self._entered and isinstance(self._result, WeposeError):  # the result before it stays
            del self._measured[self._entered]
            self._result, self._refused, self._entered = self._before, str(self._result), ""

    @property
    def _moved(self) -> Mapping[str, str]:
        """Segment → the sensor's label where they seem exchanged."""
        return self._result.calibration.labels.moved or {} if isinstance(self._result, Calibrated) else {}

    @property
    def _lacks_motion(self) -> bool:
        """Whether all that is wrong is that there was too little motion, or too little of it with the points joined."""
        reasons = self._result.quality.reasons if isinstance(self._result, Calibrated) else ()
        return bool(reasons) and all(reason.code.startswith(TOO_LITTLE) for reason in reasons)

    def actions(self) -> list[GuideAction]:
        if self._result is None:
            return [RESTART]
        if self._moved:
            return [EXCHANGE, RESTART]
        if not isinstance(self._result, Calibrated) or self._result.quality.quality == "fail":
            return [MORE, RESTART] if self._lacks_motion else [RESTART, MORE]
        return [ACCEPT, MORE, RESTART]

    def act(self, action: str) -> None:
        if action == "accept" and isinstance(self._result, Calibrated):
            self.guide.accepted = self._result
        elif action == "more":
            exercises = [step for step in self.guide.steps if isinstance(step, ExerciseStep)]
            longest = max(exercises, key=lambda step: step.seconds)
            self.guide.go(self.guide.steps.index(longest), again=True)
        elif action == "exchange":
            self._exchange(self._moved)
        else:
            self.guide.restart()

    def measure(self, stated: str) -> None:
        name, _, metres = stated.partition("=")
        with contextlib.suppress(ValueError):
            self._measured[name] = float(metres)
            self._entered, self._before, self._refused = name, self._result, ""
            self._calibrate()

    @property
    def _measurable(self) -> str:
        """What to measure next for the scale, where it is uncertain; empty: nothing."""
        if not isinstance(self._result, Calibrated):
            return ""
        calibration, quality, _ = self._result
        if not any(REMEDIES.get(reason.code) == MEASURE for reason in quality.reasons):
            return ""
        known = {*self.guide.options.measured, *self._measured}
        best = calibration.problem.measured_example.partition("=")[0]
        choices = (STATURE, best) if calibration.problem.scale_lengths else (best, STATURE)
        return next((name for name in choices if name not in known), "")

    def _exchange(self, moved: Mapping[str, str]) -> None:
        """Assign the sensors as the calibration found them, and calibrate again."""
        segments = {label: segment for segment, label in moved.items()}
        self.guide.begin_attempt().exchange(segments)
        own = self.guide.segments
        self.guide.segments = {sensor: segments.get(segment, segment) for sensor, segment in own.items()}
        self.enter()

    def view(self) -> GuideView:
        if self._result is None:
            return GuideView("The motion is being evaluated. You may move freely.")
        if isinstance(self._result, WeposeError):
            reason = str(self._result)
            return GuideView("This motion cannot be evaluated.", quality="fail", reasons=(reason,))
        calibration, quality, _ = self._result
        sentence = {
            "pass": "The calibration is good.",
            "poor": "The calibration can be used, and more motion makes it better.",
            "fail": "This calibration must not be used.",
        }[quality.quality]
        if quality.quality == "poor" and all(reason.code.startswith("scale-") for reason in quality.reasons):
            sentence = "The proportions are good. One measured length gives the scale too."
            if calibration.problem.scale_lengths:
                sentence = "The proportions are good. The scale is still uncertain."
        if quality.quality == "fail" and self._lacks_motion:
            sentence = "There was too little of the motion. More of it may be enough."
        diagnostics = (*quality.reasons, *(each for each in quality.further if each.code == "phase-not-used"))
        reasons = [text.line() for _, text in render_all(count_from_begin(diagnostics, calibration), REMEDIES)]
        if self._moved:  # all other reasons follow from this one
            sentence, reasons = (
                "Some sensors sit on other segments than assigned. The same motion will do.",
                reasons[:1],
            )
        return GuideView(
            sentence,
            self._refused,
            progress=1.0,
            lengths=_list_lengths(calibration),
            sample_size=(calibration.effective_sample_size, ENOUGH_SAMPLES),
            quality=quality.quality,
            reasons=tuple(reasons),
            measurable=self._measurable,
        )


def count_from_begin(reasons: Sequence[Diagnostic], calibration: Calibration) -> list[Diagnostic]:
    """The reasons with intervals counted from the begin of the motion: the person knows no clock of the source."""
    if not any("intervals" in reason.facts for reason in reasons):
        return list(reasons)
    begin = calibration.time[np.isfinite(calibration.gap)][0]
    intervals = format_longest([(first - begin, last - begin) for first, last in find_open_intervals(calibration)])
    return [
        replace(reason, facts={**reason.facts, "intervals": intervals}) if "intervals" in reason.facts else reason
        for reason in reasons
    ]


def _list_lengths(calibration: Calibration) -> tuple[LengthEstimate, ...]:
    subject = calibration.subject
    return tuple(LengthEstimate(name, metres, subject.std(name)) for name, metres in subject.lengths.items())


def _advise(quality: CalibrationQuality) -> tuple[str, ...]:
    """What to do while the person moves: about the parts of the motion that are too small, else the worst reason."""
    reasons = [reason for reason in quality.reasons if not reason.code.startswith("scale-")]
    motion = [reason for reason in reasons if reason.code.startswith("motion-")]
    advice = [REMEDIES.get(reason.code, render(reason).do) for reason in motion or reasons[:1]]
    return tuple(dict.fromkeys(advice))[:MOST_ADVICE]
