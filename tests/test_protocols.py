"""Protocols as data, one solver: each on exact motion and on usual imperfections, with mounts at any rotation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import LENGTHS, TABLE
from scipy.spatial.transform import Rotation

from wepose_pin.body import load_model
from wepose_pin.calibration import PROTOCOLS, Calibration, calibrate, load_protocol
from wepose_pin.calibration.problem import CalibrationProblem
from wepose_pin.calibration.protocols import Axis, Closure, Direction
from wepose_pin.commands import main
from wepose_pin.errors import WeposeError
from wepose_pin.filters.sensors import filter_recording
from wepose_pin.readers import load_session
from wepose_pin.recording import Recording
from wepose_pin.simulation import (
    IDEAL_PRESET,
    MILD_PRESET,
    MTI_3,
    NOISE_FREE,
    Person,
    Simulation,
    simulate,
    simulate_person,
)

CALIBRATION = Path(__file__).resolve().parent.parent / "calibration"
MADE: dict[tuple, tuple[Person, Simulation]] = {}


def made(protocol: str, seed: int, real: bool, seconds: float = 60.0) -> tuple[Person, Simulation]:
    """A minute of a protocol with mounts at any rotation, exact or with usual imperfections."""
    key = (protocol, seed, real, seconds)
    if key not in MADE:
        person = simulate_person(seed)
        MADE[key] = (
            person,
            simulate(
                person.lengths,
                seed=seed,
                rate_hz=100.0 if real else 50.0,
                noise=MTI_3 if real else NOISE_FREE,
                imperfections=replace(MILD_PRESET if real else IDEAL_PRESET, mount="any"),
                clasp_s=seconds,
                circles=0,
                protocol=protocol,
            ),
        )
    return MADE[key]


def mount_errors(calibration: Calibration, simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the mounts (sensors, 3) [deg] in L, the last of them the heading's, and their standard deviations."""
    error, std = [], []
    for name in calibration.subject.heading_drift:
        off = Rotation.from_quat(calibration.subject.mounts[name]) * Rotation.from_quat(simulation.quat_LS[name]).inv()
        error.append(off.as_rotvec(degrees=True))
        std.append([np.degrees(calibration.subject.std(f"mounts.{name}.{axis}")) for axis in "xyz"])
    return np.array(error), np.array(std)


# --------------------------------------------------------------------------------------------------------------- data


def codes(calibration: Calibration) -> set[str]:
    return {diagnostic.code for diagnostic in calibration.diagnostics}


def test_every_protocol_file_is_known_and_says_what_to_do() -> None:
    assert {path.stem for path in CALIBRATION.glob("*.toml")} == {*PROTOCOLS, "anthropometry"}
    for name in PROTOCOLS:
        protocol = load_protocol(name)
        assert protocol.name == name
        assert protocol.steps[0].phase == "start"
        phases = {condition.phase for condition in protocol.conditions} - {""}  # from the start pose on
        assert phases == {s.phase for s in protocol.steps} - {"start"}


# Conditions that a protocol of one's own may have, with the sensors of one arm.
OWN = {
    "a fixed point": Closure("clasp", "fixed_point", ("right_palm",)),
    "a known point": Closure("clasp", "fixed_point", ("right_palm",), at=(0.4, -0.2, 0.3)),
}


