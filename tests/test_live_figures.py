"""The whole figure out, as MVN streamer frames and by the VMC protocol, against literal bytes and against receivers."""

from __future__ import annotations

import importlib
import importlib.util
import socket
import struct
import sys
import types
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.kinematics import LiveKinematics
from wepose_pin.live.figure import SEGMENTS, complete_figure
from wepose_pin.live.mvn_frames import encode_frame
from wepose_pin.live.mvn_output import MvnOutput
from wepose_pin.live.sources.mvn import MvnSource
from wepose_pin.live.state import LivePose, StreamInfo
from wepose_pin.live.vmc_output import BONES, VmcOutput, encode_message
from wepose_pin.model import load_model
from wepose_pin.recording.arrivals import unpack_orientations

FIVE = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
POINTS = tuple(f"{side}_{point}" for side in ("left", "right") for point in ("shoulder", "elbow", "wrist", "palm"))
INFO = StreamInfo(FIVE, POINTS, 100.0)
QUARTER = np.sqrt(0.5)


def make_pose(**turns: Rotation) -> LivePose:
    """A pose in which named segments are turned, and the others stand; trunk 0.5 m, upper arm 0.3 m, forearm 0.25 m."""
    R = {name: turns.get(name, Rotation.identity()) for name in FIVE}
    points = []
    for side, y in (("left", 0.2), ("right", -0.2)):
        at = R["torso"].apply([0.0, y, 0.5])
        points.append(at)
        for part, length in (("upper_arm", 0.3), ("forearm", 0.25), ("forearm", 0.08)):
            at = at + R[f"{side}_{part}"].apply([0.0, 0.0, -length])
            points.append(at)
    quat_WL = np.array([R[name].as_quat() for name in FIVE])
    return LivePose(2.5, quat_WL, np.array(points), np.full(5, 0.02), np.zeros(5, dtype=bool), 0.001)


T_POSE = make_pose(
    **{
        f"{side}_{part}": Rotation.from_rotvec([sign * 0.5 * np.pi, 0.0, 0.0])
        for side, sign in (("left", 1.0), ("right", -1.0))
        for part in ("upper_arm", "forearm")
    }
)


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming:
        incoming.bind(("127.0.0.1", 0))
        incoming.settimeout(5.0)
        yield incoming


def test_a_t_pose_is_the_identity_and_legs_stand() -> None:
    figure = complete_figure(INFO, T_POSE)
    np.testing.assert_allclose(np.abs(figure.quat_WB[:, 3]), 1.0, atol=1e-12)
    at = dict(zip(SEGMENTS, figure.position, strict=True))
    np.testing.assert_allclose(at["pelvis"], [0.0, 0.0, 0.95])
    np.testing.assert_allclose(at["left_forearm"], [0.0, 0.5, 1.45], atol=1e-12)
    np.testing.assert_allclose(at["right_hand"], [0.0, -0.75, 1.45], atol=1e-12)
    np.testing.assert_allclose(at["left_foot"], [0.0, 0.09, 0.09])
    np.testing.assert_allclose(at["right_toe"], [0.16, -0.09, 0.02])
    bowed = complete_figure(INFO, make_pose(torso=Rotation.from_rotvec([0.0, 0.6, 0.0])))
    legs = [k for k, name in enumerate(SEGMENTS) if any(part in name for part in ("leg", "foot", "toe"))]
    np.testing.assert_array_equal(bowed.position[legs], figure.position[legs])
    np.testing.assert_array_equal(bowed.quat_WB[legs], figure.quat_WB[legs])
    np.testing.assert_array_equal(bowed.quat_WB[0], figure.quat_WB[0])
    half = Rotation.from_quat(bowed.quat_WB[SEGMENTS.index("l3")]).as_rotvec()
    np.testing.assert_allclose(half, [0.0, 0.3, 0.0], atol=1e-12)


