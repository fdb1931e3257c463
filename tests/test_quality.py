"""What a calibration says of itself: each way in which a session goes wrong is recognised and said, or solved."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from scipy.spatial.transform import Rotation, Slerp

import wepose_pin as wp
from wepose_pin import MILD_PRESET, Calibration, OrientationSensor, Recording, Simulation, WeposeError, calibrate
from wepose_pin.simulation import Person, simulate, simulate_person
from wepose_pin.writers import write_session

ANY = replace(MILD_PRESET, mount="any")
SEED = 3


@pytest.fixture(scope="module")
def person() -> Person:
    return simulate_person(SEED)


@pytest.fixture(scope="module")
def anywhere(person: Person) -> Simulation:
    return simulate(person.lengths, seed=SEED, imperfections=ANY, clasp_s=40.0, circles=0, rate_hz=50.0)


def as_orientations(simulation: Simulation, quat_WL: Mapping[str, np.ndarray], stated: bool = False) -> Recording:
    """A recording of exact orientations; how sensors sit is stated or not known."""
    sensors = {}
    for name, quat in quat_WL.items():
        mount = simulation.quat_LS[name]
        quat_WS = (Rotation.from_quat(quat) * Rotation.from_quat(mount)).as_quat()
        sensors[name] = OrientationSensor(quat_WS, mount if stated else None)
    return replace(simulation.recording(), sensors=sensors)


def solved(recording: Recording, person: Person, measured: bool = True) -> Calibration:
    lengths = {"shoulder_width": person.measured["shoulder_width"]} if measured else {}
    return calibrate(recording, measured=lengths, prior=person.prior, measured_std=person.measured_std)


@pytest.fixture(scope="module")
def unmeasured(anywhere: Simulation, person: Person) -> Calibration:
    return solved(anywhere.recording(), person, measured=False)


def exchanged(recording: Recording, *pairs: tuple[str, str]) -> Recording:
    """Sensors under each other's name, with the mount that their place has."""
    names = {a: b for pair in pairs for a, b in (pair, pair[::-1])}
    return replace(recording, sensors={k: recording.sensors[names.get(k, k)] for k in recording.sensors})


def arm_errors(calibration: Calibration, person: Person) -> np.ndarray:
    parts = [(f"{s}_upper_arm",) for s in ("left", "right")] + [
        (f"{s}_forearm", f"{s}_hand") for s in ("left", "right")
    ]
    return np.array([sum(calibration.subject.lengths[n] - person.lengths[n] for n in names) for names in parts])


SIDES_EXCHANGED = tuple((f"left_{part}", f"right_{part}") for part in ("upper_arm", "forearm"))
# Case → what is done to a good recording, the quality, the codes that come first, their places and variants.
CASES: dict[str, tuple[Callable[[Recording], Recording], str, list[tuple[str, str, str]]]] = {
    "as it should be": (lambda r: r, "pass", []),
    "left and right swapped": (
        lambda r: exchanged(r, *SIDES_EXCHANGED),
        "fail",
        [("sensors-exchanged", "left_forearm and right_forearm, left_upper_arm and right_upper_arm", "sides")],
    ),
    "upper arm and forearm exchanged": (
        lambda r: exchanged(r, ("left_upper_arm", "left_forearm")),
        "fail",
        [("sensors-exchanged", "left_upper_arm and left_forearm", "")],
    ),
    "the forearms exchanged": (
        lambda r: exchanged(r, ("left_forearm", "right_forearm")),
        "fail",
        [("sensors-exchanged", "left_forearm and right_forearm", "")],
    ),
    "torso and an upper arm exchanged": (
        lambda r: exchanged(r, ("torso", "right_upper_arm")),
        "fail",
        [("sensors-exchanged", "torso and right_upper_arm", "")],
    ),
    "palms that never meet": (
        lambda r: replace(r, sensors={**r.sensors, "left_forearm": r.sensors["torso"]}),
        "fail",
        [("closure-gap-large", "", "apart")],
    ),
    "six seconds of motion": (
        lambda r: replace(r, phases={**r.phases, "clasp": ((20.0, 26.0),)}),
        "fail",
        [("motion-too-small", "", "")],
    ),
}


QUICK = ("as it should be", "palms that never meet", "the forearms exchanged", "six seconds of motion")


def codes(quality: Any) -> list[str]:
    return [diagnostic.code for diagnostic in quality.reasons]


@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.slow] * (case not in QUICK)) for case in CASES])
def test_what_goes_wrong_is_diagnosed(case: str, anywhere: Simulation, person: Person) -> None:
    change, wanted, first = CASES[case]
    quality = solved(change(anywhere.recording()), person).quality
    reasons = [(d.code, d.place, str(d.facts.get("variant", ""))) for d in quality.reasons]
    assert quality.quality == wanted
    assert set(first) <= set(reasons)
    assert bool(reasons) == (wanted != "pass")
    assert len(set(reasons)) == len(reasons)  # each once
    if wanted == "fail":  # of another arrangement of sensors, and beside what was too short, nothing else is said
        assert reasons[0] == first[0]
        assert quality.reasons[0].severity == "error"
        assert len({code for code, _, _ in reasons}) == 1


def test_without_a_measured_length_the_scale_is_the_priors(unmeasured: Calibration) -> None:
    quality = unmeasured.quality
    assert quality.quality == "poor"
    assert codes(quality) == ["scale-uncertain"]
    assert "biacromial=" in str(quality.reasons[0])
    assert "scale-uncertain" not in {each.code for each in quality.further}  # not twice


