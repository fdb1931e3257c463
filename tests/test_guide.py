"""The guided session: who follows it ends with the calibration that the recording gives; who does not is told so."""

import re
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from commands import run
from guided_person import GuidedPerson, PersonSource, perform
from sampling import find_free_port

import wepose_pin as wp
from wepose_pin import Calibration, Recording, calibrate, load_model, load_session, simulate_person
from wepose_pin.calibration import load_protocol
from wepose_pin.live import Output, Request, SensorSetup, Status
from wepose_pin.live.guide import Guide, GuideOptions
from wepose_pin.live.steps import make_steps, measure_phase
from wepose_pin.readers.live_log import read_live_log

CLASP = Path(__file__).parents[1] / "calibration" / "clasp.toml"
PERSON = 3, 45.0  # seed, and seconds that the clasp may last
MEASURED = {"shoulder_width": simulate_person(PERSON[0]).lengths["shoulder_width"]}
PRESSED = {("sensors", "guide-next"), ("start", "guide-next"), ("quality", "guide-accept")}
CLASP_S = 20.0  # of the test's protocol, for short recordings


class Moment(NamedTuple):
    """What the guide said at a time [s]."""

    time: float
    step: str
    view: Any  # GuideView


class QuickOptions(GuideOptions):
    """Estimates nothing on the way, and writes no page of a calibration."""

    def calibrate(self, source: Recording | Path, entered: Mapping[str, float] | None = None) -> Calibration:
        if isinstance(source, Recording):
            raise wp.BadSession("nothing is estimated here")
        return calibrate(load_session(source), measured={**self.measured, **(entered or {})})


class Session:
    """A person in front of a guide whose clasp is short; presses what is offered first."""

    def __init__(
        self,
        folder: Path,
        known: Mapping[str, str] | None = None,
        orientations: str = "",
        protocol: str = "clasp",
        clasp_s: float = CLASP_S,
        given: Mapping[str, float] = MEASURED,
    ) -> None:
        self.person = GuidedPerson(perform(*PERSON), orientations=orientations)
        self.source = PersonSource(self.person)
        # The closure does not show how a tracker on the torso is turned, and it has no accelerometer to tell.
        mounts = {"torso": perform(*PERSON).quat_LS["torso"]} if orientations == "sensor" else {}
        text = CLASP.read_text(encoding="utf-8").replace("seconds = 60", f"seconds = {clasp_s}")
        (folder / "clasp.toml").write_text(text, encoding="utf-8")
        parts, setup = protocol.replace("clasp", str(folder / "clasp.toml")), SensorSetup(mounts=mounts)
        options = QuickOptions(folder, setup, load_model(), parts, measured=given, known=known or {})
        self.guide = Guide(self.source, options, make_steps(options.joined))
        self.clicks: list[str] = []
        self.obeys: Callable[[str, Any], str] = lambda _step, view: view.highlight

    def run(self, until: Callable[[Moment], bool] = lambda _: False, seconds: float = 300.0) -> list[Moment]:
        """What was said until `until`; on the person's clock."""
        moments = []
        for moment in self._moments():
            moments.append(moment)
            if until(moment):
                return moments
            assert moment.time < seconds or moment.step == "quality", moment
        return moments

    def _moments(self) -> Iterator[Moment]:
        guide, deadline = self.guide, time.monotonic() + 600.0  # of a busy machine's calibration
        while guide.accepted is None:
            assert time.monotonic() < deadline
            guide.process(self.source.read(0.1))
            guide.build_status()  # as the loop does
            view, step = guide.view(), guide.step.name
            self.person.follow(step, self.obeys(step, view))
            yield Moment(self.source.clock(), step, view)
            first = view.actions[0].name if view.actions else ""
            if (step, first) in PRESSED:
                self.clicks.append(first)
                guide.ask(Request(first))
            elif step == "quality":
                time.sleep(0.02)  # the calibration runs in a thread
        guide.close()


