"""A robot that follows a live pose: aims, limits of every command, and whatever may befall the poses."""

from __future__ import annotations

import contextlib
import json
import math
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from arms import person, write_arm
from commands import run as run_command
from sampling import find_free_port, wait_until
from scipy.spatial.transform import Rotation
from test_causal import first

import wepose_pin as wp
from wepose_pin import Simulation, retargeting
from wepose_pin.live import LivePose, Status, StreamInfo
from wepose_pin.live.outputs import RobotOutput
from wepose_pin.live.state import SensorStatus
from wepose_pin.writers import write_session

pytest.importorskip("daqp")
ROOT = Path(__file__).resolve().parent.parent
DT = 0.01
APPROACH_SPEED = 0.25  # [m/s] of a hand, as docs/live-outputs.md has it


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> retargeting.Robot:
    return retargeting.load_robot(str(write_arm(tmp_path_factory.mktemp("arm"))))


def live_poses(pose: wp.Pose, std: float = 0.005) -> list[LivePose]:
    """What the loop would show."""
    quat = np.stack([pose.quat_WL[name] for name in pose.quat_WL], axis=1)
    points = np.stack([pose.points[name] for name in pose.points], axis=1)
    k = quat.shape[1]
    return [
        LivePose(float(t), quat[n], points[n], np.full(k, std), np.zeros(k, dtype=bool), 0.0)
        for n, t in enumerate(pose.time)
    ]


class Session:
    """A stream under a clock of our own, and all that it said."""

    def __init__(self, robot: retargeting.Robot, pose: wp.Pose, **options: Any) -> None:
        self.robot, self.data = robot, robot.model.createData()
        self.stream = retargeting.CommandStream(robot, rate_hz=1.0 / DT, **options)
        self.observer = retargeting.ArmObserver(robot, tuple(pose.quat_WL), tuple(pose.points))
        self.commands: list[retargeting.Command] = []
        self.hand: list[np.ndarray] = []
        self._came = 0.0

    def run(self, poses: Sequence[LivePose | None], resume_at: int = -1) -> Session:
        """A command a tick; None: no pose came."""
        for pose in poses:
            if len(self.commands) == resume_at:
                self.stream.resume()
            now = len(self.commands) * DT
            if pose is not None:
                observed = self.observer.observe(pose.quat_WL, pose.points, pose.std, pose.lost)
                self._came = now if self.stream.push(pose.time, observed) else self._came
            self.commands.append(self.stream.step(now, now - self._came))
            pin.framesForwardKinematics(self.robot.model, self.data, self.robot.configuration(self.commands[-1].u))
            self.hand.append(self.data.oMf[self.robot.arms[0].hand].translation.copy())
        return self

    def states(self, begin: float = 0.0, end: float = math.inf) -> list[str]:
        """In order, repetitions left out."""
        every = [c.state for c in self.commands if begin <= c.clock < end]
        return [state for k, state in enumerate(every) if k == 0 or every[k - 1] != state]

    def hand_speed(self, begin: float, end: float) -> float:
        speed = np.linalg.norm(np.diff(self.hand, axis=0), axis=1) / DT
        return float(speed[round(begin / DT) : round(end / DT)].max())

    def messages(self) -> list[dict[str, Any]]:
        """What of the commands `keeps_its_limits` looks at, in the names of the datagrams."""
        names = {"n": "number", "clock": "clock", "position": "u", "velocity": "v", "acceleration": "a"}
        return [{key: getattr(each, name) for key, name in names.items()} for each in self.commands]


def keeps_its_limits(messages: Sequence[dict[str, Any]], robot: retargeting.Robot) -> None:
    """What was sent, by differences of its positions against the URDF's own text and the map's numbers."""
    said = robot.map.read_joint_limits()
    joints = robot.names
    q, v, a = (np.array([message[key] for message in messages]) for key in ("position", "velocity", "acceleration"))
    clock = np.array([message["clock"] for message in messages])
    assert np.isfinite(q).all()
    assert np.array_equal(np.diff([message["n"] for message in messages]), np.ones(len(messages) - 1))
    assert np.allclose(np.diff(clock), clock[1] - clock[0], atol=1e-9)
    dt = clock[1] - clock[0]
    low, high, fast = (
        np.array([getattr(said[name], key) for name in joints]) for key in ("lower", "upper", "velocity")
    )
    hard = np.array([robot.map.acceleration[name] for name in joints])
    assert (q >= low).all()
    assert (q <= high).all()
    mean = np.diff(q, axis=0) / dt
    for speed in (v, mean):
        assert (np.abs(speed) <= fast).all()
    for change in (a, np.diff(mean, axis=0) / dt, np.diff(v, axis=0) / dt):
        assert (np.abs(change) <= hard).all()
    jerk = np.array([robot.map.jerk[name] for name in joints])
    for change in (np.diff(a, axis=0) / dt, np.diff(mean, 2, axis=0) / dt**2):
        assert (np.abs(change) <= jerk).all()
    assert np.abs(mean - 0.5 * (v[1:] + v[:-1])).max() <= hard.max() * dt  # one motion


