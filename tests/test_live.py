"""The live loop: what it shows is what it records and what tracking the file gives, whatever befalls the samples."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import LENGTHS
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation
from test_causal import first

import wepose_pin as wp
from wepose_pin import OrientationSensor, Recording, Simulation, TrackResult, live, population_subject, track
from wepose_pin.body.subject import mount_rows
from wepose_pin.live import Output, Request
from wepose_pin.live.sources import Source
from wepose_pin.live.sources.replay import ReplaySource
from wepose_pin.readers.live_log import LiveRecording, read_live_log
from wepose_pin.recording.arrivals import Samples


@pytest.fixture(scope="module")
def recording(simulation: Simulation) -> Recording:
    """The first fifteen seconds."""
    return first(simulation.recording("live"), 1500)


class Watcher(Output):
    """An output that keeps what it was shown, and asks for something when the time has come."""

    def __init__(self, requests: Sequence[tuple[float, Request]] = ()) -> None:
        self.points: tuple[str, ...] = ()
        self.poses: list[live.LivePose] = []
        self.statuses: list[live.Status] = []
        self.closed, self.resumed, self.said = False, 0, ""
        self._requests = list(requests)

    def start(self, info: live.StreamInfo) -> None:
        self.points = info.points

    def show(self, pose: live.LivePose) -> None:
        self.poses.append(pose)

    def status(self, status: live.Status) -> None:
        self.statuses.append(status)

    def describe(self) -> str:
        return self.said

    def resume(self) -> None:
        self.resumed += 1

    def take_requests(self) -> list[Request]:
        now = self.poses[-1].time if self.poses else -math.inf
        due = [request for at, request in self._requests if at <= now]
        self._requests = [(at, request) for at, request in self._requests if at > now]
        return due

    def close(self) -> None:
        self.closed = True


class Chaos(Source):
    """A recording whose samples come as they may: a virtual clock, 20 ms from read to read."""

    def __init__(self, recording: Recording, arrivals: list[tuple[float, Samples]]) -> None:
        super().__init__(recording.sensors, recording.rate_hz)
        self._arrivals, self._at = sorted(arrivals, key=lambda a: a[0]), 0
        self._now = self.begin = float(recording.time[0])

    def read(self, timeout_s: float) -> list[Samples] | None:
        assert timeout_s > 0.0
        if self._at == len(self._arrivals):
            return None
        self._now += 0.02
        samples = []
        while self._at < len(self._arrivals) and self._arrivals[self._at][0] <= self._now:
            samples.append(self._arrivals[self._at][1])
            self._at += 1
        return samples

    def clock(self) -> float:
        return self._now


def single(recording: Recording, name: str, k: int) -> Samples:
    sensor = recording.sensors[name]
    return Samples(name, recording.time[k : k + 1], sensor.gyro_S[k : k + 1], sensor.accel_S[k : k + 1])


def one_by_one(recording: Recording, late: str = "", late_by: int = 0) -> Chaos:
    """Every sample of every sensor when it was taken; the first of one sensor never came."""
    arrivals = [
        (float(t), single(recording, name, k))
        for k, t in enumerate(recording.time)
        for name in recording.sensors
        if name != late or k >= late_by
    ]
    return Chaos(recording, arrivals)


def run(
    recording: Recording,
    file: Path,
    source: Source | None = None,
    watcher: Watcher | None = None,
    method: str = "amekf",
) -> live.SessionSummary:
    """A session from the recording's first sample on, as `run_session` runs it, without a warm-up."""
    setup, source = live.SensorSetup.from_recording(recording), source or ReplaySource(recording, math.inf)
    source.open()
    return live.LiveLoop(source, setup, method=method, record=file, outputs=[watcher] if watcher else []).run()


def assert_is_tracked_so(log: LiveRecording, *results: TrackResult) -> None:
    """The file's poses are those of each result, bit for bit."""
    for result in results:
        for i, name in enumerate(log.header["sensors"]):
            assert np.array_equal(log.quat_WL[:, i], result.quat_WL[name][: len(log.quat_WL)])


