"""The plug-in examples/mti on pseudo-terminals: read, lost and found again; frames as the protocol describes them."""

import contextlib
import os
import pty
import select
import struct
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from sampling import collect, connected, wait_until

from wepose_pin.errors import BadOption
from wepose_pin.live.sources import Source, SourceOptions

pytest.importorskip("serial")
sys.path.append(str(Path(__file__).parents[1] / "examples" / "mti"))
import wepose_mti as mti

GYRO, ACCEL = [0.25, -1.5, 3.125], [-0.5, 9.8125, 0.0625]
VECTORS = struct.pack("!fff", *GYRO), struct.pack("!fff", *ACCEL)


def whole(mid: int, data: bytes) -> bytes:
    """A frame as the protocol describes it."""
    rest = b"\xff" + mid.to_bytes(1, "big") + len(data).to_bytes(1, "big") + data
    return b"\xfa" + rest + ((256 - sum(rest) % 256) % 256).to_bytes(1, "big")


def item(kind: int, data: bytes) -> bytes:
    return struct.pack("!HB", kind, len(data)) + data


def mti_source(devices: str) -> Source:
    return mti.SOURCE.open_spec(devices, SourceOptions(f"mti:{devices}", None, ("torso", "head")))


class Device:
    """An MTi at the other end of a line, which streams while it measures; `link` is the port, a symbolic link."""

    def __init__(self, link: Path, rate: int = 100) -> None:
        self.link, self.rate = link, rate
        self.measuring = self.deaf = False
        self.ticks = 0
        self.packet, self.noise = b"", lambda: b""  # of its own, and between all
        self._stop = threading.Event()
        self.plug()

    def plug(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.link.symlink_to(os.ttyname(self._slave))
        self._stop.clear()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def pull(self) -> None:
        """The cable is out."""
        self._stop.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)
        self.link.unlink()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            if select.select([self.master], [], [], 0.002)[0]:
                asked = os.read(self.master, 4096)
                self.measuring = self.measuring or (whole(0x10, b"") in asked and not self.deaf)
                self._write(whole(0x11, b""))
            while self.measuring and due <= time.monotonic():
                due += 1.0 / self.rate
                self.ticks += 10_000 // self.rate
                data = item(0x1060, (self.ticks % 2**32).to_bytes(4, "big"))
                data += item(0x4020, VECTORS[1]) + item(0x8020, VECTORS[0])
                self._write(self.noise() + whole(0x36, self.packet or data))
            if not self.measuring:
                due = time.monotonic()

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # nobody reads
            os.write(self.master, data)


Plug = Callable[..., Device]


@pytest.fixture
def plugged(tmp_path: Path) -> Iterator[Plug]:
    devices: list[Device] = []

    def plug(name: str, rate: int = 100) -> Device:
        devices.append(Device(tmp_path / name, rate))
        return devices[-1]

    yield plug
    for device in devices:
        if device.link.is_symlink():
            device.pull()


def test_two_sensors(plugged: Plug) -> None:
    one, two = plugged("one", 50), plugged("two", 50)
    begin = time.monotonic()
    with connected(mti_source(f"{one.link}=torso,{two.link}=head")) as source:
        assert source.sensors == ("torso", "head")
        samples = collect(source, 40, sensors=2)
    for name in ("torso", "head"):
        np.testing.assert_array_equal(samples[name].gyro_S, np.tile(GYRO, (len(samples[name].time), 1)))
        np.testing.assert_array_equal(samples[name].accel_S, np.tile(ACCEL, (len(samples[name].time), 1)))
        assert np.median(np.diff(samples[name].time)) == pytest.approx(0.02, rel=0.0101)
        assert begin < samples[name].time[-1] < source.clock() + 1.0
    assert source.problems == {}


def test_a_port_that_vanishes_is_taken_up_again(plugged: Plug) -> None:
    """The other sensor goes on; the clock of the one that comes back begins anew."""
    gone, stays = plugged("one"), plugged("two")
    begin = time.monotonic()
    with connected(mti_source(f"{gone.link}=torso,{stays.link}=head")) as source:
        collect(source, 20, sensors=2)
        gone.pull()
        wait_until(lambda: source.read(0.1) and source.problems.get("connections lost to torso"))
        assert len(collect(source, 30)["head"].time) >= 30
        gone.measuring, gone.ticks = False, 0
        gone.plug()
        samples = collect(source, 20, sensors=2)["torso"]
        assert len(samples.time) >= 20
        assert begin < samples.time[-1] < source.clock() + 1.0


