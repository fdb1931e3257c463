"""Legs: the whole body's URDF, activities with known truth, and their joint angles through the commands."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

URDF = Path(__file__).resolve().parent.parent / "urdf"
SIDES = ("left", "right")


def parts(name: str) -> dict[tuple[str, str | None], ET.Element]:
    """Kind and name → element of a URDF, without the space between elements."""
    root = ET.parse(URDF / name).getroot()
    for element in root.iter():
        element.text = element.tail = None
    return {(element.tag, element.get("name")): element for element in root}


# The model --------------------------------------------------------------------------------------------------------


def test_the_upper_body_is_that_of_its_own_urdf() -> None:
    upper, whole = parts("upper_body.urdf"), parts("whole_body.urdf")
    for key, element in upper.items():
        if key == ("link", "pelvis"):  # the stumps where the legs begin
            element = copy.deepcopy(element)
            stumps = element.findall("visual")[-2:]
            assert all(float(stump.find("origin").get("xyz").split()[2]) < -0.05 for stump in stumps)
            for stump in stumps:
                element.remove(stump)
        assert ET.tostring(whole[key]) == ET.tostring(element), key
    more = {name for kind, name in set(whole) - set(upper) if kind in ("link", "joint")}
    assert all(name.startswith(("left_", "right_")) for name in more)
    assert [key for key in whole if key in upper] == list(upper)


@pytest.mark.parametrize(
    ("segment", "length", "share", "centre", "radii"),
    [  # de Leva 1996, Table 4, male: length of 1.741 m of stature [mm], then % of mass, length, radii about x, y, z
        ("thigh", 422.2, 14.16, 40.95, (32.9, 32.9, 14.9)),
        ("shank", 440.3, 4.33, 43.95, (25.1, 24.6, 10.2)),
        ("foot", 258.1, 1.37, 44.15, (12.4, 24.5, 25.7)),
    ],
)
def test_a_leg_is_de_levas(
    segment: str, length: float, share: float, centre: float, radii: tuple[float, float, float]
) -> None:
    whole = parts("whole_body.urdf")
    length *= 1e-3 * 1.75 / 1.741
    mass = 75.0 * share / 100.0
    for side in SIDES:
        inertial = whole["link", f"{side}_{segment}"].find("inertial")
        assert float(inertial.find("mass").get("value")) == pytest.approx(mass, rel=1e-4)
        moments = [float(inertial.find("inertia").get(name)) for name in ("ixx", "iyy", "izz")]
        assert moments == pytest.approx([mass * (r / 100.0 * length) ** 2 for r in radii], rel=4e-3)
        at = np.array(inertial.find("origin").get("xyz").split(), dtype=float)
        if segment == "foot":  # from the heel, along the foot
            heel, toe = (
                float(whole["joint", f"{side}_{point}_fixed"].find("origin").get("xyz").split()[0])
                for point in ("heel", "toe")
            )
            assert toe - heel == pytest.approx(length, abs=1e-3)
            assert at[0] - heel == pytest.approx(centre / 100.0 * length, abs=1e-3)
        else:
            assert at[2] == pytest.approx(-centre / 100.0 * length, abs=1e-3)


def test_left_and_right_leg_mirror_each_other() -> None:
    whole = parts("whole_body.urdf")
    for (kind, name), left in whole.items():
        if kind != "joint" or not name.startswith(("left_thigh", "left_shank", "left_foot", "left_heel", "left_toe")):
            continue
        right = whole["joint", name.replace("left", "right")]
        here, there = (np.array(each.find("origin").get("xyz").split(), dtype=float) for each in (left, right))
        np.testing.assert_array_equal(here * [1.0, -1.0, 1.0], there)
        if left.get("type") == "fixed":
            continue
        limits = [tuple(float(each.find("limit").get(end)) for end in ("lower", "upper")) for each in (left, right)]
        assert limits[1] == (limits[0] if name.endswith("_y") else (-limits[0][1], -limits[0][0]))
