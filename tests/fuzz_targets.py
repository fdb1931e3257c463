"""Our parsers of others' files as functions of bytes, and the small well-formed inputs that fuzzing begins with.

A target takes its input, or says in one line why not. All tables of devices go through one engine, so that two of them
stand for all. Parquet, MATLAB, HDF5 and C3D are not here: libraries parse them, and some die of a damaged file.
"""

import io
import json
import socket
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import device_files as df
import polars as pl
from arms import write_arm
from mcap.writer import Writer
from sampling import find_free_port
from scipy.io import savemat
from test_bad_input import QUATS, good_table
from test_bad_input import SESSION as TORSO

import wepose_pin as wp
from wepose_pin import WeposeError, retargeting
from wepose_pin.body.kinematics import parse_pose_table
from wepose_pin.calibration import load_protocol
from wepose_pin.data_tables import read_table
from wepose_pin.live.sources import open_source
from wepose_pin.readers.describe import describe_file
from wepose_pin.readers.reference import read_reference
from wepose_pin.retargeting.collision import CollisionModel
from wepose_pin.writers import load_result

ROOT = Path(wp.__file__).parents[1]
TABLE = good_table().head(12)
SESSION = f'name = "small"\nstart_pose = "n_pose"\n{TORSO}'.replace("[[0.5, 2.5]]", "[[0.01, 0.1]]")
FOREARM = QUATS[QUATS.index("[sensors") : QUATS.index("mount")].replace("torso", "left_forearm")
BOTH = f'{SESSION}{FOREARM}file = "arm.parquet"\nrate_hz = 100.0\noffset_s = 0.001\n'


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


# Well-formed inputs --------------------------------------------------------------------------------------------------


def as_parquet(table: pl.DataFrame) -> bytes:
    out = io.BytesIO()
    table.write_parquet(out)
    return out.getvalue()


def wild_csv() -> bytes:
    """As a spreadsheet writes it: remarks, semicolons, decimal commas, units in a line of their own."""
    names, rows = TABLE[:, :7].write_csv(separator=";").replace(".", ",").split("\n", 1)
    return f"remark;1\n\n{names}\ns;{'rad/s;' * 3}{';'.join(['m/s^2'] * 3)}\n{rows}".encode()


def trc() -> bytes:
    names = "\t\t\t".join(("LSHO", "RSHO", "LELB"))
    head = (
        f"PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n100\t100\t{len(TABLE)}"
    )
    accel = [100.0 * TABLE[f"a{axis}"].rename(f"{axis}{k}") for k in range(3) for axis in "xyz"]
    rows = TABLE.select("time", *accel).with_row_index().write_csv(separator="\t", include_header=False)
    return f"{head}\t3\tmm\nFrame#\tTime\t{names}\n\t\tX1\n{rows}".encode()


def live_log() -> bytes:
    """A live session of one sensor: a start pose of half a second, and as much after it; without chunks."""
    stream = io.BytesIO()
    writer = Writer(stream, use_chunking=False)
    header = {
        **{"format": 4, "name": "live", "sensors": ["torso"], "mounts": {"torso": [0.0, 0.0, 0.0, 1.0]}, "phases": {}},
        **{"start_pose": "n_pose", "remounted": False, "subject": None, "method": "amekf"},
    }
    writer.start("wepose-live", "seeds")
    writer.add_metadata("wepose", {"json": json.dumps(header)})
    channels = {topic: writer.register_channel(topic, "json", 0) for topic in ("/sensors/torso", "/events", "/pose")}

    def add(topic: str, **values: object) -> None:
        writer.add_message(channels[topic], 0, json.dumps(values).encode(), 0)

    add("/events", kind="clock", rate_hz=100.0, begin=0.0)
    for k in range(100):
        add("/sensors/torso", t=k / 100.0, gyro=[0.0, 0.0, 0.0], accel=[0.0, 0.0, 9.8])
    add("/events", kind="start", begin=0, end=50)
    for tick in (51, 52):
        add("/pose", tick=tick, quat_WL={"torso": [0.0, 0.0, 0.0, 1.0]})
    add("/events", kind="reset", tick=60)
    writer.finish()
    return stream.getvalue()


def datagrams() -> list[bytes]:
    one = {"sensor": "torso", "t": 12.345, "gyro": [0.1, -0.2, 0.3], "accel": [0.0, 0.5, 9.81]}
    two = {"sensor": "head", "t": [1, 2.5], "gyro": [[0.1, 0, 0], [0, 0, 1]], "accel": [[0, 0, 9], [0, 0, 9]]}
    return [json.dumps(one).encode(), "\n".join(json.dumps(message) for message in (one, two)).encode()]


