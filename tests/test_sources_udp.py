"""Datagrams: what is documented is read, whatever else comes is counted and harms nothing."""

import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bodies import SEGMENTS
from sampling import collect, connected, find_free_port

from wepose_pin import BadData, BadSource
from wepose_pin.live.sources import open_source
from wepose_pin.live.sources.udp import UdpSource

GOOD = {"sensor": "torso", "t": 12.345, "gyro": [0.1, -0.2, 0.3], "accel": [0.0, 0.5, 9.81]}


@pytest.fixture
def source() -> Iterator[UdpSource]:
    with connected(UdpSource("127.0.0.1", 0, SEGMENTS, SEGMENTS)) as source:
        yield source


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        yield sender


def test_a_json_line_of_one_sample(source: UdpSource, sender: socket.socket) -> None:
    before = time.monotonic()
    for line in (GOOD, GOOD | {"t": 12.355}, GOOD | {"t": 12.365}):
        sender.sendto(json.dumps(line).encode(), source.address)
    samples = collect(source, 3)["torso"]
    np.testing.assert_array_equal(samples.gyro_S, [GOOD["gyro"]] * 3)
    np.testing.assert_array_equal(samples.accel_S, [GOOD["accel"]] * 3)
    assert before - 0.1 < samples.time[0] < samples.time[2] < source.clock() + 1.0
    assert source.problems == {}


@pytest.mark.parametrize("stated", ["line", "source"])
def test_a_sender_states_its_units(sender: socket.socket, stated: str) -> None:
    units = {"gyro_unit": "deg/s", "accel_unit": "g"}
    options = ",gyro_unit=deg/s,accel_unit=g" if stated == "source" else ""
    source = open_source(f"udp:{find_free_port()}{options}", sensors=["torso", "head"])
    source.open()
    lines = [GOOD | units] if stated == "line" else [GOOD, GOOD | {"sensor": "head", "gyro_unit": "rad/s"}]
    for line in lines:
        sender.sendto(json.dumps(line).encode(), source.address)
    samples = collect(source, 1, sensors=len(lines))
    np.testing.assert_allclose(samples["torso"].gyro_S, [np.deg2rad(GOOD["gyro"])])
    np.testing.assert_allclose(samples["torso"].accel_S, [np.multiply(9.80665, GOOD["accel"])])
    if stated == "source":
        np.testing.assert_array_equal(samples["head"].gyro_S, [GOOD["gyro"]])
    assert source.problems == {}
    sender.sendto(json.dumps(GOOD | {"gyro_unit": "rpm"}).encode(), source.address)
    assert source.read(0.2) == []
    assert list(source.problems) == ["JSON lines with gyro_unit 'rpm'; there is: rad/s, deg/s"]
    source.close()


def test_many_lines_and_lists_of_samples(source: UdpSource, sender: socket.socket) -> None:
    rows = np.random.default_rng(1).normal(size=(5, 6))
    times = (100.0 + 0.01 * np.arange(5)).tolist()
    many = {"sensor": "head", "t": times, "gyro": rows[:, :3].tolist(), "accel": rows[:, 3:].tolist()}
    lines = "\r\n".join([json.dumps(many), "", json.dumps({**GOOD, "t": 100.04, "extra": "passed over"})]) + "\n"
    sender.sendto(lines.encode(), source.address)
    samples = collect(source, 1, sensors=2)
    np.testing.assert_array_equal(np.column_stack([samples["head"].gyro_S, samples["head"].accel_S]), rows)
    np.testing.assert_allclose(np.diff(samples["head"].time), 0.01, atol=1e-9)
    assert samples["torso"].time[0] == pytest.approx(samples["head"].time[4], abs=1e-9)