@pytest.fixture(scope="module")
def followed(arm: retargeting.Robot) -> tuple[wp.Pose, Session]:
    """Twelve seconds of a person who moves, and the robot that follows."""
    pose = person(12.0)
    return pose, Session(arm, pose).run(live_poses(pose))


def test_it_approaches_then_follows(arm: retargeting.Robot, followed: tuple[wp.Pose, Session]) -> None:
    run = followed[1]
    assert run.states() == ["approach", "follow"]
    began = next(c.clock for c in run.commands if c.state == "follow")
    assert 0.5 < began < 5.0
    assert run.hand_speed(0.0, 1.0) < 1.2 * (APPROACH_SPEED + 0.1)
    error = np.array([c.error[0] for c in run.commands if c.clock > began + 1.0])
    assert np.median(error[:, 0]) < 0.003
    assert error[:, 0].max() < 0.02
    assert np.isfinite(error).all()
    keeps_its_limits(run.messages(), arm)


def test_the_targets_are_those_of_a_recording(arm: retargeting.Robot, followed: tuple[wp.Pose, Session]) -> None:
    """Of a person who stands both agree; of one who moves but for the delay."""
    still = person(8.0, swing=0.0)
    run = Session(arm, still).run(live_poses(still))
    assert np.allclose(run.hand[-1], retargeting.compute_arm_targets(still, arm).hands[0].position[-1], atol=2e-3)
    pose, run = followed
    target, hand = retargeting.compute_arm_targets(pose, arm).hands[0].position, np.array(run.hand)
    behind = [np.linalg.norm(hand[600 + d : 1100 + d] - target[600:1100], axis=1).mean() for d in range(20)]
    assert 0.03 < DT * int(np.argmin(behind)) < 0.1
    assert min(behind) < 0.006


def test_the_hands_uncertainty_is_that_of_many_draws(arm: retargeting.Robot) -> None:
    """Errors of the segments' orientations and of the arm's lengths, drawn; of the hand in the torso's frame."""
    pose, rng, n = person(0.5), np.random.default_rng(0), 20_000
    std, names = np.array([0.01, 0.02, 0.05]), ("right_upper_arm", "right_forearm", "right_hand")
    lengths = list(wp.load_model().lengths)
    cov = np.zeros((len(lengths), len(lengths)))
    at = [lengths.index(name) for name in names]
    cov[at, at] = np.array([0.02, 0.015, 0.01]) ** 2
    points = np.stack([pose.points[f"right_{name}"][0] for name in ("shoulder", "elbow", "wrist", "palm")])
    links = np.diff(points, axis=0)
    along = links / np.linalg.norm(links, axis=1)[:, None]
    links = links + along * rng.normal(size=(n, 3, 1)) * np.sqrt(cov[at, at])[:, None]
    torso, upper, fore = (Rotation.from_rotvec(s * rng.normal(size=(n, 3))) for s in std)
    hand = torso.inv().apply(upper.apply(links[:, 0]) + fore.apply(links[:, 1] + links[:, 2]))
    observer = retargeting.ArmObserver(arm, tuple(pose.quat_WL), tuple(pose.points), cov)
    one = live_poses(pose)[0]
    observed = observer.observe(one.quat_WL, one.points, std, one.lost)
    assert observed is not None
    assert observed[0].std == pytest.approx(np.sqrt(hand.var(axis=0).mean()), rel=0.02)


