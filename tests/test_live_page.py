"""The live page: what a browser gets, how fast, who else gets anything, and what it looks like."""

import asyncio
import contextlib
import http.client
import json
import math
import socket
import struct
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, Browser
from sampling import wait_until
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

import wepose_pin as wp
from wepose_pin import Simulation
from wepose_pin.live import LivePose, Request, SensorStatus, Status, StreamInfo
from wepose_pin.live.page import LivePage
from wepose_pin.live.state import Action

NARROW = "document.documentElement.scrollWidth <= innerWidth"


@contextlib.contextmanager
def serve(info: StreamInfo | None = None, **options: Any) -> Iterator[LivePage]:
    """An open page."""
    page = LivePage(wp.load_model(), **options)
    if info is not None:
        page.start(info)
    page.open()
    yield page
    page.close()


class Person:
    """A loop that shows a simulated motion, and the status of the sensors."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.info = StreamInfo(tuple(simulation.quat_WL), tuple(simulation.points), simulation.rate_hz)

    def pose(self, t: float, lost: tuple[str, ...] = ()) -> LivePose:
        """That of ten seconds later, in which the arms move."""
        k, simulation = round((t + 10.0) * self.simulation.rate_hz), self.simulation
        quat, points = (np.array([v[k] for v in each.values()]) for each in (simulation.quat_WL, simulation.points))
        gone = np.array([segment in lost for segment in self.info.segments])
        return LivePose(t, quat, points, np.full(len(gone), 0.02), gone, 0.003)

    def status(self, state: str = "ready", message: str = "Tracking.", lost: tuple[str, ...] = ()) -> Status:
        sensors = tuple(
            SensorStatus(s, 99.8, s in lost, s == "torso", (0.002, -0.005, 0.0), math.nan, 3, False)
            for s in self.info.segments
        )
        actions = (Action("reset", "Reset headings", "r"),)
        return Status(state, message, 0.4, 12.0, sensors, (3.2, 8.4), 7.0, {"bad checksums": 3}, actions)


@pytest.fixture
def motion(simulation: Simulation) -> Person:
    return Person(simulation)


@pytest.fixture
def page() -> Iterator[LivePage]:
    with serve(title="<b>& circles") as page:
        yield page


def time_of(frame: bytes) -> float:
    return float(struct.unpack_from("<d", frame)[0])


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
    assert "default-src 'none'; script-src 'unsafe-inline'; " in text
    assert "connect-src 'self'; base-uri 'none'; form-action 'none'\">" in text
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Cache-Control"] == "no-store"
    with pytest.raises(OSError):  # nothing listens on another address, loopback or not  # noqa: PT011
        socket.create_connection(("127.0.0.2", int(page.url.split(":")[2].strip("/"))), timeout=5.0).close()
    for host in ("localhost:8080", "127.0.0.1"):
        assert get(page.url, Host=host)[0] == 200


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


def test_another_address_than_loopback_needs_the_token() -> None:
    with serve(host="127.0.0.2") as page:
        address, _, token = page.url.partition("?token=")
        assert len(token) > 20
        for wrong in ("", "?token=", f"?token={token[:-1]}", f"?other={token}"):
            for path in ("", "stream"):
                code, _, text = get(f"{address}{path}{wrong}")
                assert (code, text) == (403, "The address of this page has a token, as the terminal shows it.")
        assert get(page.url)[0] == 200


def test_another_body_is_another_page(page: LivePage) -> None:
    async def watch(connection: WebSocketClientConnection) -> list[str]:
        first = json.loads(await taken(connection))["id"]
        page.set_body(wp.load_model(lengths={"left_forearm": 0.3}))
        while True:
            message = await taken(connection)
            if isinstance(message, str) and "id" in json.loads(message):
                return [first, json.loads(message)["id"]]

    before = get(page.url)[2]
    first, second = talk(page, watch)
    assert first != second
    assert get(page.url)[2] != before


async def taken(connection: WebSocketClientConnection) -> Any:
    message = await asyncio.wait_for(connection.read_message(), 60.0)
    await connection.write_message("taken")
    return message


def test_a_foreign_origin_gets_no_poses(page: LivePage) -> None:
    own = page.url.rstrip("/")
    foreign = ("http://evil.example", "null", "http://localhost")
    for origin, code in ((own, 101), *((each, 403) for each in foreign)):
        connection = http.client.HTTPConnection(own.removeprefix("http://"), timeout=60)
        upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        connection.request("GET", "/stream", headers=upgrade | {"Sec-WebSocket-Key": "A" * 22 + "==", "Origin": origin})
        assert connection.sock.recv(12).decode() == f"HTTP/1.1 {code}", origin
        connection.close()


def test_who_does_not_take_gets_no_more_and_then_the_newest(page: LivePage, motion: Person) -> None:
    page.start(motion.info)

    async def slow(connection: WebSocketClientConnection) -> None:
        assert "id" in json.loads(await taken(connection))
        page.show(motion.pose(1.0))
        while time_of(await taken(connection)) != 1.0:
            pass  # the N-pose that was there before
        page.show(motion.pose(2.0))
        assert time_of(await asyncio.wait_for(connection.read_message(), 60.0)) == 2.0
        for k in range(200):  # and it does not say that it has drawn that
            page.show(motion.pose(3.0 + 0.1 * k))
            if k % 10 == 0:
                page.status(motion.status())
            await asyncio.sleep(0.002)
        waiting = asyncio.ensure_future(connection.read_message())
        assert not (await asyncio.wait([waiting], timeout=0.3))[0]
        await connection.write_message("taken")
        messages = [await asyncio.wait_for(waiting, 60.0)]
        while not isinstance(messages[-1], bytes):
            messages.append(await taken(connection))
        assert time_of(messages[-1]) == 3.0 + 0.1 * 199
        (status,) = (json.loads(message) for message in messages[:-1])
        assert status["state"] == "ready"

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


def test_the_end_reaches_the_browser(motion: Person) -> None:
    page = LivePage(wp.load_model())
    page.start(motion.info)
    page.open()

    async def wait(connection: WebSocketClientConnection) -> list[Any]:
        messages = [await taken(connection), await taken(connection)]
        page.status(motion.status("ended", "The session has ended."))
        closing = asyncio.get_running_loop().run_in_executor(None, page.close)
        while (message := await connection.read_message()) is not None:
            messages.append(message)
        await closing
        return messages

    port = int(page.url.split(":")[2].strip("/"))
    assert json.loads(talk(page, wait)[-1])["state"] == "ended"
    with serve(port=port) as again:  # the port is free at once
        assert get(again.url)[0] == 200


def test_addresses_that_cannot_be(page: LivePage) -> None:
    port = int(page.url.split(":")[2].strip("/"))
    for options, says in (
        ({"port": port}, rf"cannot listen on 127.0.0.1:{port}: .*in use"),
        ({"host": "203.0.113.9"}, r"cannot listen on 203\.0\.113\.9:0"),
        ({"host": ""}, "an address and a port from 1 to 65535"),
    ):
        with pytest.raises(wp.BadOption, match=says):
            LivePage(wp.load_model(), **options).open()


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


def test_the_start_and_the_motion_in_light_and_dark(motion: Person, browser: Browser) -> None:
    with serve(title="circles") as page:
        browser.errors.clear()
        browser.emulate(prefers_color_scheme="light")
        browser.go(page.url)
        page.status(motion.status("start_pose", "Stand upright and still: 2 s more."))
        browser.wait("window.wepose.state() === 'start_pose' && window.wepose.frames() > 0")
        words = box_of(browser, "#say strong")
        assert words["height"] > 40  # readable from where the person stands
        assert box_of(browser, "#stage")["bottom"] <= box_of(browser, "#say")["top"] + 1  # and hides no arm
        page.status(motion.status("moved", "You moved (torso). Once more."))
        browser.wait("document.querySelector('#say.moved span')?.textContent.includes('Once more')")

        assert browser.run("document.querySelector('#rows tr').innerText").split()[1:3] == ["there", "100"]
        page.start(motion.info)
        page.status(motion.status(lost=("left_forearm",), message="No samples from left forearm."))
        page.show(motion.pose(0.2, lost=("left_forearm",)))
        browser.wait("window.wepose.time() === 0.2 && window.wepose.state() === 'ready'")
        assert browser.run(NARROW)
        rows = browser.run(
            "[...document.querySelectorAll('#rows tr')].map((row) => row.innerText.replace(/\\s+/g, ' '))"
        )
        assert rows[0] == "torso static 100 3"
        assert rows[2].startswith("left forearm lost")
        browser.run("document.querySelector('#details').click()")
        row = browser.run("document.querySelector('#rows tr').innerText.replace(/\\s+/g, ' ')")
        assert row == "torso static 100 0.11 −0.29 0.00 – 3"
        assert browser.run(NARROW)
        assert "bad checksums: 3" in browser.run("document.body.innerText")
        stage, dark = box_of(browser, "#stage canvas"), {"light": False, "dark": True}
        for scheme, is_dark in dark.items():
            browser.emulate(prefers_color_scheme=scheme)
            page.show(motion.pose(2.2 if is_dark else 0.2, lost=("left_forearm",)))
            browser.wait(f"window.wepose.time() === {2.2 if is_dark else 0.2}")
            before = wait_for_picture(browser, stage, lambda image: (image[-40:, -40:].mean() < 70) == is_dark)  # noqa: B023
            page.show(motion.pose(2.9 if is_dark else 0.9, lost=("left_forearm",)))
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


def test_it_says_that_the_connection_is_lost_and_comes_back(motion: Person, browser: Browser) -> None:
    browser.emulate(prefers_color_scheme="light")
    page = LivePage(wp.load_model())
    page.start(motion.info)
    page.open()
    port = int(page.url.split(":")[2].strip("/"))
    browser.go(page.url)
    page.show(motion.pose(1.0))
    page.status(motion.status())
    browser.wait("window.wepose.time() === 1 && window.wepose.state() === 'ready'")
    page.close()
    assert "Connection lost" in browser.wait("document.querySelector('#offline:not([hidden])')?.textContent")
    with serve(motion.info, port=port) as again:
        again.show(motion.pose(2.0))
        again.status(motion.status("ended", "The session has ended."))
        browser.wait("window.wepose.time() === 2 && document.querySelector('#offline').hidden")
        browser.wait("window.wepose.state() === 'ended'")
    assert "session has ended" in browser.wait("document.querySelector('#offline:not([hidden])')?.textContent")
