"""`wepose live` as a user runs it: killed, stopped, and told wrong things."""

import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from bodies import LENGTHS, SEGMENTS
from commands import run as run_command
from sampling import find_free_port
from test_causal import first

from wepose_pin import Simulation, load_session, population_subject
from wepose_pin.body.subject import mount_rows
from wepose_pin.readers.live_log import read_live_log
from wepose_pin.writers import write_session

SPEED = 4.0


@pytest.fixture(scope="module")
def session(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute, on disk."""
    folder = tmp_path_factory.mktemp("session")
    write_session(folder, first(simulation.recording("half a minute"), 3000))
    return folder


def run(*arguments: str, code: int = 0) -> None:
    assert run_command(*arguments) == code


@pytest.mark.kill
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_ended_at_any_moment_the_file_holds_what_was_shown(session: Path, tmp_path: Path, number: int) -> None:
    file = tmp_path / "a.mcap"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.settimeout(1.0)
        command = [sys.executable, "-m", "wepose_pin", "live", "--source", f"replay:{session}", "--no-page"]
        command += ["--record", str(file), "--speed", str(SPEED), "--output", f"udp:{listening.getsockname()[1]}"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        shown, until = dict[float, dict[str, list[float]]](), time.monotonic() + 600.0  # a new clone compiles first
        while not shown or max(shown) - min(shown) < 4.0:  # some poses are left out where the machine is busy
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < until
            with contextlib.suppress(TimeoutError):
                message = json.loads(listening.recv(65536))
                shown[message["t"]] = message["segments"]
        process.send_signal(number)
        out, err = process.communicate(timeout=120)
        assert [line for line in err.splitlines() if "compiling the filters" not in line] == [], out
        assert process.returncode == (-number if number == signal.SIGKILL else 0)
    log = read_live_log(file)
    times = log.recording.time[log.first : log.first + len(log.quat_WL)]
    # What a kill may cost is a second of the day, not of the replay.
    assert times[-1] >= max(shown) - (SPEED * 1.0 if number == signal.SIGKILL else 0.0)
    for t, segments in [(t, segments) for t, segments in shown.items() if t < min(shown) + 3.0][::30]:
        k = int(np.argmin(np.abs(times - t)))
        for i, name in enumerate(log.header["sensors"]):
            np.testing.assert_allclose(log.quat_WL[k, i], segments[name], atol=1e-6)
    run("track", str(file), "-o", str(tmp_path / "result"), "--no-report")
    pose = pl.read_parquet(tmp_path / "result" / "pose.parquet")
    for i, name in enumerate(log.header["sensors"]):
        for c, part in enumerate(("qx", "qy", "qz", "qw")):
            assert np.array_equal(pose[f"{name}_{part}"].to_numpy()[: len(times)], log.quat_WL[:, i, c])
    assert json.loads((tmp_path / "result" / "summary.json").read_text(encoding="utf-8"))["causal"] is True


def test_a_recording_tracks_as_the_session_did_and_gets_its_phases_by_a_session(
    simulation: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder, session = tmp_path / "a.mcap", tmp_path / "session.toml", tmp_path / "short"
    session.mkdir()
    write_session(session, first(simulation.recording("short"), 1200))
    run("live", "--source", f"replay:{session}", "--speed", "max", "--record", str(file), "--no-page")
    run("track", str(file), "-o", str(tmp_path / "a"), "--no-report", "--no-view")
    run("track", str(session), "--causal", "-o", str(tmp_path / "b"), "--no-report", "--no-view")
    a, b = (pl.read_parquet(tmp_path / name / "pose.parquet") for name in ("a", "b"))
    assert a.drop("time").equals(b.drop("time"))
    np.testing.assert_allclose(a["time"].to_numpy(), b["time"].to_numpy(), atol=1e-9)
    assert a["time"][0] > load_session(session).phases["start"][0][1]
    # With a method of its own it is tracked anew, as a whole.
    run("track", str(file), "-o", str(tmp_path / "c"), "--method", "smoother", "--no-report", "--no-view")
    assert len(pl.read_parquet(tmp_path / "c" / "pose.parquet")) == 1200
    capsys.readouterr()
    run("calibrate", str(file), "-o", str(tmp_path / "s"), code=2)
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "phases.clasp is needed" in line
    assert "wepose info a.mcap --write" in line
    run("info", str(file), "--write")
    before, again, out = load_session(file), load_session(folder), capsys.readouterr().out
    assert f"{len(before)} samples at {before.rate_hz:g} Hz" in out
    np.testing.assert_allclose(again.phases["start"], before.phases["start"], atol=0.006)
    assert list(again.sensors) == [name for name in SEGMENTS if name in before.sensors]
    for name, sensor in before.sensors.items():
        np.testing.assert_array_equal(again.sensors[name].gyro_S, sensor.gyro_S)
        np.testing.assert_array_equal(again.sensors[name].accel_S, sensor.accel_S)
        np.testing.assert_allclose(again.sensors[name].stated_quat_LS, sensor.stated_quat_LS)
    text = folder.read_text(encoding="utf-8")
    folder.write_text(re.sub(r"(?m)^start = ", "clasp = [[8.0, 11.0]]\nstart = ", text))
    assert load_session(folder).phases["clasp"] == ((8.0, 11.0),)


def test_wrong_options_are_one_line(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "there.mcap"
    file.write_bytes(b"something")
    replay, unknown = f"replay:{session}", "mounted is not known: find it out with --guide"
    for arguments, message in (
        (["--source", "udp:9000"], f"how the sensors are {unknown}"),
        (["--source", "udp:9000", "--stature", "1.8"], "--stature: goes with --guide"),
        (["--source", "udp:9000", "--guide", "--protocol", "free", "-o", str(tmp_path)], "free: has no motion"),
        (["--source", "mti:/dev/ttyUSB0=torso"], "[,accel_unit=g]; mti is a plug-in: pip install examples/mti"),
        (["--source", "replay:nowhere"], "nowhere: no such file"),
        (["--source", replay, "--speed", "-1"], "speed: '-1'; a positive number"),
        (["--source", replay, "--record", str(file)], "there.mcap: exists; --force replaces it"),
        (["--source", replay, "--record", str(tmp_path / "no" / "a.mcap")], "a.mcap: cannot be written"),
        # It is found before the person does anything.
        (["--source", replay, "--guide", "-o", str(tmp_path / "o"), "--record", "no/a.mcap"], "a.mcap: cannot be"),
        (["--source", replay, "--subject", str(tmp_path / "none")], "none: no such file"),
        (["--source", replay, "--output", "udp:somewhere"], "--output udp: somewhere: a port or HOST:PORT is needed"),
        (["--source", replay, "--output", "osc:9000"], "--output osc:9000: 'osc' is not known; there is: lsl, udp"),
        (["--source", replay, "--port", "70000"], "127.0.0.1:70000: an address and a port from 1 to 65535"),
        (["--source", replay, "--method", "smoother"], "smoother"),
        (["--source", replay, "--vmc", "39539"], "--vmc is not an option of wepose live"),
    ):
        run("live", *arguments, *([] if "--port" in arguments else ["--no-page"]), code=2)
        # A new clone says, too, that it compiles.
        (line,) = (each for each in capsys.readouterr().err.splitlines() if not each.startswith("compiling"))
        assert message in line
    assert file.read_bytes() == b"something"
    run("track", str(file), "-o", str(tmp_path / "r"), code=2)


def test_ctrl_c_stops_the_wait_for_senders_at_once(tmp_path: Path) -> None:
    subject = replace(
        population_subject(),
        mounts={"torso": np.array([0.0, 0.0, 0.0, 1.0])},
        order=(*LENGTHS, *mount_rows("torso")),
        covariance=1e-4 * np.eye(len(LENGTHS) + 3),
    )
    subject.save(tmp_path / "subject.toml")
    command = [sys.executable, "-um", "wepose_pin", "live", "--source", f"udp:{find_free_port()}"]
    command += ["--subject", "subject.toml", "--no-page"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert process.stdout is not None
    while "Waiting for samples at UDP" not in (line := process.stdout.readline()):
        assert line
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert err.splitlines()[-1] == "wepose: stopped"  # in a new clone it compiles before
    assert process.returncode == 130


def test_a_session_without_a_start_pose_promises_no_poses(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "short").mkdir()
    write_session(tmp_path / "short", replace(first(load_session(session), 250), phases={}))
    record = ["--record", str(tmp_path / "a.mcap")]
    run("live", "--source", f"replay:{tmp_path / 'short'}", "--speed", "max", "--no-page", *record)
    out = capsys.readouterr().out
    assert "no poses: the start pose was not held" in out
    assert f"Nothing was recorded to {tmp_path / 'a.mcap'}" in out
    assert not (tmp_path / "a.mcap").exists()
    assert "nan" not in out
    assert "gives these poses again" not in out
