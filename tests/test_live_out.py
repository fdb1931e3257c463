"""The pose out: what is sent, how often, that nobody waits for it, and that the documented example reads it."""

import json
import re
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sampling import find_free_port
from scipy.spatial.transform import Rotation

from wepose_pin import BadOption
from wepose_pin.live import LivePose, StreamInfo
from wepose_pin.live.outputs import LslOutput, UdpOutput

ROOT = Path(__file__).resolve().parent.parent
INFO = StreamInfo(("torso", "right_forearm"), ("right_wrist", "right_palm"), 100.0)


def pose(time_s: float = 1.25, seed: int = 0, **other: Any) -> LivePose:
    rng = np.random.default_rng(seed)
    quat_WL = Rotation.random(2, rng=rng).as_quat()
    usual = LivePose(time_s, quat_WL, rng.normal(size=(2, 3)), np.array([0.02, np.nan]), np.array([False, True]), 0.003)
    return usual._replace(**other)


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming:
        incoming.bind(("127.0.0.1", 0))
        incoming.settimeout(60.0)
        yield incoming


def test_a_datagram_a_pose_keeps_micrometres_and_says_what_is_not_known(receiver: socket.socket) -> None:
    out = UdpOutput(str(receiver.getsockname()[1]))
    out.show(pose())  # before the start: there are no names yet
    out.start(INFO)
    poses = [pose(k * 0.01, seed=k) for k in range(3)]
    poses[2] = poses[2]._replace(points=np.array([[np.nan, 0.0, 0.0], [1.0, 2.0, 3.0]]))
    for one in poses:
        out.show(one)
    messages = [json.loads(receiver.recv(65535)) for _ in poses]
    for one, said in zip(poses[:2], messages, strict=False):
        assert list(said) == ["format", "t", "segments", "points", "std", "lost"]
        assert (said["format"], said["t"]) == (1, one.time)
        for names, key, values in ((INFO.segments, "segments", one.quat_WL), (INFO.points, "points", one.points)):
            assert list(said[key]) == list(names)
            np.testing.assert_allclose([said[key][name] for name in names], values, atol=5.1e-7)
        assert said["std"] == {"torso": 0.02, "right_forearm": None}
        assert said["lost"] == ["right_forearm"]
    assert messages[2]["points"] == {"right_wrist": None, "right_palm": [1.0, 2.0, 3.0]}
    shown = re.search(r"```json\n(.*?)```", (ROOT / "docs" / "live-outputs.md").read_text(encoding="utf-8"), re.DOTALL)
    assert shown is not None
    assert list(json.loads(shown[1])) == list(messages[0])  # the page's example
    out.close()
    out.close()
    out.show(pose(9.0))
    receiver.settimeout(0.05)
    with pytest.raises(TimeoutError):
        receiver.recv(65535)


def test_a_receiver_that_never_reads_holds_nobody_up(receiver: socket.socket) -> None:
    """More than its buffer holds: a blocking socket, or one that queues here, would stand or grow."""
    out = UdpOutput(str(receiver.getsockname()[1]))
    out.start(INFO)
    one = pose()
    for k in range(20_000):
        out.show(one._replace(time=0.01 * k))
    out.close()
    received = 0
    receiver.setblocking(False)
    while True:
        try:
            received += len(receiver.recv(65535)) > 0
        except BlockingIOError:
            break
    assert 0 < received < 20_000


@pytest.mark.parametrize(("rate_hz", "share"), [(1000.0, 0.1), (60.0, 1.0), (120.0, 5 / 6)])
def test_a_hundred_poses_a_second_on_average(receiver: socket.socket, rate_hz: float, share: float) -> None:
    out, one, received = UdpOutput(str(receiver.getsockname()[1])), pose(), 0
    out.start(INFO)
    receiver.setblocking(False)
    jitter = np.random.default_rng(1).uniform(-0.1, 0.1, 3000)
    for k in range(3000):
        out.show(one._replace(time=(k + jitter[k]) / rate_hz + 1.7e9))
        while select.select([receiver], [], [], 0.0)[0]:
            received += len(receiver.recv(65535)) > 0
    out.close()
    assert abs(received / 3000 - share) < 0.01


@pytest.mark.parametrize("to", ["here", "127.0.0.1:http", "70000", "no such host:9001"])
def test_wrong_addresses(to: str) -> None:
    with pytest.raises(BadOption, match=r"--output udp: .*: (no host|a port or HOST:PORT)"):
        UdpOutput(to)


def test_the_example_reads_it() -> None:
    script = (ROOT / "examples" / "live_consumer.py").read_text(encoding="utf-8")
    code = script.split('"""\n\n', 1)[1]
    assert f"```python\n{code}```" in (ROOT / "docs" / "live-outputs.md").read_text(encoding="utf-8")
    assert code.count("\n") <= 15
    port = find_free_port()
    run = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", script.replace("9001", str(port))], stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    assert run.stdout.readline() == f"waiting for poses on 127.0.0.1:{port}; Ctrl-C ends\n"
    out = UdpOutput(f"127.0.0.1:{port}")
    out.start(INFO)
    where = [round(value, 6) for value in pose().points[1].tolist()]
    for k in range(20):
        out.show(pose(k * 0.01))
        time.sleep(0.01)
    out.close()
    assert run.stdout.readline().endswith(f"s  right hand {where} m\n")
    assert next(line for line in run.stdout if "right hand" not in line) == "no pose for 3 s; waiting\n"
    assert run.poll() is None  # it waits on
    run.terminate()
    run.communicate(timeout=120)


def test_lsl_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    pylsl = pytest.importorskip("pylsl")
    monkeypatch.delenv("LSLAPICFG", raising=False)
    out = LslOutput("OutTest")
    out.show(pose())  # before the start
    out.start(INFO)
    info = pylsl.resolve_byprop("name", "OutTest", timeout=60.0)[0]
    inlet = pylsl.StreamInlet(info, recover=False)
    described = inlet.info(timeout=60.0)
    assert (described.type(), described.nominal_srate()) == ("Pose", 100.0)
    inlet.open_stream(timeout=60.0)
    one = pose()
    before = pylsl.local_clock()
    out.show(one)
    values, stamp = inlet.pull_sample(timeout=60.0)
    by_label = dict(zip(described.get_channel_labels(), values, strict=True))
    np.testing.assert_allclose([by_label[f"right_palm_{axis}"] for axis in "xyz"], one.points[1], atol=1e-6)
    np.testing.assert_allclose(
        [by_label[f"torso_{part}"] for part in ("qx", "qy", "qz", "qw")], one.quat_WL[0], atol=1e-6
    )
    assert (by_label["torso_lost"], by_label["right_forearm_lost"]) == (0.0, 1.0)
    assert np.isnan(by_label["right_forearm_std"])
    assert before - one.latency <= stamp <= pylsl.local_clock() - one.latency
    inlet.close_stream()
    out.close()
    out.close()
    assert not pylsl.resolve_byprop("name", "OutTest", timeout=1.0)
