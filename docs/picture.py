"""Films the view page of a tracked circle in Chromium, for the README and the site: `python docs/picture.py`.

It simulates a person, calibrates, tracks, and writes docs/demo.webp, an animated picture that begins and ends at rest.
docs/robot.webp is view.html of `wepose retarget demo/result --robot panda_table` after the demo.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

from browser import Browser  # noqa: E402

import wepose_pin as wp  # noqa: E402

WIDTH, HEIGHT = 720, 640  # [px] of the window, with the browser's own bar
CROP = (110, 30, 690, 553)  # [px] left, top, right, bottom: the person
FPS = 12
QUALITY = 60  # of WebP
LEAD_S = 0.4  # [s] of rest shown before and after the circle
HIDE = """for (const name of ['#bar', '#head', '#angles']) document.querySelector(name).style.display = 'none';
dispatchEvent(new Event('resize'));"""


def track_circle() -> tuple[wp.TrackResult, float, float]:
    """Return the motion of a calibrated person, and when the first circle begins and ends [s]."""
    true = wp.population_subject(1.75, "f").lengths
    simulation = wp.simulate(true, seed=2, circles=1)
    recording = simulation.recording()
    calibration = wp.calibrate(recording, measured={"shoulder_width": true["shoulder_width"]})
    [(begin, end)] = recording.phases["circles"]
    return wp.track(recording, calibration), begin, end


def film(result: wp.TrackResult, begin: float, end: float) -> list[Image.Image]:
    browser = Browser(WIDTH, HEIGHT)
    try:
        with tempfile.TemporaryDirectory() as folder:
            browser.go(result.show(open=False).save(Path(folder) / "view.html").as_uri())
            browser.wait("document.querySelector('#stage canvas') !== null")
            browser.run(HIDE)
            frames = []
            for k in range(round((end - begin) * FPS)):
                browser.run(f"location.hash = 't={begin + k / FPS:.3f}'")
                browser.call(
                    "Runtime.evaluate",
                    expression="new Promise((shown) => requestAnimationFrame(() => requestAnimationFrame(shown)))",
                    awaitPromise=True,
                )
                frames.append(Image.open(io.BytesIO(browser.png())).convert("RGB").crop(CROP))
            return frames
    finally:
        browser.close()


def main() -> None:
    result, begin, end = track_circle()
    first, *others = film(result, begin - LEAD_S, end + LEAD_S)
    path = HERE / "demo.webp"
    first.save(path, save_all=True, append_images=others, duration=round(1000 / FPS), loop=0, quality=QUALITY, method=6)
    print(f"{path}: {len(others) + 1} frames, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