def test_a_jump_of_a_metre_is_gone_after_slowly(arm: retargeting.Robot) -> None:
    pose = person(14.0)
    points = dict(pose.points)
    for name in ("right_elbow", "right_wrist", "right_palm"):
        points[name] = points[name] + np.where(pose.time > 6.0, 1.0, 0.0)[:, None] * [0.0, 0.0, 1.0]
    run = Session(arm, pose).run(live_poses(replace(pose, points=points)))
    assert run.states(5.0, 6.0) == ["follow"]
    assert run.states(6.02, 6.5) == ["approach"]
    assert "jumped" in run.commands[610].reason
    assert run.hand_speed(6.5, 7.5) < 0.6  # what is left of the swing dies down before
    assert run.states(12.0) == ["follow"]
    keeps_its_limits(run.messages(), arm)


def test_a_pose_that_is_no_number_stops_the_robot(arm: retargeting.Robot) -> None:
    pose = person(9.0)
    poses = live_poses(pose)
    for k in range(500, 550):
        poses[k] = poses[k]._replace(points=np.full_like(poses[k].points, np.nan))
    poses[560] = poses[560]._replace(quat_WL=np.full_like(poses[560].quat_WL, np.nan))
    poses[570] = poses[570]._replace(quat_WL=np.zeros_like(poses[570].quat_WL))
    run = Session(arm, pose).run(poses)
    assert run.states(4.0) == ["follow", "hold", "approach", "follow"]
    assert run.commands[515].reason == "no sound pose for 0.1 s"
    keeps_its_limits(run.messages(), arm)


def test_an_uncertain_hand_is_slow(arm: retargeting.Robot) -> None:
    pose = person(10.0, swing=45.0)
    poses = live_poses(pose)
    poses[500:800] = live_poses(pose, std=0.5)[500:800]
    run = Session(arm, pose).run(poses)
    assert run.states(4.9, 7.9) == ["follow", "slow"]
    assert re.fullmatch(r"the right hand is uncertain by \d{3} mm", run.commands[600].reason)
    assert run.hand_speed(6.0, 8.0) < 1.3 * APPROACH_SPEED
    assert run.states(9.5) == ["follow"]
    keeps_its_limits(run.messages(), arm)


def test_a_pause_of_three_seconds_stops_it_until_somebody_says_so(arm: retargeting.Robot) -> None:
    pose = person(16.0, swing=45.0)
    poses: list[LivePose | None] = [*live_poses(pose)]
    poses[500:800] = [None] * 300
    run = Session(arm, pose).run(poses, resume_at=1100)
    assert run.states(4.9) == ["follow", "hold", "stopped", "approach", "follow"]
    halted = [c for c in run.commands if c.state == "stopped"]
    assert 5.99 < halted[0].clock < 6.5
    assert halted[-1].clock == pytest.approx(10.99)
    for c in halted:
        assert not c.v.any()
        assert not c.a.any()
        assert np.array_equal(c.u, halted[0].u)
        assert c.reason == "no sound pose for 1 s"
    keeps_its_limits(run.messages(), arm)
    # Said while nothing comes it is not forgotten: the next pose goes on.
    early = Session(arm, pose).run(poses, resume_at=750)
    assert early.states(7.4, 8.3) == ["stopped", "hold", "approach"]
    keeps_its_limits(early.messages(), arm)


def test_braking_from_any_moment_keeps_the_limits(arm: retargeting.Robot) -> None:
    """Held and let go again and again, at all phases of a fast motion."""
    pose = person(20.0, swing=60.0)
    poses: list[LivePose | None] = [*live_poses(pose)]
    for begin in range(150, 1900, 61):
        poses[begin : begin + 12 + begin % 37] = [None] * (12 + begin % 37)
    run = Session(arm, pose).run(poses[: len(pose.time)])
    assert run.states().count("hold") > 20
    keeps_its_limits(run.messages(), arm)


@pytest.fixture
def robot_out() -> Iterator[Callable[..., RobotOutput]]:
    """Makes one, and ends its thread whatever becomes of the test."""
    made: list[RobotOutput] = []

    def make(stream: retargeting.CommandStream, to: str, **options: Any) -> RobotOutput:
        made.append(RobotOutput(stream, to, **options))
        return made[-1]

    yield make
    for out in made:
        out.close()


