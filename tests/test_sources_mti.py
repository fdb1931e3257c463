"""MTi sensors on pseudo-terminals: configured, read, lost and found again."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import struct
import threading
import time
import tty
from pathlib import Path

import numpy as np
import pytest
from sampling import collect, connected
from test_sources_xbus import ACCEL, GYRO, mtdata2, whole

from wepose_pin.errors import BadSource
from wepose_pin.live.sources import mti, open_source

serial = pytest.importorskip("serial")


class Device:
    """An MTi at the other end of a line: answers what it is asked, and streams while it measures.

    Parameters
    ----------
    link : where the port is found, a symbolic link
    most : rate [Hz] of each item, at most; what is asked beyond is cut down to it
    """

    def __init__(self, link: Path, most: dict[int, int] | None = None, streaming: bool = False) -> None:
        self.link, self.most = link, most or {0x4020: 100, 0x8020: 100, 0x4040: 1000, 0x8040: 1000}
        self.measuring = streaming
        self.items: list[tuple[int, int]] = [(0x4020, 100), (0x8020, 100)]
        self.asked: list[tuple[int, bytes]] = []
        self.sent = 0
        self.ticks = 0
        self.noise = b""
        self.error: int | None = None
        self.deaf = False
        self._stop = threading.Event()
        self._plug()

    def _plug(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.link.unlink(missing_ok=True)
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

    plug = _plug

    def _run(self) -> None:
        due = time.monotonic()
        inbox = b""
        while not self._stop.is_set():
            if select.select([self.master], [], [], 0.002)[0]:
                inbox += os.read(self.master, 4096)
                while len(inbox) >= 5 and len(inbox) >= 5 + inbox[3]:
                    self._answer(inbox[2], inbox[4 : 4 + inbox[3]])
                    inbox = inbox[5 + inbox[3] :]
            rate = max(rate for _, rate in self.items)
            while self.measuring and due <= time.monotonic():
                due += 1.0 / rate
                self.ticks += 10_000 // rate
                data = mtdata2(
                    self.ticks, *((kind, ACCEL if kind & 0xF000 == 0x4000 else GYRO) for kind, _ in self.items)
                )
                self._write(self.noise + whole(0x36, data))
                self.sent += 1
            if not self.measuring:
                due = time.monotonic()

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # nobody reads
            os.write(self.master, data)

    def _answer(self, mid: int, data: bytes) -> None:
        self.asked.append((mid, data))
        if self.deaf:
            return
        if mid == 0x30:
            self.measuring = False
        elif mid == 0x10:
            self.measuring = True
        elif mid == 0xC0:
            if self.error is not None:
                self._write(whole(0x42, bytes([self.error])))
                return
            pairs = list(struct.iter_unpack("!HH", data))
            pairs = [(kind, rate if rate == 0xFFFF else min(rate, self.most.get(kind, 0))) for kind, rate in pairs]
            self.items = [(kind, rate) for kind, rate in pairs if rate != 0xFFFF]
            data = b"".join(struct.pack("!HH", *pair) for pair in pairs)
            self._write(whole(0xC1, data))
            return
        self._write(whole(mid + 1, b""))


@pytest.fixture
def plugged(tmp_path: Path):
    devices: list[Device] = []

    def plug(name: str, **options) -> Device:
        devices.append(Device(tmp_path / name, **options))
        return devices[-1]

    yield plug
    for device in devices:
        if device.link.is_symlink():
            device.pull()


def test_two_sensors_configured_to_a_rate(plugged) -> None:
    one, two = plugged("one", streaming=True), plugged("two")
    with connected(f"mti:{one.link}=torso,{two.link}=head@50") as source:
        assert source.sensors == ("torso", "head")
        assert source.rate_hz == 50
        samples = collect(source, 40, sensors=2)
    for device, name in ((one, "torso"), (two, "head")):
        assert [mid for mid, _ in device.asked] == [0x30, 0xC0, 0x10]
        assert device.asked[1][1] == bytes.fromhex("1020FFFF1060FFFF4020003280200032")
        np.testing.assert_array_equal(samples[name].gyro_S, np.tile(GYRO, (len(samples[name].time), 1)))
        np.testing.assert_array_equal(samples[name].accel_S, np.tile(ACCEL, (len(samples[name].time), 1)))
        np.testing.assert_allclose(np.diff(samples[name].time), 0.02, rtol=0.0101)
        assert abs(samples[name].time[-1] - source.clock()) < 1.0
    assert source.problems == {}


def test_the_outputs_that_are_asked_for(plugged) -> None:
    """High rates of the HR outputs; of a device without them the plain ones; without a rate it stays as it is."""
    device, plain = plugged("one"), plugged("two", most={0x4020: 400, 0x8020: 400})
    with connected(f"mti:{device.link}=torso@1000", baud=921600) as source:
        samples = collect(source, 500)["torso"]
    assert {kind for kind, _ in device.items} == {0x4040, 0x8040}
    assert np.diff(samples.time).mean() == pytest.approx(0.001, rel=0.0101)
    with connected(f"mti:{plain.link}=torso@400"):
        assert plain.items == [(0x4020, 400), (0x8020, 400)]
    measuring, waiting = plugged("three", streaming=True), plugged("four")
    with connected(f"mti:{measuring.link}=torso,{waiting.link}=head") as source:
        collect(source, 5, sensors=2)
    assert measuring.asked == []
    assert [mid for mid, _ in waiting.asked] == [0x10]


def test_a_rate_that_the_device_has_not(plugged) -> None:
    device = plugged("one", most={0x4020: 100, 0x8020: 100, 0x4040: 1000, 0x8040: 800})
    for rate, error, said in (
        (1000, None, r"at 1000 Hz; it offers RateOfTurnHR at 800 Hz, .*; choose a rate"),
        (100, 0x21, "RateOfTurn: a parameter is not one it knows"),
    ):
        device.error = error
        with pytest.raises(BadSource, match=said), connected(f"mti:{device.link}=torso@{rate}"):
            pass


def test_noise_is_counted_and_no_sample_lost(plugged) -> None:
    device = plugged("one")
    device.noise = b"\xfa\xff\x36\x05noise\x00"
    with connected(f"mti:{device.link}=torso@100") as source:
        samples = collect(source, 60)["torso"]
    assert len(samples.time) >= 60
    np.testing.assert_allclose(np.diff(samples.time), 0.01, rtol=0.0101)
    assert source.problems["bytes skipped"] >= 59 * len(device.noise)
    assert source.problems["bad checksums"] >= 59


def test_a_port_that_vanishes_is_taken_up_again(plugged) -> None:
    """The other sensor goes on; the one that comes back is configured anew, its clock begins anew."""
    gone, stays = plugged("one"), plugged("two")
    with connected(f"mti:{gone.link}=torso,{stays.link}=head@100") as source:
        collect(source, 20, sensors=2)
        gone.pull()
        between = collect(source, 30)
        assert len(between["head"].time) >= 30
        assert source.problems["connections lost to torso"] == 1
        gone.measuring, gone.ticks = False, 0
        gone.plug()
        samples = collect(source, 20, sensors=2)["torso"]
        assert len(samples.time) >= 20
        assert abs(samples.time[-1] - source.clock()) < 0.5
        assert source.problems["reconnections of torso"] == 1
        assert [mid for mid, _ in gone.asked] == [0x30, 0xC0, 0x10] * 2


def test_a_device_that_falls_silent_is_woken(plugged, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mti, "SILENT_S", 0.2)
    device = plugged("one")
    with connected(f"mti:{device.link}=torso@100") as source:
        collect(source, 20)
        device.measuring = False  # its supply failed, it starts in config state, the port stays
        while source.read(0.1):
            pass
        assert len(collect(source, 20)["torso"].time) >= 20


def test_a_port_is_waited_for_and_what_is_wrong_is_said(
    tmp_path: Path, plugged, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mti, "ANSWER_S", 0.05)
    path = tmp_path / "one"
    unset, source = open_source(f"mti:{path}=torso"), open_source(f"mti:{path}=torso@100")
    place = f"the MTi of torso at {path}: "
    assert not source.connect(0.0)
    assert source.describe_awaited() == f"{place}cannot open the port (No such file or directory)"
    device = plugged("one")
    device.deaf = True
    for waiting, said in ((unset, "no MTData2 comes at 115200 baud"), (source, "no MTi answers at 115200 baud")):
        assert not waiting.connect(0.0)
        assert waiting.describe_awaited().startswith(place + said)
    device.deaf = False
    with connected(source):
        assert source.describe_awaited(["torso"]) == f"MTi sensors: torso at {path}"
        assert collect(source, 5)
        assert not unset.connect(0.0)
        assert "cannot open the port" in unset.describe_awaited()
    with connected(source):  # the port is free again
        assert collect(source, 5)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("mti ")]
