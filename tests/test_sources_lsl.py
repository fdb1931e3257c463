"""Lab Streaming Layer: streams found, read, lost and taken up again, on this machine only."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from sampling import collect, connected, find_free_port, wait_until

from wepose_pin import BadSource
from wepose_pin.live.sources import lsl, open_source

RATE = 100.0
Outlet = Callable[..., Any]


@pytest.fixture
def pylsl(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("pylsl")
    monkeypatch.delenv("LSLAPICFG", raising=False)
    monkeypatch.setattr(lsl, "ANSWER_S", 60.0)
    return lsl.configure_pylsl()


@pytest.fixture
def outlet(pylsl: ModuleType) -> Iterator[Outlet]:
    def make(name: str, labels: list[str] | None = None, units: list[str] | None = None, source_id: str = "") -> Any:
        info = pylsl.StreamInfo(name, "IMU", len(labels) if labels else 6, RATE, "float32", source_id)
        described = info.desc().append_child("channels")
        for k, label in enumerate(labels or []):
            channel = described.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", units[k] if units else "")
        return pylsl.StreamOutlet(info)

    return make


def send(outlets: list[Any], rows: np.ndarray, stamps: np.ndarray) -> None:
    for row, stamp in zip(rows.tolist(), stamps.tolist(), strict=True):
        for outlet in outlets:
            outlet.push_sample(row, stamp)


def test_one_stream_a_sensor(pylsl: ModuleType, outlet: Outlet) -> None:
    outlets = [outlet("each-left_forearm"), outlet("each_torso"), outlet("eacher-head"), outlet("other")]
    with connected("lsl:each") as source:
        assert source.sensors == ("torso", "left_forearm")
        assert source.rate_hz == RATE
        rows = np.random.default_rng(1).normal(size=(50, 6)).astype(np.float32)
        stamps = pylsl.local_clock() + np.arange(50) / RATE - 0.5
        send(outlets[:2], rows, stamps)
        samples = collect(source, 50, sensors=2)
        assert stamps[0] < source.clock() <= pylsl.local_clock()
    for name in source.sensors:
        np.testing.assert_array_equal(np.column_stack([samples[name].gyro_S, samples[name].accel_S]), rows)
        np.testing.assert_array_equal(samples[name].time, stamps)
    assert source.problems == {}


def test_a_stream_with_units_and_other_channels(pylsl: ModuleType, outlet: Outlet) -> None:
    labels = ["counter", *reversed(lsl.SIGNALS), "mag_x"]
    out = outlet("units-torso", labels, ["", *["g"] * 3, *["deg/s"] * 3, ""])
    with connected("lsl:units", sensors=["torso"]) as source:
        rows = np.random.default_rng(2).normal(size=(20, len(labels))).astype(np.float32)
        send([out], rows, pylsl.local_clock() + np.arange(20) / RATE)
        samples = collect(source, 20)["torso"]
    columns = [rows[:, labels.index(label)].astype(float) for label in lsl.SIGNALS]
    np.testing.assert_allclose(samples.gyro_S, np.deg2rad(np.column_stack(columns[:3])), rtol=1e-12)
    np.testing.assert_allclose(samples.accel_S, 9.80665 * np.column_stack(columns[3:]), rtol=1e-12)


def test_samples_that_cannot_be_are_counted_and_the_times_of_others_stay(pylsl: ModuleType, outlet: Outlet) -> None:
    """A second is missing, too: dejittering would move all that follows."""
    out = outlet("bad-torso")
    with connected("lsl:bad") as source:
        stamps = pylsl.local_clock() + np.arange(300) / RATE
        stamps = stamps[(np.arange(300) < 100) | (np.arange(300) >= 200)]
        rows = np.ones((200, 6))
        rows[3, 2], rows[7, 4] = np.nan, 1e30
        send([out], rows, stamps)
        samples = collect(source, 198)["torso"]
    np.testing.assert_array_equal(samples.time, np.delete(stamps, [3, 7]))
    np.testing.assert_array_equal(samples.accel_S, np.ones((198, 3)))
    assert source.problems == {"samples with values that no body sensor gives": 2}


def test_a_stream_that_starts_anew_is_taken_up(pylsl: ModuleType, outlet: Outlet) -> None:
    """By its source_id; the other one goes on."""
    gone, stays = outlet("back-torso", source_id="torso"), outlet("back-head")
    with connected("lsl:back") as source:
        send([gone, stays], np.ones((5, 6)), pylsl.local_clock() + np.arange(5) / RATE)
        collect(source, 5, sensors=2)
        del gone
        again, heard = outlet("back-torso", source_id="torso"), list[str]()

        def hears_both() -> bool:
            send([again, stays], np.ones((1, 6)), np.array([pylsl.local_clock()]))
            heard.extend(samples.sensor for samples in source.read(0.02))
            return "torso" in heard and "head" in heard[heard.index("torso") :]

        wait_until(hears_both)


def test_what_is_not_there_is_said_and_one_that_is_there_twice_refused(outlet: Outlet) -> None:
    outlets = [outlet("some-torso"), outlet("some-head")]
    for spec, sensors, awaited in (
        ("lsl:nobody", None, "the LSL streams nobody-SEGMENT on this machine"),
        ("lsl:some", ["torso", "pelvis"], "the LSL streams some-SEGMENT on this machine: pelvis"),
    ):
        source = open_source(spec, sensors=sensors)
        source.open()
        wait_until(lambda: not source.connect(0.1) and source.describe_awaited() == awaited)  # noqa: B023
        source.close()
    outlets.append(outlet("some_head"))
    with pytest.raises(BadSource, match=r"lsl:some: head is in two streams"), connected("lsl:some"):
        pass


@pytest.mark.parametrize(
    ("name", "labels", "unit", "words"),
    [
        ("x-trso", [], "", "'trso' is not a segment; did you mean 'torso'"),
        ("x-torso", ["gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y"], "", "no channel labelled 'acc_z'"),
        ("x-torso", list(lsl.SIGNALS), "rpm", "channel 'gyr_x': unit 'rpm'; there is: rad/s, deg/s"),
    ],
)
def test_wrong_channels_say_what_is_right(outlet: Outlet, name: str, labels: list[str], unit: str, words: str) -> None:
    stream = outlet(name, labels, [unit] * len(labels))
    with pytest.raises(BadSource) as error, connected("lsl:x"):
        pass
    del stream
    assert words in str(error.value)


SENDER = """
import sys, time
from wepose_pin.live.sources import lsl
pylsl = lsl.configure_pylsl()
out = pylsl.StreamOutlet(pylsl.StreamInfo("far-torso", "IMU", 6, 100.0, "float32", ""))
print("ready", flush=True)
while True:
    out.push_sample([0.0] * 6)
    time.sleep(0.01)
"""


@pytest.mark.usefixtures("pylsl")
def test_sources_listen_on_loopback_only() -> None:
    """A reading LSL source has no socket that listens; a UDP source the one that is asked for, on 127.0.0.1."""
    process = pytest.importorskip("psutil").Process()

    def list_listening() -> set[str]:
        """Addresses that this process listens on, TCP and UDP."""
        return {each.laddr.ip for each in process.net_connections() if each.status in ("LISTEN", "NONE")}

    before = list_listening()
    with subprocess.Popen([sys.executable, "-c", SENDER], stdout=subprocess.PIPE, text=True) as sender:
        try:
            assert sender.stdout is not None
            assert sender.stdout.readline() == "ready\n"
            with connected("lsl:far") as source:
                assert len(collect(source, 10)["torso"].time) >= 10
                assert list_listening() <= before
        finally:
            sender.kill()
    with connected(f"udp:{find_free_port()}", sensors=["torso"]):
        assert list_listening() - before <= {"127.0.0.1"}
