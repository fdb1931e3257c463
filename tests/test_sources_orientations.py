"""Sources of orientations over the network, against senders written from the formats' descriptions, byte by byte."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from bodies import SEGMENTS
from scipy.spatial.transform import Rotation

from wepose_pin.errors import BadSource, WeposeError
from wepose_pin.live.sources import open_source
from wepose_pin.live.sources.datagrams import DatagramSource
from wepose_pin.live.sources.mvn import MvnSource
from wepose_pin.live.sources.slimevr import SlimeVrSource
from wepose_pin.recording.arrivals import Samples, unpack_orientations

# Packets as a tracker sends them; rotation and acceleration are the worked example of the protocol's description.
MAC = bytes.fromhex("4c11ae0000a1")
HANDSHAKE = bytes.fromhex("00000003 0000000000000000 00000003 00000010 00000002 000000000000000000000000 00000016")
HANDSHAKE += b"\x05v0.6." + MAC + b"\x00"
HANDSHAKE_ANSWER = b"\x03Hey OVR =D 5" + bytes(51)
SENSOR_1_INFO = bytes.fromhex("0000000f 0000000000000005 01 01 10 0000 01 10 00")  # on the right upper arm
ROTATION = bytes.fromhex("00000011 000000000000002a 01 01 00000000 00000000 00000000 3f800000 00")
ACCELERATION = bytes.fromhex("00000004 000000000000002b 00000000 00000000 3f800000 01")
# A header and the pelvis at (0, 0, 0.95), of one person; the worked example of the streamer's description.
MVN_HEAD = bytes.fromhex("4d5854503032 00000007 80 01 000003e8 00 17 00 00 0000 0020")
MVN_PELVIS = bytes.fromhex("00000001 00000000 00000000 3f733333 3f800000 00000000 00000000 00000000")


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        sender.settimeout(5.0)
        yield sender


def read_all(source: DatagramSource, count: int = 1) -> dict[str, list[np.ndarray]]:
    """Quaternions by segment, as soon as there are `count`, or what came in two seconds."""
    rotations: dict[str, list[np.ndarray]] = {}
    deadline = time.monotonic() + 2.0
    while sum(map(len, rotations.values())) < count and time.monotonic() < deadline:
        for samples in source.read(0.05):
            assert isinstance(samples, Samples)
            assert abs(samples.time[-1] - source.clock()) < 1.0
            rotations.setdefault(samples.sensor, []).extend(unpack_orientations(samples.gyro_S, samples.accel_S))
    return rotations


def make_tracker_source(**options: object) -> SlimeVrSource:
    source = SlimeVrSource("127.0.0.1", 0, list(SEGMENTS), SEGMENTS, **options)
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
        assert source.problems == {
            "packets of trackers that have not introduced themselves": 1,
            "SlimeVR packets that came twice or too late": 1,
            "orientations that are none": 1,
        }
    finally:
        source.close()


def test_trackers_without_a_place_are_named_and_can_be_assigned(sender: socket.socket) -> None:
    source = make_tracker_source()
    try:
        sender.sendto(HANDSHAKE, source.address)
        sender.sendto(ROTATION, source.address)
        assert not read_all_for(source, 0.2)
        assert "orientations of 4c:11:ae:00:00:a1/1, whose place on the body is not known" in source.problems
    finally:
        source.close()
    assigned = open_source("slimevr:16969,4C:11:AE:00:00:A1/1=head")
    assert isinstance(assigned, SlimeVrSource)
    assert assigned.sensors == ("head",)
    assigned.address = ("127.0.0.1", 0)
    assigned.open()
    try:
        sender.sendto(HANDSHAKE, assigned.address)
        # The older packets: a rotation of the first sensor, and one of sixteen bits.
        sender.sendto(struct.pack(">IQ4f", 16, 9, 0.0, 0.0, 1.0, 0.0), assigned.address)
        sender.sendto(struct.pack(">IQB4h3h", 23, 10, 1, 0, 0, 23170, 23170, 0, 0, 0), assigned.address)
        rotations = read_all(assigned, 2)["head"]
        np.testing.assert_allclose(rotations[0], [0.0, 0.0, 1.0, 0.0], atol=1e-7)
        np.testing.assert_allclose(rotations[1], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-7)
    finally:
        assigned.close()


def read_all_for(source: DatagramSource, seconds: float) -> list[Samples]:
    """What comes in this time."""
    packets, deadline = [], time.monotonic() + seconds
    while time.monotonic() < deadline:
        packets += source.read(0.05)
    return packets


def test_mvn_segments_are_ours_in_the_n_pose(sender: socket.socket) -> None:
    """The arms of a T-pose are the identity in MVN and a quarter turn in ours; the rest is the same in both."""
    source = MvnSource("127.0.0.1", 0, list(SEGMENTS), SEGMENTS)
    source.open()
    try:
        identity = struct.pack(">7f", 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0)
        bowed = struct.pack(">7f", 0.0, 0.0, 1.3, *np.array([0.5 * np.sqrt(3.0), 0.0, 0.5, 0.0], dtype=float))
        items = [struct.pack(">i", 13) + identity, struct.pack(">i", 10) + identity, struct.pack(">i", 5) + bowed]
        first = struct.pack(">6sIBBIBBBBHH", b"MXTP02", 8, 0x00, 2, 1010, 0, 23, 0, 0, 0, 64)
        last = struct.pack(">6sIBBIBBBBHH", b"MXTP02", 8, 0x81, 1, 1010, 0, 23, 0, 0, 0, 32)
        for datagram in (
            MVN_HEAD + MVN_PELVIS,
            first + items[0] + items[1],
            last + items[2],
            b"MXTP20" + MVN_HEAD[6:] + MVN_PELVIS,
            MVN_HEAD[:16] + b"\x01" + MVN_HEAD[17:] + MVN_PELVIS,
            MVN_HEAD + MVN_PELVIS[:-4],
            b"hello",
        ):
            sender.sendto(datagram, source.address)
        rotations = read_all(source, 4)
        assert set(rotations) == {"pelvis", "left_upper_arm", "right_forearm", "torso"}
        along = np.array([0.0, 0.0, -1.0])
        np.testing.assert_allclose(
            Rotation.from_quat(rotations["left_upper_arm"][0]).apply(along), [0, 1, 0], atol=1e-7
        )
        np.testing.assert_allclose(
            Rotation.from_quat(rotations["right_forearm"][0]).apply(along), [0, -1, 0], atol=1e-7
        )
        np.testing.assert_allclose(rotations["pelvis"][0], [0.0, 0.0, 0.0, 1.0], atol=1e-7)
        np.testing.assert_allclose(rotations["torso"][0], [0.0, 0.5, 0.0, 0.5 * np.sqrt(3.0)], atol=1e-7)
        assert all(source.orientations.values())
        read_all_for(source, 0.1)
        assert source.problems == {
            "MVN datagrams of type 20, which is not read": 1,
            "MVN frames of character 1, not 0": 1,
            "MVN datagrams of a wrong length": 1,
            "datagrams that are none of MVN": 1,
        }
    finally:
        source.close()


def test_a_source_waits_and_says_for_what_and_where(sender: socket.socket) -> None:
    source = MvnSource("127.0.0.1", 0, None, SEGMENTS)
    texts: list[str] = []

    def wait(text: str) -> bool:
        texts.append(text)
        if len(texts) == 2:
            threading.Thread(target=sender.sendto, args=(MVN_HEAD + MVN_PELVIS, source.address)).start()
        return True

    source.open(wait)
    host, port = source.address
    source.close()
    assert source.sensors == ("pelvis",)
    assert (
        f"frames of the MVN network streamer (type 02, quaternions) at UDP {host}:{port} (this machine only)"
        in texts[0]
    )
    again = SlimeVrSource("127.0.0.1", 0, None, SEGMENTS)
    again.open(lambda _: False)
    assert again.sensors == ()
    with pytest.raises(BadSource, match=r"nothing came within 0.1 s from SlimeVR trackers at UDP 127.0.0.1:\d+"):
        SlimeVrSource("127.0.0.1", 0, None, SEGMENTS, 0.1).open()


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("slimevr:0.0.0.0:70000", "70000: a port or HOST:PORT"),
        ("slimevr:,4c:11=torso,4c:12=torso", "'4c:12=torso': each device and each segment is named once"),
        ("slimevr:,torso", "'torso' is no DEVICE=SEGMENT, as 4c:11:ae:00:00:01/0=torso"),
        ("mvn:1:2:x", "mvn:1:2:x': 1:2:x: a port or HOST:PORT"),
        ("ximu3:", "source 'ximu3:' is none"),
        ("ximu3:somewhere=torso", "'somewhere' is no device; its IP address"),
        ("ximu3:127.0.0.1:x=torso", "127.0.0.1:x: a port or HOST:PORT"),
        ("ximu3:127.0.0.1=neck", "'neck' is not a segment"),
    ],
)
def test_a_wrong_address_says_what_is_right(spec: str, words: str) -> None:
    with pytest.raises(WeposeError) as error:
        open_source(spec)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_an_address_that_is_not_ours_is_said() -> None:
    with pytest.raises(BadSource, match=r"mvn:192\.0\.2\.1:9763: cannot listen there"):
        MvnSource("192.0.2.1", 9763, None, SEGMENTS).open()


def test_x_imu3_messages_come_in_si_from_an_emulated_sensor() -> None:
    """The package receives over TCP what the manual describes; the escaped message is its worked example."""
    pytest.importorskip("ximu3")
    example = bytes.fromhex("c9 dbdc00000000000000 0000803f 00000040 00004040 00000000 00000000 0000803f 0a")
    ascii_line = b"I,20010,10.0000,0.0000,-5.0000,0.0000,0.5000,1.0000\n"
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        peer, _ = server.accept()
        with peer:
            peer.settimeout(0.05)
            for _ in range(100):
                peer.sendall(example + ascii_line)
                try:
                    if not peer.recv(1000):
                        return
                except TimeoutError:
                    continue
                except OSError:
                    return

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    source = open_source(f"ximu3:127.0.0.1:{server.getsockname()[1]}=torso")
    source.open()
    try:
        rows: list[np.ndarray] = []
        deadline = time.monotonic() + 5.0
        while len(rows) < 2 and time.monotonic() < deadline:
            for samples in source.read(0.1) or []:
                rows += np.column_stack([samples.time, samples.gyro_S, samples.accel_S]).tolist()
    finally:
        source.close()
        server.close()
    first = next(k for k, row in enumerate(rows) if row[1] == pytest.approx(np.deg2rad(1.0)))
    np.testing.assert_allclose(rows[first][1:], [*np.deg2rad([1.0, 2.0, 3.0]), 0.0, 0.0, 9.80665], rtol=1e-6)
    other = next(row for row in rows if row[1] == pytest.approx(np.deg2rad(10.0)))
    np.testing.assert_allclose(other[1:], [*np.deg2rad([10.0, 0.0, -5.0]), 0.0, 4.903325, 9.80665], rtol=1e-6)
