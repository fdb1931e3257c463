"""A four-bar linkage: a crank-rocker in a vertical plane, an open chain whose tip is the second pivot on the ground."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from wepose_pin.body import BodyModel

from .ur5_arm import Moved, move_arm

LENGTHS = {"crank": 0.2, "coupler": 0.5, "rocker": 0.4}  # [m] of the table
START = {"crank_joint": -1.2, "coupler_joint": 0.775, "rocker_joint": 2.19}  # [rad]
RATIOS = {"crank": 1.05, "coupler": 0.94, "rocker": 1.03}  # true lengths over the table's
STD_PERCENT = 10.0  # of the lengths in the table
PROTOCOL = """name = "pivot"
title = "second pivot"
[[step]]
phase = "tip"
seconds = 40
do = "Turn the crank."
[[closure]]
phase = "tip"
kind = "fixed_point"
points = ["tip"]
at = {at}
at_std = 0.002
slip = 0.001
"""


def write_four_bar(folder: Path, std_percent: float = STD_PERCENT) -> Path:
    """Write four_bar.urdf with its table beside it, and return the table."""
    text, parent, at = '<link name="ground"/>', "ground", 0.0
    lengths, points = "", ""
    ends = [*(f"{name}_joint" for name in list(LENGTHS)[1:]), "tip"]
    for (name, length), end in zip(LENGTHS.items(), ends, strict=True):
        text += (
            f'<link name="{name}"/><joint name="{name}_joint" type="revolute"><parent link="{parent}"/>'
            f'<child link="{name}"/><origin xyz="{at} 0 0"/><axis xyz="0 1 0"/>'
            f'<limit lower="-9" upper="9" effort="1" velocity="9"/></joint>'
        )
        points += f'{name}_joint = "{name}"\n'
        lengths += (
            f'{name} = {{ segment = "{name}", from = "{name}_joint", to = "{end}", std_percent = {std_percent} }}\n'
        )
        parent, at = name, length
    points += f'tip = {{ link = "{parent}", at = [{at}, 0.0, 0.0] }}\n'
    (folder / "four_bar.urdf").write_text(f'<robot name="four_bar">{text}</robot>', encoding="utf-8")
    segments = "".join(f'{name} = "{name}"\n' for name in LENGTHS)
    file = folder / "four_bar.toml"
    head = 'urdf = "four_bar.urdf"\nkind = "mechanism"\n'
    file.write_text(f"{head}[segments]\n{segments}[points]\n{points}[lengths]\n{lengths}", encoding="utf-8")
    return file


def move_four_bar(body: BodyModel, seed: int, **options: Any) -> Moved:
    """Move the linkage, as `move_arm` with its `options`."""
    return move_arm(body, seed, start=START, ratios=RATIOS, **options)
