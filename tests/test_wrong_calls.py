"""Wrong calls of the public functions, from a table: each ends in an error that names what is wrong with it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

import numpy as np
import pytest
from arms import person as moving_arm
from arms import write_arm

import wepose_pin as wp
from wepose_pin.body.subject import HeadingDrift, Hinge, StartPoseOffset
from wepose_pin.diagnostics import WARNING, Diagnostic
from wepose_pin.errors import BadData
from wepose_pin.filters import AmekfParams
from wepose_pin.retargeting import ControllerParams
from wepose_pin.simulation import Imperfections, ImuNoise
from wepose_pin.tracking import TrackResult

NAN, INF = float("nan"), float("inf")
ANYTHING = object()

# Wrong values for a parameter of each kind; None is one of them where the parameter is not optional.
FLAG = ("no", "true", "", 1.5, 2, [], {})
NUMBER = ("100", "", b"1", NAN, INF, -INF, True, [1.0], {}, 1j, ANYTHING)
POSITIVE = (*NUMBER, -1.0, 0.0)
COUNT = (*NUMBER, -1, 1.5)
NAME = ("nonsense", "", 3, 1.5, True, ["amekf"], {}, b"amekf", ANYTHING)
THING = ("x", 3, NAN, True, [], {}, ANYTHING, np.zeros(3))
PATH = (3, 1.5, True, [], {}, b"x", ANYTHING)
INTERVAL = (
    "x",
    3.0,
    (1.0,),
    (1.0, 2.0, 3.0),
    (NAN, 2.0),
    ("0", "2"),
    (2.0, 1.0),
    (1.0, 1.0),
    np.array([0.5, 2.0]),
    ANYTHING,
)
LENGTHS = (
    "x",
    3.0,
    [0.3],
    {"nonsense": 0.3},
    {"left_forearm": "0.3"},
    {"left_forearm": NAN},
    {"left_forearm": -0.3},
    {"left_forearm": 0.0},
    {"left_forearm": None},
    {"left_forearm": True},
    {"left_forearm": 25.0},
    {3: 0.3},
)
SAMPLES = (
    None,
    "x",
    3.0,
    np.zeros(600),
    np.zeros((600, 4)),
    np.zeros((0, 3)),
    np.zeros((599, 3)),
    np.full((600, 3), NAN),
    np.full((600, 3), "x"),
    np.zeros((600, 3), dtype=complex),
    [[0.0, 0.0]],
    ANYTHING,
)


class Wrong(NamedTuple):
    """One wrong call."""

    function: str
    names: str  # what the message must name
    changed: dict[str, Any]  # arguments in place of those of the right call

    def __str__(self) -> str:
        shown = ", ".join(f"{name}={str(value)[:40]}" for name, value in self.changed.items())
        return f"{self.function}({shown}) [{self.names}]"


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
    from wepose_pin.retargeting import find_map, load_robot

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
        "retarget": {"pose": moving_arm(2.0), "robot": load_robot(find_map(str(urdf)))},
        "simulate": {"lengths": dict(person.lengths), "seed": 1, "clasp_s": 5.0, "circles": 0, "rate_hz": 25.0},
    }


# Function → parameter → wrong values. One that is optional takes None.
TABLE: dict[str, dict[str, tuple[Any, ...]]] = {
    "load_session": {"path": (*PATH, None), "gaps": (*FLAG, None)},
    "load_subject": {"path": (*PATH, None)},
    "load_result": {"folder": (*PATH, None, "nowhere")},
    "load_model": {
        "path": PATH,
        "lengths": LENGTHS,
        "segments": ("x", 3, [], {"torso": 3}),
        "points": ("x", 3, []),
        "up": ("z", 3, None, "+w"),
        "forward": ("x", 3, None, "+w"),
        "root": (3, 1.5, True),
    },
    "population_subject": {"stature": (*POSITIVE, 175.0, 0.3), "sex": NAME},
    "estimate_orientation": {
        "gyro_S": SAMPLES,
        "accel_S": SAMPLES,
        "rate_hz": (*POSITIVE, None),
        "static": (*INTERVAL, (-1.0, 2.0), (0.0, 1e6)),
        "method": (*NAME, None),
        "params": ("x", 3, {}, AmekfParams),
        "static_test": THING,
    },
    "track": {
        "recording": (*THING, None),
        "subject": THING,
        "method": (*NAME, None),
        "model": THING,
        "static_test": THING,
        "open_loop": (*FLAG, None),
        "causal": (*FLAG, None),
        "limits": (*FLAG, None),
        "accept_failed": (*FLAG, None),
    },
    "calibrate": {
        "recording": (*THING, None),
        "measured": LENGTHS,
        "prior": THING,
        "stature": (*POSITIVE, 175.0),
        "sex": NAME,
        "protocol": NAME,
        "method": (*NAME, None),
        "measured_std": (*POSITIVE, None),
        "formulation": (*NAME, None),
    },
    "evaluate": {
        "pose": (*THING, None),
        "truth": (*THING, None),
        "interval": (*INTERVAL, (1e6, 2e6)),
    },
    "joint_angles": {
        "pose": (*THING, None),
        "sequence": (*NAME, None),
        "near_lock": (*POSITIVE, None, 10.0),
    },
    "export": {
        "result": (*PATH, None, "nowhere"),
        "file": (*PATH, None, "out.nonsense"),
        "format": NAME,
        "names": NAME,
        "rate_hz": POSITIVE,
        "force": (*FLAG, None),
        "provenance": ("x", 3, []),
    },
    "retarget": {
        "pose": (*THING, None),
        "robot": (*THING, None, "pandas", "nowhere.urdf"),
        "rate_hz": (*POSITIVE, None, 1e9),
        "params": THING,
        "scale": POSITIVE,
        "smoothing_hz": (*NUMBER, None, -1.0),
        "strict": (*FLAG, None),
        "progress": ("x", 3),
    },
    "simulate": {
        "lengths": (*LENGTHS, None),
        "seed": ("x", 1.5, NAN, True, None, -1),
        "rate_hz": (*POSITIVE, None),
        "noise": (*THING, None),
        "imperfections": (*THING, None),
        "clasp_s": (*POSITIVE, None),
        "circles": (*COUNT, None),
        "protocol": (*NAME, None),
    },
}


def wrong_recordings(recording: wp.Recording) -> Iterator[tuple[str, wp.Recording]]:
    """What a recording made by hand may have wrong, and what its error must name."""
    time, torso = recording.time, recording.sensors["torso"]
    n = len(time)

    def sensor(**changed: Any) -> wp.Recording:
        return replace(recording, sensors={**recording.sensors, "torso": replace(torso, **changed)})

    def at(values: np.ndarray, k: int, value: Any) -> np.ndarray:
        changed = np.array(values)
        changed[k] = value
        return changed

    for rate in (*POSITIVE, None, 10.0 * recording.rate_hz, 0.1 * recording.rate_hz, 1.05 * recording.rate_hz):
        yield "rate_hz", replace(recording, rate_hz=rate)
    jump = np.where(np.arange(n) < n // 2, 0.0, 0.5)
    for times in (
        None,
        "x",
        list(time),
        time[:, None],
        time[: n // 2],
        time[:0],
        time[::-1].copy(),
        np.zeros(n),
        time + jump,
        1e3 * time,
        at(time, 100, NAN),
        at(time, 100, INF),
        at(time, 100, time[99]),
        time.astype(str),
        time.astype(complex),
    ):
        yield "time", replace(recording, time=times)
    for name in ("gyro_S", "accel_S"):
        values = getattr(torso, name)
        for samples in (
            None,
            "x",
            values.tolist(),
            values[:-1],
            np.vstack([values, values]),
            values[:, :2],
            values.T,
            values[:, 0],
            np.full_like(values, NAN),
            at(values, 100, NAN),
            at(values, 100, INF),
            values.astype(str),
            values.astype(complex),
        ):
            yield "torso", sensor(**{name: samples})
    for unit in (1.0 / 9.81, 1e3 / 9.81):
        yield "torso.accel_S", sensor(accel_S=unit * torso.accel_S)
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    for quats in (2.0 * quat, np.zeros((n, 4)), quat[:, :3], quat[:-1], at(quat, 5, NAN), quat.tolist(), "x", None):
        yield "torso", replace(recording, sensors={**recording.sensors, "torso": wp.OrientationSensor(quats)})
    for mount in ("+x", [0.0, 0.0, 0.0, 1.0], np.zeros(4), np.array([0.0, 0.0, 0.0, 2.0]), np.eye(3), np.full(4, NAN)):
        yield "stated_quat_LS", sensor(stated_quat_LS=mount)
    for gap in ("x", np.zeros(n), np.zeros(n - 1, dtype=bool), [False] * n):
        yield "gap", sensor(gap=gap)
    for aligned in ("no", None, 2):
        fused = wp.OrientationSensor(quat, aligned=aligned)
        yield "aligned", replace(recording, sensors={**recording.sensors, "torso": fused})
    for sensors in (None, {}, [torso], "x", {"torso": None}, {"torso": "x"}, {3: torso}):
        yield "sensors", replace(recording, sensors=sensors)
    for name in ("trunk", "left_arm", "Torso", ""):
        yield "sensors", replace(recording, sensors={**recording.sensors, name: torso})
    for phases in (
        None,
        "start",
        [("start", 0.5, 4.5)],
        {"start": (0.5, 4.5)},
        {"start": "x"},
        {"start": ((0.5,),)},
        {"start": ((4.5, 0.5),)},
        {"start": ((1.0, 1.0),)},
        {"start": ((-5.0, 4.5),)},
        {"start": ((0.5, 1e6),)},
        {"start": ((NAN, 4.5),)},
        {"start": (("0.5", "4.5"),)},
        {"start": np.array([[0.5, 4.5]])},
        {"start": ((None, 4.5),)},
        {3: ((0.5, 4.5),)},
    ):
        yield "phases", replace(recording, phases=phases)
    for name in NAME:
        yield "start_pose", replace(recording, start_pose=name)
    for remounted in (None, "new", 1):
        yield "remounted", replace(recording, remounted=remounted)
    for resets in ("x", (-1,), (n + 5,), (1.5,), (True,), 3):
        yield "resets", replace(recording, resets=resets)
    for joints in ("x", {"elbow": "0"}, {"elbow": NAN}, None):
        yield "joints", replace(recording, joints=joints)
    for name in (None, 3):
        yield "name", replace(recording, name=name)
    for diagnostics in ("x", None, (3,), ("start-pose-late",), (Diagnostic(3, WARNING),)):
        yield "diagnostics", replace(recording, diagnostics=diagnostics)


def wrong_subjects(subject: wp.Subject) -> Iterator[tuple[str, wp.Subject]]:
    k = len(subject.order)
    for lengths in (None, "x", {}, *({**subject.lengths, **wrong} for wrong in LENGTHS if isinstance(wrong, dict))):
        yield "lengths", replace(subject, lengths=lengths)
    skew = subject.covariance.copy()
    skew[0, 1] += 1e-3
    for covariance in (
        None,
        "x",
        subject.covariance.tolist(),
        np.zeros((k, k - 1)),
        np.zeros((k - 1, k - 1)),
        -subject.covariance,
        skew,
        np.full((k, k), NAN),
        subject.covariance.astype(complex),
    ):
        yield "covariance", replace(subject, covariance=covariance)
    for order in (
        None,
        "x",
        ("nonsense", *subject.order[1:]),
        (subject.order[1], *subject.order[1:]),
        subject.order[1:],
    ):
        yield "order" if order != subject.order[1:] else "covariance", replace(subject, order=order)
    good = subject.mounts["torso"]
    for mount in (None, "x", good.tolist(), 2.0 * good, np.zeros(4), np.zeros(3), np.full(4, NAN)):
        yield "mounts", replace(subject, mounts={**subject.mounts, "torso": mount})
    for mounts in (None, "x", {"arm": good}):
        yield "mounts", replace(subject, mounts=mounts)
    for hinges in (
        {"middle_elbow": Hinge(np.array([0.0, 1.0, 0.0]), 0.1)},
        {"left_elbow": Hinge(np.array([0.0, 2.0, 0.0]), 0.1)},
        {"left_elbow": Hinge(np.array([0.0, 1.0, 0.0]), -0.1)},
        {"left_elbow": Hinge(np.array([0.0, 1.0, 0.0]), NAN)},
        {"left_elbow": "x"},
        None,
    ):
        yield "hinges", replace(subject, hinges=hinges)
    for tilt in (
        StartPoseOffset(np.zeros(3), 0.1),
        StartPoseOffset(np.full(2, NAN), 0.1),
        StartPoseOffset(np.zeros(2), -0.1),
        "x",
    ):
        yield "start_pose_offset", replace(subject, start_pose_offset={"torso": tilt})
    for drift in (HeadingDrift(NAN, 0.1), HeadingDrift(0.0, -0.1), HeadingDrift("0", 0.1), 3):
        yield "heading_drift", replace(subject, heading_drift={"torso": drift})
    yield "heading_drift", replace(subject, heading_drift={"arm": HeadingDrift(0.0, 0.1)})


def wrong_poses(pose: Any) -> Iterator[tuple[str, Any]]:
    time, segment, point = pose.time, next(iter(pose.quat_WL)), next(iter(pose.points))
    n, quat, place = len(time), pose.quat_WL[segment], pose.points[point]
    for times in (None, "x", time[:-1], time[::-1].copy(), np.zeros(n), np.full(n, NAN), time[:, None], time[:0]):
        yield "time", replace(pose, time=times)
    for quats in (None, "x", quat[:-1], quat[:, :3], 2.0 * quat, np.zeros((n, 4)), quat.tolist(), quat.astype(str)):
        yield segment, replace(pose, quat_WL={**pose.quat_WL, segment: quats})
    for places in (None, "x", place[:-1], place[:, :2], place.astype(str), np.full((n, 3), INF), place.tolist()):
        yield point, replace(pose, points={**pose.points, point: places})
    for name in ("quat_WL", "points", "segment_cov", "point_cov", "gap"):
        for value in (None, "x", [quat]):
            yield name, replace(pose, **{name: value})
    for cov in (np.zeros((n, 3)), np.tile(-np.eye(3), (n, 1, 1)), np.tile(np.triu(np.ones((3, 3))), (n, 1, 1)), "x"):
        yield "segment_cov", replace(pose, segment_cov={segment: cov})
        yield "point_cov", replace(pose, point_cov={point: cov})
    for gap in (np.zeros(n), np.zeros(n - 1, dtype=bool), "x"):
        yield "gap", replace(pose, gap={segment: gap})


def wrong_options() -> Iterator[tuple[str, str, str, Any]]:
    """Function, its parameter, what the message must name, and what makes options with a wrong value."""

    def changed(options: Any, **values: Any) -> Any:
        return partial(replace, options, **values)

    for value in (*POSITIVE, None):
        for name in ("window_s", "alpha", "beta", "gamma1", "gamma2"):
            if value == 0.0 and name != "window_s":
                continue  # never static: odd, and possible
            test = changed(wp.StaticTest(), **{name: value})
            for function in ("estimate_orientation", "track") if name == "window_s" else ("estimate_orientation",):
                yield function, "static_test", name, test
    for value in (*NUMBER, None, -1.0):
        yield "retarget", "params", "position", changed(ControllerParams(), position=value)
        yield "retarget", "params", "task_gain", changed(ControllerParams(), task_gain=value)
        yield "simulate", "noise", "gyro_density", changed(ImuNoise(), gyro_density=value)
        yield "simulate", "imperfections", "soft_tissue_deg", changed(Imperfections(), soft_tissue_deg=value)
    for value in ("nonsense", 3, None):
        yield "simulate", "imperfections", "mount", changed(Imperfections(), mount=value)
    for value in ("100", NAN, None, [1.0]):
        yield "estimate_orientation", "params", "block_s", changed(AmekfParams(), block_s=value)


@cache
def wrong_calls() -> list[Wrong]:
    calls = [
        Wrong(function, "length" if name == "lengths" else name, {name: value})
        for function, parameters in TABLE.items()
        for name, values in parameters.items()
        for value in values
    ]
    arguments = right()
    for function in ("track", "calibrate"):
        calls += [
            Wrong(function, name, {"recording": r}) for name, r in wrong_recordings(arguments[function]["recording"])
        ]
    for name, subject in wrong_subjects(arguments["track"]["subject"]):
        calls += [Wrong("track", name, {"subject": subject}), Wrong("calibrate", name, {"prior": subject})]
    for name, pose in wrong_poses(arguments["evaluate"]["pose"]):
        calls += [Wrong("evaluate", name, {parameter: pose}) for parameter in ("pose", "truth")]
        calls.append(Wrong("joint_angles", name, {"pose": pose}))
    for name, pose in wrong_poses(arguments["retarget"]["pose"]):
        calls.append(Wrong("retarget", name, {"pose": pose}))
    calls += [Wrong(function, names, {parameter: options}) for function, parameter, names, options in wrong_options()]
    calls += [Wrong(function, "nonsense", {"nonsense": 1}) for function in arguments]
    calls += [Wrong(f, name, {name: ...}) for f, of in arguments.items() for name in of if name in _needed(f)]
    return calls


def _needed(function: str) -> set[str]:
    import inspect

    parameters = inspect.signature(getattr(wp, function)).parameters.values()
    return {p.name for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD}


def outcome(wrong: Wrong) -> str:
    """ "named", or what came instead."""
    arguments = {k: v for k, v in (right()[wrong.function] | wrong.changed).items() if v is not ...}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = {k: v() if isinstance(v, partial) else v for k, v in arguments.items()}
            getattr(wp, wrong.function)(**made)
    except wp.WeposeError as error:
        text = str(error)
        if len(text.splitlines()) != 1:
            return f"more than a line: {text}"
        mentioned = wrong.names in text.replace("-", "_") or str(arguments.get(wrong.names)) in text
        return "named" if mentioned else f"not named: {text}"
    except TypeError as error:  # as Python says of what is missing, or not a parameter
        missing = {"nonsense", *_needed(wrong.function)} & {wrong.names} and (
            f"'{wrong.names}'" in str(error) and "argument" in str(error)
        )
        return "named" if missing else f"raw: TypeError: {error}"
    except Exception as error:
        return f"raw: {type(error).__name__}: {error}"
    return "accepted"


@pytest.mark.parametrize("function", TABLE)
def test_every_wrong_call_is_refused_and_says_what_is_wrong(function: str) -> None:
    pytest.importorskip("daqp")
    outcomes = {str(wrong): outcome(wrong) for wrong in wrong_calls() if wrong.function == function}
    assert len(outcomes) > 5
    assert {call: answer for call, answer in outcomes.items() if answer != "named"} == {}


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
    for wrong, match in (((1e200 * gyro, accel), r"^gyro_S\[.* rad/s"), ((gyro, 1e3 * accel), r"^accel_S\[.* m/s\^2")):
        with pytest.raises(BadData, match=match):
            wp.estimate_orientation(*wrong, 100.0, static=(0.5, 4.5))


def test_the_name_that_is_meant_may_differ_in_case_and_hyphens() -> None:
    recording = replace(right()["track"]["recording"], start_pose="N-Pose")
    with pytest.raises(wp.WeposeError, match="did you mean 'n_pose'"):
        wp.track(recording)


def test_an_unknown_point_lists_the_known_ones() -> None:
    pose = right()["evaluate"]["pose"]
    motion = TrackResult("x", pose, wp.load_model(), wp.population_subject())
    with pytest.raises(KeyError, match=r"no point 'hand'; .*right_palm") as raised:
        motion.points["hand"]
    assert isinstance(raised.value, wp.WeposeError)


def test_a_pose_or_a_truth_of_nan_is_refused() -> None:
    pose = right()["evaluate"]["pose"]
    unknown = replace(pose, quat_WL={name: np.full_like(quat, NAN) for name, quat in pose.quat_WL.items()})
    with pytest.raises(BadData, match="NaN in all samples"):
        wp.joint_angles(unknown)
    for pair in ((pose, unknown), (unknown, pose)):
        with pytest.raises(BadData, match=r"no orientation of a segment .* NaN"):
            wp.evaluate(*pair)