def test_a_failed_calibration_says_so_and_is_not_tracked(
    anywhere: Simulation, person: Person, unmeasured: Calibration
) -> None:
    known = {"measured": {"shoulder_width": person.measured["shoulder_width"]}, "prior": person.prior}
    recording = anywhere.recording()
    moved = exchanged(recording, ("left_upper_arm", "left_forearm"))
    failed = calibrate(moved, **known)
    assert failed.quality.quality == failed.subject.quality == "fail"
    assert failed.subject.std("left_forearm") >= failed.problem.prior.std("left_forearm")
    assert failed.subject.std("mounts.torso.z") >= np.deg2rad(15.0) - 1e-9
    assert np.isnan(failed.scale_std)
    assert re.fullmatch(r"Calibration\('simulated': fail; 8 lengths ± \d+ to \d+ mm; first: .+\)", repr(failed))
    assert failed.diagnostics[0] == failed.quality.reasons[0]
    assert "left upper arm and left forearm seem to be exchanged" in failed._repr_html_()
    with pytest.raises(WeposeError, match="its calibration failed"):
        wp.track(moved, failed)
    assert wp.track(moved, failed, accept_failed=True).subject.quality == "fail"
    assert unmeasured.subject.quality == "poor"
    assert "Measure" in repr(unmeasured)


def test_hands_that_hardly_move_are_named(anywhere: Simulation, person: Person) -> None:
    """The clasp at a twentieth of its speed: two seconds of it in forty."""
    ((begin, _),) = anywhere.phases["clasp"]
    slow = np.where(anywhere.time > begin, begin + (anywhere.time - begin) / 20.0, anywhere.time)
    quat_WL = {
        name: Slerp(anywhere.time, Rotation.from_quat(q))(slow).as_quat() for name, q in anywhere.quat_WL.items()
    }
    quality = solved(as_orientations(anywhere, quat_WL), person).quality
    assert quality.quality == "fail"
    assert "motion-too-small" in codes(quality)


def test_hands_apart_for_a_quarter_of_the_time_are_found_and_left_out(anywhere: Simulation, person: Person) -> None:
    """The left arm swings away by 30 deg now and then."""
    swing = np.sin(np.pi * (anywhere.time - 5.0) / 10.0) - 0.5
    away = 30.0 * np.clip(3.0 * swing, 0.0, 1.0) * (anywhere.time > 7.5)
    quat_WL = dict(anywhere.quat_WL)
    for name in ("left_upper_arm", "left_forearm"):
        turned = Rotation.from_euler("z", away[:, None], degrees=True) * Rotation.from_quat(quat_WL[name])
        quat_WL[name] = turned.as_quat()
    calibration = solved(as_orientations(anywhere, quat_WL, stated=True), person)
    (apart,) = [d for d in calibration.quality.diagnostics if d.code == "closure-open"]
    assert 0.2 < apart.value < 0.4
    assert "Keep the points together" in str(apart)
    assert np.abs(arm_errors(calibration, person)).max() < 0.025
    at = away[np.searchsorted(anywhere.time, calibration.time - 1e-6)]
    assert np.mean(calibration.contact[at > 20.0]) < 0.1
    assert np.mean(calibration.contact[at < 1.0]) > 0.8


def test_exit_code_and_file_carry_the_quality(
    anywhere: Simulation,
    person: Person,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_session(tmp_path, anywhere.recording("made"))
    width = f"shoulder_width={person.measured['shoulder_width']:.4f}"
    words = ["--stature", f"{person.stature:.3f}", "--sex", person.sex, "--no-report"]
    for options, wanted, code in ((["--measured", width], "pass", 0), ([], "poor", 3)):
        assert run("calibrate", "session.toml", "-o", wanted, *words, *options) == code
        printed = capsys.readouterr().out
        assert f"Quality: {wanted}" in printed
        assert max(map(len, printed.splitlines())) <= 100
        content = json.loads((tmp_path / wanted / "calibration.json").read_text(encoding="utf-8"))
        assert content["quality"] == wanted
        assert any(each["severity"] != "info" for each in content["diagnostics"]) == (wanted != "pass")
        assert all(each["text"]["do"] for each in content["diagnostics"])
        assert {check["quality"] for check in content["checks"]} == {"pass", wanted}
        assert content["mounts"].keys() == anywhere.quat_LS.keys()
        assert content["lengths"]["left_upper_arm"]["std"] > 0.0
        assert {"wepose-pin", "casadi"} <= content["versions"].keys()


def test_a_measured_length_that_is_right_to_a_centimetre_is_not_contradicted() -> None:
    """The estimate of the upper arm is off by as much on people, whatever its residuals say."""
    person = simulate_person(3)
    recording = simulate(person.lengths, seed=3, circles=0, clasp_s=30.0, rate_hz=50.0).recording()
    for error, contradicted in ((0.012, False), (0.060, True)):
        measured = {name: person.lengths[name] for name in ("shoulder_width", "right_upper_arm")}
        measured["left_upper_arm"] = person.lengths["left_upper_arm"] + error
        calibration = calibrate(recording, measured=measured, prior=person.prior)
        assert ("length-contradicted" in codes(calibration.quality)) == contradicted
