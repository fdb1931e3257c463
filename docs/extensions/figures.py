"""Draws the package's own figure in the N-pose, with its sensors, from the body's URDF: generated/straps.svg."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from sphinx.application import Sphinx

import wepose_pin as wp
from wepose_pin.kinematics import compute_link_placements, solve_configuration
from wepose_pin.model import Visual

SCALE = 570.0  # [px/m]
SENSOR_COLOUR, SENSOR_EDGE = "#c81e4a", "#7d0f2c"
DARK = 0.13  # red of a visual's colour below which it is a sensor: URDF draws them nearly black
AXES = {"x": ("#c62828", (1.0, 0.0, 0.0)), "y": ("#2e7d32", (0.0, 1.0, 0.0)), "z": ("#1565c0", (0.0, 0.0, 1.0))}


class View(NamedTuple):
    """A direction from which the body is seen, orthographically."""

    title: str
    right_W: tuple[float, float, float]
    toward_W: tuple[float, float, float]  # to whoever looks
    centre_x: float  # [px]

    def project(self, points_W: np.ndarray) -> np.ndarray:
        """Points (n, 3) [m] in W → (n, 2) [px], y downwards, and depth (n,) [m]."""
        across = points_W @ np.array(self.right_W)
        return np.column_stack([self.centre_x + SCALE * across, 515.0 - SCALE * points_W[:, 2]])

    def depth(self, points_W: np.ndarray) -> np.ndarray:
        return points_W @ np.array(self.toward_W)


class Label(NamedTuple):
    """Words beside a point [m] in W, at a place [px] of the drawing."""

    point_W: tuple[float, float, float]
    x: float
    y: float
    lines: tuple[str, ...]
    anchor: str


FRONT = View("from the front", (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), 325.0)
SIDE = View("from the right", (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), 800.0)


def sample_surface(visual: Visual) -> np.ndarray:
    """(n, 3) [m] in the visual's frame: points whose hull is the shape."""
    if visual.kind == "box":
        return np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * visual.size
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle]) * visual.size[0]
    if visual.kind == "cylinder":
        return np.concatenate([ring + [0.0, 0.0, 0.5 * s * visual.size[1]] for s in (-1.0, 1.0)])
    return np.concatenate([Rotation.from_euler("y", tilt).apply(ring) for tilt in np.linspace(0.0, np.pi, 9)[:-1]])


def draw_body(view: View) -> list[str]:
    model = wp.load_model()
    q = solve_configuration(model, {segment: np.array([[0.0, 0.0, 0.0, 1.0]]) for segment in model.chains})
    placements = compute_link_placements(model, q, dict.fromkeys(visual.link for visual in model.visuals))
    parts = []
    for visual in model.visuals:
        quat_WL, p_WL = placements[visual.link]
        points_L = Rotation.from_quat(visual.quat_LV).apply(sample_surface(visual)) + visual.p_LV
        points_W = Rotation.from_quat(quat_WL[0]).apply(points_L) + p_WL[0]
        outline = view.project(points_W)
        outline = outline[ConvexHull(outline).vertices]
        is_sensor = visual.kind == "box" and visual.rgba[0] < DARK
        fill = SENSOR_COLOUR if is_sensor else "#" + "".join(f"{round(255 * value):02x}" for value in visual.rgba[:3])
        edge = SENSOR_EDGE if is_sensor else fill
        shape = " ".join(f"{x:.1f},{y:.1f}" for x, y in outline)
        drawn = f'<polygon points="{shape}" fill="{fill}" stroke="{edge}" stroke-width="0.6"/>'
        depth = view.depth(points_W)
        parts.append((0.9 * depth.max() + 0.1 * depth.mean(), drawn))  # which of two overlapping parts is in front
    return [drawn for _, drawn in sorted(parts, key=lambda part: part[0])]