def test_from_sensors_of_any_name_to_the_calibration_of_their_recording(tmp_path: Path) -> None:
    for name in ("calibration.json", "model.toml"):  # of an earlier body
        (tmp_path / name).write_text("{}")
    session = Session(tmp_path)
    moments = session.run()
    assert not (tmp_path / "model.toml").exists()
    assert session.clicks == ["guide-next", "guide-next", "guide-accept"]
    assert session.guide.segments == session.person.worn
    assert [*dict.fromkeys(moment.step for moment in moments)] == [
        "sensors", "assignment", "start", "clasp", "quality",
    ]  # fmt: skip
    assert session.guide.accepted is not None
    live = session.guide.accepted
    file = tmp_path / "calibration-1.mcap"
    again = calibrate(load_session(file), measured=MEASURED)
    assert again.subject.lengths == live.subject.lengths
    assert np.array_equal(again.subject.covariance, live.subject.covariance)
    for name, mount in live.subject.mounts.items():
        assert np.array_equal(again.subject.mounts[name], mount)
    assert again.quality.quality != "fail"
    for name, length in perform(*PERSON).lengths.items():
        assert abs(live.subject.lengths[name] - length) < 3.0 * live.subject.std(name), name
    # What was said on the way is in the file.
    recording = read_live_log(file).recording
    ((first, last),) = recording.phases["start"]
    assert last - first == pytest.approx(4.0, abs=0.02)
    ((first, last),) = recording.phases["clasp"]
    assert last - first == pytest.approx(CLASP_S, abs=0.1)
    # The start pose is held after the countdown, not before.
    counted = [m.view.countdown for m in moments if m.step == "start" and m.view.countdown is not None]
    assert counted[0] == pytest.approx(8.0, abs=0.1)


@pytest.mark.parametrize("orientations", [pytest.param("sensor", marks=pytest.mark.slow), "segment"])
def test_sensors_that_measure_orientations_are_shaken_and_calibrated_too(tmp_path: Path, orientations: str) -> None:
    """Trackers in worlds of their own, and a suit that streams segments; both under any names."""
    session = Session(tmp_path, orientations=orientations)
    if orientations == "segment":
        session.guide.options.known.update(session.person.worn)
    session.run()
    assert session.clicks == ["guide-next", "guide-next", "guide-accept"]
    assert session.guide.segments == session.person.worn
    assert session.guide.accepted is not None
    subject = session.guide.accepted.subject
    for name, length in perform(*PERSON).lengths.items():
        assert abs(subject.lengths[name] - length) < 3.0 * subject.std(name), name
    recording = load_session(tmp_path / "calibration-1.mcap")
    assert not recording.imus
    assert set(recording.phases) == {"start", "clasp"}


def begin(session: Session, phase: str, seconds: float) -> None:
    """Follow the guide until so many seconds of a phase are recorded."""
    session.run(lambda m: m.step == phase and measure_phase(session.guide.attempt, phase) >= seconds)


def test_who_moves_in_the_start_pose_is_told_which_sensor_moved(tmp_path: Path) -> None:
    session = Session(tmp_path)
    session.run(lambda m: m.step == "start" and 0.2 < m.view.progress < 1.0)
    session.person.disturb = lambda segment, gyro: gyro + 1.0 * (segment == "right_forearm")
    moved = session.run(lambda m: bool(m.view.note))[-1]
    assert moved.step == "start"
    assert moved.view.note == "You moved (right forearm). Once more: 4 s still."
    session.person.disturb = lambda _segment, gyro: gyro
    begin_s = session.run(lambda m: m.step == "clasp")[-1].time
    assert begin_s - moved.time == pytest.approx(4.0, abs=0.4)
    session.guide.close()


def test_a_start_pose_that_the_calibration_would_refuse_is_asked_for_again(tmp_path: Path) -> None:
    """A sway of 7.5 deg/s from side to side, which nowhere stands still for a second."""
    session = Session(tmp_path)
    sway = lambda: np.deg2rad(7.5) * np.sin(2.0 * np.pi * 0.8 * session.source.clock())  # noqa: E731
    session.person.disturb = lambda segment, gyro: gyro + sway() * (segment == "torso") * np.eye(3)[2]
    moment = session.run(lambda m: "swayed" in m.view.note or m.step == "clasp")[-1]
    assert (moment.step, moment.view.note) == ("start", "You swayed too much. Once more: 4 s still.")
    session.guide.close()


def test_an_accelerometer_in_g_is_not_calibrated(tmp_path: Path) -> None:
    session = Session(tmp_path)
    session.source.accel_scale = 1.0 / 9.80665
    moment = session.run(lambda m: "norm" in m.view.note)[-1]
    assert moment.step == "start"
    assert re.search(r"accel: norm 1.*: g\? State the unit.*accel_unit=g", moment.view.note)
    session.guide.close()


