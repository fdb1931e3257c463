"""Xbus: frames in, samples out, against an encoder written from the protocol's description and a device's own bytes."""

from __future__ import annotations

import random
import struct

import numpy as np
import pytest

from wepose_pin.live.sources import xbus

GYRO, ACCEL = [0.25, -1.5, 3.125], [-0.5, 9.8125, 0.0625]


def whole(mid: int, data: bytes, extended: bool = False) -> bytes:
    """A frame as the protocol describes it."""
    if extended or len(data) > 254:
        middle = b"\xff" + (len(data) // 256).to_bytes(1, "big") + (len(data) % 256).to_bytes(1, "big")
    else:
        middle = len(data).to_bytes(1, "big")
    rest = b"\xff" + mid.to_bytes(1, "big") + middle + data
    checksum = (256 - sum(rest) % 256) % 256
    return b"\xfa" + rest + checksum.to_bytes(1, "big")


def numbers(values: list[float], form: str) -> bytes:
    if form == "float32":
        return struct.pack("!fff", *values)
    if form == "float64":
        return struct.pack("!ddd", *values)
    if form == "fp12.20":
        return b"".join(round(v * 1048576).to_bytes(4, "big", signed=True) for v in values)
    raw = [round(v * 4294967296).to_bytes(6, "big", signed=True) for v in values]
    return b"".join(six[2:] + six[:2] for six in raw)  # the fraction is sent first


FORMS = {"float32": 0, "fp12.20": 1, "fp16.32": 2, "float64": 3}


def item(kind: int, data: bytes) -> bytes:
    return struct.pack("!HB", kind, len(data)) + data


def mtdata2(ticks: int | None, *vectors: tuple[int, list[float]], form: str = "float32") -> bytes:
    data = item(0x1020, b"\x12\x34")
    if ticks is not None:
        data += item(0x1060, (ticks % 2**32).to_bytes(4, "big"))
    return data + b"".join(item(kind | FORMS[form], numbers(values, form)) for kind, values in vectors)


def joined(packets: list[bytes]) -> tuple[np.ndarray, np.ndarray, xbus.Joiner]:
    joiner = xbus.Joiner()
    for data in packets:
        joiner.add(xbus.parse_packet(data))
    return *joiner.take(), joiner


# Frames --------------------------------------------------------------------------------------------------------------


def test_commands_are_the_bytes_that_are_known() -> None:
    """As MT Manager sends them."""
    assert xbus.build_frame(xbus.GO_TO_CONFIG) == bytes.fromhex("FAFF3000D1")
    assert xbus.build_frame(xbus.GO_TO_MEASUREMENT) == bytes.fromhex("FAFF1000F1")
    assert xbus.build_frame(xbus.SET_OUTPUT, bytes.fromhex("1020FFFF1060FFFF"))[:4] == bytes.fromhex("FAFFC008")
    assert xbus.Frames().feed(bytes.fromhex("FAFFC1081020FFFF1060FFFF9C")) == [
        xbus.Frame(0xC1, bytes.fromhex("1020FFFF1060FFFF"))
    ]


@pytest.mark.parametrize("length", [0, 1, 253, 254, 255, 256, 2048])
@pytest.mark.parametrize("piece", [1, 7, 5000])
def test_frames_of_any_length_in_any_pieces(length: int, piece: int) -> None:
    data = random.Random(length).randbytes(length)
    stream = whole(0x36, data) * 2 + whole(0x42, b"\x04")
    assert xbus.build_frame(0x36, data) == whole(0x36, data)
    frames = xbus.Frames()
    read = [f for k in range(0, len(stream), piece) for f in frames.feed(stream[k : k + piece])]
    assert read == [(0x36, data), (0x36, data), (0x42, b"\x04")]
    assert not frames.problems


def test_extended_length_for_a_short_frame() -> None:
    assert xbus.Frames().feed(whole(0x36, b"abc", extended=True)) == [(0x36, b"abc")]


def test_noise_between_frames_is_skipped_and_counted() -> None:
    """Noise with preambles in it, also such that announce a long frame: no whole frame is lost."""
    rng = random.Random(3)
    frames, read, noise = xbus.Frames(), [], 0
    for k in range(200):
        between = rng.randbytes(rng.randrange(20)) + (b"\xfa\xff\x36\x40" if k % 5 == 0 else b"")
        noise += len(between)
        read += frames.feed(between + whole(0x36, k.to_bytes(2, "big") + b"\xfa\xff\x36\x10"))
    read += frames.feed(bytes(3000))
    noise += 3000
    assert [f.data[:2] for f in read] == [k.to_bytes(2, "big") for k in range(200)]
    assert frames.problems[xbus.SKIPPED] == noise
    assert frames.problems[xbus.BAD_CHECKSUMS] >= 40


def test_a_wrong_checksum_and_a_cut_frame_cost_themselves_only() -> None:
    good = whole(0x36, b"good")
    wrong = good[:-1] + bytes([good[-1] ^ 1])
    frames = xbus.Frames()
    assert frames.feed(good + wrong + good + good[:6] + good + good) == [(0x36, b"good")] * 4
    assert frames.problems[xbus.BAD_CHECKSUMS] == 2
    assert frames.problems[xbus.SKIPPED] == len(wrong) + 6


# Packets -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("axes", [0x0, 0x4, 0x8])  # ENU, NED, NWU: of the world, not of the sensor
def test_every_way_to_write_numbers(form: str, axes: int) -> None:
    data = mtdata2(77, (0x8020 | axes, GYRO), (0x4020 | axes, ACCEL), form=form)
    assert xbus.parse_packet(data) == {0x1060: (77,), 0x8020: tuple(GYRO), 0x4020: tuple(ACCEL)}
    data = mtdata2(77, (0x8040 | axes, GYRO), (0x4040 | axes, ACCEL), form=form)
    assert xbus.parse_packet(data) == {0x1060: (77,), 0x8040: tuple(GYRO), 0x4040: tuple(ACCEL)}


def test_a_packet_of_a_device() -> None:
    """An MTi-300's bytes and what MT Manager reads in them; orientation, ΔV, ΔQ, magnetic field are passed over."""
    data = bytes.fromhex(
        "102002918D10600401363FA62010103F35E0423F31CD15BD9F49DBBDA938CF40200CBD635A90411D08D43E5FAA50"
        "40100CB91168003CC901003A0F7D0040300CBC3B29803C35FC003CA46E0080200C3CAEA241BB56D800BAD5AC01"
        "8030103F80000037DF8801B6898000B608C000C0200CBEFBFBF23F33C485BFA0A2C108100442168000"
        "301004000186E1E0200400400003"
    )
    packet = xbus.parse_packet(data)
    assert packet[xbus.SAMPLE_TIME_FINE] == (20332454,)
    assert packet[xbus.ACCELERATION] == pytest.approx((-0.05550629, 9.81465530, 0.21842313), abs=1e-8)
    assert packet[xbus.RATE_OF_TURN] == pytest.approx((0.02131760, -0.00327826, -0.00163019), abs=1e-8)


@pytest.mark.parametrize(
    "data",
    [
        b"\x80",
        b"\x80\x20\x0c" + bytes(11),
        item(0x8020, bytes(11)),
        item(0x8020, bytes(24)),
        item(0x8022, bytes(12)),
        item(0x1060, bytes(2)),
    ],
)
def test_malformed_packets(data: bytes) -> None:
    with pytest.raises(xbus.Malformed):
        xbus.parse_packet(data)


# Samples -------------------------------------------------------------------------------------------------------------


def test_time_goes_on_where_the_counter_wraps() -> None:
    begin = 2**32 - 250
    time, values, _ = joined([mtdata2(begin + 100 * k, (0x8020, GYRO), (0x4020, ACCEL)) for k in range(6)])
    np.testing.assert_allclose(np.diff(time), 0.01, atol=1e-9)
    np.testing.assert_array_equal(values, [[*GYRO, *ACCEL]] * 6)


def test_a_device_that_starts_anew_goes_back() -> None:
    ticks = [50_000, 50_100, 300, 400]
    time, _, _ = joined([mtdata2(t, (0x8020, GYRO), (0x4020, ACCEL)) for t in ticks])
    np.testing.assert_allclose(time, np.array(ticks) / 1e4)


@pytest.mark.parametrize(("gyro_step", "accel_step"), [(10, 10), (10, 25), (25, 10), (10, 100)])
def test_rates_and_accelerations_of_different_packets_are_paired_by_time(gyro_step: int, accel_step: int) -> None:
    """1 kHz and 400 Hz, either way round, and 1 kHz with 100 Hz; a ramp of acceleration, for which linear is exact."""
    packets = sorted(
        [(t, 0x8040) for t in range(0, 2001, gyro_step)] + [(t + 0.5, 0x4040) for t in range(0, 2001, accel_step)]
    )
    data = [
        mtdata2(int(t), (kind, [t / 1e4, 0.0, 1.0] if kind == 0x8040 else [int(t) / 100, 2.0, 3.0]))
        for t, kind in packets
    ]
    time, values, joiner = joined(data)
    np.testing.assert_allclose(time, np.arange(0, 2001, gyro_step) / 1e4)
    np.testing.assert_allclose(values[:, 0], time, atol=1e-7)
    np.testing.assert_allclose(values[:, 3], time * 100.0, atol=1e-5)
    assert not joiner.problems


def test_high_rate_is_taken_where_both_kinds_come() -> None:
    hr = [1.0, 1.0, 1.0]
    data = [
        mtdata2(t, (0x8040, hr), (0x4040, hr), *(((0x8020, GYRO), (0x4020, ACCEL)) if t % 100 == 0 else ()))
        for t in range(0, 1000, 10)
    ]
    time, values, _ = joined(data)
    np.testing.assert_allclose(np.diff(time), 0.001, atol=1e-9)
    np.testing.assert_array_equal(values, np.ones((100, 6)))


def test_rates_without_an_acceleration_are_counted_and_do_not_wait_for_ever() -> None:
    time, _, joiner = joined([mtdata2(100 * k, (0x8020, GYRO)) for k in range(100)])
    assert len(time) == 0
    assert joiner.problems[xbus.UNPAIRED] == pytest.approx(90, abs=2)
    lost = [mtdata2(100 * k, (0x8020, GYRO), *([(0x4020, ACCEL)] if not 20 < k < 60 else [])) for k in range(100)]
    time, _, joiner = joined(lost)
    assert len(time) == 100 - 39
    assert joiner.problems[xbus.UNPAIRED] == 39


def test_packets_without_a_time_are_counted() -> None:
    time, _, joiner = joined([mtdata2(None, (0x8020, GYRO), (0x4020, ACCEL))])
    assert len(time) == 0
    assert joiner.problems[xbus.UNTIMED] == 1


def test_what_is_asked_of_a_device() -> None:
    assert xbus.build_output_items(100, 0x8020, 0x4020) == bytes.fromhex("1020FFFF 1060FFFF 40200064 80200064")
    assert xbus.build_output_items(1000, 0x8040, 0x4040) == bytes.fromhex("1020FFFF 1060FFFF 404003E8 804003E8")
    assert xbus.read_rates(bytes.fromhex("1060FFFF 40230190 80")) == {0x1060: 0xFFFF, 0x4020: 400}
    assert xbus.describe_error(b"\x21") == "a parameter is not one it knows"
    assert xbus.describe_error(b"\x77") == "error 0x77"
    assert xbus.describe_error(b"") == "an error without a number"