@pytest.mark.parametrize("name", ["clasp", "t_pose+bow", "table", *OWN])
def test_jacobians_are_those_of_differences(name: str) -> None:
    simulated = name if name == "t_pose+bow" else "clasp"
    person, simulation = made(simulated, 1, real=False, seconds=20.0)
    recording, protocol = simulation.recording(), load_protocol("clasp" if name in OWN else name)
    recording = replace(recording, phases={**recording.phases, "table": recording.phases.get("clasp", ())})
    protocol = replace(protocol, conditions=(OWN[name],)) if name in OWN else protocol
    problem = CalibrationProblem(recording, filter_recording(recording), protocol, person.prior, {}, load_model())
    observations, _ = problem.observe()
    observations = observations.take(np.concatenate([[span.start, span.stop - 1] for _, span in observations.spans()]))
    layout, n, rng = observations.layout, len(observations), np.random.default_rng(1)
    assert len(layout.girdles) == (1 if name in OWN else 2)
    x = rng.normal(scale=0.1, size=layout.size)
    x[:8] = rng.uniform(0.1, 0.5, 8)
    x[layout.heading] = rng.uniform(-3, 3, len(layout.sensors))
    x[layout.drift] = rng.normal(scale=1e-3, size=len(layout.sensors))
    J = np.asarray(observations.jacobian(x)).T.reshape(n, -1, layout.size)
    assert J.shape == (n, 3 + len(layout.hinges), layout.size)
    for k in range(layout.size):
        step = np.zeros(layout.size)
        step[k] = 1e-6
        after, before = (np.asarray(observations.residuals(near)[0]).T for near in (x + step, x - step))
        slope = (after - before) / 2e-6
        np.testing.assert_allclose(J[:, :, k], slope, atol=1e-5 * max(1.0, np.abs(slope).max()))
    assert np.all((np.abs(observations.gaps(x)).max(axis=1) > 0) == observations.closed)


# -------------------------------------------------------------------------------------------------------------- exact


# ---------------------------------------------------------------------------------------------------------- realistic


def test_poses_tell_headings_and_no_length() -> None:
    person, simulation = made("t_pose+bow", 4, real=True)
    recording = simulation.recording()
    calibration = calibrate(recording, prior=person.prior, protocol="t_pose+bow")
    assert calibration.subject.lengths == pytest.approx(person.prior.lengths)
    for name in LENGTHS:
        assert calibration.subject.std(name) == pytest.approx(person.prior.std(name))
    assert "lengths-not-observed" in codes(calibration)
    # As well as the poses are held, the T-pose and the N-pose of bent elbows, against a torso that bowed.
    heading = dict(zip(calibration.subject.heading_drift, mount_errors(calibration, simulation)[1][:, 2], strict=True))
    torso = heading.pop("torso")
    conditions = load_protocol("t_pose+bow").conditions
    (bow,) = (np.degrees(condition.std) for condition in conditions if isinstance(condition, Axis))
    assert bow < torso < 10.0
    (t_pose,) = {np.degrees(condition.std) for condition in conditions if isinstance(condition, Direction)}
    for name, std in heading.items():
        n_pose = np.degrees(np.linalg.norm(TABLE.segments[name].start_std[:2]))
        assert np.hypot(t_pose, bow) < std < np.linalg.norm([t_pose, n_pose, torso])
    measured = calibrate(recording, prior=person.prior, protocol="t_pose+bow", measured={"trunk": 0.47})
    assert measured.subject.lengths["trunk"] == pytest.approx(0.47, abs=2e-3)


# ------------------------------------------------------------------------------------------------------ wrong requests


def without(recording: Recording, phase: str) -> Recording:
    return replace(recording, phases={name: spans for name, spans in recording.phases.items() if name != phase})


def test_wrong_requests_are_one_line_that_names_them() -> None:
    recording = made("clasp", 1, real=False)[1].recording()
    ((begin, _),) = recording.phases["clasp"]
    short = replace(recording, phases={**recording.phases, "clasp": ((begin, begin + 0.6),)})
    fewer = replace(recording, sensors={k: v for k, v in recording.sensors.items() if k != "torso"})
    for error, match, asked in (
        (WeposeError, "protocol 'clap' is not known; did you mean 'clasp'", lambda: load_protocol("clap")),
        (WeposeError, "mine.toml: no such file; a protocol is wanted here", lambda: load_protocol("mine.toml")),
        (WeposeError, r"phases\.clasp is needed here", lambda: run(without(recording, "clasp"), "clasp")),
        (WeposeError, r"phases\.t_pose is needed here", lambda: run(recording, "t_pose")),
        (
            WeposeError,
            r"phases\.clasp has 0\.[67] s in which all sensors measure; at least 1\.25 s",
            lambda: run(short, "clasp"),
        ),
        (WeposeError, "no sensor on torso; protocol 'clasp' needs one", lambda: run(fewer, "clasp")),
        (WeposeError, "measured bar: not a length", lambda: run(recording, "clasp", bar=0.4)),
        (WeposeError, "measured trunc: not a length; did you mean 'trunk'", lambda: run(recording, "clasp", trunc=0.4)),
    ):
        with pytest.raises(error, match=match) as caught:
            asked()
        assert "\n" not in str(caught.value)


