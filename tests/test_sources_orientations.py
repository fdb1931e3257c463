"""The plug-in examples/slimevr, against a sender written from the protocol's description, byte by byte."""

import socket
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sampling import find_free_port
from scipy.spatial.transform import Rotation

from wepose_pin import BadOption, BadSource
from wepose_pin.body import load_table
from wepose_pin.live.sources import Source, SourceOptions

sys.path.append(str(Path(__file__).parents[1] / "examples" / "slimevr"))
import wepose_slimevr as slimevr

# Packets as a tracker sends them; rotation and acceleration are the worked example of the protocol's description.
MAC = bytes.fromhex("4c11ae0000a1")
HANDSHAKE = bytes.fromhex("00000003 0000000000000000 00000003 00000010 00000002 000000000000000000000000 00000016")
HANDSHAKE += b"\x05v0.6." + MAC + b"\x00"
HANDSHAKE_ANSWER = b"\x03Hey OVR =D 5" + bytes(51)
SENSOR_1_INFO = bytes.fromhex("0000000f 0000000000000005 01 01 10 0000 01 10 00")  # on the right upper arm
ROTATION = bytes.fromhex("00000011 000000000000002a 01 01 00000000 00000000 00000000 3f800000 00")
ACCELERATION = bytes.fromhex("00000004 000000000000002b 00000000 00000000 3f800000 01")


def open_slimevr(rest: str, sensors: tuple[str, ...] | None = None) -> Source:
    segments = sensors or tuple(load_table().segments)
    return slimevr.SOURCE.open_spec(rest, SourceOptions(f"slimevr:{rest}", sensors, segments))


class Tracker:
    """Sends packets to a source that it connects to."""

    def __init__(self, sensors: tuple[str, ...] | None = None) -> None:
        self.port = find_free_port()
        self.source = open_slimevr(str(self.port), sensors)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(60.0)
        self.source.open()

    def send(self, *packets: bytes) -> None:
        for packet in packets:
            self._socket.sendto(packet, ("127.0.0.1", self.port))

    def answer(self) -> bytes:
        return self._socket.recv(2000)

    def read(self, count: int, seconds: float = 60.0) -> dict[str, list[np.ndarray]]:
        """Quaternions by sensor, as soon as there are `count`, or what came in this time."""
        rotations: dict[str, list[np.ndarray]] = {}
        deadline = time.monotonic() + seconds
        while sum(map(len, rotations.values())) < count and time.monotonic() < deadline:
            for samples in self.source.read(0.05) or ():
                assert samples.time[-1] <= self.source.clock()
                quat = np.column_stack([samples.gyro_S, samples.accel_S[:, 0]])
                rotations.setdefault(samples.sensor, []).extend(quat)
        return rotations

    def close(self) -> None:
        self.source.close()
        self._socket.close()


@pytest.fixture
def tracker() -> Iterator[Tracker]:
    tracker = Tracker()
    yield tracker
    tracker.close()


def test_a_tracker_is_answered_and_its_rotation_comes_on_the_segment_that_it_sits_on(tracker: Tracker) -> None:
    source = tracker.source
    assert not source.connect(0.05)
    assert source.describe_awaited() == f"SlimeVR trackers at UDP 127.0.0.1:{tracker.port} (this machine only)"
    ping = struct.pack(">IQI", 10, 7, 77)
    # The first one: nobody has introduced himself.
    tracker.send(ROTATION, HANDSHAKE, SENSOR_1_INFO, struct.pack(">IQff", 12, 6, 3.9, 0.75), ping, ROTATION)
    assert source.connect(60.0)
    assert source.sensors == ("right_upper_arm",)
    turn = Rotation.from_euler("zyx", [40.0, -20.0, 10.0], degrees=True).as_quat()
    for number, quat in ((44, turn), (43, turn), (45, [0.0, 0.0, 0.0, 0.0])):
        tracker.send(struct.pack(">IQBB4fB", 17, number, 1, 1, *quat, 0))
    rotations = tracker.read(2)
    assert list(rotations) == ["right_upper_arm"]
    np.testing.assert_allclose(rotations["right_upper_arm"], [[0.0, 0.0, 0.0, 1.0], turn], atol=1e-7)
    tracker.send(ACCELERATION.replace(b"\x2b", b"\x50"))
    assert not tracker.read(1, 0.7)  # a heartbeat comes twice a second
    answers = [tracker.answer() for _ in range(4)]
    assert HANDSHAKE_ANSWER in answers
    assert bytes.fromhex("0000000f 01 01") in answers  # without a number
    assert ping in answers
    assert bytes.fromhex("00000001 0000000000000000") in answers  # a heartbeat
    assert source.orientations["right_upper_arm"] is False
    assert source.problems == {"SlimeVR packets that came twice or too late": 1, "damaged SlimeVR packets": 1}


def test_trackers_without_a_place_are_named_and_can_be_assigned(tracker: Tracker) -> None:
    tracker.send(HANDSHAKE, ROTATION)
    assert not tracker.source.connect(0.3)
    where = "orientations of 4c:11:ae:00:00:a1/1, whose place on the body is not known"
    assert where in tracker.source.problems
    assert f"1 {where}" in tracker.source.describe_awaited()
    name = "4c:11:ae:00:00:a1/1"  # of an earlier guide
    named = Tracker((name,))
    named.send(HANDSHAKE, ROTATION, ROTATION.replace(b"\x2a", b"\x2b")[:20])
    np.testing.assert_allclose(named.read(1)[name], [[0.0, 0.0, 0.0, 1.0]], atol=1e-7)
    assert not named.read(1, 0.2)
    assert named.source.problems == {"damaged SlimeVR packets": 1}
    named.close()


def test_an_address_that_is_not_ours_is_said() -> None:
    with pytest.raises(BadSource, match=r"slimevr:192\.0\.2\.1:6969: cannot listen there"):
        open_slimevr("192.0.2.1").open()
    with pytest.raises(BadOption, match="70000: a port or HOST:PORT"):
        open_slimevr("0.0.0.0:70000")
