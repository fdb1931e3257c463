"""What a live session costs: five sensors at 1 kHz through the whole loop, replayed at their own pace."""

from __future__ import annotations

import gc
import importlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from wepose_pin.live import Output, SensorSetup, Status, run_session
from wepose_pin.live.outputs import RobotOutput, UdpOutput
from wepose_pin.live.sources.replay import ReplaySource
from wepose_pin.recording import Recording
from wepose_pin.retargeting import CommandStream, find_map, load_robot
from wepose_pin.simulation import simulate, simulate_person

from .tables import Column, Section, Table

RATE_HZ = 1000.0
MOTION_S = 60.0  # [s] of motion that is repeated
LATENCY_MS, LATENCY_99_MS, SHARE = 1.0, 5.0, 50.0  # limits: [ms], [ms], [%] of one core

# Reads the page's stream as a browser does, in a process of its own.
_READER = """
import asyncio, sys
from tornado.websocket import websocket_connect
async def read(url):
    socket = await websocket_connect(url)
    while await socket.read_message() is not None:
        await socket.write_message("taken")
asyncio.run(read(sys.argv[1]))
"""


@contextmanager
def _reader(url: str) -> Iterator[None]:
    command = [sys.executable, "-c", _READER, url.replace("http:", "ws:") + "stream"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.kill()
        process.wait()


class _Meter(Output):
    """Notes processor time and memory at the first pose and at the end."""

    def __init__(self) -> None:
        self.before: tuple[float, float, float] | None = None
        self.after: tuple[float, float, float] | None = None

    def status(self, status: Status) -> None:
        now = time.perf_counter(), time.process_time(), _resident()
        if status.state == "ready" and self.before is None:
            self.before = now
        self.after = now


def sections(quick: bool) -> list[Section]:
    """List the functions that measure."""
    return [partial(measure_live_session, 30.0 if quick else 300.0)]


def measure_live_session(seconds: float) -> Table:
    """Measure loop and file, page and robot for `seconds` each."""
    recording = _recording(seconds)
    table = Table(
        f"A live session: five sensors at {RATE_HZ:g} Hz for {seconds:g} s, replayed at their own pace",
        (
            Column("ticks", "ticks", 0),
            Column("lost", "lost samples", 0),
            Column("p50", "latency p50 [ms]", 2),
            Column("p99", "p99 [ms]", 2),
            Column("busy_us", "processor time per pose [us]", 0),
            Column("share", "of one core [%]", 1),
            Column("grown", "memory grown [MB]", 1),
        ),
    )
    with tempfile.TemporaryDirectory() as folder:
        table.rows["poses and file"] = _measure(recording, Path(folder) / "a.mcap", [])
        from wepose_pin.body import load_model
        from wepose_pin.live.page import LivePage

        for row, file in (("and page, with a browser", "b.mcap"), ("and a robot's arm, UDP", "c.mcap")):
            outputs = [UdpOutput("9"), _connect_robot(recording, Path(folder))] if "robot" in row else []
            page = LivePage(load_model())
            page.open()
            with _reader(page.url):
                table.rows[row] = _measure(recording, Path(folder) / file, [page, *outputs])
    table.notes.append(
        "Latency is from the moment at which the newest sample was due to its pose. Limits: p50 under "
        f"{LATENCY_MS:g} ms, p99 {LATENCY_99_MS:g} ms, under {SHARE:g} % of one core, no sample lost, memory flat."
    )
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    table.notes.append(
        "Other work on the machine shows in the 99th percentile first: after the measurement "
        f"{load:.1f} programs waited for each core. Processor time is that of all threads, robot and page included."
    )
    return table


def _connect_robot(recording: Recording, folder: Path) -> RobotOutput:
    """The output for an arm of seven joints, that of the tests."""
    write_arm = importlib.import_module("tests.arms").write_arm
    robot = RobotOutput(CommandStream(load_robot(find_map(str(write_arm(folder))))), "9", tuple(recording.sensors))
    robot.open()
    return robot


def _recording(seconds: float) -> Recording:
    """A person who stands, then moves; the motion is repeated until it is `seconds` long."""
    person = simulate_person(1)
    made = simulate(person.lengths, seed=1, rate_hz=RATE_HZ, clasp_s=MOTION_S, circles=0).recording("live")
    start, n = made.span(made.phases["start"][0]).stop, round(seconds * RATE_HZ)
    rows = np.concatenate([np.arange(start), start + np.arange(n) % (len(made) - start)])
    sensors = {}
    for name, sensor in made.imus.items():
        sensors[name] = replace(sensor, gyro_S=sensor.gyro_S[rows], accel_S=sensor.accel_S[rows])
    time_s = np.arange(len(rows)) / RATE_HZ
    return replace(made, time=time_s, rate_hz=RATE_HZ, sensors=sensors, phases={"start": made.phases["start"]})


def _measure(recording: Recording, file: Path, outputs: Sequence[Output]) -> dict[str, float]:
    meter = _Meter()
    gc.collect()
    summary = run_session(
        ReplaySource(recording), SensorSetup.from_recording(recording), record=file, outputs=[*outputs, meter]
    )
    assert meter.before is not None
    assert meter.after is not None
    wall, busy, grown = (after - before for before, after in zip(meter.before, meter.after, strict=True))
    lost = sum(
        count["missing"] + count["late"] + count["bad"] + len(recording) - count["taken"]
        for count in summary.counts.values()
    )
    return {
        "ticks": float(summary.poses),
        "lost": float(lost),
        "p50": 1e3 * float(np.quantile(summary.latency, 0.5)),
        "p99": 1e3 * float(np.quantile(summary.latency, 0.99)),
        "busy_us": 1e6 * busy / max(summary.poses, 1),
        "share": 100.0 * busy / wall,
        "grown": grown / 1e6,
    }


def _resident() -> float:
    """Memory [bytes] of this process; NaN but on Linux."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return float("nan")
    return float(pages * os.sysconf("SC_PAGE_SIZE"))
