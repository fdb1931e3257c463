"""Our parsers of others' files, each as a function of bytes: it takes them, or says in one line why not.

All tables of devices go through one engine, so that two of them stand for all.

Parquet, MATLAB, HDF5 and C3D are not here: libraries parse them, and some of these die of a damaged file.
"""

from __future__ import annotations

import socket
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sampling import find_free_port

import wepose_pin as wp
from wepose_pin import WeposeError
from wepose_pin.live.sources import open_source

from . import seeds


class Target(NamedTuple):
    """One reader.

    Parameters
    ----------
    seeds : well-formed inputs
    run : takes a folder and an input; raises `WeposeError` on what it does not take
    """

    name: str
    seeds: Callable[[], list[bytes]]
    run: Callable[[Path, bytes], object]


def try_one(target: Target, folder: Path, data: bytes) -> WeposeError | None:
    """Give the input to the target: what it was refused for, None if it was taken; all else is a finding and raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="meshcat|zmq")  # as they are imported
        try:
            target.run(folder, data)
        except WeposeError as error:
            text = str(error)
            assert text.isprintable() and 0 < len(text) <= 4000, repr(text)[:400]  # noqa: PT018
            return error
    return None


def file(name: str, read: Callable[[Path], object]) -> Callable[[Path, bytes], object]:
    """The target that reads the input as a file of this name."""

    def run(folder: Path, data: bytes) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return run


def _datagram(_folder: Path, data: bytes) -> object:
    port = find_free_port()
    source = open_source(f"udp:{port}", sensors=["torso", "head"])
    source.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(data[:60_000], ("127.0.0.1", port))
    samples = source.read(0.01)
    source.close()
    assert all(problem.isprintable() for problem in source.problems), source.problems
    return samples


KINDS = (".csv", ".txt", ".sto", ".mvnx", ".xml", ".toml", ".mcap")


def _described(folder: Path, data: bytes) -> object:
    """The first byte says what the file's name ends with."""
    from wepose_pin.readers.describe import describe_file

    path = folder / f"a{KINDS[data[0] % len(KINDS) if data else 0]}"
    path.write_bytes(data[1:])
    try:
        return describe_file(path)
    finally:
        path.unlink()  # what lies beside a file is looked at too


def _described_seeds() -> list[bytes]:
    """One of each kind."""
    of = {
        ".csv": [seeds.csv(), seeds.wild_csv(), seeds.device("dot")],
        ".txt": [seeds.device("mt_manager")],
        **{".sto": [seeds.device("opensim")], ".mvnx": [seeds.device("mvnx")], ".xml": [seeds.device("mvnx")]},
        ".toml": [seeds.subject()],
    }
    return [bytes([KINDS.index(kind)]) + text for kind, texts in of.items() for text in texts]


def _session(data_file: str, session: str) -> Callable[[Path, bytes], object]:
    """The input is the data; a session that is well names it."""

    def run(folder: Path, data: bytes) -> object:
        (folder / data_file).write_bytes(data)
        (folder / "session.toml").write_text(session, encoding="utf-8")
        return wp.load_session(folder / "session.toml", gaps=True)

    return run


def _session_text(folder: Path, data: bytes) -> object:
    """The input is the session; the data that it may name are well."""
    for name, content in (
        ("arm.csv", seeds.csv),
        ("arm.parquet", seeds.parquet),
        ("arm.mat", seeds.mat),
    ):
        if not (folder / name).is_file():
            (folder / name).write_bytes(content())
    (folder / "session.toml").write_bytes(data)
    return wp.load_session(folder / "session.toml")


def _reference(path: Path) -> object:
    from wepose_pin.readers.reference import read_reference

    return read_reference(path)


def _subject(path: Path) -> object:
    subject = wp.load_subject(path)
    return subject.save(path.parent / "again.toml", force=True)


def _table(path: Path) -> object:
    if not (path.parent / "upper_body.urdf").is_file():
        (path.parent / "upper_body.urdf").write_bytes(seeds.shipped("urdf/upper_body.urdf")[0])
    return wp.load_model(path)


def _robot_map(path: Path) -> object:
    from wepose_pin.retargeting.maps import read_map

    (path.parent / "arm.urdf").write_text(seeds.URDF, encoding="utf-8")
    return read_map(path)


