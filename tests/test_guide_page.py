"""From sensors that send to tracking, in a browser: a simulated person who follows the page, in real time."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from arms import write_arm
from browser import BROWSER, Browser
from guided_person import GuidedPerson, UdpPerson, perform
from sampling import find_free_port

from wepose_pin import calibrate, load_session, load_subject, simulate_person

PERSON = 3, 45.0  # seed, and seconds that the clasp may last
LENGTHS = simulate_person(PERSON[0]).lengths
ROOT = Path(__file__).parents[1]
STEPS = ["Sensors", "Segments", "Start pose", "Clasp", "Result"]
SAID = """JSON.stringify({
  step: document.getElementById("steps").hidden ? "" : document.querySelector("#steps .now").textContent,
  says: document.querySelector("#say span").textContent,
  big: document.querySelector("#say strong").textContent,
  note: document.getElementById("note").hidden ? "" : document.getElementById("note").textContent,
  actions: [...document.querySelectorAll("#actions button")].map((button) => button.dataset.action),
  lengths: document.querySelectorAll("#lengths tr").length,
  state: window.wepose.state(),
})"""


class Reader:
    """The person in front of the page: reads it, does what it says, presses what it offers first."""

    def __init__(self, browser: Browser, person: GuidedPerson) -> None:
        self.browser, self.person = browser, person
        self.clicks: list[str] = []
        self.steps: list[str] = []

    def read(self) -> dict[str, Any]:
        """What the page says now; the person does it."""
        said = json.loads(self.browser.run(f"window.wepose ? {SAID} : ''") or "{}")
        if not said or not said["state"]:  # the page loads: the person goes on
            return {}
        step, says = said["step"], said["says"]
        shaken = says.removeprefix("Shake the sensor on the ").rstrip(".").replace(" ", "_")
        names = {"Segments": "assignment", "Clasp": "clasp", "Result": "quality"}
        self.person.follow(names.get(step, ""), shaken)
        if step and step not in self.steps:
            self.steps.append(step)
        return said

    def press(self, action: str) -> None:
        self.clicks.append(action)
        self.browser.run(f"document.querySelector('#actions [data-action={action}]').click()")

    def until(self, step: str = "", state: str = "", seconds: float = 300.0) -> dict[str, Any]:
        """Read and press until the page is at a step or in a state."""
        deadline = time.monotonic() + seconds
        pressed = {("Sensors", "guide-next"), ("Start pose", "guide-next"), ("Result", "guide-accept")}
        while time.monotonic() < deadline:
            said = self.read()
            if said and (said["step"] == step if step else said["state"] == state):
                return said
            if said and said["actions"] and (said["step"], said["actions"][0]) in pressed:
                self.press(said["actions"][0])
                while (now := self.read()) and (now["step"], now["actions"]) == (said["step"], said["actions"]):
                    time.sleep(0.1)
            time.sleep(0.1)
        raise AssertionError(f"not within {seconds:g} s: {step or state}; {self.read()}")


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_from_nothing_to_tracking_in_the_browser(tmp_path: Path) -> None:
    pytest.importorskip("daqp")
    protocol = (ROOT / "calibration" / "clasp.toml").read_text(encoding="utf-8")
    (tmp_path / "short.toml").write_text(protocol.replace("seconds = 60", "seconds = 24"), encoding="utf-8")
    receiver, port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), find_free_port()
    receiver.bind(("127.0.0.1", 0))
    follow = f'robot = "{write_arm(tmp_path).name}"\narm = "right"\nto = {receiver.getsockname()[1]}\n'
    (tmp_path / "follow.toml").write_text(follow, encoding="utf-8")
    measured = f"shoulder_width={LENGTHS['shoulder_width']}"
    command = [sys.executable, "-m", "wepose_pin", "live", "--source", f"udp:{port}", "--guide", "-o", "anna"]
    command += ["--no-open", "--protocol", "short.toml", "--measured", measured, "--robot", "follow.toml"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    run = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
    )
    assert run.stdout is not None
    url = run.stdout.readline().split()[1]
    person = GuidedPerson(perform(*PERSON))
    browser = Browser()
    try:
        with UdpPerson(person, port):
            browser.go(url)
            reader = Reader(browser, person)
            reader.until("Clasp")
            # The page is loaded again in the middle of the motion: it shows where the guide stands.
            deadline = time.monotonic() + 180.0
            while not (said := reader.read()) or not said["lengths"]:
                assert time.monotonic() < deadline, said
                time.sleep(0.2)
            browser.go(url)
            assert reader.until("Clasp")["actions"]
            reader.until("Result")
            reader.until(state="ready")
            receiver.settimeout(60.0)
            while json.loads(receiver.recv(65535))["state"] == "hold":  # the robot, until it has a pose
                pass
            assert reader.steps == STEPS
            assert reader.clicks == ["guide-next", "guide-next", "guide-accept"]
            moments = [time.monotonic()]
            for pressed in ("'true'", "null"):
                browser.run("document.querySelector('[data-action=take]').click()")
                browser.wait(f"document.querySelector('[data-action=take]')?.ariaPressed === {pressed}")
                moments.append(time.monotonic())
                time.sleep(2.0)
            assert browser.errors == []
    finally:
        browser.close()
        receiver.close()
        run.terminate()
        out, err = run.communicate(timeout=180)
    assert run.returncode == 0, err
    assert "anna/session-1.mcap" in out
    # The subject that tracking used is that of the offline calibration of the same samples.
    recording = load_session(tmp_path / "anna" / "calibration-1.mcap")
    offline = calibrate(recording, measured={"shoulder_width": LENGTHS["shoulder_width"]}).subject
    saved = load_subject(tmp_path / "anna")
    for name, metres in offline.lengths.items():
        assert saved.lengths[name] == pytest.approx(metres, abs=1e-6)
        assert abs(metres - LENGTHS[name]) < 3.0 * offline.std(name)
    # No sample was lost while the motion was evaluated.
    assert not any(sensor.gap is not None and sensor.gap.any() for sensor in recording.sensors.values())
    # The take is a phase of the recording, which tracks as it was.
    track = [sys.executable, "-m", "wepose_pin", "track", "anna/session-1.mcap", "-o", "result", "--no-report"]
    subprocess.run([*track, "--no-view"], check=True, cwd=tmp_path, env=environment, capture_output=True)
    export = [sys.executable, "-m", "wepose_pin", "export", "result", "--phase", "take_1", "-o", "take.parquet"]
    subprocess.run(export, check=True, cwd=tmp_path, env=environment, capture_output=True)
    take = pl.read_parquet(tmp_path / "take.parquet")["time"]
    assert 1.5 < take[-1] - take[0] < moments[2] - moments[0] + 0.5
    assert np.all(np.diff(take.to_numpy()) > 0.0)
