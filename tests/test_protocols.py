"""Protocols as data: what they show, and what a wrong one is told."""

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import LENGTHS, TABLE
from commands import run as command
from scipy.spatial.transform import Rotation

import wepose_pin as wp
from wepose_pin import Calibration, Recording, Simulation, calibrate, load_session
from wepose_pin.calibration import load_protocol
from wepose_pin.simulation import Person, simulate, simulate_person

CALIBRATION = Path(__file__).resolve().parent.parent / "calibration"


@cache
def made(protocol: str, seed: int, real: bool, seconds: float = 60.0) -> tuple[Person, Simulation]:
    """A minute of a protocol with mounts at any rotation, exact or with usual imperfections."""
    person = simulate_person(seed)
    options: dict[str, Any] = {"imperfections": replace(wp.MILD_PRESET, mount="any")}
    if not real:
        options = {"rate_hz": 50.0, "noise": wp.NOISE_FREE, "imperfections": replace(wp.IDEAL_PRESET, mount="any")}
    return person, simulate(person.lengths, seed=seed, clasp_s=seconds, circles=0, protocol=protocol, **options)


def mount_errors(calibration: Calibration, simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the mounts (sensors, 3) [deg] in L, the last of them the heading's, and their standard deviations."""
    error, std = [], []
    for name in calibration.subject.heading_drift:
        off = Rotation.from_quat(calibration.subject.mounts[name]) * Rotation.from_quat(simulation.quat_LS[name]).inv()
        error.append(off.as_rotvec(degrees=True))
        std.append([np.degrees(calibration.subject.std(f"mounts.{name}.{axis}")) for axis in "xyz"])
    return np.array(error), np.array(std)


def codes(calibration: Calibration) -> set[str]:
    return {diagnostic.code for diagnostic in calibration.diagnostics}


def test_every_protocol_file_is_known_and_says_what_to_do() -> None:
    for name in (path.stem for path in CALIBRATION.glob("*.toml") if path.stem != "anthropometry"):
        protocol = load_protocol(name)
        assert protocol.name == name
        assert protocol.steps[0].phase == "start"
        phases = {condition.phase for condition in protocol.conditions} - {""}  # from the start pose on
        assert phases == {s.phase for s in protocol.steps} - {"start"}


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
    bow, t_pose = (
        tomllib.loads((CALIBRATION / f"{name}.toml").read_text(encoding="utf-8"))[kind][0]["std_deg"]
        for name, kind in (("bow", "axis"), ("t_pose", "pose"))
    )
    assert bow < torso < 10.0
    for name, std in heading.items():
        n_pose = np.degrees(np.linalg.norm(TABLE.segments[name].start_std[:2]))
        assert np.hypot(t_pose, bow) < std < np.linalg.norm([t_pose, n_pose, torso])
    measured = calibrate(recording, prior=person.prior, protocol="t_pose+bow", measured={"trunk": 0.47})
    assert measured.subject.lengths["trunk"] == pytest.approx(0.47, abs=2e-3)


def without(recording: Recording, phase: str) -> Recording:
    return replace(recording, phases={name: spans for name, spans in recording.phases.items() if name != phase})


def test_wrong_requests_are_one_line_that_names_them() -> None:
    recording = made("clasp", 1, real=False)[1].recording()
    ((begin, _),) = recording.phases["clasp"]
    short = replace(recording, phases={**recording.phases, "clasp": ((begin, begin + 0.6),)})
    fewer = replace(recording, sensors={k: v for k, v in recording.sensors.items() if k != "torso"})
    for match, asked in (
        ("protocol 'clap' is not known; did you mean 'clasp'", lambda: run(recording, "clap")),
        ("mine.toml: no such file; a protocol is needed here", lambda: run(recording, "mine.toml")),
        (r"phases\.clasp is needed here", lambda: run(without(recording, "clasp"), "clasp")),
        (r"phases\.t_pose is needed here", lambda: run(recording, "t_pose")),
        (r"phases\.clasp has 0\.[67] s in which all sensors measure; at least 1\.25 s", lambda: run(short, "clasp")),
        ("no sensor on torso; protocol 'clasp' needs one", lambda: run(fewer, "clasp")),
        ("measured bar: not a length", lambda: run(recording, "clasp", bar=0.4)),
        ("measured trunc: not a length; did you mean 'trunk'", lambda: run(recording, "clasp", trunc=0.4)),
        ("one follows from the other", lambda: run(recording, "clasp", biacromial=0.4, shoulder_width=0.33)),
    ):
        with pytest.raises(wp.WeposeError, match=match) as caught:
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
        ("needs =", "needs ==", r"not valid TOML"),
        ("needs =", "needs = 3 #", r"needs = 3; a list of texts is needed"),
        ("needs =", "needs = [3] #", r"needs\[0\] = 3; a text is needed"),
        ("points =", "points = 'left_palm' #", r"closure 1.points = \['left_palm'\]; kind 'coincide' takes 2"),
        ("points =", "points = [['left_palm'], 'right_palm'] #", r"points\[0\] = \['left_palm'\]; a text is needed"),
    ):
        own.write_text(FILE.replace(old, new))
        with pytest.raises(wp.WeposeError, match=match) as caught:
            load_protocol(own).check_body(TABLE)
        assert "\n" not in str(caught.value)


def test_a_protocol_is_simulated_and_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = tmp_path / "made"
    assert command("simulate", "-o", str(made), "--protocol", "t_pose+bow", "--seconds", "20") == 0
    assert set(load_session(made).phases) >= {"start", "t_pose", "bow"}
    assert command("calibrate", str(made), "--protocol", "t_pose+bow", "--gaps", "-o", str(tmp_path / "out")) == 3
    assert "determines headings and no length" in capsys.readouterr().err
    asked = ["calibrate", str(made), "--protocol", "hande", "-o", str(tmp_path / "out"), "--force"]
    assert command(*asked) == 2
    assert "protocol 'hande' is not known" in capsys.readouterr().err
