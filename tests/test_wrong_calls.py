"""Wrong calls of the public functions, from a table: each ends in one line that names what is wrong with it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from arms import person as moving_arm
from arms import write_arm

import wepose_pin as wp
from wepose_pin import ImuNoise, WeposeError
from wepose_pin.filters import AmekfParams

NAN, INF = float("nan"), float("inf")
POSITIVE = ("100", NAN, INF, True, -1.0, 0.0)  # wrong for a number above 0
NAME = ("nonsense", "", 3)
PATH = (3, b"x")
INTERVAL = ("x", (1.0,), (NAN, 2.0), (2.0, 1.0))
LENGTHS = (*({"left_forearm": wrong} for wrong in ("0.3", NAN, -0.3, 0.0, 25.0)), {"nonsense": 0.3}, [0.3])
SAMPLES = (None, np.zeros((600, 4)), np.zeros((599, 3)), np.full((600, 3), NAN), np.full((600, 3), "x"))


@cache
def right() -> dict[str, dict[str, Any]]:
    """The arguments of a right call of each function; positional ones by their names."""
    folder = Path(mkdtemp())
    person = wp.population_subject(1.75)
    simulation = wp.simulate(dict(person.lengths), seed=1, clasp_s=8.0, circles=1)
    recording = simulation.recording("by hand")
    pose = simulation.truth()
    mounts = {name: sensor.stated_quat_LS for name, sensor in recording.sensors.items()}
    subject = replace(person, mounts=mounts)
    torso = recording.sensors["torso"]
    urdf = write_arm(folder)
    return {
        "load_session": {"path": folder, "gaps": False},
        "load_subject": {"path": folder},
        "load_result": {"folder": folder},
        "load_model": {"path": None, "lengths": None},
        "population_subject": {"stature": 1.7, "sex": "f"},
        "estimate_orientation": {
            "gyro_S": torso.gyro_S[:600],
            "accel_S": torso.accel_S[:600],
            "rate_hz": 100.0,
            "static": (0.5, 4.0),
            "method": "amekf",
            "params": None,
            "static_test": None,
        },
        "track": {"recording": recording, "subject": subject},
        "calibrate": {"recording": recording, "measured": {"shoulder_width": person.lengths["shoulder_width"]}},
        "evaluate": {"pose": pose, "truth": pose},
        "joint_angles": {"pose": pose},
        "export": {"result": folder, "file": folder / "out.csv"},
        "retarget": {"pose": moving_arm(2.0), "robot": urdf},
        "simulate": {"lengths": dict(person.lengths), "seed": 1, "clasp_s": 5.0, "circles": 0, "rate_hz": 25.0},
    }


# Function → parameter → wrong values.
TABLE: dict[str, dict[str, tuple[Any, ...]]] = {
    "load_session": {"path": PATH, "gaps": ("no", None)},
    "load_subject": {"path": PATH},
    "load_result": {"folder": (*PATH, "nowhere")},
    "load_model": {"path": PATH, "lengths": LENGTHS},
    "population_subject": {"stature": (*POSITIVE, 175.0, 0.3), "sex": NAME},
    "estimate_orientation": {
        "gyro_S": SAMPLES,
        "accel_S": SAMPLES,
        "rate_hz": POSITIVE,
        "static": (*INTERVAL, (-1.0, 2.0), (0.0, 1e6)),
        "method": NAME,
        "params": ("x", AmekfParams),
        "static_test": (3,),
    },
    "track": {
        "recording": ("session.toml", None),
        "subject": ("anna",),
        "method": NAME,
        "model": ("upper_body.urdf",),
        "causal": ("no",),
    },
    "calibrate": {
        "recording": ("session.toml",),
        "measured": LENGTHS,
        "prior": ("anna",),
        "stature": (*POSITIVE, 175.0),
        "sex": NAME,
        "protocol": NAME,
        "method": NAME,
        "measured_std": POSITIVE,
        "formulation": NAME,
    },
    "evaluate": {"pose": ("result",), "truth": (None,), "interval": (*INTERVAL, (1e6, 2e6))},
    "joint_angles": {"pose": ("result",), "sequence": NAME},
    "export": {
        "result": (*PATH, "nowhere"),
        "file": (*PATH, "out.nonsense"),
        "format": NAME,
        "names": NAME,
        "rate_hz": POSITIVE,
    },
    "retarget": {
        "pose": (3,),
        "robot": ("pandas", "nowhere.urdf"),
        "rate_hz": (*POSITIVE, 1e9),
        "scale": POSITIVE,
        "smoothing_hz": (NAN, -1.0),
    },
    "simulate": {
        "lengths": LENGTHS,
        "seed": (1.5, -1),
        "rate_hz": POSITIVE,
        "noise": ("x",),
        "clasp_s": POSITIVE,
        "circles": (-1, 1.5),
        "protocol": NAME,
    },
}


def wrong_recordings(recording: wp.Recording) -> Iterator[tuple[str, wp.Recording]]:
    """What a recording made by hand may have wrong, and what its error must name."""
    time, torso = recording.time, recording.sensors["torso"]
    n = len(time)
    gap = np.array(torso.gyro_S)
    gap[100] = NAN
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))

    def sensor(**changed: Any) -> wp.Recording:
        return replace(recording, sensors={**recording.sensors, "torso": replace(torso, **changed)})

    for rate in (*POSITIVE, 10.0 * recording.rate_hz, 1.05 * recording.rate_hz):
        yield "rate_hz", replace(recording, rate_hz=rate)
    for times in (None, list(time), time[: n // 2], time[:0], time[::-1].copy(), 1e3 * time, time.astype(str)):
        yield "time", replace(recording, time=times)
    for samples in (None, torso.gyro_S[:-1], torso.gyro_S.T, torso.gyro_S[:, :2], gap):
        yield "torso", sensor(gyro_S=samples)
    yield "torso.accel_S", sensor(accel_S=torso.accel_S / 9.81)  # in g
    for quats in (2.0 * quat, quat[:, :3], quat[:-1]):
        yield "torso", replace(recording, sensors={**recording.sensors, "torso": wp.OrientationSensor(quats)})
    for mount in ("+x", np.eye(3), np.array([0.0, 0.0, 0.0, 2.0])):
        yield "stated_quat_LS", sensor(stated_quat_LS=mount)
    for sensors in ({}, [torso], {**recording.sensors, "left_arm": torso}):
        yield "sensors", replace(recording, sensors=sensors)
    for start in ((0.5, 4.5), ((4.5, 0.5),), ((0.5, 1e6),), ((NAN, 4.5),)):
        yield "phases", replace(recording, phases={"start": start})
    for name in NAME:
        yield "start_pose", replace(recording, start_pose=name)
    yield "resets", replace(recording, resets=(n + 5,))


def wrong_subjects(subject: wp.Subject) -> Iterator[tuple[str, wp.Subject]]:
    k, good = len(subject.order), subject.mounts["torso"]
    for wrong in (length for length in LENGTHS if isinstance(length, dict) and set(length) <= set(subject.lengths)):
        yield "lengths", replace(subject, lengths={**subject.lengths, **wrong})
    for covariance in (None, np.zeros((k, k - 1)), np.full((k, k), NAN)):
        yield "covariance", replace(subject, covariance=covariance)
    yield "order", replace(subject, order=("nonsense", *subject.order[1:]))
    for mounts in (None, {"torso": 2.0 * good}, {"torso": np.zeros(3)}, {"arm": good}):
        yield "mounts", replace(subject, mounts=mounts)
    yield "heading_drift", replace(subject, heading_drift={"torso": np.array([0.0, -1.0])})


def wrong_poses(pose: Any) -> Iterator[tuple[str, Any]]:
    time, segment, point = pose.time, next(iter(pose.quat_WL)), next(iter(pose.points))
    n, quat, place = len(time), pose.quat_WL[segment], pose.points[point]
    for times in (None, time[:-1], time[::-1].copy(), np.full(n, NAN)):
        yield "time", replace(pose, time=times)
    for quats in ("x", quat[:-1], quat[:, :3], 2.0 * quat):
        yield segment, replace(pose, quat_WL={**pose.quat_WL, segment: quats})
    for places in (None, place[:-1], np.full((n, 3), INF)):
        yield point, replace(pose, points={**pose.points, point: places})
    yield "segment_cov", replace(pose, segment_cov={segment: np.zeros((n, 3))})
    yield "gap", replace(pose, gap={segment: np.zeros(n)})


def list_wrong_calls(function: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """What an error must name, and the wrong arguments."""
    arguments = right()[function]
    for name, values in TABLE[function].items():
        yield from (("length" if name == "lengths" else name, {name: value}) for value in values)
    if function in ("track", "calibrate"):
        yield from ((name, {"recording": wrong}) for name, wrong in wrong_recordings(arguments["recording"]))
        subjects = wrong_subjects(right()["track"]["subject"])
        yield from ((name, {"subject" if function == "track" else "prior": wrong}) for name, wrong in subjects)
    if function in ("evaluate", "joint_angles", "retarget"):
        yield from ((name, {"pose": wrong}) for name, wrong in wrong_poses(arguments["pose"]))


@pytest.mark.parametrize("function", TABLE)
def test_every_wrong_call_is_refused_and_says_what_is_wrong(function: str) -> None:
    pytest.importorskip("daqp")
    arguments = right()[function]
    for name, changed in list_wrong_calls(function):
        with pytest.raises(wp.WeposeError) as raised:
            getattr(wp, function)(**(arguments | changed))
        text = str(raised.value)
        assert len(text.splitlines()) == 1
        assert name in text.replace("-", "_") or str(changed.get(name)) in text, (name, text)
    with pytest.raises(TypeError, match="'nonsense'"):
        getattr(wp, function)(**arguments, nonsense=1)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        *((lambda value=value: wp.StaticTest(window_s=value), "window_s") for value in POSITIVE),
        (lambda: wp.StaticTest(alpha=-1.0), "alpha"),
        (lambda: AmekfParams(block_s="100"), "block_s"),
        (lambda: wp.simulate(**right()["simulate"], noise=ImuNoise(gyro_density=NAN)), "gyro_density"),
    ],
)
def test_options_refuse_what_is_no_number_of_theirs(make: Any, name: str) -> None:
    pytest.importorskip("daqp")
    with pytest.raises(wp.WeposeError, match=name):
        make()


def test_right_calls_go_through() -> None:
    """Else the table would prove nothing: a call that is wrong anyway is refused whatever else is in it."""
    pytest.importorskip("daqp")
    for function, arguments in right().items():
        if function in ("load_session", "load_subject", "load_result", "export"):  # nothing is there
            with pytest.raises(wp.WeposeError, match=str(next(iter(arguments.values())))):
                getattr(wp, function)(**arguments)
        elif function != "calibrate":  # see test_python_calls
            assert getattr(wp, function)(**arguments) is not None


def test_numbers_beyond_any_sensor_are_refused_with_their_unit() -> None:
    rng = np.random.default_rng(0)
    gyro, accel = rng.normal(scale=1e-3, size=(900, 3)), rng.normal(scale=1e-2, size=(900, 3)) + [0.0, 0.0, 9.81]
    swing = np.sin(np.arange(900) / 50.0)[:, None]
    beyond = ((1e200 * gyro, accel), r"^gyro_S .* rad/s"), ((gyro, 1e3 * accel), r"^accel_S .* m/s\^2")
    deg_s, moving = gyro + 20.0 * swing, gyro + swing * [0.0, 0.0, 1.0]
    for wrong, match in (*beyond, ((deg_s, accel), "rad/s are needed"), ((moving, accel), r"turns at 4\d deg/s")):
        with pytest.raises(WeposeError, match=match):
            wp.estimate_orientation(*wrong, 100.0, static=(0.5, 4.5))


def test_a_pose_or_a_truth_of_nan_is_refused() -> None:
    pose = right()["evaluate"]["pose"]
    quats, points = ({n: np.full_like(v, NAN) for n, v in each.items()} for each in (pose.quat_WL, pose.points))
    unknown = replace(pose, quat_WL=quats, points=points)
    with pytest.raises(WeposeError, match="NaN in all samples"):
        wp.joint_angles(unknown)
    for pair in ((pose, unknown), (unknown, pose)):
        with pytest.raises(WeposeError, match=r"no orientation of a segment is known to both at a time: of .* NaN"):
            wp.evaluate(*pair)
    with pytest.raises(WeposeError, match=r"no position of a point is known to both at a time: of .* NaN"):
        wp.evaluate(pose, replace(pose, points=points))