def pose() -> pl.DataFrame:
    """A whole body's pose: both arms, as `wepose track` writes it."""
    columns = {"time": TABLE["time"][:4]}
    for segment in ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm"):
        columns |= {f"{segment}_q{axis}": TABLE[f"q{axis}"][:4] for axis in "xyzw"} | {f"{segment}_std": [0.01] * 4}
    for point in ("shoulder", "elbow", "wrist", "palm"):
        for side in ("left", "right"):
            columns |= {f"{side}_{point}_{axis}": TABLE["time"][:4] for axis in "xyz"}
            columns[f"{side}_{point}_std"] = [0.01] * 4
    return pl.DataFrame(columns)


def written(write: Callable[[Path], Path]) -> bytes:
    """What a function writes into a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        return write(Path(folder)).read_bytes()


def subject() -> bytes:
    return written(lambda folder: wp.population_subject().save(folder / "subject.toml")) + (
        b"[mounts.torso]\nqx = 0.0\nqy = 0.0\nqz = 0.0\nqw = 1.0\n"
        b"[hinges.left_elbow]\nx = 0.0\ny = 1.0\nz = 0.0\nstd_deg = 5.0\n"
        b"[start_pose_offset.torso]\nx_deg = 1.0\ny_deg = 2.0\nstd_deg = 1.0\n"
        b"[heading_drift.torso]\nrate_deg_min = 1.0\nstd_deg_min = 2.0\n"
    )


def device(format: str) -> bytes:
    """A file of a maker, of which forty rows say enough."""
    if format == "mvnx":
        return written(lambda folder: df.mvnx(folder, df.turning(), raw=True))
    data = written(lambda folder: df.make(format, folder))
    return data if format == "xdf" else b"".join(data.splitlines(keepends=True)[:50])


def shipped(*names: str) -> list[bytes]:
    """Files of ours, as they are."""
    return [(ROOT / name).read_bytes() for name in names]


SMALL_TABLE = b"""urdf = "upper_body.urdf"
up = "+z"
forward = "+x"
[segments]
torso = "torso"
left_upper_arm = "left_upper_arm"
left_forearm = { link = "left_forearm" }
right_upper_arm = "right_upper_arm"
right_forearm = "right_forearm"
left_hand = "left_hand"
[points]
right_wrist = { link = "right_hand", at = [0.0, 0.0, 0.0] }
"""
SUMMARY = b'{"recording": "a", "sensors": {"torso": {}}, "points": ["left_palm"], "warnings": ["b"]}'
WORDS = (
    b"nan", b"inf", b"-1e308", b"1e400", b"9" * 400, b"9" * 5000, b"0", b"-0.0", b"1_0", b"0x1p3", b"\xe2\x88\x921",
    *(bytes([c]) for c in b",;\t\n\"#\0[]{}=:'<>&"), b"\r\n", b"\xff\xfe", b"\xef\xbb\xbf", b"\x1b[31m",
    b"true", b"null", b"a." * 600, b"\\u001b", b"\\ud800", b"1979-05-27T07:32:00Z", b"../", b"/dev/zero",
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"<!ENTITY % d SYSTEM 'http://127.0.0.1:9/d'>%d;", b"<![CDATA[", b"&#27;",
    b"encoding='utf-16'", b"type='floating'", b"<mimic joint='elbow'/>", b"<axis xyz='0 0 0'/>",
)  # fmt: skip


# Targets -------------------------------------------------------------------------------------------------------------


def file(
    name: str, read: Callable[[Path], object], beside: Callable[[], dict[str, bytes]] = dict
) -> Callable[[Path, bytes], object]:
    """The target that reads the input as a file of this name, with those `beside` that it needs."""

    def run(folder: Path, data: bytes) -> object:
        if not (folder / name).exists():
            for other, content in beside().items():
                (folder / other).write_bytes(content)
        (folder / name).write_bytes(data)
        return read(folder / name)

    return run


def of_session(data_file: str, session: str) -> Callable[[Path, bytes], object]:
    """The input is the data; a session that is well names it."""
    return file(
        data_file,
        lambda path: wp.load_session(path.with_name("session.toml"), gaps=True),
        lambda: {"session.toml": session.encode()},
    )


def of_device(name: str, format: str) -> Callable[[Path, bytes], object]:
    return of_session(name, f'[data]\nfile = "{name}"\nformat = "{format}"\n[sensors.torso]\n')


def receive(_folder: Path, data: bytes) -> object:
    port = find_free_port()
    source = open_source(f"udp:{port}", sensors=["torso", "head"])
    source.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(data[:60_000], ("127.0.0.1", port))
    samples = source.read(0.01)
    source.close()
    assert all(problem.isprintable() for problem in source.problems), source.problems
    return samples


KINDS = {
    ".csv": lambda: [TABLE.write_csv().encode(), wild_csv(), device("dot")],
    ".txt": lambda: [device("mt_manager")],
    ".sto": lambda: [device("opensim")],
    ".mvnx": lambda: [device("mvnx")],
    ".xml": lambda: [device("mvnx")],
    ".toml": lambda: [subject()],
    ".mcap": lambda: [live_log()],
}


def describe(folder: Path, data: bytes) -> object:
    """The first byte says what the file's name ends with."""
    path = folder / f"a{list(KINDS)[data[0] % len(KINDS) if data else 0]}"
    path.write_bytes(data[1:])
    try:
        return describe_file(path)
    finally:
        path.unlink()  # what lies beside a file is looked at too