def scale(recording: Recording, *, gyro: float = 1.0, accel: float = 1.0) -> Recording:
    """The recording in other units, without a stated start pose."""
    sensors = {
        name: replace(sensor, gyro_S=gyro * sensor.gyro_S, accel_S=accel * sensor.accel_S)
        for name, sensor in recording.imus.items()
    }
    return replace(recording, sensors=sensors, phases={})


def test_an_accelerometer_in_g_is_not_tracked_and_nothing_is_recorded(recording: Recording, tmp_path: Path) -> None:
    source, watcher = ReplaySource(scale(recording, accel=1.0 / 9.80665), math.inf), Watcher()
    setup, message = live.SensorSetup.from_recording(recording), r"sensors\.torso\.accel: norm 1.* m/s\^2 in phases\."
    with pytest.raises(wp.BadData, match=message + r"start .*: g\? State the unit"):
        live.run_session(source, setup, record=tmp_path / "a", outputs=[watcher])
    assert (watcher.poses, list(tmp_path.iterdir())) == ([], [])
    assert watcher.statuses[-1].state == "ended"
    assert "sensors.torso.accel: norm 1" in watcher.statuses[-1].message


def test_who_walks_to_the_start_pose_is_not_told_to_have_moved(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live.LiveLoop, "STATUS_PERIOD_S", 0.0)
    watcher = Watcher()
    run(replace(recording.cut(slice(1000, 1400)), phases={}), tmp_path / "a", watcher=watcher)
    assert {status.state for status in watcher.statuses} == {"start_pose", "ended"}


