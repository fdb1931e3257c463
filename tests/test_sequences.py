"""Protocols joined in one session, free motion, points on the body, and several sessions of one person."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.assets import asset
from wepose_pin.calibration import Calibration, assess, calibrate, calibrate_sessions, load_protocol
from wepose_pin.calibration.initial_headings import _see_from
from wepose_pin.calibration.protocols import choose_protocol
from wepose_pin.calibration.series import check_same_person
from wepose_pin.cli import main
from wepose_pin.errors import BadOption, BadPhase, BadSession
from wepose_pin.recording import Recording
from wepose_pin.simulation import (
    IDEAL_PRESET,
    MILD_PRESET,
    NOISE_FREE,
    Person,
    Simulation,
    simulate,
    simulate_activity,
    simulate_person,
)
from wepose_pin.subject import load_subject
from wepose_pin.writers.session import write_session

ANY = replace(IDEAL_PRESET, mount="any")


def simulated(protocol: str, seed: int = 3, **options: object) -> tuple[Person, Simulation]:
    person = simulate_person(seed)
    options = {"rate_hz": 50.0, "noise": NOISE_FREE, "imperfections": ANY, "clasp_s": 40.0} | options
    return person, simulate(person.lengths, seed=seed, circles=0, protocol=protocol, **options)


@pytest.fixture(scope="module")
def joined() -> tuple[Person, Simulation]:
    return simulated("clasp+elbows+t_pose+touch_body", clasp_s=60.0)


def in_torso(simulation: Simulation, point: str, rows: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(simulation.quat_WL["torso"][rows]).inv().apply(simulation.points[point][rows])


def rows_of(simulation: Simulation, phase: str) -> np.ndarray:
    [(begin, end)] = simulation.phases[phase]
    return np.flatnonzero((simulation.time >= begin) & (simulation.time <= end))


def heading_errors(calibration: Calibration, simulation: Simulation) -> np.ndarray:
    """Of all sensors [deg]."""
    return np.array(
        [
            (Rotation.from_quat(quat) * Rotation.from_quat(simulation.quat_LS[name]).inv()).as_rotvec(degrees=True)[2]
            for name, quat in calibration.subject.mounts.items()
        ]
    )


def test_protocols_join(tmp_path: Path) -> None:
    protocol = load_protocol("clasp+t_pose")
    assert [step.phase for step in protocol.steps] == ["start", "clasp", "t_pose"]
    assert protocol.conditions == load_protocol("clasp").conditions + load_protocol("t_pose").conditions
    assert protocol.needs == load_protocol("clasp").needs
    own = tmp_path / "a+b.toml"  # a path is one protocol
    own.write_text((asset("calibration", "clasp.toml")).read_text(encoding="utf-8"), encoding="utf-8")
    assert load_protocol(own).steps == load_protocol("clasp").steps
    assert choose_protocol({"start", "clasp"}) == "clasp"
    assert choose_protocol({"start", "clasp", "t_pose"}) == "clasp+t_pose"
    with pytest.raises(BadOption, match="protocol 't_poes' is not known; did you mean 't_pose'"):
        load_protocol("clasp+t_poes")
    with pytest.raises(BadOption, match=r"protocol 'clasp\+handle' is not simulated"):
        simulated("clasp+handle")


def test_parts_are_done_as_they_say(joined: tuple[Person, Simulation]) -> None:
    """Palms stay together, upper arms hang, arms are level, palms stay on the torso while elbows move."""
    _, simulation = joined
    clasp = rows_of(simulation, "clasp")
    assert np.ptp(simulation.points["left_palm"][clasp] - simulation.points["right_palm"][clasp]) < 1e-9
    elbows, up = rows_of(simulation, "elbows"), np.array((0.0, 0.0, 1.0))
    for side in ("left", "right"):
        upper, fore = (
            Rotation.from_quat(simulation.quat_WL[f"{side}_{part}"][elbows]) for part in ("upper_arm", "forearm")
        )
        assert np.degrees(np.arccos(upper.apply(up) @ up)).max() < 6.0
        assert np.ptp(np.degrees((upper.inv() * fore).magnitude())) > 60.0
        raised = Rotation.from_quat(simulation.quat_WL[f"{side}_upper_arm"][rows_of(simulation, "t_pose")[50:-50]])
        assert abs(np.degrees(np.arcsin(raised.apply(-up) @ up)).mean() + 3.0) < 0.5  # as people hold it
        for phase in ("hips", "shoulders", "head"):
            rows = rows_of(simulation, phase)
            assert np.ptp(in_torso(simulation, f"{side}_palm", rows), axis=0).max() < 1e-9
            assert np.ptp(in_torso(simulation, f"{side}_elbow", rows), axis=0).max() > 0.05


@pytest.mark.slow
def test_exact_parts_give_headings_and_lengths_back(joined: tuple[Person, Simulation]) -> None:
    """The T-pose is left out: it is held as people hold it, not exactly."""
    person, simulation = joined
    calibration = calibrate(
        simulation.recording(),
        measured={"shoulder_width": person.lengths["shoulder_width"]},
        prior=person.prior,
        protocol="clasp+elbows+touch_body",
        measured_std=1e-4,
    )
    assert np.abs(heading_errors(calibration, simulation)).max() < 0.5
    for side in ("left", "right"):
        names = [f"{side}_upper_arm", f"{side}_forearm", f"{side}_hand"]
        assert abs(sum(calibration.subject.lengths[name] - person.lengths[name] for name in names)) < 0.01


def test_the_slope_of_a_gap_seen_from_a_segment() -> None:
    rng = np.random.default_rng(2)
    Q = Rotation.random(12, random_state=rng).as_matrix().reshape(3, 4, 3, 3)
    gap, J, psi = rng.normal(size=(2, 4, 3)), np.zeros((2, 6, 4, 3)), rng.uniform(-3.0, 3.0, (2, 3))
    seen, slope = _see_from(gap, J, Q, psi, 1)
    step = np.array((0.0, 1e-6, 0.0))
    differences = (_see_from(gap, J, Q, psi + step, 1)[0] - _see_from(gap, J, Q, psi - step, 1)[0]) / 2e-6
    np.testing.assert_allclose(slope[:, 1], differences, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=2), np.linalg.norm(gap, axis=2))


def test_free_motion_shows_headings_and_keeps_lengths() -> None:
    person = simulate_person(4)
    simulation = simulate_activity("tasks", seed=4, imperfections=ANY, seconds=40.0, lengths=person.lengths)
    recording = simulation.recording()
    calibration = calibrate(recording, prior=person.prior, protocol="free")
    errors = heading_errors(calibration, simulation)
    std = max(calibration.subject.std(f"mounts.{name}.z") for name in calibration.subject.mounts)
    assert np.abs(errors).max() < 2.0 * np.degrees(std) < 40.0
    assert np.ptp(errors) < 4.0  # against each other by the accelerations of the joints
    assert calibration.subject.lengths == pytest.approx(person.prior.lengths, rel=1e-9)
    assert "lengths-not-observed" in {diagnostic.code for diagnostic in calibration.diagnostics}
    assert assess(calibration).quality != "pass"
    still = replace(recording, phases={"start": ((0.5, 1.5),)}).cut(recording.span((0.0, 4.9)))
    with pytest.raises(BadPhase, match=r"the motion does not show how sensors\.left_upper_arm") as caught:
        calibrate(still, prior=person.prior, protocol="free")
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def sessions() -> list[Recording]:
    person = simulate_person(11)
    made = [
        simulate(
            person.lengths,
            seed=11,
            session=session,
            circles=0,
            clasp_s=20.0,
            rate_hz=50.0,
            imperfections=replace(MILD_PRESET, mount="any"),
        )
        for session in range(2)
    ]
    return [simulation.recording(f"session {k}") for k, simulation in enumerate(made)]


@pytest.mark.slow
def test_the_order_of_sessions_does_not_matter(sessions: list[Recording]) -> None:
    person = simulate_person(11)
    options = {"prior": person.prior, "measured": person.measured}
    forth, back = (calibrate_sessions(order, **options) for order in (sessions, sessions[::-1]))
    alone = [calibration.subject for calibration in (forth[0], back[0])]
    for name in person.lengths:
        assert forth[-1].subject.lengths[name] == pytest.approx(back[-1].subject.lengths[name], abs=1e-6)
        assert forth[-1].subject.std(name) == pytest.approx(back[-1].subject.std(name), rel=1e-4)
    std = [
        np.sqrt(np.trace(subject.lengths_covariance(tuple(person.lengths)))) for subject in (*alone, forth[-1].subject)
    ]
    assert std[2] < min(std[:2])
    # Mounts are those of the last session, moved by no more than lengths that are known better move them.
    for name, quat in forth[-1].subject.mounts.items():
        own, other = (Rotation.from_quat(subject.mounts[name]) for subject in alone[::-1])
        assert (Rotation.from_quat(quat) * own.inv()).magnitude() < np.deg2rad(2.0)
        assert (Rotation.from_quat(quat) * other.inv()).magnitude() > np.deg2rad(5.0)


def test_sessions_of_two_people_are_one_line(sessions: list[Recording]) -> None:
    first = calibrate(sessions[0], prior=simulate_person(11).prior).subject
    longer = {name: 1.3 * value if name.startswith("right") else value for name, value in first.lengths.items()}
    with pytest.raises(
        BadSession, match=r"b: the right arm is \d+ mm long and \d+ mm in a.*not sessions of one person"
    ) as caught:
        check_same_person(["a", "b"], [first, replace(first, lengths=longer)])
    assert "\n" not in str(caught.value)


def test_the_command_takes_several_sessions(
    sessions: list[Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, recording in zip("ab", sessions, strict=True):
        Path(name).mkdir()
        write_session(Path(name), recording)
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", "a", "b", "-o", "both", "--no-report"])
    assert stopped.value.code in (3, 4)
    assert "a: quality" in capsys.readouterr().out
    assert set(load_subject(Path("both")).mounts) == set(sessions[1].sensors)
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", "a", "b", "-o", "paper", "--formulation", "paper", "--measured", "shoulder_width=0.37"])
    assert stopped.value.code == 2
    assert "takes one session" in capsys.readouterr().err
