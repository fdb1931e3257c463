"""Everything that reads what others wrote, each as a function of bytes: it takes them, or says in one line why not."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from wepose_pin.errors import WeposeError

from . import seeds


class Target(NamedTuple):
    """One reader.

    Parameters
    ----------
    seeds : well-formed inputs
    run : takes a folder and an input; raises `WeposeError` on what it does not take
    words : what inputs are made of, for a fuzzer that knows nothing of the format
    """

    name: str
    seeds: Callable[[], list[bytes]]
    run: Callable[[Path, bytes], object]
    words: tuple[bytes, ...] = ()


class NotOneLine(AssertionError):
    """An error's text that is no line for a user."""


def try_one(target: Target, folder: Path, data: bytes) -> WeposeError | None:
    """Give the input to the target: what it was refused for, None if it was taken; all else is a finding and raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            target.run(folder, data)
        except WeposeError as error:
            text = str(error)
            if not text or not text.isprintable() or len(text) > 4000:
                raise NotOneLine(repr(text)[:400]) from error
            return error
    return None


def file(name: str, read: Callable[[Path], object]) -> Callable[[Path, bytes], object]:
    """The target that reads the input as a file of this name."""

    def run(folder: Path, data: bytes) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return run


def _described(path: Path) -> object:
    from wepose_pin.readers.describe import describe

    return describe(path)


def _session(data_file: str, session: str) -> Callable[[Path, bytes], object]:
    """The input is the data; a session that is well names it."""

    def run(folder: Path, data: bytes) -> object:
        from wepose_pin.readers import load_session

        (folder / data_file).write_bytes(data)
        (folder / "session.toml").write_text(session, encoding="utf-8")
        return load_session(folder / "session.toml", gaps=True)

    return run


def _session_text(folder: Path, data: bytes) -> object:
    """The input is the session; the data that it may name are well."""
    from wepose_pin.readers import load_session

    for name, content in (
        ("arm.csv", seeds.csv),
        ("arm.parquet", seeds.parquet),
        ("arm.mat", lambda: seeds.mat(False)),
    ):
        if not (folder / name).is_file():
            (folder / name).write_bytes(content())
    (folder / "session.toml").write_bytes(data)
    return load_session(folder / "session.toml")


def _pieces(path: Path) -> object:
    from wepose_pin.readers import iter_session

    (path.parent / "session.toml").write_text(TABLE.replace("arm.csv", path.name), encoding="utf-8")
    return list(iter_session(path.parent / "session.toml", 0.05))


def _subject(path: Path) -> object:
    from wepose_pin.subject import load_subject, subject_toml

    return subject_toml(load_subject(path))


def _table(path: Path) -> object:
    from wepose_pin.model import load_model

    if not (path.parent / "upper_body.urdf").is_file():
        (path.parent / "upper_body.urdf").write_bytes(seeds.shipped("urdf/upper_body.urdf")[0])
    return load_model(path)


def _robot_map(path: Path) -> object:
    from wepose_pin.retargeting.maps import read_map

    (path.parent / "arm.urdf").write_text(seeds.URDF, encoding="utf-8")
    return read_map(path)


def _protocol(path: Path) -> object:
    from wepose_pin.calibration.protocols import load_protocol

    return load_protocol(path)


def _body(path: Path) -> object:
    from wepose_pin.model import load_model

    return load_model(path).visuals


def _robot(path: Path) -> object:
    from wepose_pin.model.robot import load_robot

    return load_robot(path)


def _datagram(_folder: Path, data: bytes) -> object:
    import numpy as np

    from wepose_pin.live.sources.clocks import HostClock
    from wepose_pin.live.sources.packets import decode

    batches, problems = decode(data)
    if not all(problem.isprintable() for problem in problems):
        raise NotOneLine(repr(problems)[:400])
    for batch in batches:
        assert batch.values.shape == (len(batch.time), 6)
        if np.abs(batch.time).max() < 1e10:  # as UdpSource takes them
            HostClock().to_host(batch.time, 100.0)
    return batches


def _serial(_folder: Path, data: bytes) -> object:
    from wepose_pin.live.sources import xbus

    stream, joiner = xbus.Frames(), xbus.Joiner()
    half = len(data) // 2
    for frame in stream.feed(data[:half]) + stream.feed(data[half:]):
        xbus.granted(frame.data)
        xbus.error_words(frame.data)
        try:
            joiner.add(xbus.packet(frame.data))
        except xbus.Malformed:
            continue
    return joiner.take()


def _streams(_folder: Path, data: bytes) -> object:
    from wepose_pin.live.sources.lsl import layout

    stream, *rest = data.decode("utf-8", errors="replace").split("\n")
    labels, units = rest[::2], rest[1::2]
    return layout(stream, "imu", labels, units, len(labels))


def _live(path: Path) -> object:
    """With checksums that are right: else nothing but checksums would be tested."""
    from wepose_pin.readers import read_live_log
    from wepose_pin.subject import subject_of

    path.write_bytes(_checked(path.read_bytes()))
    found = read_live_log(path)
    if found.header["subject"]:
        subject_of(found.header["subject"], path)
    return found


def _checked(data: bytes) -> bytes:
    from wepose_pin.readers.live_log import BLOCK, MAGIC

    made, at = data[: len(MAGIC)], len(MAGIC)
    while at + BLOCK.size <= len(data):
        tag, size, _ = BLOCK.unpack_from(data, at)
        payload = data[at + BLOCK.size : at + BLOCK.size + size]
        made += BLOCK.pack(tag, len(payload), zlib.crc32(payload, zlib.crc32(tag))) + payload
        at += BLOCK.size + size
    return made


def _pose(path: Path) -> object:
    from wepose_pin.pose import pose_from_table
    from wepose_pin.readers.tables import read_table

    return pose_from_table(read_table(path), str(path))


def _summary(path: Path) -> object:
    from wepose_pin.readers.describe import describe
    from wepose_pin.writers.result import read_result

    (path.parent / "pose.parquet").write_bytes(seeds.pose())
    if not (path.parent / "subject.urdf").is_file():
        (path.parent / "subject.urdf").write_bytes(seeds.shipped("urdf/upper_body.urdf")[0])
    describe(path.parent)
    return read_result(path.parent)


TABLE = seeds.SESSION.split("[sensors.left_forearm]")[0]
ARRAYS = """[data]
file = "{}"
time = "/clock/time"
gyro_unit = "rad/s"
accel_unit = "m/s^2"
[sensors.torso]
gyro = "/imu/torso/gyro"
accel = "/imu/torso/accel"
[sensors.head]
orientation = ["/q[0]", "/q[1]", "/q[2]", "/q[3]"]
"""
DEVICE = '[data]\nfile = "{}"\nformat = "{}"\n[sensors.torso]\n'
NUMBERS = (
    b"nan",
    b"inf",
    b"-1e308",
    b"1e400",
    b"9" * 30,
    b"9" * 5000,
    b"9" * 400,
    b"0",
    b"-0.0",
    b"1_0",
    b"0x1p3",
    b"\xe2\x88\x921",
)
LINES = (*NUMBERS, b",", b";", b"\t", b"\n", b"\r\n", b'"', b"#", b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\x1b[31m")
TOML = (
    *NUMBERS, b"[", b"]", b"[[", b"]]", b"{", b"}", b"= ", b"true", b"[]", b"{}", b'"', b"'", b'"""', b"\\u001b", b"\n",
    b"1979-05-27T07:32:00Z", b"[" * 2000, b"a." * 600, b'"' + b"\\n" + b'"', b"+x", b"\\u0000", b"../", b"/dev/zero",
)  # fmt: skip
XML = (
    *NUMBERS, b"<", b"/>", b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"&b;", b"<!ENTITY % d SYSTEM 'http://127.0.0.1:9/d'>%d;",
    b"<![CDATA[", b"]]>", b"<!--", b"-->", b"<?x?>", b"&#27;", b"xmlns='a'", b"encoding='utf-16'", b"type='floating'",
    b"<mimic joint='elbow'/>", b"type='prismatic'", b"<axis xyz='0 0 0'/>",
)  # fmt: skip
JSON = (*NUMBERS, b"NaN", b"-Infinity", b"[" * 2000, b"null", b'"\\ud800"', b"{", b"}", b"[", b"]", b":", b"true")