def run(recording: Recording, protocol: str, **measured: float) -> Calibration:
    return calibrate(recording, protocol=protocol, measured=measured)


FILE = """
needs = ["torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm"]
[[closure]]
phase = "clasp"
kind = "coincide"
points = ["left_palm", "right_palm"]
slip = 0.005
"""
POSE = "[[pose]]\nphase = 'static'\nstd_deg = 5\ndirections = {}\n[[closure]]"


def test_a_protocol_of_ones_own(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(FILE)
    protocol = load_protocol(own)
    assert protocol.name == "mine"
    person, simulation = made("clasp", 1, real=False, seconds=20.0)
    calibration = calibrate(simulation.recording(), prior=person.prior, protocol=protocol)
    assert "mine" in calibration.subject.note
    for old, new, match in (
        ('"left_palm"', '"left_plam"', "'left_plam' is no point of upper_body; did you mean 'left_palm'"),
        (', "right_palm"', "", r"points = \['left_palm'\]; kind 'coincide' takes 2"),
        ('"coincide"', '"distance"', r"closure 1.kind = 'distance' is not known"),
        ("slip = 0.005", 'slip = "half"', r"slip = 'half'; a number \[m\] from 0.0001 to 0.1"),
        ("slip =", "slipp =", r"closure 1.slipp is not a known key; did you mean 'slip'"),
        ("kind =", "# kind =", r"closure 1.kind is missing; there is: coincide"),
        ("[[closure]]", "[[closures]]", r"closures is not a known key; did you mean 'closure'"),
        ("[[closure]]", "pose = 3\n[[closure]]", r"pose = 3 is no list of tables; write \[\[pose\]\]"),
        ("[[closure]]", "[[step]]\nseconds = 3\n[[closure]]", r"step 1.phase is missing"),
        ("[[closure]]", POSE.format("3"), r"pose 1.directions = 3 is not a table"),
        ("[[closure]]", POSE.format("{ torso = ['a', 0, 0] }"), r"directions\.torso = .*three numbers are needed"),
        ("[[closure]]", POSE.format("{ haed = [0, 0, 1] }"), "haed is no segment of upper_body; did you mean 'head'"),
        (
            "[[closure]]",
            "[[motion]]\nsegment = 'torso'\n[[closure]]",
            r"motion 1.segment is not a known key; there is: phase",
        ),
        ("needs =", "measured_example = 'foo=1'\nneeds =", "measured_example: 'foo' is no length"),
        ("needs =", "needs ==", r"not valid TOML"),
        ("needs =", "needs = 3 #", r"needs = 3; a text, or a list of texts is needed"),
        ("needs =", "needs = [3] #", r"needs\[0\] = 3; a text is needed"),
        ("points =", "points = 'left_palm' #", r"closure 1.points = \['left_palm'\]; kind 'coincide' takes 2"),
        ("points =", "points = [['left_palm'], 'right_palm'] #", r"points\[0\] = \['left_palm'\]; a text is needed"),
    ):
        own.write_text(FILE.replace(old, new))
        with pytest.raises(WeposeError, match=match) as caught:
            load_protocol(own).check_body(TABLE)
        assert "\n" not in str(caught.value)


def command(*argv: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        main(list(argv))
    return int(stopped.value.code or 0)


def test_a_protocol_is_simulated_and_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = tmp_path / "made"
    assert command("simulate", "-o", str(made), "--protocol", "t_pose+bow", "--seconds", "20") == 0
    assert set(load_session(made).phases) >= {"start", "t_pose", "bow"}
    assert command("calibrate", str(made), "--protocol", "t_pose+bow", "--gaps", "-o", str(tmp_path / "out")) == 3
    assert "determines headings and no length" in capsys.readouterr().err
    asked = ["calibrate", str(made), "--protocol", "hande", "-o", str(tmp_path / "out"), "--force"]
    assert command(*asked) == 2
    assert "protocol 'hande' is not known" in capsys.readouterr().err
