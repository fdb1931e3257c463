"""The live page: what a browser gets, how fast, who else gets anything, and what it looks like."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import math
import re
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arms import write_arm
from browser import BROWSER, Browser
from listening import NO_PROC, list_listening
from sampling import wait_until
from scipy.spatial.transform import Rotation
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from wepose_pin.body import BodyModel, load_model
from wepose_pin.body.configuration import solve_configuration
from wepose_pin.body.kinematics import KinematicsSolver
from wepose_pin.body.links import compute_link_placements
from wepose_pin.errors import BadOption
from wepose_pin.live import LivePose, Request, SensorStatus, Status, StreamInfo
from wepose_pin.live.encoder import PoseEncoder, RobotFigure
from wepose_pin.live.page import LivePage
from wepose_pin.live.state import Action
from wepose_pin.retargeting import find_map, load_robot

SEGMENTS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
NARROW = "document.documentElement.scrollWidth <= innerWidth"


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return load_model()


@contextlib.contextmanager
def serve(model: BodyModel, info: StreamInfo | None = None, **options: Any) -> Iterator[LivePage]:
    """An open page."""
    page = LivePage(model, **options)
    if info is not None:
        page.start(info)
    page.open()
    yield page
    page.close()


class Person:
    """A fake loop: arms that swing, and the status of their sensors."""

    def __init__(self, model: BodyModel, segments: tuple[str, ...] = SEGMENTS) -> None:
        self._kinematics = KinematicsSolver(model, segments)
        self.info = StreamInfo(segments, self._kinematics.points, 100.0)

    def pose(self, t: float, lost: tuple[str, ...] = ()) -> LivePose:
        swing = {"torso": [0, 0, 0.2], "left_forearm": [0, -1.5, 0], "right_forearm": [0, -1.2 - 0.3 * math.sin(t), 0]}
        quat_WL = np.array(
            [Rotation.from_rotvec(swing.get(s, [0, -0.8 * math.sin(2 * t), 0])).as_quat() for s in self.info.segments]
        )
        points = self._kinematics.compute_points(quat_WL)
        gone = np.array([segment in lost for segment in self.info.segments])
        return LivePose(t, quat_WL, points, np.full(len(gone), 0.02), gone, 0.003)

    def status(self, state: str = "ready", message: str = "Tracking.", lost: tuple[str, ...] = ()) -> Status:
        sensors = tuple(
            SensorStatus(s, 99.8, s in lost, s == "torso", (0.002, -0.005, 0.0), math.nan, 3.0, 1, 2, False)
            for s in self.info.segments
        )
        actions = (Action("reset", "Reset headings", "r"),)
        return Status(state, message, 0.4, 12.0, sensors, (3.2, 8.4), 7.0, {"bad checksums": 3}, actions)


@pytest.fixture
def person(model: BodyModel) -> Person:
    return Person(model)


@pytest.fixture
def page(model: BodyModel) -> Iterator[LivePage]:
    with serve(model, title="<b>& circles") as page:
        yield page


def unpacked(model: BodyModel, frame: bytes) -> tuple[float, dict[str, np.ndarray], np.ndarray, dict[str, bool]]:
    """Time, link → (12,), hands (2, 3), link → lost."""
    links = PoseEncoder(model).links
    n = len(links)
    layout = np.dtype([("time", "<f8"), ("placed", "<f4", (n, 12)), ("hands", "<f4", (2, 3)), ("lost", "u1", n)])
    (row,) = np.frombuffer(frame, layout)
    lost = dict(zip(links, row["lost"].astype(bool).tolist(), strict=True))
    return float(row["time"]), dict(zip(links, row["placed"], strict=True)), row["hands"], lost


# What a frame holds -------------------------------------------------------------------------------------------------


def test_a_frame_places_every_link_as_the_kinematics_do(model: BodyModel, person: Person) -> None:
    encoder = PoseEncoder(model)
    encoder.start(person.info)
    pose = person.pose(0.7, lost=("left_forearm",))
    time_s, placed, hands, lost = unpacked(model, encoder.encode(pose))
    assert time_s == 0.7
    q = solve_configuration(model, {s: pose.quat_WL[k : k + 1] for k, s in enumerate(SEGMENTS)})
    for link, (quat_WL, p_WL) in compute_link_placements(model, q, encoder.links).items():
        np.testing.assert_allclose(placed[link][:9], Rotation.from_quat(quat_WL[0]).as_matrix().ravel(), atol=1e-6)
        np.testing.assert_allclose(placed[link][9:], p_WL[0], atol=1e-6)
    for k, hand in enumerate(("left_palm", "right_palm")):
        np.testing.assert_allclose(hands[k], pose.points[person.info.points.index(hand)], atol=1e-6)
    assert {link for link, gone in lost.items() if gone} == {"left_forearm", "left_hand"}  # rigid with its forearm


def test_the_n_pose_before_the_start_and_only_what_is_measured_after(model: BodyModel) -> None:
    encoder = PoseEncoder(model)
    time_s, placed, hands, lost = unpacked(model, encoder.encode(None))
    assert math.isnan(time_s)
    assert np.isnan(hands).all()
    assert not any(lost.values())
    for row in placed.values():
        np.testing.assert_allclose(row[:9], np.eye(3).ravel(), atol=1e-6)
    one_arm = Person(model, ("torso", "right_upper_arm"))
    encoder.start(one_arm.info)
    for frame in (encoder.encode(None), encoder.encode(one_arm.pose(0.3))):
        placed = unpacked(model, frame)[1]
        seen = {link for link, row in placed.items() if np.isfinite(row).all()}
        assert seen == {"torso", "pelvis", "head", "right_upper_arm"}
        assert all(np.isnan(row).all() for link, row in placed.items() if link not in seen)
    assert np.isnan(unpacked(model, encoder.encode(one_arm.pose(0.3)))[2]).all()


def test_joint_angles_are_those_of_the_poses(model: BodyModel, person: Person) -> None:
    encoder = PoseEncoder(model)
    encoder.start(person.info)
    assert encoder.take_angles() is None
    poses = [person.pose(0.01 * k) for k in range(60)]
    for pose in poses:
        encoder.show(pose)
    angles = encoder.take_angles()
    assert angles is not None
    assert encoder.take_angles() is None
    chosen = [pose for pose in poses if round(pose.time, 3) in angles["time"]]
    assert len(chosen) == len(angles["time"]) == 12  # of 100 Hz
    flexion = [
        math.degrees((Rotation.from_quat(p.quat_WL[3]).inv() * Rotation.from_quat(p.quat_WL[4])).magnitude())
        for p in chosen
    ]
    np.testing.assert_allclose(angles["joints"]["right_elbow"]["flexion"], flexion, atol=0.06)


# The server ---------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(NO_PROC, reason="reads Linux's /proc")
def test_nothing_listens_but_on_loopback() -> None:
    """In a process of its own: other tests' sockets are not this page's."""
    code = (
        "import sys\nfrom wepose_pin.live.page import LivePage\nfrom wepose_pin.live.outputs import UdpOutput\n"
        "from wepose_pin.live.terminal import TerminalView\nfrom wepose_pin.body import load_model\n"
        "page, out, view = LivePage(load_model()), UdpOutput('127.0.0.1:9'), TerminalView()\n"
        "page.open()\nprint(page.url, flush=True)\nsys.stdin.read()\npage.close()\nout.close()\n"
    )
    run = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert run.stdin is not None
    assert run.stdout is not None
    assert run.stdout.readline().startswith("http://127.0.0.1:")
    # A socket that only sends is 0.0.0.0:0 until it has; ours has not and is not in the table.
    assert list_listening(run.pid) == {"127.0.0.1"}
    run.communicate("", timeout=30)
    assert run.returncode == 0


def get(url: str, **headers: str) -> tuple[int, Any, str]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers, error.read().decode()


def test_the_page_may_do_nothing_but_its_own(page: LivePage) -> None:
    code, headers, text = get(page.url)
    assert code == 200
    assert "<h1>&lt;b&gt;&amp; circles</h1>" in text
    policy = dict(part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    assert all(source.startswith("'sha256-") for source in policy["script-src"].split())
    assert policy["connect-src"] == page.url.replace("http", "ws").rstrip("/")
    assert headers["Cache-Control"] == "no-store"
    for host in ("localhost:8080", "127.0.0.1"):
        code, headers, _ = get(page.url, Host=host)
        assert code == 200
        assert f"connect-src ws://{host};" in headers["Content-Security-Policy"]


@pytest.mark.parametrize("path", ["", "stream"])
@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:80", "127.0.0.1; script-src *", "[::1%25x]"])
def test_a_foreign_name_gets_nothing(page: LivePage, path: str, host: str) -> None:
    code, _, text = get(page.url + path, Host=host)
    assert code in (400, 403)  # 400: tornado itself finds it no host
    assert "WebGL" not in text


def talk(page: LivePage, do: Callable[[WebSocketClientConnection], Awaitable[Any]]) -> Any:
    """What `do` gives, with a connection as the page opens it."""

    async def connected() -> Any:
        address, own = page.url.replace("http", "ws") + "stream", {"Origin": page.url.rstrip("/")}
        connection = await websocket_connect(HTTPRequest(address, headers=own))
        try:
            return await do(connection)
        finally:
            connection.close()
            with contextlib.suppress(TimeoutError):  # one that was told of the end waits for another in vain
                async with asyncio.timeout(0.5):
                    while await connection.read_message() is not None:
                        pass

    return asyncio.run(connected())


def test_another_address_than_loopback_needs_the_token(model: BodyModel) -> None:
    with serve(model, host="127.0.0.2") as page:
        address, _, token = page.url.partition("?token=")
        assert len(token) > 20
        for wrong in ("", "?token=", f"?token={token[:-1]}", f"?other={token}"):
            for path in ("", "stream"):
                code, _, text = get(f"{address}{path}{wrong}")
                assert (code, text) == (403, "The address of this page has a token, as the terminal shows it.")
        assert get(page.url)[0] == 200
        assert get(f"{address}?token={token}", Origin="http://evil.example")[0] == 403


def test_another_body_is_another_page(page: LivePage, model: BodyModel, tmp_path: Path) -> None:
    robot = load_robot(find_map(str(write_arm(tmp_path))))
    first = get(page.url)[2]

    async def watch(connection: WebSocketClientConnection) -> None:
        before = json.loads(await taken(connection))["id"]
        page.set_body(model, RobotFigure(robot, model, lambda: None))
        while True:
            message = await taken(connection)
            if isinstance(message, str) and "id" in json.loads(message):
                assert json.loads(message)["id"] != before
                return

    talk(page, watch)
    second = get(page.url)[2]
    pattern = r'<script id="wepose-data" type="application/json">(.*?)</script>'
    links = [json.loads(re.findall(pattern, text, re.DOTALL)[0])["links"] for text in (first, second)]
    assert [link for link in links[1] if link.startswith("robot ")] == links[1][len(links[0]) :] != []


async def taken(connection: WebSocketClientConnection) -> Any:
    message = await asyncio.wait_for(connection.read_message(), 60.0)
    await connection.write_message("taken")
    return message


def test_a_foreign_origin_gets_no_poses(page: LivePage) -> None:
    own = page.url.rstrip("/")
    foreign = ("http://evil.example", "null", own.replace("http", "https"), "http://localhost")
    for origin, code in ((own, 101), *((each, 403) for each in foreign)):
        connection = http.client.HTTPConnection(own.removeprefix("http://"), timeout=60)
        upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        connection.request("GET", "/stream", headers=upgrade | {"Sec-WebSocket-Key": "A" * 22 + "==", "Origin": origin})
        assert connection.sock.recv(12).decode() == f"HTTP/1.1 {code}", origin
        connection.close()


def test_who_does_not_take_gets_no_more_and_then_the_newest(page: LivePage, person: Person, model: BodyModel) -> None:
    page.start(person.info)

    async def slow(connection: WebSocketClientConnection) -> None:
        assert "id" in json.loads(await taken(connection))
        page.show(person.pose(1.0))
        while unpacked(model, await taken(connection))[0] != 1.0:
            pass  # the N-pose that was there before
        page.show(person.pose(2.0))
        assert unpacked(model, await asyncio.wait_for(connection.read_message(), 60.0))[0] == 2.0
        for k in range(200):  # and it does not say that it has drawn that
            page.show(person.pose(3.0 + k))
            if k % 10 == 0:
                page.status(person.status())
            await asyncio.sleep(0.002)
        waiting = asyncio.ensure_future(connection.read_message())
        assert not (await asyncio.wait([waiting], timeout=0.3))[0]
        await connection.write_message("taken")
        messages = [await asyncio.wait_for(waiting, 60.0)]
        while not isinstance(messages[-1], bytes):
            messages.append(await taken(connection))
        assert unpacked(model, messages[-1])[0] == 202.0
        assert [json.loads(message)["state"] for message in messages[:-1]] == ["ready"]

    talk(page, slow)


def test_keys_and_nonsense(page: LivePage) -> None:
    async def press(connection: WebSocketClientConnection) -> None:
        reset, quit_, nameless = '{"action": "reset"}', '{"action": "quit"}', '{"action": "text", "text": "\\u0000"}'
        for message in (reset, quit_, "reset", "{}", "[1]", "1", nameless, b"\xff\x00", "taken", "taken", "taken"):
            await connection.write_message(message, binary=isinstance(message, bytes))
        for _ in range(100):
            await connection.write_message('{"action": "text", "text": "trial 3"}')
        await connection.write_message("x" * 100_000)  # too long: that browser is shown the door
        while await connection.read_message() is not None:
            pass

    talk(page, press)
    asked = page.take_requests()
    assert asked == [Request("text", "trial 3")] * 16  # the newest; what came before is dropped
    assert page.take_requests() == []
    assert get(page.url)[0] == 200


def test_the_end_reaches_the_browser(model: BodyModel, person: Person) -> None:
    page = LivePage(model)
    page.start(person.info)
    page.open()

    async def wait(connection: WebSocketClientConnection) -> list[Any]:
        messages = [await taken(connection), await taken(connection)]
        page.status(person.status("ended", "The session has ended."))
        closing = asyncio.get_running_loop().run_in_executor(None, page.close)
        while (message := await connection.read_message()) is not None:
            messages.append(message)
        await closing
        return messages

    port = int(page.url.split(":")[2].strip("/"))
    messages = talk(page, wait)
    assert json.loads(messages[-1])["state"] == "ended"
    page.close()
    with serve(model, port=port) as again:  # the port is free at once
        assert get(again.url)[0] == 200


def test_addresses_that_cannot_be(model: BodyModel, page: LivePage) -> None:
    port = int(page.url.split(":")[2].strip("/"))
    with pytest.raises(BadOption, match=rf"cannot listen on 127.0.0.1:{port}: .*in use"):
        LivePage(model, port=port).open()
    with pytest.raises(BadOption, match=r"cannot listen on 203\.0\.113\.9:0"):
        LivePage(model, host="203.0.113.9").open()
    with pytest.raises(BadOption, match="an address and a port from 1 to 65535"):
        LivePage(model, host="").open()
    with pytest.raises(BadOption, match=r"127\.0\.0\.1:99999: an address and a port"):
        LivePage(model, port=99999).open()


# In the browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if BROWSER is None:
        pytest.skip("no chromium or google-chrome")
    browser = Browser(1200, 700)
    yield browser
    browser.close()


def region(picture: np.ndarray, box: dict[str, float]) -> np.ndarray:
    top, left = round(box["y"]), round(box["x"])
    return picture[top : top + round(box["height"]), left : left + round(box["width"])]


def find_change(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(height, width) bool: the pixels that differ."""
    return np.asarray(np.abs(before - after).max(axis=2) > 40)