def _retargeted(path: Path) -> object:
    """The input is the URDF of an arm whose map is well."""
    from wepose_pin.retargeting import find_map, load_robot
    from wepose_pin.retargeting.collision import CollisionModel

    (path.parent / "arm.toml").write_bytes(seeds.ARM_MAP)
    return CollisionModel(load_robot(find_map(str(path))))


def _protocol(path: Path) -> object:
    from wepose_pin.calibration import load_protocol

    return load_protocol(path)


def _body(path: Path) -> object:
    return wp.load_model(path).visuals


def _pose(path: Path) -> object:
    from wepose_pin.body.kinematics import parse_pose_table
    from wepose_pin.data_tables import read_table

    return parse_pose_table(read_table(path), str(path))


def _summary(path: Path) -> object:
    from wepose_pin.readers.describe import describe_file
    from wepose_pin.writers.result import read_result

    (path.parent / "pose.parquet").write_bytes(seeds.pose())
    if not (path.parent / "subject.urdf").is_file():
        (path.parent / "subject.urdf").write_bytes(seeds.shipped("urdf/upper_body.urdf")[0])
    describe_file(path.parent)
    return read_result(path.parent)


TABLE = seeds.SESSION.split("[sensors.left_forearm]")[0]
DEVICE = '[data]\nfile = "{}"\nformat = "{}"\n[sensors.torso]\n'
WORDS = (
    b"nan", b"inf", b"-1e308", b"1e400", b"9" * 400, b"9" * 5000, b"0", b"-0.0", b"1_0", b"0x1p3", b"\xe2\x88\x921",
    *(bytes([c]) for c in b",;\t\n\"#\0[]{}=:'<>&"), b"\r\n", b"\xff\xfe", b"\xef\xbb\xbf", b"\x1b[31m",
    b"true", b"null", b"a." * 600, b"\\u001b", b"\\ud800", b"1979-05-27T07:32:00Z", b"../", b"/dev/zero",
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"<!ENTITY % d SYSTEM 'http://127.0.0.1:9/d'>%d;", b"<![CDATA[", b"&#27;",
    b"encoding='utf-16'", b"type='floating'", b"<mimic joint='elbow'/>", b"<axis xyz='0 0 0'/>",
)  # fmt: skip

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
SUMMARY = b'{"recording": "a", "sensors": {"torso": {}}, "points": ["left_palm"], "warnings": ["b"]}'
_PROTOCOLS = ("calibration/clasp.toml", "calibration/t_pose.toml", "calibration/tip.toml")


def _device(name: str, format: str) -> Callable[[Path, bytes], object]:
    return _session(name, DEVICE.format(name, format))


TARGETS = (
    Target("csv", lambda: [seeds.csv(), seeds.wild_csv()], _session("arm.csv", TABLE)),
    Target("mvnx", lambda: [seeds.device("mvnx")], _device("a.mvnx", "mvnx")),
    Target("mt_manager", lambda: [seeds.device("mt_manager")], _device("a.txt", "mt_manager")),
    Target("dot", lambda: [seeds.device("dot"), seeds.increments()], _device("a.csv", "dot")),
    Target("xdf", lambda: [seeds.device("xdf")], _device("a.xdf", "xdf")),
    Target("trc", lambda: [seeds.trc()], file("a.trc", _reference)),
    Target("opensim", lambda: [seeds.device("opensim")], _device("a.sto", "opensim")),
    Target("info", _described_seeds, _described),
    Target("session", lambda: [seeds.SESSION.encode()], _session_text),
    Target("subject", lambda: [seeds.subject()], file("subject.toml", _subject)),
    Target("table", lambda: [SMALL_TABLE], file("model.toml", _table)),
    Target("robot_map", lambda: [seeds.ARM_MAP], file("map.toml", _robot_map)),
    Target("protocol", lambda: seeds.shipped(*_PROTOCOLS), file("own.toml", _protocol)),
    Target("body", lambda: seeds.shipped("urdf/upper_body.urdf"), file("body.urdf", _body)),
    Target("retarget", lambda: [seeds.ARM.encode()], file("arm.urdf", _retargeted)),
    Target("datagram", seeds.datagrams, _datagram),
    Target("live_log", lambda: [seeds.live_log()], file("a.mcap", wp.load_session)),
    Target("pose", lambda: [seeds.pose_csv()], file("pose.csv", _pose)),
    Target("summary", lambda: [SUMMARY], file("summary.json", _summary)),
)