class Receiver(threading.Thread):
    """Keeps all datagrams: what the system would is a second's."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self.port = str(self._socket.getsockname()[1])
        self.messages: list[dict[str, Any]] = []
        self._over = False
        self.start()

    def run(self) -> None:
        while not self._over:
            with contextlib.suppress(TimeoutError):
                self.messages.append(json.loads(self._socket.recv(65535)))
        self._socket.close()

    def until(self, happens: Callable[[dict[str, Any]], bool], meanwhile: Callable[[], object] = lambda: None) -> int:
        """Wait until such a message comes, after all that have come; return its row."""
        row, end = len(self.messages), time.monotonic() + 600.0  # a new clone compiles first
        while True:
            if row < len(self.messages):
                if happens(self.messages[row]):
                    return row
                row += 1
                continue
            assert time.monotonic() < end, self.messages[-1:]
            meanwhile()
            time.sleep(0.005)

    def has_ended(self) -> bool:
        """Whether the last commands tell that the robot stands."""
        last = self.messages[-3:]
        return all(m["state"] == "stopped" and not any(m["velocity"]) and not any(m["acceleration"]) for m in last)

    def close(self) -> None:
        self._over = True
        self.join(5.0)


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    listening = Receiver()
    yield listening
    listening.close()


def test_a_source_that_dies_stops_the_robot_until_the_person_says_so(
    robot_out, arm: retargeting.Robot, receiver: Receiver
) -> None:
    """By the wall clock; what a busy machine does to the poses' pace may cost holds on the way, and no limit."""
    pose = person(4.0, swing=45.0)
    poses, out = live_poses(pose), robot_out(retargeting.CommandStream(arm), receiver.port)
    shown = 0

    def show_next() -> None:
        nonlocal shown
        out.show(poses[shown % len(poses)]._replace(time=1e4 + shown * 0.005))
        shown += 1

    with pytest.raises(wp.BadData, match="arm's right arm follows right_forearm, which the sensors do not measure"):
        out.status(Status("start_pose", "", sensors=(SensorStatus("torso"), SensorStatus("right_upper_arm"))))
    wait_until(lambda: receiver.messages)
    out.start(StreamInfo(tuple(pose.quat_WL), tuple(pose.points), 100.0))
    first = receiver.messages[0]
    assert (first["state"], first["t"], first["reason"]) == ("hold", None, "waiting for a pose")
    assert first["position"] == pytest.approx(arm.rest.tolist())
    document_shows(first)
    receiver.until(lambda m: m["state"] == "approach" and max(map(abs, m["velocity"])) > 0.05, show_next)
    stopped = receiver.until(lambda m: m["state"] == "stopped")  # nobody calls it any more
    assert receiver.messages[stopped]["t"] == pytest.approx(1e4 + (shown - 1) * 0.005)
    assert "hold" in [m["state"] for m in receiver.messages[stopped - 60 : stopped]]
    assert out.describe() == "arm: stopped (no sound pose for 1 s); r, in the start pose, goes on."
    for _ in range(10):
        show_next()
        assert receiver.messages[receiver.until(lambda _: True)]["state"] == "stopped"
    out.resume()
    receiver.until(lambda m: m["state"] == "approach", show_next)
    out.close()
    wait_until(lambda: len(receiver.messages) == out.newest.number + 1)
    assert receiver.has_ended()
    keeps_its_limits(receiver.messages, arm)


def document_shows(message: dict[str, Any]) -> None:
    text = (ROOT / "docs" / "live-outputs.md").read_text(encoding="utf-8").partition("## A robot that follows")[2]
    documented = json.loads(text.partition("```json\n")[2].partition("```")[0])
    assert list(documented) == list(message)
    assert list(documented["arms"]["right"]) == list(message["arms"]["right"])
    assert documented["format"] == message["format"]
    code = (ROOT / "examples" / "robot_receiver.py").read_text(encoding="utf-8").split('"""\n\n', 1)[1]
    assert f"```python\n{code}```" in text