@pytest.mark.parametrize(
    ("datagram", "problem"),
    [
        *((line, "lines that are not as {") for line in (b"hello", b"\xff\xfe\x00", b"[" * 60000, b"[1, 2]")),
        *(
            (json.dumps({**GOOD, **wrong}).encode(), "lines that are not as {")
            for wrong in (
                {"t": "now"},
                {"gyro": ["1", True, 0]},
                {"gyro": [None, 0, 0]},
                {"t": 10**400},
                {"t": [1.0, [2.0]]},
                {"t": [1.0, 2.0]},
                {"t": [], "gyro": [], "accel": []},
                {"gyro": [0, 0]},
            )
        ),
        (json.dumps({**GOOD, "sensor": "trunk"}).encode(), "samples of an unknown sensor: 'trunk'"),
        (json.dumps({**GOOD, "sensor": ["torso"]}).encode(), "samples of an unknown sensor: \"['torso']\""),
        (json.dumps({**GOOD, "t": float("nan")}).encode(), "samples with times over 1e+10 s, which no clock has"),
        (json.dumps({**GOOD, "t": 1.7e12}).encode(), "samples with times over 1e+10 s"),  # milliseconds since 1970
        (json.dumps({**GOOD, "gyro": [1e9, 0, 0]}).encode(), "samples with values that no body sensor gives"),
    ],
)
def test_what_is_wrong_is_counted_and_the_next_is_read(
    source: UdpSource, sender: socket.socket, datagram: bytes, problem: str
) -> None:
    sender.sendto(datagram, source.address)
    sender.sendto(json.dumps(GOOD).encode(), source.address)
    received = collect(source, 1)
    assert [len(samples.time) for samples in received.values()] == [1]
    assert [kind.startswith(problem) for kind in source.problems] == [True]
    assert list(source.problems.values()) == [1]


def test_the_example_of_the_page_is_read(source: UdpSource, sender: socket.socket) -> None:
    page = (Path(__file__).resolve().parent.parent / "docs" / "live-sources.md").read_text(encoding="utf-8")
    [line] = re.findall(r"```json\n(.*?)\n```", page, re.DOTALL)
    sender.sendto(line.encode(), source.address)
    assert collect(source, 1)
    assert source.problems == {}


def test_two_senders_with_clocks_of_their_own(source: UdpSource, sender: socket.socket) -> None:
    """Sent at the same moment, their samples have the same time."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        for k in range(20):
            sender.sendto(json.dumps({**GOOD, "t": 5000.0 + k / 100}).encode(), source.address)
            other.sendto(json.dumps({**GOOD, "t": k / 100, "sensor": "head"}).encode(), source.address)
            time.sleep(0.01)
        samples = collect(source, 20, sensors=2)
    assert np.abs(samples["torso"].time - samples["head"].time).max() < 0.02


def test_times_in_another_unit_are_refused_and_those_of_one_sender_are_counted() -> None:
    """A clock that is set by eleven days while it runs is in seconds all the same."""

    def take(*scales: float) -> dict[str, int]:
        source = UdpSource("127.0.0.1", 0, SEGMENTS, SEGMENTS)
        for now in np.arange(0.0, 5.0, 0.05):
            lines = [GOOD | {"t": now * scale + 1e6 * (now > 2.5)} for scale in scales]
            source.take([(json.dumps(line).encode(), sender) for sender, line in enumerate(lines)], now)
        return source.problems

    assert take(1.0) == {}
    assert "samples whose t grows 1000 times faster than this machine's clock; seconds" in str(take(1.0, 1e3))
    with pytest.raises(BadData, match="t grows 1000000 times faster than this machine's clock; seconds are needed"):
        take(1e6, 1e6)


def test_kinds_of_problems_are_bounded(source: UdpSource, sender: socket.socket) -> None:
    for k in range(100):
        sender.sendto(json.dumps({**GOOD, "sensor": f"sensor {k}"}).encode(), source.address)
    source.read(0.2)
    assert len(source.problems) < 30
    assert sum(source.problems.values()) == 100


def test_sensors_are_found_where_they_are_not_given(sender: socket.socket) -> None:
    """The second one begins when the first has long been seen; what came meanwhile comes once. A third is too late."""
    port = find_free_port()
    source = open_source(f"udp:{port}")
    source.open()
    assert not source.connect(0.05)
    assert f"samples at UDP 127.0.0.1:{port} (this machine only)" in source.describe_awaited()

    def send(k: int, *names: str) -> None:
        for name in names:
            sender.sendto(json.dumps({**GOOD, "sensor": name, "t": k / 20}).encode(), ("127.0.0.1", port))

    for k in range(12):
        send(k, "torso")
    later = threading.Timer(0.2, send, (12, "torso", "left_forearm"))
    later.start()
    assert source.connect(60.0)
    later.join()
    assert source.sensors == ("torso", "left_forearm")
    times = np.concatenate([samples.time for samples in source.read(0.1) if samples.sensor == "torso"])
    assert len(times) == len(np.unique(times)) == 13
    send(13, "head")
    assert source.read(0.2) == []
    assert source.problems == {"samples of head, which is not tracked": 1}
    source.close()


def test_a_port_in_use_is_told_and_close_frees_it() -> None:
    with connected(UdpSource("127.0.0.1", 0, ["torso"])) as source:
        other = UdpSource(*source.address, ["torso"])
        with pytest.raises(BadSource, match="cannot listen there"):
            other.open()
    with connected(other):
        assert other.address == source.address
