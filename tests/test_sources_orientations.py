"""Sources of orientations over the network, against senders written from the formats' descriptions, byte by byte."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest
from bodies import SEGMENTS
from scipy.spatial.transform import Rotation

from wepose_pin.errors import BadSource
from wepose_pin.live.sources.slimevr import SlimeVrSource
from wepose_pin.live.sources.udp import DatagramSource
from wepose_pin.recording.arrivals import Samples, unpack_orientations

# Packets as a tracker sends them; rotation and acceleration are the worked example of the protocol's description.
MAC = bytes.fromhex("4c11ae0000a1")
HANDSHAKE = bytes.fromhex("00000003 0000000000000000 00000003 00000010 00000002 000000000000000000000000 00000016")
HANDSHAKE += b"\x05v0.6." + MAC + b"\x00"
HANDSHAKE_ANSWER = b"\x03Hey OVR =D 5" + bytes(51)
SENSOR_1_INFO = bytes.fromhex("0000000f 0000000000000005 01 01 10 0000 01 10 00")  # on the right upper arm
ROTATION = bytes.fromhex("00000011 000000000000002a 01 01 00000000 00000000 00000000 3f800000 00")
ACCELERATION = bytes.fromhex("00000004 000000000000002b 00000000 00000000 3f800000 01")


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        sender.settimeout(60.0)
        yield sender


def read_all(source: DatagramSource, count: int = 1) -> dict[str, list[np.ndarray]]:
    """Quaternions by segment, as soon as there are `count`, or what came in a minute."""
    rotations: dict[str, list[np.ndarray]] = {}
    deadline = time.monotonic() + 60.0
    while sum(map(len, rotations.values())) < count and time.monotonic() < deadline:
        for samples in source.read(0.05):
            assert isinstance(samples, Samples)
            assert samples.time[-1] <= source.clock()
            rotations.setdefault(samples.sensor, []).extend(unpack_orientations(samples.gyro_S, samples.accel_S))
    return rotations


def make_tracker_source() -> SlimeVrSource:
    source = SlimeVrSource("127.0.0.1", 0, list(SEGMENTS), SEGMENTS)
    source.open()
    return source


def test_a_tracker_is_answered_and_its_rotation_comes_on_the_segment_that_it_sits_on(sender: socket.socket) -> None:
    source = make_tracker_source()
    try:
        sender.sendto(ROTATION, source.address)  # nobody has introduced himself
        sender.sendto(HANDSHAKE, source.address)
        sender.sendto(SENSOR_1_INFO, source.address)
        sender.sendto(struct.pack(">IQff", 12, 6, 3.9, 0.75), source.address)
        ping = struct.pack(">IQI", 10, 7, 77)
        sender.sendto(ping, source.address)
        turn = Rotation.from_euler("zyx", [40.0, -20.0, 10.0], degrees=True).as_quat()
        for number, quat in ((42, [0.0, 0.0, 0.0, 1.0]), (44, turn), (43, turn), (45, [0.0, 0.0, 0.0, 0.0])):
            packet = struct.pack(">IQBB4fB", 17, number, 1, 1, *quat, 0)
            assert number != 42 or packet == ROTATION
            sender.sendto(packet, source.address)
        rotations = read_all(source, 2)
        assert list(rotations) == ["right_upper_arm"]
        np.testing.assert_allclose(rotations["right_upper_arm"], [[0.0, 0.0, 0.0, 1.0], turn], atol=1e-7)
        sender.sendto(ACCELERATION.replace(b"\x2b", b"\x50"), source.address)
        assert not read_all_for(source, 0.7)  # a heartbeat comes twice a second
        answers = [sender.recv(2000) for _ in range(4)]
        assert HANDSHAKE_ANSWER in answers
        assert bytes.fromhex("0000000f 01 01") in answers  # without a number
        assert ping in answers
        assert bytes.fromhex("00000001 0000000000000000") in answers  # a heartbeat
        assert source.batteries == {"right_upper_arm": pytest.approx(0.75)}
        assert source.orientations["right_upper_arm"] is False
        assert source.problems == {"SlimeVR packets that came twice or too late": 1, "damaged SlimeVR packets": 1}
    finally:
        source.close()


def test_trackers_without_a_place_are_named_and_can_be_assigned(sender: socket.socket) -> None:
    source = make_tracker_source()
    try:
        sender.sendto(HANDSHAKE, source.address)
        sender.sendto(ROTATION, source.address)
        sender.sendto(b"\0\0\0\x17" + ROTATION[4:11] + b"\x2b" + ROTATION[12:], source.address)
        assert not read_all_for(source, 0.2)
        assert "1 SlimeVR packets of type 23; orientations are read from type 17" in source.describe_awaited()
        assert "orientations of 4c:11:ae:00:00:a1/1, whose place on the body is not known" in source.problems
    finally:
        source.close()
    setup = {"4c:11:ae:00:00:a1/1": "head"}  # of an earlier guide
    named = SlimeVrSource("127.0.0.1", 0, list(setup), list(setup))
    named.open()
    try:
        for packet in (HANDSHAKE, ROTATION, ROTATION.replace(b"\x2a", b"\x2b")[:20]):
            sender.sendto(packet, named.address)
        np.testing.assert_allclose(read_all(named)["4c:11:ae:00:00:a1/1"], [[0.0, 0.0, 0.0, 1.0]], atol=1e-7)
        assert not read_all_for(named, 0.2)
        assert named.problems == {"damaged SlimeVR packets": 1}
    finally:
        named.close()


def read_all_for(source: DatagramSource, seconds: float) -> list[Samples]:
    """What comes in this time."""
    packets, deadline = [], time.monotonic() + seconds
    while time.monotonic() < deadline:
        packets += source.read(0.05)
    return packets


def test_a_source_waits_and_says_for_what_and_where(sender: socket.socket) -> None:
    source = SlimeVrSource("127.0.0.1", 0, None, SEGMENTS)
    source.open()
    try:
        assert not source.connect(0.05)
        host, port = source.address
        assert source.describe_awaited() == f"SlimeVR trackers at UDP {host}:{port} (this machine only)"
        for packet in (HANDSHAKE, SENSOR_1_INFO, ROTATION):
            sender.sendto(packet, source.address)
        assert source.connect(60.0)
        assert source.sensors == ("right_upper_arm",)
    finally:
        source.close()


def test_an_address_that_is_not_ours_is_said() -> None:
    with pytest.raises(BadSource, match=r"slimevr:192\.0\.2\.1:6969: cannot listen there"):
        SlimeVrSource("192.0.2.1", 6969, None, SEGMENTS).open()