def wait_for_picture(
    browser: Browser, box: dict[str, float], is_drawn: Callable[[np.ndarray], object], seconds: float = 60.0
) -> np.ndarray:
    """(height, width, 3): a part of the page, as soon as it looks so and does not change any more."""
    deadline, before = time.monotonic() + seconds, np.zeros(0)
    while True:
        image = region(browser.picture(), box)
        if is_drawn(image) and np.array_equal(image, before):
            return image
        assert time.monotonic() < deadline
        before = image


def box_of(browser: Browser, element: str) -> dict[str, float]:
    return dict(browser.run(f"document.querySelector('{element}').getBoundingClientRect().toJSON()"))


def test_the_start_and_the_motion_in_light_and_dark(model: BodyModel, person: Person, browser: Browser) -> None:
    with serve(model, title="circles") as page:
        browser.errors.clear()
        browser.emulate(prefers_color_scheme="light")
        browser.go(page.url)
        page.status(person.status("start_pose", "Stand upright and still: 2 s more."))
        browser.wait("window.wepose.state() === 'start_pose' && window.wepose.frames() > 0")
        words = box_of(browser, "#say strong")
        assert words["height"] > 40  # readable from where the person stands
        assert box_of(browser, "#stage")["bottom"] <= box_of(browser, "#say")["top"] + 1  # and hides no arm
        page.status(person.status("moved", "You moved (torso). Once more."))
        browser.wait("document.querySelector('#say.moved span')?.textContent.includes('Once more')")

        assert browser.run("document.querySelector('#rows tr').innerText").split()[1:3] == ["there", "100"]
        page.start(person.info)
        page.status(person.status(lost=("left_forearm",), message="No samples from left forearm."))
        page.show(person.pose(0.2, lost=("left_forearm",)))
        browser.wait("window.wepose.time() === 0.2 && window.wepose.state() === 'ready'")
        assert browser.run(NARROW)
        rows = browser.run(
            "[...document.querySelectorAll('#rows tr')].map((row) => row.innerText.replace(/\\s+/g, ' '))"
        )
        assert rows[0] == "torso static 100 3"
        assert rows[2].startswith("left forearm lost")
        browser.run("document.querySelector('#details').click()")
        row = browser.run("document.querySelector('#rows tr').innerText.replace(/\\s+/g, ' ')")
        assert row == "torso static 100 0.11 −0.29 0.00 – 3 s 3"
        assert browser.run(NARROW)
        assert "bad checksums: 3" in browser.run("document.body.innerText")
        stage, dark = box_of(browser, "#stage canvas"), {"light": False, "dark": True}
        for scheme, is_dark in dark.items():
            browser.emulate(prefers_color_scheme=scheme)
            page.show(person.pose(2.2 if is_dark else 0.2, lost=("left_forearm",)))
            browser.wait(f"window.wepose.time() === {2.2 if is_dark else 0.2}")
            before = wait_for_picture(browser, stage, lambda image: (image[-40:, -40:].mean() < 70) == is_dark)  # noqa: B023
            page.show(person.pose(2.9 if is_dark else 0.9, lost=("left_forearm",)))
            after = wait_for_picture(browser, stage, lambda image: find_change(before, image).mean() > 0.005)  # noqa: B023
            rows, columns = np.nonzero(find_change(before, after))
            height, width = after.shape[:2]
            assert 0.2 * width < columns.mean() < 0.8 * width
            assert 0.2 * height < rows.mean() < 0.9 * height

        browser.call("Input.dispatchKeyEvent", type="keyDown", key="r", text="r")
        browser.wait("document.querySelector('#answer').textContent.length > 0")
        wait_until(lambda: page.requests)
        assert page.take_requests() == [Request("reset")]
        assert browser.errors == []


def test_it_says_that_the_connection_is_lost_and_comes_back(model: BodyModel, person: Person, browser: Browser) -> None:
    browser.emulate(prefers_color_scheme="light")
    page = LivePage(model)
    page.start(person.info)
    page.open()
    port = int(page.url.split(":")[2].strip("/"))
    browser.go(page.url)
    page.show(person.pose(1.0))
    page.status(person.status())
    browser.wait("window.wepose.time() === 1 && window.wepose.state() === 'ready'")
    page.close()
    assert "Connection lost" in browser.wait("document.querySelector('#offline:not([hidden])')?.textContent")
    with serve(model, person.info, port=port) as again:
        again.show(person.pose(2.0))
        again.status(person.status("ended", "The session has ended."))
        browser.wait("window.wepose.time() === 2 && document.querySelector('#offline').hidden")
        browser.wait("window.wepose.state() === 'ended'")
    assert "session has ended" in browser.wait("document.querySelector('#offline:not([hidden])')?.textContent")