def read_summary(path: Path) -> object:
    describe_file(path.parent)
    return load_result(path.parent)


def beside_session() -> dict[str, bytes]:
    out = io.BytesIO()
    savemat(out, {"imu": {"torso": {"gyro": TABLE[:, 1:4].to_numpy()}}, "note": "a"})
    return {"arm.csv": TABLE.write_csv().encode(), "arm.parquet": as_parquet(TABLE), "arm.mat": out.getvalue()}


def urdf(name: str = "upper_body.urdf") -> dict[str, bytes]:
    return {name: shipped("urdf/upper_body.urdf")[0]}


def arm() -> dict[str, bytes]:
    names = ("arm.urdf", "arm.toml")
    return {name: written(lambda folder, name=name: write_arm(folder).with_name(name)) for name in names}


TARGETS = (
    Target("csv", lambda: [TABLE.write_csv().encode(), wild_csv()], of_session("arm.csv", SESSION)),
    Target("mvnx", lambda: [device("mvnx")], of_device("a.mvnx", "mvnx")),
    Target("mt_manager", lambda: [device("mt_manager")], of_device("a.txt", "mt_manager")),
    Target("dot", lambda: [device("dot")], of_device("a.csv", "dot")),
    Target("xdf", lambda: [device("xdf")], of_device("a.xdf", "xdf")),
    Target("trc", lambda: [trc()], file("a.trc", read_reference)),
    Target("opensim", lambda: [device("opensim")], of_device("a.sto", "opensim")),
    Target("info", lambda: [bytes([k]) + text for k, of in enumerate(KINDS.values()) for text in of()], describe),
    Target("session", lambda: [BOTH.encode()], file("session.toml", wp.load_session, beside_session)),
    Target(
        "subject",
        lambda: [subject()],
        file("subject.toml", lambda path: wp.load_subject(path).save(path.with_name("again.toml"), force=True)),
    ),
    Target("table", lambda: [SMALL_TABLE], file("model.toml", wp.load_model, urdf)),
    Target("robot_map", lambda: [arm()["arm.toml"]], file("map.toml", retargeting.read_map, arm)),
    Target(
        "protocol",
        lambda: shipped("calibration/clasp.toml", "calibration/t_pose.toml", "calibration/tip.toml"),
        file("own.toml", load_protocol),
    ),
    Target("body", lambda: [*urdf().values()], file("body.urdf", lambda path: wp.load_model(path).visuals)),
    Target(
        "retarget",
        lambda: [arm()["arm.urdf"]],
        file("arm.urdf", lambda path: CollisionModel(retargeting.load_robot(str(path))), arm),
    ),
    Target("datagram", datagrams, receive),
    Target("live_log", lambda: [live_log()], file("a.mcap", wp.load_session)),
    Target(
        "pose",
        lambda: [pose().write_csv().encode()],
        file("pose.csv", lambda path: parse_pose_table(read_table(path), str(path))),
    ),
    Target(
        "summary",
        lambda: [SUMMARY],
        file(
            "summary.json",
            read_summary,
            lambda: {"pose.parquet": as_parquet(pose()), "subject.toml": subject()} | urdf("subject.urdf"),
        ),
    ),
)
