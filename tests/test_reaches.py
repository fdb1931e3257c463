"""The chains read off a model: they give Pinocchio's points, for any lengths and orientations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from test_model import GAZEBO, cosmik, example_robot_data_human

from benchmarks.ur5_arm import write_table, write_urdf
from wepose_pin.body import BodyModel, LinkVector, load_model
from wepose_pin.errors import WeposeError


def point_position(lengths: list[float], R_WK: Mapping[str, Rotation], way: Mapping[str, LinkVector]) -> np.ndarray:
    """The place (3,) [m] of a point in W from the orientations of the links on its way."""
    return np.sum([R_WK[link].apply(part.by_length @ lengths + part.constant) for link, part in way.items()], axis=0)


def arm() -> BodyModel:
    """A robot's arm."""
    with TemporaryDirectory() as folder:
        return load_model(write_table(write_urdf(Path(folder))))


def cosmik_in_a_folder(data: Path) -> BodyModel:
    with TemporaryDirectory() as folder:
        return cosmik(data, Path(folder))


BODIES: dict[str, Callable[[Path], BodyModel]] = {
    "ours": lambda _: load_model(),
    "whole body": lambda _: load_model("whole_body"),
    "an arm with a table": lambda _: arm(),
    **{name: lambda data, file=file: load_model(data / "human_urdf" / file) for name, file in GAZEBO.items()},
    "cosmik": cosmik_in_a_folder,
    "example-robot-data": lambda _: load_model(example_robot_data_human()),
}


@pytest.fixture(params=list(BODIES))
def body(request: pytest.FixtureRequest, data: Path) -> BodyModel:
    return BODIES[request.param](data)


def random_rotations(body: BodyModel, rng: np.random.Generator) -> tuple[pin.Data, dict[str, Rotation]]:
    """Forward kinematics of a configuration drawn at random, girdles at zero, and link → its R_WK."""
    m = body.pin
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in (m.lowerPositionLimit, m.upperPositionLimit))
    q = pin.normalize(m, rng.uniform(low, high))
    q[[m.idx_qs[m.getJointId(joint)] for girdle in body.table.girdles.values() for joint in girdle.joints]] = 0.0
    kinematics = m.createData()
    pin.framesForwardKinematics(m, kinematics, q)
    R_WK = {m.names[joint]: kinematics.oMi[joint].rotation for joint in range(m.njoints)}
    R_WK |= {s: kinematics.oMf[m.getFrameId(s)].rotation for s in body.table.segments}
    return kinematics, {link: Rotation.from_matrix(R) for link, R in R_WK.items()}


def test_every_point_is_pinocchios_for_all_lengths_and_orientations(body: BodyModel) -> None:
    """All known bodies are affine in their lengths; those of others have constant parts and links between segments."""
    rng, own = np.random.default_rng(0), body.lengths
    reaches = body.reaches
    assert set(reaches) == set(body.point_frames)
    for _ in range(5):
        changed = body.with_lengths({name: value * rng.uniform(0.7, 1.3) for name, value in own.items()})
        kinematics, R_WK = random_rotations(changed, rng)
        values = list(changed.lengths.values())
        for point, way in reaches.items():
            place = point_position(values, R_WK, way)
            expected = kinematics.oMf[changed.pin.getFrameId(changed.point_frames[point])].translation
            np.testing.assert_allclose(place, expected, atol=1e-12)


def test_a_joint_that_slides_on_the_way_is_refused(tmp_path: Path) -> None:
    table = write_table(write_urdf(tmp_path))
    urdf = next(tmp_path.glob("*.urdf"))
    text = urdf.read_text(encoding="utf-8")
    urdf.write_text(text.replace('type="revolute"', 'type="prismatic"', 1), encoding="utf-8")
    with pytest.raises(WeposeError, match=r"joint '\w+' slides: orientations do not tell where \w+ is"):
        _ = load_model(table).reaches