@pytest.mark.parametrize("where", ["worn", "table"])
def test_rates_in_deg_s_are_said_while_the_person_waits(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """A person who stands, and sensors on a table, whose bias alone turns gravity."""
    monkeypatch.setattr(live.LiveLoop, "STATUS_PERIOD_S", 1e-3)
    waits = replace(recording.cut(slice(0, 440)), phases={})
    if where == "table":
        noise = 1e-3 * np.random.default_rng(1).standard_normal((440, 3))
        sensors = {
            name: replace(each, gyro_S=np.deg2rad(0.2) + noise, accel_S=each.accel_S.mean(axis=0) + noise)
            for name, each in waits.imus.items()
        }
        waits = replace(waits, sensors=sensors)
    said = []
    for gyro in (1.0, np.rad2deg(1.0)):
        watcher, scaled = Watcher(), scale(waits, gyro=gyro)
        run(scaled, tmp_path / f"{gyro:g}", one_by_one(scaled), watcher)
        said.append([status.message for status in watcher.statuses if status.state != "ended"][-1])
    assert said[0] == "Tracking."
    assert "rad/s while gravity does not turn: deg/s? State the unit" in said[1]


def test_takes_are_phases_of_the_recording(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live.LiveLoop, "STATUS_PERIOD_S", 2e-2)
    file = tmp_path / "a.mcap"
    take, phase = Request("take"), Request("phase", "clasp")
    asked = [(6.0, take), (9.0, take), (9.5, phase), (11.5, phase), (12.5, take), (13.5, Request("nonsense"))]
    watcher = Watcher(asked)
    run(recording, file, one_by_one(recording), watcher)
    log = read_live_log(file)
    phases, last = log.recording.phases, log.recording.time[-1]
    # What is marked is marked at the newest tick; the last take was not ended.
    for name, spans in {"take_1": [(6.0, 9.0)], "clasp": [(9.5, 11.5)], "take_2": [(12.5, last)]}.items():
        np.testing.assert_allclose(phases[name], spans, atol=0.15)
    assert_is_tracked_so(log, track(log.recording, causal=True))  # with the clasp that was marked
    assert [action.name for action in watcher.statuses[0].actions] == ["reset"]
    labels = {(action.label, action.is_on) for status in watcher.statuses for action in status.actions}
    assert {("Begin take", False), ("End take 1", True), ("End clasp", True), ("End take 2", True)} <= labels
    # They change no pose, but for the clasp, which corrects headings.
    run(recording.cut(slice(0, 1250)), tmp_path / "b.mcap")
    unmarked = read_live_log(tmp_path / "b.mcap").quat_WL
    before = round((phases["clasp"][0][0] - recording.time[log.first]) * recording.rate_hz)
    assert np.array_equal(log.quat_WL[:before], unmarked[:before])
    assert not np.array_equal(log.quat_WL[: len(unmarked)], unmarked)


@pytest.mark.parametrize("method", ["amekf", pytest.param("smekf", marks=pytest.mark.slow), "ncf"])
def test_live_its_file_and_causal_tracking_give_the_same_bits(
    recording: Recording, tmp_path: Path, method: str
) -> None:
    ended = run(recording, tmp_path / "a.mcap", method=method)
    log = read_live_log(tmp_path / "a.mcap")
    causal, again = (track(each, method=method, causal=True) for each in (recording, log.recording))
    assert not log.recording.diagnostics
    assert log.first == len(recording) - len(causal.time)
    assert ended.poses == len(log.quat_WL) == len(causal.time) == len(again.time)
    assert_is_tracked_so(log, causal, again)
    for count in ended.counts.values():
        assert (count["taken"], count["missing"], count["late"]) == (len(recording), 0, 0)


def test_measured_orientations_and_a_marked_clasp_give_the_same_bits(
    recording: Recording, simulation: Simulation, tmp_path: Path
) -> None:
    """Two sensors with orientations, one of them lost for a second, beside raw ones."""
    gap = np.zeros(len(recording), dtype=bool)
    gap[900:1000] = True
    sensors = dict(recording.sensors)
    for name, lost in (("torso", None), ("left_forearm", gap)):
        quat_VS, mount = simulation.quat_WS[name][: len(recording)], sensors[name].stated_quat_LS
        sensors[name] = OrientationSensor(quat_VS, mount, lost)
    phases = {**recording.phases, "clasp": ((7.0, 8.5), (11.5, 13.5))}
    mixed = replace(recording, sensors=sensors, phases=phases)
    run(mixed, tmp_path / "a.mcap")
    log, causal = read_live_log(tmp_path / "a.mcap"), track(mixed, causal=True)
    assert_is_tracked_so(log, causal, track(log.recording, causal=True))
    without = track(replace(mixed, phases=recording.phases), causal=True)
    assert not np.array_equal(causal.quat_WL["right_forearm"], without.quat_WL["right_forearm"])
    run(mixed.cut(slice(0, 1230)), tmp_path / "b.mcap")  # ended within the second clasp
    ended = read_live_log(tmp_path / "b.mcap")
    assert ended.recording.phases["clasp"] == ((7.0, 8.5), (11.5, float(ended.recording.time[-1])))
    assert_is_tracked_so(ended, track(ended.recording, causal=True))
    read = log.recording.sensors["left_forearm"]
    assert isinstance(read, OrientationSensor)
    assert np.array_equal(read.gap, gap)
    assert np.array_equal(read.quat_VS[~gap], simulation.quat_WS["left_forearm"][: len(recording)][~gap])


def test_a_calibrated_subject_is_in_the_file(recording: Recording, simulation: Simulation, tmp_path: Path) -> None:
    """Mounts and their covariance decide the headings: all of their bits count."""
    order = tuple(row for segment in simulation.quat_LS for row in mount_rows(segment))
    subject = replace(
        population_subject(),
        mounts={name: Rotation.from_quat(quat).as_quat() for name, quat in simulation.quat_LS.items()},
        order=(*LENGTHS, *order),
        covariance=np.diag([1e-4 / 3.0] * len(LENGTHS) + [np.deg2rad(1.0 / 3.0) ** 2] * len(order)),
    )
    setup = live.SensorSetup.from_recording(recording, subject)
    live.run_session(ReplaySource(recording, math.inf), setup, record=tmp_path / "a.mcap")
    log = read_live_log(tmp_path / "a.mcap")
    assert len(log.quat_WL) > 1000
    (tmp_path / "subject.toml").write_text(log.header["subject"], encoding="utf-8")
    assert_is_tracked_so(log, track(log.recording, wp.load_subject(tmp_path), causal=True))
    watcher, sensors = Watcher(), {n: s for n, s in recording.sensors.items() if n != "right_forearm"}
    live.run_session(ReplaySource(first(replace(recording, sensors=sensors), 9), math.inf), setup, outputs=[watcher])
    assert "are not tracked (right forearm)" in str(watcher.statuses[0].problems)


def test_heading_resets_are_in_the_file_and_outputs_get_the_poses(recording: Recording, tmp_path: Path) -> None:
    watcher = Watcher([(7.0, Request("reset")), (10.0, Request("reset")), (14.0, Request("quit"))])
    watcher.said = "arm: hold."
    ended = run(recording, tmp_path / "a.mcap", watcher=watcher)
    log = read_live_log(tmp_path / "a.mcap")
    assert len(log.recording.resets) == watcher.resumed == 2
    assert "Tracking. arm: hold." in {status.message for status in watcher.statuses}
    again, untouched = track(log.recording, causal=True), track(recording, causal=True)
    assert_is_tracked_so(log, again)
    before = log.recording.resets[0] - log.first
    assert np.array_equal(log.quat_WL[:before, 0], untouched.quat_WL["torso"][:before])
    assert not np.array_equal(log.quat_WL[before + 5, 0], untouched.quat_WL["torso"][before + 5])
    assert ended.poses < len(untouched.time)  # q ended it
    assert watcher.statuses[-1].state == "ended"
    for pose in watcher.poses[:: len(watcher.poses) // 10]:
        k = int(np.argmin(np.abs(again.time - pose.time)))
        assert abs(again.time[k] - pose.time) < 1e-6
        for i, name in enumerate(watcher.points):
            np.testing.assert_allclose(pose.points[i], again.points[name][k], atol=1e-12)


def is_told_by_a_neighbour(quat_WL: np.ndarray, clean: TrackResult, name: str) -> bool:
    """Whether orientations (n, 4) have the tilt of the clean ones, and a heading within three of its deviations.

    Neighbours tell each other their headings, so a hurt one tells the others less.
    """
    R, R_clean = Rotation.from_quat(quat_WL), Rotation.from_quat(clean.quat_WL[name][: len(quat_WL)])
    up, up_clean = (each.inv().apply([0.0, 0.0, 1.0]) for each in (R, R_clean))
    std = np.sqrt(clean.pose.segment_cov[name][: len(quat_WL), 2, 2])
    return bool(np.abs(up - up_clean).max() < 1e-9 and np.all((R * R_clean.inv()).magnitude() < 3.0 * std))


def chaos(recording: Recording, seed: int, hurt: str) -> list[tuple[float, Samples]]:
    """Arrivals in which one sensor loses, delays, repeats and corrupts samples, and dies for four seconds."""
    rng = np.random.default_rng(seed)
    came = []
    for name in recording.sensors:
        for k, t in enumerate(recording.time):
            sample = single(recording, name, k)
            if name != hurt:
                came.append((float(t) + 0.005 + rng.exponential(0.001), sample))
                continue
            if 1200 <= k < 1600 or (k > 600 and rng.random() < 0.1):
                continue
            delay = rng.exponential(0.01) + (0.3 if rng.random() < 0.02 else 0.0)
            came.append((float(t) + delay, sample))
            if rng.random() < 0.05:
                came.append((float(t) + delay + 0.01, sample))
            if rng.random() < 0.05:
                wild = rng.choice([np.nan, np.inf, 1e30])
                came.append((float(t) + delay, sample._replace(gyro_S=sample.gyro_S * wild)))
            if rng.random() < 0.01:
                came.append((float(t) + delay, sample._replace(time=sample.time + rng.choice([1e4, -1e4, np.nan]))))
    return came


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.monte_carlo) for seed in (1, 2))])
def test_chaos_hurts_nobody_else_and_the_hurt_one_comes_back(simulation: Simulation, tmp_path: Path, seed: int) -> None:
    recording = first(simulation.recording("live"), 2400)
    hurt = list(recording.sensors)[seed + 1]
    came, watcher = chaos(recording, seed, hurt), Watcher()
    ended = run(recording, tmp_path / "a.mcap", Chaos(recording, came), watcher)
    log = read_live_log(tmp_path / "a.mcap")
    clean, again = track(recording, causal=True), track(log.recording, causal=True)
    n = len(log.quat_WL)
    assert n >= len(clean.time) - 40
    assert_is_tracked_so(log, again)  # the file decides it all
    for i, name in enumerate(recording.sensors):
        assert name == hurt or is_told_by_a_neighbour(log.quat_WL[:, i], clean, name)
    i = list(recording.sensors).index(hurt)
    off = (Rotation.from_quat(clean.quat_WL[hurt][:n]).inv() * Rotation.from_quat(log.quat_WL[:, i])).magnitude()
    assert np.degrees(off[: 1150 - log.first].max()) < 8.0  # a tenth of the samples lost, some for 50 ms and more
    # Nobody saw the four seconds; then the tilt comes back, and the heading is off by no more than is said.
    up = Rotation.from_quat(clean.quat_WL[hurt][n - 300 : n]).inv().apply([0.0, 0.0, 1.0])
    seen = Rotation.from_quat(log.quat_WL[n - 300 :, i]).inv().apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos(np.clip(np.sum(up * seen, axis=1), -1.0, 1.0)).max()) < 12.0
    std = np.sqrt(again.pose.segment_cov[hurt][:, 2, 2])
    assert std[1590 - log.first] > 1.1 * std[1000 - log.first]
    assert np.all(off[n - 300 :] < 3.0 * np.sqrt(np.trace(again.pose.segment_cov[hurt][n - 300 : n], axis1=1, axis2=2)))
    # It was shown as lost while it was, and no other ever.
    shown = [(pose.time, pose.lost) for pose in watcher.poses]
    assert all(lost[i] for t, lost in shown if recording.time[1220] < t < recording.time[1590])
    assert not any(lost[j] for _, lost in shown for j in range(len(recording.sensors)) if j != i)
    assert watcher.statuses[-2].problems == {}
    # All that was received is in the file, and ticks without a value are counted.
    with (tmp_path / "a.mcap").open("rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert sum(topic.startswith("/sensors/") for topic in topics) == len(came)
    missing = {segment: counts["missing"] for segment, counts in ended.counts.items()}
    assert missing.pop(hurt) >= 380  # four seconds, but for what interpolation covers
    assert set(missing.values()) == {0}


@pytest.mark.parametrize("method", ["amekf", pytest.param("smekf", marks=pytest.mark.slow)])
def test_a_sensor_that_freezes_is_lost_and_said_to_be(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    """It repeats itself for two seconds in motion; what is stated of it grows, as while it sends nothing."""
    monkeypatch.setattr(live.LiveLoop, "STATUS_PERIOD_S", 0.0)
    hurt, begin, end = "right_forearm", 700, 900
    recording = recording.cut(slice(0, 1150))
    sensor, row = recording.imus[hurt], np.arange(len(recording))
    row[begin:end] = begin - 1
    frozen = replace(sensor, gyro_S=sensor.gyro_S[row], accel_S=sensor.accel_S[row])
    stopped = replace(recording, sensors={**recording.sensors, hurt: frozen})
    watcher = Watcher()
    ended = run(recording, tmp_path / "a.mcap", one_by_one(stopped), watcher, method=method)
    assert ended.counts[hurt]["frozen"] == pytest.approx(end - begin, abs=10)
    assert all(count["frozen"] == 0 for name, count in ended.counts.items() if name != hurt)
    i = list(recording.sensors).index(hurt)
    while_frozen = [s for s in watcher.statuses if recording.time[begin + 10] < s.time < recording.time[end]]
    assert len(while_frozen) > 10
    assert all(status.sensors[i].frozen and status.sensors[i].lost for status in while_frozen)
    assert {status.message for status in while_frozen} == {"Repeated values from right forearm: switch it off and on."}
    assert watcher.statuses[-2].message == "Tracking."
    assert all(lost[i] for t, lost in ((pose.time, pose.lost) for pose in watcher.poses) if 7.4 < t < 8.9)
    log = read_live_log(tmp_path / "a.mcap")
    again, whole = (track(each, causal=True, method=method) for each in (log.recording, recording))
    assert_is_tracked_so(log, again)
    off = Rotation.from_quat(whole.quat_WL[hurt]).inv() * Rotation.from_quat(again.quat_WL[hurt])
    since = begin - log.first
    assert np.degrees(off[since : since + end - begin].magnitude()).max() > 20.0
    std = np.sqrt(np.linalg.eigvalsh(again.pose.segment_cov[hurt])[:, -1])
    assert np.all(off.magnitude()[since + 6 :] < 6.0 * std[since + 6 :])


def test_a_file_that_breaks_off_anywhere_is_read_up_to_there(recording: Recording, tmp_path: Path) -> None:
    whole, part, recording = tmp_path / "a.mcap", tmp_path / "part.mcap", first(recording, 1000)
    run(recording, whole)
    full, data = read_live_log(whole), whole.read_bytes()
    lengths = []
    for size in [len(data) - 1, *np.random.default_rng(0).integers(len(data) // 2, len(data), 4).tolist()]:
        part.write_bytes(data[:size])
        log = read_live_log(part)
        lengths.append(len(log.quat_WL))
        assert np.array_equal(log.quat_WL, full.quat_WL[: len(log.quat_WL)])
        assert_is_tracked_so(log, track(log.recording, causal=True))
    assert max(lengths) > 0
    part.write_bytes(data[: len(data) // 20])
    with pytest.raises(wp.BadData, match="broke off"):
        read_live_log(part)
    with pytest.raises(wp.MissingFile, match="no such file"):
        read_live_log(tmp_path / "none.mcap")
    with pytest.raises(wp.ExistingOutput, match="exists; --force"):
        run(recording, whole)
    # More is damaged than an index, which nothing of ours is read from.
    part.write_bytes(data[: len(data) // 2] + bytes(8192) + data[len(data) // 2 + 8192 :])
    (killed,) = read_live_log(part).recording.diagnostics
    assert (killed.code, killed.place) == ("file-incomplete", "part.mcap")


def test_other_programs_read_the_recording(recording: Recording, tmp_path: Path) -> None:
    """By the index that MCAP's own reader needs: JSON that its schema describes, with all bits of each sample."""
    file, recording = tmp_path / "a.mcap", first(recording, 600)
    run(recording, file)
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert {schema.encoding for schema in summary.schemas.values()} == {"jsonschema"}
        rows: dict[str, list[dict[str, Any]]] = {}
        for _, channel, message in reader.iter_messages():
            assert channel.message_encoding == "json"
            rows.setdefault(channel.topic, []).append(json.loads(message.data))
    for name, sensor in recording.imus.items():
        assert np.array_equal([row["gyro"] for row in rows[f"/sensors/{name}"]], sensor.gyro_S)
        assert np.array_equal([row["accel"] for row in rows[f"/sensors/{name}"]], sensor.accel_S)
    shown = [[row["quat_WL"][name] for name in recording.sensors] for row in rows["/pose"]]
    assert np.array_equal(shown, read_live_log(file).quat_WL)
    assert [row["kind"] for row in rows["/events"]] == ["clock", "start"]


def test_the_person_is_told_what_to_do(recording: Recording, tmp_path: Path) -> None:
    """Without a named start pose: waiting for a sensor that comes late, then hold, then ready."""
    recording, watcher = replace(recording, phases={}), Watcher()
    run(recording, tmp_path / "a.mcap", one_by_one(recording, late="right_forearm", late_by=100), watcher)
    assert [watcher.statuses[k].state for k in (0, -1)] == ["waiting", "ended"]
    assert watcher.points
    assert "right forearm" in watcher.statuses[0].message
    log = read_live_log(tmp_path / "a.mcap")
    assert_is_tracked_so(log, track(log.recording, causal=True))


@pytest.mark.parametrize("header_bytes", [0, 100_000])  # the disk is full after the header, or within it
def test_a_full_disk_ends_the_recording_and_not_the_session(recording: Recording, header_bytes: int) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    setup = live.SensorSetup.from_recording(replace(recording, name="x" * header_bytes))
    source = ReplaySource(recording, math.inf)
    watcher = Watcher()
    ended = live.run_session(source, setup, record="/dev/full", force=True, outputs=[watcher])
    assert ended.poses > 900
    assert watcher.closed
    (incomplete,) = (each for each in ended.diagnostics if each.code == "file-incomplete")
    assert "the recording ended: No space left" in str(incomplete.facts["reason"])
