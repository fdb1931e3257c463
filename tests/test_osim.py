"""A generic OpenSim model scaled to a subject, and the set-ups of OpenSense: against OpenSim, and wrong models."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lxml import etree
from test_export import LENGTHS, a_pose, write_folder
from test_export_opensim import SEGMENT_OF, motion, peer, pose_by_opensim

from wepose_pin import cli
from wepose_pin.errors import BadOption
from wepose_pin.model import load_model
from wepose_pin.writers.export import export
from wepose_pin.writers.osim import SPANS

__all__ = ["peer"]  # a fixture
GENERIC = "osim/Rajagopal_2015.osim"
# Length → the joints (by the body that each moves) or markers between which it lies.
ENDS = {
    "trunk": (("femur_r", "femur_l"), ("humerus_r", "humerus_l")),
    "shoulder_width": (("humerus_r",), ("humerus_l",)),
    "hip_width": (("femur_r",), ("femur_l",)),
    **{
        f"{side}_{part}": ((start,), (end,))
        for side, s in (("left", "l"), ("right", "r"))
        for part, start, end in (
            ("upper_arm", f"humerus_{s}", f"ulna_{s}"),
            ("forearm", f"ulna_{s}", f"hand_{s}"),
            ("hand", f"hand_{s}", f"{side}_palm"),
            ("thigh", f"femur_{s}", f"tibia_{s}"),
            ("shank", f"tibia_{s}", f"talus_{s}"),
            ("foot", f"talus_{s}", f"toes_{s}"),
        )
    },
}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("osim") / "result", a_pose())


def coordinates(file: Path) -> dict[str, dict[str, str]]:
    """Coordinate → its properties."""
    return {
        each.get("name"): {child.tag: child.text for child in each} for each in etree.parse(file).iter("Coordinate")
    }


# The model --------------------------------------------------------------------------------------------------------


def test_what_is_measured_can_move_and_the_rest_is_locked(result: Path, data: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "subject.osim", osim_model=data / GENERIC)
    free = coordinates(tmp_path / "subject.osim")
    before = coordinates(data / GENERIC)
    assert set(free) == set(before)
    assert before["arm_flex_r"]["clamped"] == "true"  # why its inverse kinematics ended at 90°
    for name, coordinate in free.items():
        legs = name.startswith(("hip", "knee", "ankle", "subtalar", "mtp"))
        if not name.endswith(("_tx", "_ty", "_tz", "_beta")):
            assert coordinate["locked"] == ("true" if legs else "false"), name
        if not legs and not name.endswith(("_tx", "_ty", "_tz", "_beta")):
            low, high = map(float, (coordinate["range"] or "").split())
            assert low <= -2.0 * np.pi < 2.0 * np.pi <= high, name
            assert float(coordinate["default_value"] or "nan") == 0.0
    alone = write_folder(tmp_path / "one", a_pose(("torso", "left_upper_arm", "left_forearm"), n=5))
    export(alone, tmp_path / "one.osim", osim_model=data / GENERIC)
    moving = {name for name, each in coordinates(tmp_path / "one.osim").items() if each["locked"] == "false"}
    arm = {f"{name}_l" for name in ("arm_flex", "arm_add", "arm_rot", "elbow_flex", "pro_sup")}
    lumbar = {"lumbar_extension", "lumbar_bending", "lumbar_rotation"}
    assert {name for name in moving if not name.endswith(("_tx", "_ty", "_tz", "_beta"))} == arm | lumbar


def test_scaling_twice_is_scaling_once(result: Path, data: Path, tmp_path: Path) -> None:
    export(result, tmp_path / "once.osim", osim_model=data / GENERIC)
    export(result, tmp_path / "twice.osim", osim_model=tmp_path / "once.osim")
    once, twice = ((tmp_path / f"{name}.osim").read_text(encoding="utf-8").split() for name in ("once", "twice"))
    assert len(once) == len(twice)
    for a, b in zip(once, twice, strict=True):
        if a != b:
            mine, yours = (re.findall(r"-?[0-9.]+(?:e-?[0-9]+)?", word) for word in (a, b))
            np.testing.assert_allclose(np.array(mine, dtype=float), np.array(yours, dtype=float), rtol=1e-9, atol=1e-9)


def test_the_setups_name_each_other(result: Path, data: Path, tmp_path: Path) -> None:
    diagnostics = export(result, tmp_path / "a.sto", osim_model=data / GENERIC).diagnostics
    assert [each.code for each in diagnostics] == ["osim-scaled"]
    names = {"a.sto", "a.osim", "a_placement.sto", "a_placer.xml", "a_ik.xml"}
    assert {path.name for path in tmp_path.iterdir()} == names
    placer, ik = (etree.parse(tmp_path / f"a_{tool}.xml").getroot()[0] for tool in ("placer", "ik"))
    assert placer.findtext("model_file") == "a.osim"
    assert placer.findtext("orientation_file_for_calibration") == "a_placement.sto"
    assert placer.findtext("output_model_file") == ik.findtext("model_file")
    assert ik.findtext("orientations_file") == "a.sto"
    begin, end = map(float, (ik.findtext("time_range") or "").split())
    assert (begin, end) == pytest.approx((1.995, 5.005))


# Wrong models -----------------------------------------------------------------------------------------------------


def remove(text: str, *names: str) -> str:
    """The model without some bodies and joints."""
    for name in names:
        text = re.sub(rf'<(\w+) name="{name}">.*?</\1>', "", text, count=1, flags=re.DOTALL)
    return text


def swap(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new)


# What is done to the model, and a part of the line that it gets.
SPOILED: dict[str, tuple[Callable[[str], str], str]] = {
    "cut off": (lambda text: text[: len(text) // 2], r"is no complete XML file, as an \.osim is: line \d+"),
    "no XML": (lambda text: text[:9], "is no complete XML file"),
    "another XML": (lambda text: text and '<robot name="a"/>', "is XML, but no OpenSim model: it is <robot>"),
    "old": (swap('Version="40000"', 'Version="30516"'), "document version 30516; 40000 or later is needed"),
    "NaN": (swap("0.013143999999999999", "nan"), "translation is 'nan -0.286273 -0.0095"),
    "text": (swap("0.3715 0.17000000000000001", "0,3715 0.17"), "'0.0031549999999999998 0,3715 0.17'; 3 numbers are"),
    "mass": (swap("<mass>2.0325000000000002<", "<mass>-2<"), "Body humerus_r: mass is -2 kg"),
    "no body": (
        lambda text: remove(text, "hand_l", "radius_hand_l"),
        "no Body 'hand_l', which the subject's motion or",
    ),
    "no joint": (lambda text: remove(text, "acromial_l"), "no joint moves Body 'humerus_l'"),
    "nowhere": (swap("/bodyset/radius_r<", "/bodyset/rad<"), "on '/bodyset/rad', which is no body of the model"),
    "no coordinate": (swap("arm_flex_r", "shoulder_elv"), "no coordinate 'arm_flex_r' that turns 'humerus_r'; it has"),
    "axis": (swap("-0.0228627 0.228018 ", "-0.0228627 0.328018 "), "axis of 'elbow_flex_r' is 5.7"),
    "tilted": (lambda text: text.replace("-1.56884 0.05", "-1.4 0.05", 1), "turns 'radius_r' by"),
    "entity": (swap("<OpenSimDocument", '<!DOCTYPE a [<!ENTITY b "c">]><OpenSimDocument'), "declares entities"),
    "feet": (swap("<length_units>meters", "<length_units>feet"), "length_units is 'feet'; a model in meters is needed"),
    "millimetres": (swap("-0.286273 ", "-286.273 "), "left_upper_arm is 286.3 m in it"),
    "hangs elsewhere": (swap("/bodyset/torso<", "/bodyset/pelvis<"), "no joint moves Body 'torso'"),
    "empty": (lambda text: re.sub("<BodySet.*</BodySet>", "<BodySet/>", text, flags=re.DOTALL), "no BodySet in it, or"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_wrong_model_gives_one_line_and_no_file(
    name: str, result: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil, expected = SPOILED[name]
    generic, out = tmp_path / "generic.osim", tmp_path / "out"
    text = (data / GENERIC).read_text(encoding="utf-8")
    out.mkdir()
    generic.write_text(spoil(text), encoding="utf-8")
    assert generic.read_text(encoding="utf-8") != text
    for file in ("subject.osim", "motion.sto"):
        with pytest.raises(SystemExit) as stopped:
            cli.main(["export", str(result), "-o", str(out / file), "--osim-model", str(generic)])
        assert stopped.value.code == 2
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1, error
        assert "generic.osim: " in error[0]
        assert re.search(expected, error[0]), error[0]
        assert list(out.iterdir()) == []


def test_options_that_do_not_go_together(result: Path, data: Path, tmp_path: Path) -> None:
    for file, options, expected in (
        ("a.osim", {}, "--osim-model names a generic one"),
        ("a.mot", {"osim_model": data / GENERIC}, "only an .osim and a .sto have use for it"),
        ("a.osim", {"osim_model": data / GENERIC, "rate_hz": 10.0}, "no motion in a file of format osim"),
    ):
        with pytest.raises(BadOption, match=expected):
            export(result, tmp_path / file, **options)
    assert list(tmp_path.iterdir()) == []


# OpenSim itself ---------------------------------------------------------------------------------------------------


@pytest.mark.peer
def test_opensim_measures_the_subjects_lengths(peer: Callable[..., Any], data: Path, tmp_path: Path) -> None:
    """Of a body with legs; from the .osim, with no coordinate turned."""
    model = load_model("whole_body", lengths=LENGTHS | {"left_thigh": 0.44, "right_foot": 0.17, "hip_width": 0.19})
    folder = write_folder(tmp_path / "r", a_pose())
    (folder / "subject.urdf").write_text(model.urdf(), encoding="utf-8")
    export(folder, tmp_path / "subject.osim", osim_model=data / GENERIC)
    peer("zero_pose", tmp_path / "subject.osim", tmp_path / "zero.osim")
    at = peer("joint_centres", tmp_path / "zero.osim")
    lengths = load_model(folder / "subject.urdf").lengths
    assert set(lengths) == set(ENDS) == set(SPANS)
    for length, (start, end) in ENDS.items():
        first, last = (np.mean([at[name] for name in names], axis=0) for names in (start, end))
        assert np.linalg.norm(last - first) == pytest.approx(lengths[length], abs=1e-6), length
    for point, joint in (("left_shoulder", "humerus_l"), ("right_elbow", "ulna_r"), ("right_wrist", "hand_r")):
        np.testing.assert_allclose(at[point], at[joint], atol=1e-9)


@pytest.mark.peer
def test_scaled_as_opensim_scales(peer: Callable[..., Any], result: Path, data: Path, tmp_path: Path) -> None:
    [diagnostic] = export(result, tmp_path / "subject.osim", osim_model=data / GENERIC).diagnostics
    factors: dict[str, list[float]] = {}
    for bodies, factor, axes in re.findall(
        r"([a-z_, ]+) by ([0-9.]+)(?: in ([xyz]+))? \(", str(diagnostic.facts["scales"])
    ):
        for body in bodies.strip(" ;").split(", "):
            entry = factors.setdefault(body, [1.0, 1.0, 1.0])
            for k, axis in enumerate("xyz"):
                entry[k] *= float(factor) if not axes or axis in axes else 1.0
    peer("scale", data / GENERIC, {body: tuple(factor) for body, factor in factors.items()}, tmp_path / "theirs.osim")
    peer("zero_pose", tmp_path / "subject.osim", tmp_path / "ours.osim")
    ours, theirs = (peer("joint_centres", tmp_path / f"{name}.osim") for name in ("ours", "theirs"))
    for body in theirs:
        np.testing.assert_allclose(ours[body], theirs[body], atol=1e-4)  # factors are said to four digits
    ours, theirs = (peer("mass_properties", tmp_path / f"{name}.osim") for name in ("ours", "theirs"))
    for body, (mass, centre, inertia) in theirs.items():
        assert ours[body][0] == pytest.approx(mass, rel=1e-9)
        np.testing.assert_allclose(ours[body][1], centre, atol=1e-4)
        if len(set(factors.get(body, [1.0]))) == 1:  # of others OpenSim takes a cylinder
            np.testing.assert_allclose(ours[body][2], inertia, rtol=1e-3, atol=1e-9)


@pytest.mark.peer
def test_opensims_ik_agrees_beyond_the_limits_of_the_generic_model(
    peer: Callable[..., Any], data: Path, tmp_path: Path
) -> None:
    """Arms above the head, a person who has turned round, elbows that bend backwards a little: 0.3° at its accuracy."""
    values = {name: value for name, value in motion(25).items() if not name.startswith("pelvis")}
    ramp = np.linspace(0.0, 1.0, 25)
    for name, to in (("arm_flex_r", 2.3), ("arm_flex_l", 2.0), ("lumbar_rotation", 2.6), ("elbow_flex_r", -0.2)):
        values[name] = values[name][0] + (to - values[name][0]) * ramp
    solved, ours = solve(peer, values, data, tmp_path)
    assert np.abs(ours["values"]).max() > 130.0
    np.testing.assert_allclose(solved["time"], ours["time"], atol=1e-6)
    np.testing.assert_allclose(solved["values"], ours["values"], atol=0.3)


@pytest.mark.peer
def test_opensims_ik_begins_where_two_axes_of_a_shoulder_fall_together(
    peer: Callable[..., Any], data: Path, tmp_path: Path
) -> None:
    """In a T-pose flexion and rotation are one: from zero, and without limits, it ended at millions of degrees."""
    values = {name: value for name, value in motion(5).items() if not name.startswith("pelvis")}
    values |= {"arm_add_r": np.full(5, -1.55), "arm_add_l": np.full(5, -1.5)}
    solved, ours = solve(peer, values, data, tmp_path)
    off = dict(zip(ours["labels"], np.abs(solved["values"] - ours["values"]).max(axis=0), strict=True))
    near_lock = {f"arm_{angle}_{side}" for angle in ("flex", "rot") for side in "rl"}
    assert max(off[name] for name in near_lock) < 30.0
    assert (
        max(value for name, value in off.items() if name not in near_lock) < 1.0
    )  # what is left of its tolerance there


def solve(
    peer: Callable[..., Any], values: dict[str, np.ndarray], data: Path, folder: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What OpenSense makes of a motion [deg], in the columns of our .mot, and that."""
    pose = pose_by_opensim(peer, values | {"pelvis_tilt": np.zeros(len(values["arm_flex_r"]))})
    quat_WL = {name: pose.quat_WL[name] for name in SEGMENT_OF.values() if name != "pelvis"}
    result = write_folder(folder / "r", replace(pose, quat_WL=quat_WL))
    export(result, folder / "x.mot", names="opensim")
    export(result, folder / "x.sto", osim_model=data / GENERIC)
    solved, ours = peer("run_setups", folder, "x"), peer("read", folder / "x.mot")
    columns = [solved["labels"].index(label) for label in ours["labels"]]
    return solved | {"values": solved["values"][:, columns]}, ours