def test_a_gentle_shake_is_seen_and_a_stronger_one_asked_for(tmp_path: Path) -> None:
    session = Session(tmp_path)
    session.obeys = lambda _step, _view: ""
    rate = 2.4 * np.sqrt(2.0)  # amplitude [rad/s] of one with 2.4 rad/s rms

    def shake(segment: str, gyro: np.ndarray) -> np.ndarray:
        now = session.source.clock()
        return gyro + rate * np.sin(6.0 * np.pi * now) * np.array([segment == "torso" and now > 3.0, 0.0, 0.0])

    session.person.disturb = shake
    assert session.run(lambda m: bool(m.view.note))[-1].view.note == (
        "Too gentle, or not alone: a7. Shake one harder, hold the others still."
    )
    session.guide.ask(Request("assignment"))
    rate = 12.0
    session.run(lambda _: len(session.guide.segments) == 1)
    assert session.run(lambda m: bool(m.view.note))[-1].view.note == "Hold all sensors still for a moment. Moving: a7."
    session.guide.close()


def test_a_short_loss_is_bridged_and_a_long_one_needs_the_start_pose_again(tmp_path: Path) -> None:
    session = Session(tmp_path)
    begin(session, "clasp", 5.0)
    session.person.silent = {"left_forearm"}
    note = session.run(lambda m: bool(m.view.note))[-1].view.note
    assert note == "No samples from left forearm. Switched on and in reach?"
    session.person.silent = set()
    begin(session, "clasp", 8.0)
    ((first, last),) = session.guide.attempt.make_recording().phases["clasp"]
    assert last - first >= 8.0
    # All are silent for ten seconds, as when the laptop sleeps.
    session.source.asleep_s = 10.0
    note = session.run(lambda m: m.step == "start")[-1].view.note
    assert note == "No samples from any sensor. Switched on and in reach? Headings were lost: begin once more."
    assert session.guide.segments == session.person.worn
    session.run(lambda m: m.step == "clasp")
    assert session.guide.attempt.log.path.name == "calibration-1.mcap"
    assert set(session.guide.attempt.make_recording().phases) == {"start"}
    session.guide.close()


def test_too_little_motion_asks_for_more_of_it(tmp_path: Path) -> None:
    session = Session(tmp_path, clasp_s=6.0)
    view = session.run(lambda m: bool(m.view.quality))[-1].view
    session.guide.close()
    assert view.quality == "fail"
    assert view.sentence == "There was too little of the motion. More of it may be enough."
    assert [action.name for action in view.actions] == ["clasp", "start"]


def test_a_length_gives_the_scale_and_one_that_cannot_be_is_refused(tmp_path: Path) -> None:
    session = Session(tmp_path, given={})
    guide = session.guide
    before = session.run(lambda m: bool(m.view.quality))[-1].view
    assert before.quality == "poor"
    assert before.actions[-1].entry.endswith("[cm]")
    guide.ask(Request("guide-measure", "wide"))
    assert guide.view() == before._replace(note="'wide' is no length in cm, such as 38.5.")
    guide.ask(Request("guide-measure", "-30"))
    assert guide.view().quality == ""
    after = session.run(lambda m: bool(m.view.quality))[-1].view
    assert "-0.3" in after.note
    assert after._replace(note="") == before
    breadth = 100.0 * MEASURED["shoulder_width"]
    name = next(action.entry for action in after.actions if action.name == "guide-measure")
    guide.ask(Request("guide-measure", f"{breadth:.1f}".replace(".", ",")))
    measured = session.run(lambda m: bool(m.view.quality))[-1].view
    assert name not in [action.entry for action in measured.actions]
    guide.close()


@pytest.mark.slow
def test_sensors_that_were_mistaken_are_named(tmp_path: Path) -> None:
    session = Session(tmp_path)
    mistaken = {"left_forearm": "right_forearm", "right_forearm": "left_forearm"}
    session.obeys = lambda _step, view: mistaken.get(view.highlight, view.highlight)
    view = session.run(lambda m: bool(m.view.quality))[-1].view
    session.guide.close()
    assert (view.quality, view.sentence) == ("fail", "Some sensors sit on other segments than assigned.")
    assert "left forearm and right forearm seem to be exchanged" in view.reasons[0]
    assert "Go back to Segments" in view.reasons[0]
    assert [action.name for action in view.actions] == ["start"]