def draw_label(view: View, label: Label) -> list[str]:
    [[x, y]] = view.project(np.array([label.point_W]))
    end = label.x + (8.0 if label.anchor == "end" else -8.0)
    lines = [f'<path d="M{x:.1f} {y:.1f}L{end:.1f} {label.y:.1f}" class="leader"/>']
    for k, words in enumerate(label.lines):
        at = f'x="{label.x:.0f}" y="{label.y + 5 + 17 * k:.0f}" text-anchor="{label.anchor}"'
        lines.append(f'<text {at} class="{"words" if k else "name"}">{words}</text>')
    return lines


def draw_axes(x: float, y: float) -> list[str]:
    """The axes of W, and of every segment in the N-pose, seen from the front and the left."""
    right, up = np.array([-0.55, 0.85, 0.0]), np.array([-0.35, -0.2, 0.92])
    lines = []
    for name, (colour, axis) in AXES.items():
        dx, dy = 58.0 * right @ axis, -58.0 * up @ axis
        lines += [
            f'<path d="M{x} {y}l{dx:.1f} {dy:.1f}" stroke="{colour}" stroke-width="3" marker-end="url(#{name})"/>',
            f'<text x="{x + 1.35 * dx:.1f}" y="{y + 1.35 * dy + 5:.1f}" fill="{colour}" class="axis">{name}</text>',
        ]
    return lines


def draw_straps() -> str:
    """Return the drawing as SVG."""
    lengths = wp.load_model().lengths
    shoulder, trunk = 0.5 * lengths["shoulder_width"], lengths["trunk"]
    elbow = trunk - lengths["left_upper_arm"]
    upper, fore = trunk - 0.57 * lengths["left_upper_arm"], elbow - 0.82 * lengths["left_forearm"]
    front = [
        Label((0.1, 0.0, 0.42), 170.0, 110.0, ("torso", "on the breastbone"), "end"),
        Label((0.0, shoulder + 0.05, upper), 520.0, 240.0, ("left_upper_arm", "outside, below the middle"), "start"),
        Label((0.0, shoulder + 0.04, fore), 520.0, 410.0, ("left_forearm", "back, above the wrist"), "start"),
        Label((0.0, -shoulder - 0.05, upper), 155.0, 240.0, ("right_upper_arm",), "end"),
        Label((0.0, -shoulder - 0.04, fore), 150.0, 410.0, ("right_forearm",), "end"),
    ]
    side = [
        Label((0.11, 0.0, 0.42), 940.0, 250.0, ("torso",), "start"),
        Label((0.0, -shoulder, upper), 940.0, 310.0, ("right_upper_arm",), "start"),
        Label((0.0, -shoulder, fore), 940.0, 440.0, ("right_forearm",), "start"),
    ]
    arrows = "".join(
        f'<marker id="{name}" viewBox="0 0 8 8" refX="3" refY="4" markerWidth="4" markerHeight="4" orient="auto">'
        f'<path d="M0 0L8 4L0 8z" fill="{colour}"/></marker>'
        for name, (colour, _) in AXES.items()
    )
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1100 700" font-family="system-ui, sans-serif">',
        "<title>The N-pose from the front and from the right, with a sensor on the breastbone, on the outside of each "
        "upper arm and on the back of each forearm</title>",
        f"<defs>{arrows}</defs>",
        "<style>.name{font-weight:600;font-size:16px;fill:#1b2430}.words{font-size:14px;fill:#36414d}"
        ".axis{font-size:16px;font-weight:600}.leader{stroke:#4d5967;fill:none}</style>",
        '<rect width="1100" height="700" rx="10" fill="#dfe5ec"/>',
    ]
    for view, labels in ((FRONT, front), (SIDE, side)):
        parts += draw_body(view)
        for label in labels:
            parts += draw_label(view, label)
        parts.append(
            f'<text x="{view.centre_x:.0f}" y="672" class="words" text-anchor="middle">the N-pose {view.title}</text>'
        )
    return "\n".join([*parts, *draw_axes(90.0, 600.0), "</svg>"]) + "\n"


def write_figures(app: Sphinx) -> None:
    folder = Path(app.srcdir) / "generated"
    folder.mkdir(exist_ok=True)
    (folder / "straps.svg").write_text(draw_straps(), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write_figures)
    return {"parallel_read_safe": True}