def test_the_example_reads_it_and_notices_the_end(robot_out, arm: retargeting.Robot) -> None:
    number = str(find_free_port())
    script = [str(ROOT / "examples" / "robot_receiver.py"), "--port", number, "--timeout", "2"]
    run = subprocess.Popen([sys.executable, "-W", "error", *script], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    assert run.stdout.readline() == f"waiting for commands on 127.0.0.1:{number}; Ctrl-C ends\n"
    out = robot_out(retargeting.CommandStream(arm), number)
    out.open()
    lines = [run.stdout.readline()]
    out.close()
    lines += run.communicate(timeout=120)[0].splitlines()
    assert run.returncode == 0
    assert re.match(r"\d+ hold \[", lines[0])
    assert lines[-1] == "no command: the robot is to be stopped here; waiting"


@pytest.fixture(scope="module")
def session(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session")
    write_session(folder, first(simulation.recording("robot"), 3000))
    return folder


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_stopped_amid_a_motion_the_robot_stands(session: Path, tmp_path: Path, receiver: Receiver, number: int) -> None:
    urdf = write_arm(tmp_path)
    command = [sys.executable, "-um", "wepose_pin", "live", "--source", f"replay:{session}", "--port", "0"]
    follow = tmp_path / "follow.toml"
    follow.write_text(f'robot = "{urdf.name}"\narm = "right"\nto = {receiver.port}\n', encoding="utf-8")
    command += ["--speed", "2", "--robot", str(follow)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    receiver.until(
        lambda m: m["state"] == "approach" and max(map(abs, m["velocity"])) > 0.2,
        lambda: process.poll() is None or pytest.fail(str(process.communicate())),
    )
    assert process.stdout is not None
    address = next(found[0] for line in process.stdout if (found := re.search(r"http://\S+", line)))
    with urllib.request.urlopen(address, timeout=60) as page:  # which draws the robot beside the person
        assert b'"robot ' in page.read()
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    # Skipped on a busy machine; compiled where no test has used the filters before.
    assert all("commands were skipped" in line or "compiling the filters" in line for line in err.splitlines())
    wait_until(receiver.has_ended)
    assert receiver.messages[-1]["reason"] == "the session has ended"
    assert "arm: " in out
    keeps_its_limits(receiver.messages, retargeting.load_robot(str(urdf)))


def test_wrong_robots_are_one_line_before_the_source_opens(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = write_arm(tmp_path)
    alone, bare, torso = tmp_path / "alone", tmp_path / "bare", tmp_path / "torso"
    for folder in (alone, bare, torso):
        folder.mkdir()
    write_arm(alone)
    (alone / "arm.toml").rename(alone / "other.toml")
    write_arm(bare, without="elbow.velocity")
    only = first(wp.load_session(session), 2000)
    write_session(torso, replace(only, sensors={name: only.sensors[name] for name in ("torso", "left_upper_arm")}))

    def follow(line: str) -> str:
        """A file that lets the arm follow with one more key."""
        file = tmp_path / f"{len(list(tmp_path.iterdir()))}-follow.toml"
        file.write_text(f'robot = "arm.urdf"\n{line}\n', encoding="utf-8")
        return str(file)

    for arguments, said in (
        (["--robot", str(tmp_path / "none.urdf")], "none.urdf: no such file"),
        (["--robot", str(alone / "arm.urdf")], "no arm.toml beside it"),
        (["--robot", str(bare / "arm.urdf")], "joint 'elbow' has no velocity limit"),
        (["--robot", follow('arm = "left"')], "follow.toml: arm = left: arm has no left arm; there is: right"),
        (["--robot", follow('arm = "up"')], "follow.toml: arm = 'up' is not known; there is: left, right, both"),
        (["--robot", follow('to = "there"')], "to = there: a port or HOST:PORT is needed"),
        (["--robot", follow("rate_hz = 5")], "follow.toml: rate_hz = 5: from 10 to 1000"),
        (["--robot", follow("hold_after = 2")], "hold_after = 2: seconds, above 0 and less than stop_after = 1"),
        (["--robot", follow("rate = 5")], "follow.toml: rate is not a known key; did you mean 'rate_hz'?"),
        (["--robot", str(whole), "--speed", "max"], "--speed max: a robot follows a replay at its own speed"),
    ):
        assert run_command("live", "--source", f"replay:{session}", "--no-page", *arguments) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert said in line
    assert run_command("live", "--source", f"replay:{torso}", "--no-page", "--robot", whole) == 2
    said = "arm's right arm follows right_upper_arm, right_forearm, which the sensors do not measure"
    assert said in capsys.readouterr().err
    guide = ["--guide", "-o", tmp_path / "guided", "--protocol", "bow"]  # it is found before the guide begins
    assert run_command("live", "--source", f"replay:{torso}", "--no-page", *guide, "--robot", whole) == 2
    assert said in capsys.readouterr().err
