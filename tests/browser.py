"""Headless Chromium in real time, for pages that talk to a server: steered through pipes, so nothing listens."""

import base64
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
OPTIONS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --remote-debugging-pipe "
    "--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
)


class Browser:
    """One tab, of a browser that ends with it."""

    def __init__(self, width: int = 1200, height: int = 760) -> None:
        assert BROWSER is not None
        self.errors: list[str] = []  # of the console, and what the page's policy refused
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        read, self._out = os.pipe()
        self._in, write = os.pipe()
        command = f'exec "$0" "$@" 3<&{read} 4>&{write}'  # the descriptors that Chromium looks at
        options = [*OPTIONS.split(), f"--window-size={width},{height}", f"--user-data-dir={self._profile.name}"]
        self._process = subprocess.Popen(
            ["bash", "-c", command, BROWSER, *options],
            pass_fds=(read, write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read)
        os.close(write)
        self._rest, self._number, self._session = b"", 0, None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, timeout_s: float = 60.0, **parameters: Any) -> dict[str, Any]:
        """The answer of the DevTools protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + timeout_s
        while True:
            while b"\0" not in self._rest:
                left = until - time.monotonic()
                assert left > 0, f"{method}: no answer"
                if select.select([self._in], [], [], left)[0]:
                    got = os.read(self._in, 1 << 20)
                    assert got, f"{method}: the browser is gone"
                    self._rest += got
            one, self._rest = self._rest.split(b"\0", 1)
            answer = json.loads(one)
            if answer.get("id") == self._number:
                if "navigated" in answer.get("error", {}).get("message", ""):  # the page loads anew: it gives nothing
                    return {"result": {}}
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        if event.get("method") == "Log.entryAdded" and event["params"]["entry"]["level"] == "error":
            self.errors.append(event["params"]["entry"]["text"])
        elif event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(event["params"]["exceptionDetails"]))

    def go(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def run(self, script: str) -> Any:
        """What an expression of the page's gives."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait(self, script: str, seconds: float = 120.0, meanwhile: Callable[[], None] = lambda: None) -> Any:
        """What an expression gives as soon as it is true."""
        until = time.monotonic() + seconds
        while not (value := self.run(f"(() => {{ try {{ return {script} }} catch {{ return null }} }})()")):
            assert time.monotonic() < until, f"not within {seconds:g} s: {script}; {self.errors}"
            meanwhile()
            time.sleep(0.05)
        return value

    def emulate(self, media: str = "", **features: str) -> None:
        """Another medium, or what the user prefers: ``prefers_color_scheme="dark"``."""
        wanted = [{"name": name.replace("_", "-"), "value": value} for name, value in features.items()]
        self.call("Emulation.setEmulatedMedia", media=media, features=wanted)

    def picture(self) -> np.ndarray:
        """(height, width, 3) float, 0 to 255: what is seen now."""
        return pixels(self.png())

    def png(self) -> bytes:
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(20)
        os.close(self._in)
        os.close(self._out)
        self._profile.cleanup()


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=float)
