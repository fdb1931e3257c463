"""The page: whole in itself, made without a server, true to the motion it was given."""

import base64
import html.parser
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin.body import Visual, load_model
from wepose_pin.report.viewer import (
    LEFT_COLOUR,
    OTHER_COLOUR,
    RIGHT_COLOUR,
    Trail,
    choose_trail_colour,
    frame_indices,
    view_html,
)

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
ORANGE, BLUE = (1.0, 0.5, 0.0, 1.0), (0.0, 0.2, 1.0, 1.0)


def visual(link, kind="sphere", size=(0.1,), rgba=ORANGE):
    return Visual(link, kind, size, UPRIGHT, np.array([0.0, 0.0, -0.1]), rgba)


VISUALS = [
    visual("torso", "box", (0.2, 0.3, 0.5)),
    visual("left_forearm", "cylinder", (0.04, 0.27)),
    visual("left_forearm", "sphere", (0.04,)),
    visual("right_forearm", "cylinder", (0.04, 0.27), BLUE),
]


def motion(time, links, seed=0):
    rng = np.random.default_rng(seed)
    n = len(time)
    return {link: (Rotation.random(n, rng=rng).as_quat(), rng.normal(size=(n, 3))) for link in links}


@pytest.fixture
def recording():
    time = 1.7e9 + np.arange(400) / 100.0  # seconds since 1970: float32 could not tell the samples apart
    placements = motion(time, ["torso", "left_forearm", "right_forearm"])
    return time, placements


class Page(html.parser.HTMLParser):
    """The elements with their attributes, and the text of each kind of element."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.text, self._open = [], {}, ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.elements.append((tag, attributes))
        self._open = attributes.get("id") or tag

    def handle_endtag(self, _tag):
        self._open = ""

    def handle_data(self, data):
        self.text[self._open] = self.text.get(self._open, "") + data


def data_of(page):
    return json.loads(Page(page).text["wepose-data"])


def floats(text, *shape):
    return np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(shape)


def test_page_loads_nothing_from_outside(recording):
    page = Page(view_html(VISUALS, *recording))
    for tag, attributes in page.elements:
        for name in ("src", "href", "action", "data", "poster", "srcset"):
            assert name not in attributes, f"<{tag} {name}={attributes.get(name)}>"
    assert not re.search(r"@import|url\(", page.text["style"])
    policy = next(a["content"] for _, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy
    assert "http" not in policy


def test_meshcats_python_side_is_not_loaded():
    code = "import sys, wepose_pin.report.viewer as v; v.view_html([], [0.0], {}); sys.exit('meshcat' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_page_holds_the_motion_and_the_angles(recording):
    time, placements = recording
    data = data_of(view_html(VISUALS, time, placements, angles={"elbow flexion": np.arange(400.0)}))
    assert data["begin"] == time[0]
    np.testing.assert_allclose(floats(data["offsets"], -1), time - time[0], atol=1e-6)
    moved = floats(data["motion"], len(data["links"]), 400, 7)
    for k, link in enumerate(data["links"]):
        quat_WL, p_WL = placements[link]
        np.testing.assert_allclose(moved[k, :, :4], quat_WL, atol=1e-6)
        np.testing.assert_allclose(moved[k, :, 4:], p_WL, atol=1e-6)
    (angle,) = data["angles"]
    assert angle["name"] == "elbow flexion"
    np.testing.assert_array_equal(floats(angle["values"], -1), np.arange(400.0))


@pytest.mark.parametrize("rate_hz", [10.0, 30.0, 59.9, 1000.0])
def test_decimation_never_makes_up_a_frame(rate_hz):
    time = 5.0 + np.arange(200) / rate_hz
    frames = frame_indices(time, 30.0)
    assert frames[0] == 0
    assert frames[-1] == 199
    assert (np.diff(frames) > 0).all()
    if rate_hz <= 30.0:
        np.testing.assert_array_equal(frames, np.arange(200))
    else:
        clock = np.arange(time[0], time[-1], 1 / 30.0)
        assert np.abs(time[frames][: len(clock)] - clock).max() <= 0.5 / rate_hz + 1e-9


def test_link_without_placement_is_left_out(recording):
    time, placements = recording
    del placements["right_forearm"]
    data = data_of(view_html(VISUALS, time, placements))
    assert data["links"] == ["torso", "left_forearm"]
    assert [part["link"] for part in data["scene"]["parts"]] == [0, 1, 1]


def test_text_from_outside_stays_text(recording):
    time, placements = recording
    nasty = "</script><script>alert(1)</script>@@data@@ <b>&"
    page = view_html(VISUALS, time, placements, title=nasty, phases={nasty: [(time[0], time[9])]})
    parsed = Page(page)
    assert parsed.text["title"] == nasty
    assert parsed.text["h1"] == nasty
    assert not any(tag == "b" for tag, _ in parsed.elements)
    assert sum(tag == "script" for tag, _ in parsed.elements) == 3
    assert data_of(page)["phases"] == [{"name": nasty, "spans": [[time[0], time[9]]]}]
    assert view_html(VISUALS, time, placements, title=nasty, phases={nasty: [(time[0], time[9])]}) == page


def test_trails_keep_gaps_and_their_colour(recording):
    time, placements = recording
    hand = np.ones((len(time), 3))
    hand[50:60] = np.nan
    trails = {"left_palm": Trail(hand, "#ff8000"), "nose": Trail(hand, "#0033ff")}
    left, nose = data_of(view_html(VISUALS, time, placements, trails=trails))["trails"]
    np.testing.assert_array_equal(floats(left["points"], -1, 3), hand)
    assert (left["name"], left["colour"], nose["colour"]) == ("left_palm", "#ff8000", "#0033ff")


def test_a_trail_has_the_colour_of_its_side():
    model = load_model()
    colours = [choose_trail_colour(point, model) for point in ("left_palm", "right_palm", "neck")]
    assert colours == [LEFT_COLOUR, RIGHT_COLOUR, OTHER_COLOUR]


def test_camera_sees_every_visual():
    """A link far to the side moves the outermost points there."""
    time = np.array([0.0])
    for offset in ([0.0, 0.0, 3.0], [-2.0, 4.0, 0.0]):
        data = data_of(view_html([visual("torso")], time, {"torso": (UPRIGHT[None], np.array([offset]))}))
        points, centre = np.array(data["view"]["points"]), np.add(offset, [0.0, 0.0, -0.1])
        assert (points.max(axis=0) >= np.maximum(centre + 0.1, 0.0) - 1e-3).all()  # from the root to beyond the ball
        assert (points.min(axis=0) <= np.minimum(centre - 0.1, 0.0) + 1e-3).all()


@pytest.mark.parametrize("n", [1, 2])
def test_shortest_recordings_and_nothing_to_see(n):
    time = np.arange(n) / 100.0
    assert floats(data_of(view_html([], time, {}))["offsets"], -1).shape == (n,)
    unknown = {"torso": (np.full((n, 4), np.nan), np.full((n, 3), np.nan))}
    assert data_of(view_html(VISUALS, time, unknown))["links"] == ["torso"]