SMALL_TABLE = b"""urdf = "upper_body.urdf"
up = "+z"
forward = "+x"
[segments]
torso = "torso"
left_upper_arm = "left_upper_arm"
left_forearm = { link = "left_forearm", up = "+z", forward = "+x" }
right_upper_arm = "right_upper_arm"
right_forearm = "right_forearm"
left_hand = "left_hand"
[points]
right_wrist = { link = "right_hand", at = [0.0, 0.0, 0.0] }
"""
LSL = b"imu-torso\n" + b"".join(b"gyr_%s\nrad/s\n" % a for a in (b"x", b"y", b"z")) + b"acc_x\ng\nacc_y\ng\nacc_z\ng"
SUMMARY = b'{"recording": "a", "sensors": {"torso": {}}, "points": ["left_hand"], "warnings": ["b"]}'
_ROBOTS = ("urdf/robots/ur5.toml", "urdf/robots/baxter.toml")
_PROTOCOLS = ("calibration/clasp.toml", "calibration/poses.toml", "calibration/handle.toml")
_TEXTS = (seeds.mt_manager, seeds.dot, seeds.ximu3)


def _device(name: str, format: str) -> Callable[[Path, bytes], object]:
    return _session(name, DEVICE.format(name, format))


TARGETS = (
    Target("csv", lambda: [seeds.csv()], _session("arm.csv", TABLE), LINES),
    Target("pieces", lambda: [seeds.csv()], file("arm.csv", _pieces), LINES),
    Target("parquet", lambda: [seeds.parquet()], _session("arm.parquet", TABLE.replace("csv", "parquet"))),
    Target("mat", lambda: [seeds.mat(False), seeds.mat(True)], _session("arm.mat", ARRAYS.format("arm.mat"))),
    Target("hdf5", lambda: [seeds.hdf5()], _session("arm.h5", ARRAYS.format("arm.h5"))),
    Target("mvnx", lambda: [seeds.mvnx(True), seeds.mvnx(False)], _device("a.mvnx", "mvnx"), XML),
    Target("mt_manager", seeds.mt_manager, _device("a.txt", "mt_manager"), LINES),
    Target("dot", seeds.dot, _device("a.csv", "dot"), LINES),
    Target("ximu3", seeds.ximu3, _device("Inertial.csv", "ximu3"), LINES),
    Target("opensim", lambda: [seeds.opensim()], _device("a.sto", "opensim"), LINES),
    Target("info", lambda: [seeds.csv(), *(t for of in _TEXTS for t in of())], file("a.csv", _described), LINES),
    Target("session", lambda: [seeds.SESSION.encode()], _session_text, TOML),
    Target("subject", lambda: [seeds.subject()], file("subject.toml", _subject), TOML),
    Target("table", lambda: [SMALL_TABLE], file("model.toml", _table), TOML),
    Target("robot_map", lambda: seeds.shipped(*_ROBOTS), file("map.toml", _robot_map), TOML),
    Target("protocol", lambda: seeds.shipped(*_PROTOCOLS), file("own.toml", _protocol), TOML),
    Target("body", lambda: seeds.shipped("urdf/upper_body.urdf"), file("body.urdf", _body), XML),
    Target("robot", lambda: [seeds.URDF.encode()], file("arm.urdf", _robot), XML),
    Target("udp", seeds.datagrams, _datagram, JSON),
    Target("xbus", lambda: [seeds.serial()], _serial),
    Target("lsl", lambda: [LSL], _streams),
    Target("live_log", lambda: [seeds.live_log()], file("a.wepose", _live), JSON),
    Target("pose", lambda: [seeds.pose()], file("pose.parquet", _pose)),
    Target("summary", lambda: [SUMMARY], file("summary.json", _summary), JSON),
)