def test_a_step_is_repeated_and_a_known_setup_needs_no_shaking(tmp_path: Path) -> None:
    worn = GuidedPerson(perform(*PERSON)).worn
    session = Session(tmp_path, worn)
    moments = session.run(lambda m: m.step == "clasp")
    assert "assignment" not in {moment.step for moment in moments}
    session.guide.ask(Request("guide-accept"))  # is not offered
    assert session.guide.step.name == "clasp"
    session.guide.ask(Request("start"))
    assert session.guide.step.name == "start"
    session.guide.ask(Request("assignment"))
    assert (session.guide.step.name, session.guide.segments) == ("assignment", {})
    session.run(lambda m: m.step == "start")
    assert session.guide.segments == worn
    assert session.guide.attempt.log.path.name == "calibration-2.mcap"  # of other sensors
    session.guide.close()


def test_a_phase_may_be_named_next(tmp_path: Path) -> None:
    session = Session(tmp_path)
    file = tmp_path / "clasp.toml"
    file.write_text(file.read_text(encoding="utf-8").replace('"clasp"', '"next"'), encoding="utf-8")
    options = QuickOptions(tmp_path, SensorSetup(), load_model(), str(file))
    session.guide = Guide(session.source, options, make_steps(options.joined))
    assert [*dict.fromkeys(moment.step for moment in session.run(lambda m: m.step == "next"))] == [
        "sensors", "assignment", "start", "next",
    ]  # fmt: skip
    session.guide.close()
    file.write_text(file.read_text(encoding="utf-8").replace('"next"', '"quality"'), encoding="utf-8")
    with pytest.raises(wp.BadOption, match="phase 'quality' has the name of a step"):
        make_steps(load_protocol(file))


def test_more_motion_is_of_the_longest_part_of_a_joined_protocol_and_a_pose_is_repeated(tmp_path: Path) -> None:
    session = Session(tmp_path, protocol="clasp+t_pose")
    guide = session.guide
    session.run(lambda m: bool(m.view.quality))
    assert set(guide.attempt.make_recording().phases) == {"start", "clasp", "t_pose"}
    guide.ask(Request("clasp"))
    assert guide.step.name == "clasp"
    session.run(lambda m: m.step == "quality")
    assert set(guide.attempt.list_phases()) == {"start", "clasp", "t_pose"}
    guide.ask(Request("t_pose"))  # the pose is held anew
    assert set(guide.attempt.list_phases()) == {"start", "clasp"}
    guide.close()


def test_what_ends_the_guide_is_shown(tmp_path: Path) -> None:
    class Shown(Output):
        def status(self, status: Status) -> None:
            self.newest = status

    class Broken(PersonSource):
        def read(self, timeout_s: float) -> Any:  # noqa: ARG002
            raise wp.BadSource("another unit")

    session, shown = Session(tmp_path), Shown()
    guide = Guide(Broken(session.person), session.guide.options, session.guide.steps, [shown])
    with pytest.raises(wp.BadSource):
        guide.run()
    assert shown.newest[:2] == ("ended", "The session has ended: another unit")


def test_a_full_disk_is_said_and_the_next_start_pose_begins_a_new_file(tmp_path: Path) -> None:
    session = Session(tmp_path)
    begin(session, "clasp", 1.0)
    session.guide.attempt.log.problem = "calibration-1.mcap: the recording ended: No space left on device"
    assert session.run(lambda m: bool(m.view.note))[-1].view.note.endswith("No space left on device")
    session.guide.ask(Request("start"))
    assert session.guide.view().note == ""
    assert session.guide.attempt.log.path.name == "calibration-2.mcap"
    session.guide.close()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[sensors]\na = "tail"', "sensors.a = 'tail' is not a segment"),
        ('[sensors]\na = "torso"\nb = "torso"', "names a segment twice"),
        ("", "has no [sensors]"),
    ],
)
def test_a_setup_with_a_wrong_segment_is_refused(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "setup.toml").write_text(f"format = 1\n{text}")
    source = f"udp:{find_free_port()}"
    assert run("live", "--source", source, "--guide", "--setup", tmp_path, "-o", tmp_path / "o", "--no-page") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