def test_measured_legs_move_and_the_lower_foot_is_on_the_floor() -> None:
    """A person who lifts one knee, pelvis tilted: joints are where Pinocchio has them."""
    model = load_model("whole_body")
    segments = ("pelvis", *(f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shank", "foot")))
    rng = np.random.default_rng(5)
    R = {name: Rotation.from_rotvec(0.2 * rng.standard_normal(3)) for name in segments}
    R["left_thigh"] = Rotation.from_rotvec([0.0, -1.2, 0.0])
    kinematics = LiveKinematics(model, segments)
    quat_WL = np.array([R[name].as_quat() for name in segments])
    points = kinematics.compute_points(quat_WL)
    pose = LivePose(0.0, quat_WL, points, np.zeros(7), np.zeros(7, dtype=bool), 0.0)
    figure = complete_figure(StreamInfo(segments, kinematics.points, 100.0), pose)
    at, p_W = dict(zip(SEGMENTS, figure.position, strict=True)), dict(zip(kinematics.points, points, strict=True))
    lowest = min(p_W[f"right_{end}"][2] for end in ("heel", "toe"))
    np.testing.assert_allclose(at["pelvis"], [0.0, 0.0, -lowest])
    for part, point in (("upper_leg", "hip"), ("lower_leg", "knee"), ("foot", "ankle")):
        for side in ("left", "right"):
            np.testing.assert_allclose(at[f"{side}_{part}"] - at["pelvis"], p_W[f"{side}_{point}"], atol=1e-12)
    quat = dict(zip(SEGMENTS, figure.quat_WB, strict=True))
    for name, segment in (("pelvis", "pelvis"), ("left_upper_leg", "left_thigh"), ("right_toe", "right_foot")):
        assert (Rotation.from_quat(quat[name]).inv() * R[segment]).magnitude() < 1e-12
    tip = at["left_toe"] + R["left_foot"].apply([0.06, 0.0, -0.02])
    np.testing.assert_allclose(tip - at["pelvis"], p_W["left_toe"], atol=1e-12)


def test_one_arm_alone_is_a_whole_figure() -> None:
    """What has no sensor hangs, and nothing is zero: a receiver would make it not a number."""
    pose = T_POSE._replace(quat_WL=T_POSE.quat_WL[:2], points=T_POSE.points[:2])
    figure = complete_figure(StreamInfo(FIVE[:2], POINTS[:2], 100.0), pose)
    assert np.isfinite(figure.position).all()
    np.testing.assert_allclose(np.linalg.norm(figure.quat_WB, axis=1), 1.0)
    at = dict(zip(SEGMENTS, figure.position, strict=True))
    np.testing.assert_allclose(at["right_hand"] - at["right_upper_arm"], [0.0, 0.0, -0.56], atol=1e-12)


def test_a_frame_is_what_the_streamer_sends(receiver: socket.socket) -> None:
    out = MvnOutput(str(receiver.getsockname()[1]), None)
    out.show(T_POSE)  # before the start
    out.start(INFO)
    bent = make_pose(left_forearm=Rotation.from_rotvec([0.0, -0.5 * np.pi, 0.0]))
    out.show(T_POSE)
    out.show(bent._replace(time=2.51))
    first, second = receiver.recv(2000), receiver.recv(2000)
    out.close()
    assert len(first) == 24 + 23 * 32
    assert first[:24] == bytes.fromhex("4d5854503032 00000000 80 17 00000000 00 17 00 00 0000 02e0")
    assert second[:24] == bytes.fromhex("4d5854503032 00000001 80 17 0000000a 00 17 00 00 0000 02e0")
    pelvis = "00000001 00000000 00000000 3f733333 3f800000 00000000 00000000 00000000"
    assert first[24:56] == bytes.fromhex(pelvis)
    items = np.frombuffer(second, dtype=[("id", ">i4"), ("at", ">f4", 3), ("wxyz", ">f4", 4)], offset=24)
    assert items["id"].tolist() == list(range(1, 24))
    # From hanging, the forearm bent forward: its frame in MVN's convention is Ry(-90 deg) Rx(-90 deg).
    expected = (Rotation.from_euler("y", -90, degrees=True) * Rotation.from_euler("x", -90, degrees=True)).as_quat()
    np.testing.assert_allclose(items["wxyz"][13], np.roll(expected, 1), atol=1e-7)
    np.testing.assert_allclose(items["at"][14], [0.25, 0.2, 0.95 + 0.2], atol=1e-6)


def test_what_goes_out_as_mvn_comes_in_as_it_was() -> None:
    """Of the segments with sensors; the source knows no lengths."""
    rng = np.random.default_rng(3)
    turns = {name: Rotation.random(rng=rng) for name in FIVE}
    source = MvnSource("127.0.0.1", 0, list(FIVE), FIVE)
    source.open()
    out = MvnOutput(str(source.address[1]), None)
    out.start(INFO)
    out.show(make_pose(**turns))
    got = {s.sensor: unpack_orientations(s.gyro_S, s.accel_S)[0] for s in source.read(2.0)}
    out.close()
    source.close()
    for name, R in turns.items():
        assert (Rotation.from_quat(got[name]).inv() * R).magnitude() < 1e-6


class Anything(types.ModuleType):
    """A module that has every name."""

    def __getattr__(self, name: str) -> type:
        return object


@pytest.mark.peer
def test_hermes_reads_the_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """pysio-hermes-mvn's own parser; what it needs of its framework is replaced by nothing."""
    if importlib.util.find_spec("hermes") is None:
        pytest.skip("pysio-hermes-mvn is not installed")
    for name in ("base.stream", "base.nodes.producer", "utils.types", "utils.time_utils", "utils.zmq_utils"):
        monkeypatch.setitem(sys.modules, f"hermes.{name}", Anything(name))
    producer = importlib.import_module("hermes.mvn.producer")
    parser = producer.MvnAnalyzeProducer.__new__(producer.MvnAnalyzeProducer)
    parser._xsens_sample_index, parser._xsens_message_start_time_s = None, 0.0
    parser._xsens_timestep_receive_time_s, parser._num_segments = 0.0, 23
    parser._segment_id_mapping = {k + 1: k for k in range(23)}
    figure = complete_figure(INFO, make_pose(left_forearm=Rotation.from_rotvec([0.0, -0.5 * np.pi, 0.0])))
    message = encode_frame(figure, 7, 0.25)
    metadata, start = parser._process_header(message, message.find(b"MXTP"))
    assert (metadata["counter"], metadata["num_segments"], metadata["payload_size"]) == (7, 23, 736)
    data, end = parser._process_pose(message, start, metadata, {})
    assert end == len(message)
    positions = np.asarray(next(value for key, value in data.items() if "position" in key)).reshape(23, 3)
    quats = np.asarray(next(value for key, value in data.items() if "quaternion" in key)).reshape(23, 4)
    np.testing.assert_allclose(positions, figure.position, atol=1e-6)
    np.testing.assert_allclose(quats, np.roll(figure.quat_WB, 1, axis=1), atol=1e-6)


def test_a_bone_is_the_message_of_the_protocol() -> None:
    expected = bytes.fromhex(
        "2f 56 4d 43 2f 45 78 74 2f 42 6f 6e 65 2f 50 6f 73 00 00 00 2c 73 66 66 66 66 66 66 66 00 00 00"
        "4c 65 66 74 55 70 70 65 72 41 72 6d 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00"
        "00 00 00 00 00 00 00 00 3f 80 00 00"
    )
    assert encode_message("/VMC/Ext/Bone/Pos", "LeftUpperArm", *(0.0,) * 6, 1.0) == expected


def test_a_renderer_gets_local_bones_in_its_frame(receiver: socket.socket) -> None:
    """Read by python-osc: arms that hang are turned down from the T-pose, in a left-handed frame with y up."""
    osc_bundle = pytest.importorskip("pythonosc.osc_bundle")
    out = VmcOutput(str(receiver.getsockname()[1]), None)
    out.start(INFO)
    out.show(make_pose(left_forearm=Rotation.from_rotvec([0.0, -0.5 * np.pi, 0.0])))
    bones: dict[str, np.ndarray] = {}
    addresses = []
    while len(bones) < len(BONES):
        datagram = receiver.recv(65535)
        assert len(datagram) <= 1500
        for message in osc_bundle.OscBundle(datagram):
            addresses.append(message.address)
            if message.address == "/VMC/Ext/Bone/Pos":
                name, *numbers = message.params
                assert len(numbers) == 7
                bones[name] = np.array(numbers)
    out.close()
    assert addresses[:3] == ["/VMC/Ext/OK", "/VMC/Ext/T", "/VMC/Ext/Root/Pos"]
    np.testing.assert_allclose(bones["Hips"], [0.0, 0.95, 0.0, 0.0, 0.0, 0.0, 1.0], atol=1e-6)
    # Unity: x right, y up, z forward. Down from the T-pose the left arm (at −x) turns about z by +90 deg there.
    np.testing.assert_allclose(bones["LeftUpperArm"][3:], [0.0, 0.0, QUARTER, QUARTER], atol=1e-6)
    np.testing.assert_allclose(bones["RightUpperArm"][3:], [0.0, 0.0, -QUARTER, QUARTER], atol=1e-6)
    np.testing.assert_allclose(bones["LeftLowerArm"][:3], [-0.3, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(bones["LeftUpperLeg"], [-0.09, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], atol=1e-6)
    # The forearm is bent forward by 90 deg about the axis that points down in the T-pose's frame of the arm.
    assert np.abs(bones["LeftLowerArm"][4]) == pytest.approx(QUARTER, abs=1e-6)


def test_osc_numbers_are_big_endian() -> None:
    assert encode_message("/a", 1, 0.5) == b"/a\0\0,if\0" + struct.pack(">if", 1, 0.5)
