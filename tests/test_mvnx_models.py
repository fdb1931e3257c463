"""The MVNX sample tracked on two bodies: their points beside Xsens's own positions of the same joints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import rotations
from wepose_pin.cli import main
from wepose_pin.readers.mvnx import SEGMENT_OF, read_frames
from wepose_pin.subject import population_subject, subject_toml

# An Xsens segment's position is that of the joint at which it begins.
JOINTS = {
    f"{side}_{point}": f"{side.capitalize()}{segment}"
    for side in ("left", "right")
    for point, segment in (("shoulder", "UpperArm"), ("elbow", "ForeArm"), ("wrist", "Hand"))
}
START = (0.0, 0.4)  # [s]; the orientations are the segments' own, so that it sets the heading of x alone
# [mm] mean and largest distance of a point, a tenth above what was found. All of it is where the shoulders are from the
# hips. Our trunk is one segment that turns as T8. The 66-DoF spine bends, but its pelvis is the root and stays upright:
# the person's is 17 deg off. Neither moves its clavicles. From the shoulder on the arms are Xsens's own.
BOUNDS = {"upper_body": (79.0, 88.0), "humanSubject01_66dof": (55.0, 61.0)}
ARM = 0.5  # [mm] largest, from the shoulder on


class Sample(NamedTuple):
    """The file's own positions, and lengths from them."""

    time: np.ndarray  # (n,) [s]
    places: dict[str, np.ndarray]  # Xsens segment → (n, 3) [m] from the middle of the hips, in the file's world
    torso: Rotation  # (n,) T8 to the file's world
    lengths: dict[str, float]  # [m]


@pytest.fixture(scope="module")
def sample(data: Path) -> Sample:
    frames = read_frames(data / "mvnx" / "test_mocap.mvnx")
    at = {name: k for k, name in enumerate(frames.segments)}
    positions = frames.values["position"]
    hips = 0.5 * (positions[:, at["LeftUpperLeg"]] + positions[:, at["RightUpperLeg"]])
    places = {name: positions[:, k] - hips for name, k in at.items()}
    torso = Rotation.from_quat(rotations.xyzw_from_wxyz(frames.values["orientation"][:, at["T8"]]))

    def length(first: np.ndarray, last: np.ndarray) -> float:
        return float(np.linalg.norm(last - first, axis=1).mean())

    left, right = places["LeftUpperArm"], places["RightUpperArm"]
    lengths = {"trunk": length(np.zeros((1, 3)), 0.5 * (left + right)), "shoulder_width": length(right, left)}
    for side in ("Left", "Right"):
        shoulder, elbow, wrist = (places[f"{side}{part}"] for part in ("UpperArm", "ForeArm", "Hand"))
        lengths[f"{side.lower()}_upper_arm"] = length(shoulder, elbow)
        lengths[f"{side.lower()}_forearm"] = length(elbow, wrist)
    return Sample(frames.time, places, torso, lengths)


@pytest.mark.parametrize("model", ["upper_body", "humanSubject01_66dof"])
def test_points_lie_beside_xsens(data: Path, sample: Sample, model: str, tmp_path: Path) -> None:
    sensors = "".join(f'[sensors.{segment}]\nlabel = "{label}"\n' for label, segment in SEGMENT_OF.items())
    file = data / "mvnx" / "test_mocap.mvnx"
    (tmp_path / "session.toml").write_text(
        f'[data]\nfile = "{file}"\n[phases]\nstart = [[{START[0]}, {START[1]}]]\n{sensors}', encoding="utf-8"
    )
    prior = population_subject()
    subject = replace(prior, name="xsens", lengths={**prior.lengths, **sample.lengths})
    (tmp_path / "subject.toml").write_text(subject_toml(subject), encoding="utf-8")
    body = [] if model == "upper_body" else ["--model", str(data / "human_urdf" / f"{model}.urdf")]
    command = ["track", tmp_path, *body, "--subject", tmp_path / "subject.toml", "-o", tmp_path / "out"]
    with pytest.raises(SystemExit) as stopped:
        main([str(part) for part in (*command, "--no-view", "--no-report")])
    assert not stopped.value.code
    pose = pl.read_parquet(tmp_path / "out" / "pose.parquet")
    np.testing.assert_allclose(pose["time"], sample.time, atol=1e-6)
    quat = pose.select([f"torso_{c}" for c in ("qx", "qy", "qz", "qw")]).to_numpy()
    to_W = (Rotation.from_quat(quat) * sample.torso.inv()).mean()  # the heading of x
    apart = {
        point: pose.select([f"{point}_{axis}" for axis in "xyz"]).to_numpy() - to_W.apply(sample.places[joint])
        for point, joint in JOINTS.items()
    }
    mean, most = BOUNDS[model]
    print(f"{model}: mm from Xsens's joint, mean and largest; the same from the shoulder on")
    for point, difference in apart.items():
        off = 1e3 * np.linalg.norm(difference, axis=1)
        arm = 1e3 * np.linalg.norm(difference - apart[f"{point.partition('_')[0]}_shoulder"], axis=1)
        print(f"{point:15} {off.mean():6.1f} {off.max():6.1f} {arm.mean():8.2f} {arm.max():6.2f}")
        assert off.mean() < mean
        assert off.max() < most
        assert arm.max() < ARM