def test_a_device_that_falls_silent_is_woken(plugged: Plug, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mti, "SILENT_S", 0.2)
    device = plugged("one")
    with connected(mti_source(f"{device.link}=torso")) as source:
        collect(source, 20)
        device.measuring = False  # its supply failed, it starts in config state, the port stays
        while source.read(0.1):
            pass
        assert len(collect(source, 20)["torso"].time) >= 20


def test_a_port_is_waited_for_and_what_is_wrong_is_said(
    tmp_path: Path, plugged: Plug, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mti, "SILENT_S", 0.2)
    before = set(threading.enumerate())
    source = mti_source(f"{tmp_path / 'one'}=torso")
    place = f"the MTi of torso at {tmp_path / 'one'}: "
    source.open()
    wait_until(lambda: "No such file or directory" in source.describe_awaited())
    assert not source.connect(0.1)
    device = plugged("one")
    device.deaf = True
    wait_until(lambda: source.describe_awaited().startswith(f"{place}nothing comes at 115200 baud"))
    device.packet, device.deaf = item(0x1060, bytes(4)) + item(0x8020, VECTORS[0]), False
    wait_until(lambda: source.describe_awaited().startswith(f"{place}no packets with SampleTimeFine, RateOfTurn"))
    device.packet = b""
    source.close()
    for _ in range(2):  # the port is free again after each
        with connected(source):
            assert collect(source, 5)
    assert len(set(threading.enumerate()) - before) == 1  # the device


@pytest.mark.parametrize(
    ("devices", "words"),
    [
        ("/dev/ttyUSB0", "'/dev/ttyUSB0': DEVICE=SEGMENT is needed"),
        ("/dev/ttyUSB0=trso", "did you mean 'torso'"),
        ("/dev/a=torso,/dev/a=head", "'/dev/a=head': DEVICE=SEGMENT is needed, each device"),
    ],
)
def test_wrong_devices_are_one_line(devices: str, words: str) -> None:
    with pytest.raises(BadOption, match=words):
        mti_source(devices)


# Frames and packets --------------------------------------------------------------------------------------------------


def test_frames_come_out_of_noise(plugged: Plug) -> None:
    """With preambles in it, also such that announce a long frame; a wrong checksum; a frame that is cut."""
    rng, device = np.random.default_rng(3), plugged("one")
    bad = whole(0x36, bytes(20))
    device.noise = lambda: rng.bytes(9) + bad[:-1] + bytes([bad[-1] ^ 1]) + b"\xfa\xff\x36\x05"
    with connected(mti_source(f"{device.link}=torso")) as source:
        torso = collect(source, 50)["torso"]
        assert len(torso.time) >= 50
        assert (torso.gyro_S == GYRO).all()
        assert sum(source.problems.values()) > 0


def test_a_packet_of_a_device(plugged: Plug) -> None:
    """An MTi-300's bytes and what MT Manager reads in them; orientation, ΔV, ΔQ, magnetic field are passed over."""
    device = plugged("one")
    device.packet = bytes.fromhex(
        "102002918D10600401363FA62010103F35E0423F31CD15BD9F49DBBDA938CF40200CBD635A90411D08D43E5FAA50"
        "40100CB91168003CC901003A0F7D0040300CBC3B29803C35FC003CA46E0080200C3CAEA241BB56D800BAD5AC01"
        "8030103F80000037DF8801B6898000B608C000C0200CBEFBFBF23F33C485BFA0A2C108100442168000"
        "301004000186E1E0200400400003"
    )
    with connected(mti_source(f"{device.link}=torso")) as source:
        torso = collect(source, 1)["torso"]
    np.testing.assert_allclose(torso.gyro_S[0], [0.02131760, -0.00327826, -0.00163019], atol=1e-8)
    np.testing.assert_allclose(torso.accel_S[0], [-0.05550629, 9.81465530, 0.21842313], atol=1e-8)


@pytest.mark.parametrize(
    "packet",
    [
        item(0x1060, bytes(4)) + item(0x8021, VECTORS[0]) + item(0x4021, VECTORS[1]),  # fixed point
        item(0x8020, VECTORS[0]) + item(0x4020, VECTORS[1]),  # without a time
        item(0x1060, bytes(4)) + item(0x8020, VECTORS[0][:11]) + item(0x4020, VECTORS[1]),
        b"\x80",
    ],
)
def test_a_packet_without_a_sample_is_counted(packet: bytes, plugged: Plug) -> None:
    device = plugged("one")
    with connected(mti_source(f"{device.link}=torso")) as source:
        collect(source, 5)
        device.packet = packet
        wait_until(lambda: source.read(0.05) is not None and source.problems)
        device.packet = b""
        assert (collect(source, 5)["torso"].gyro_S == GYRO).all()
