"""The motion as one HTML page on meshcat that opens offline, from a file, without a server.

meshcat's own server listens on every interface, so none is started: the page carries meshcat's viewer inside, and
static/viewer.js builds the scene in it. The motion is not meshcat's animation but a table that static/view.js plays:
as keyframes, minutes would be tens of megabytes.
"""

from __future__ import annotations

import base64
import contextlib
from collections.abc import Mapping, Sequence
from importlib.metadata import distribution
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from ..angles import AUTO, Angles, joint_angles
from ..body import BodyModel, Visual
from ..body.configuration import solve_configuration
from ..body.kinematics import Pose, compute_link_poses, find_known_links
from ..errors import BadData
from ..rotations import unwrap_signs
from .page import load_template
from .words import plain

if TYPE_CHECKING:
    from ..retargeting import Trajectory
    from ..retargeting.visuals import MeshPart

FLOOR_Z = -0.93  # [m] the ground in W, whose origin is between the hips, of a body without feet
FEET_Z = -0.6  # [m] below which a point of a person is at a foot
FRAMES_A_SECOND = 30.0
MOST_FRAMES = 20_000  # of a page; the browser interpolates
MOST_POSES = 150  # by which the camera is placed
LEFT_COLOUR, RIGHT_COLOUR, OTHER_COLOUR = "#e8743b", "#2a7fb8", "#5b6b7d"

Phases: TypeAlias = Mapping[str, Sequence[tuple[float, float]]]  # name → spans (begin, end) [s]
Trails: TypeAlias = Mapping[str, tuple[np.ndarray, str]]  # point → its way (n, 3) [m] in W, may hold NaN; colour in CSS


def compute_angles(pose: Pose) -> Angles | None:
    """Compute the joint angles of a motion; None: it has none."""
    with contextlib.suppress(BadData):  # no joint has both of its segments
        return joint_angles(pose, AUTO)
    return None


def pose_html(
    model: BodyModel,
    pose: Pose,
    *,
    phases: Phases = MappingProxyType({}),
    title: str = "",
    angles: Angles | None = None,
    fps: float = FRAMES_A_SECOND,
) -> str:
    """The page that plays `pose` on `model`, with trails of the points whose path is drawn; parameters as `view_html`.

    Segments that no sensor measured are drawn rigid with the one above where the model's table says so; what is not
    known is not drawn. `angles` are those of `compute_angles`, which are computed where they are missing.
    """
    seconds = max(float(pose.time[-1] - pose.time[0]), 1e-3)
    frames = frame_indices(pose.time, min(fps, MOST_FRAMES / seconds))
    visuals, placed = _place_body(model, pose, frames)
    paths = [name for name in model.table.draw.paths if name in pose.points]
    angles = angles or compute_angles(pose)
    shown = {
        plain(f"{joint} {name}"): np.degrees(np.where(each.hidden(k), np.nan, each.values[:, k]))[frames]
        for joint, each in (angles.joints.items() if angles else ())
        for k, name in enumerate(each.names)
    }
    return view_html(
        visuals,
        pose.time[frames],
        placed,
        trails={name: (pose.points[name][frames], choose_trail_colour(name, model)) for name in paths},
        angles=shown,
        phases=phases,
        title=title,
        floor_z=find_floor(model),
    )


def _place_body(
    model: BodyModel, pose: Pose, samples: np.ndarray
) -> tuple[list[Visual], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """The visuals of the links that are known, and link → its orientations and positions in W at these samples."""
    if pose.q is None:
        q = solve_configuration(model, {segment: quat_WL[samples] for segment, quat_WL in pose.quat_WL.items()})
    else:
        q = pose.q[samples]
    known = set(find_known_links(model, pose.quat_WL))
    visuals = [visual for visual in model.visuals if visual.link in known]
    links = list(dict.fromkeys(visual.link for visual in visuals))
    R_WK, p_WK = compute_link_poses(model, q, links)
    quats = [unwrap_signs(Rotation.from_matrix(R).as_quat()) for R in R_WK.swapaxes(0, 1)]
    return visuals, dict(zip(links, zip(quats, p_WK.swapaxes(0, 1), strict=True), strict=True))


def find_floor(model: BodyModel) -> float:
    """Height [m] of the ground in W: below the feet of a person, at the root of a mechanism."""
    if model.table.is_mechanism:
        return 0.0
    lengths = np.array(list(model.lengths.values()))
    ways = model.reaches.values()
    heights = [sum(float(B[2] @ lengths + c[2]) for B, c in way.values()) for way in ways]
    lowest = min(heights, default=FLOOR_Z)
    return lowest if lowest < FEET_Z else FLOOR_Z


def retarget_html(model: BodyModel, pose: Pose, trajectory: Trajectory, *, title: str = "") -> str:
    """The page on which a person and the robot that does as they do move together, on the robot's time."""
    from ..retargeting.targets import find_person_arm
    from ..retargeting.visuals import build_parts, compute_placements, place_beside_person

    frames = frame_indices(trajectory.time, FRAMES_A_SECOND)
    nearest = np.searchsorted(0.5 * (pose.time[:-1] + pose.time[1:]), trajectory.recorded_time[frames])
    visuals, placed = _place_body(model, pose, nearest)
    robot, parts = trajectory.robot, build_parts(trajectory.robot)
    arms = {arm.side: find_person_arm(model.table, arm.side) for arm in robot.arms}
    shoulder_z = float(np.nanmedian([pose.points[arm.points[0]][:, 2] for arm in arms.values()]))
    floor_z = find_floor(model)
    root = R_WB, p_WB = place_beside_person(robot, shoulder_z, floor_z)
    placed |= compute_placements(robot, trajectory.joint_position[frames], parts, *root)
    trails = {}  # short names: heads are beside them
    for side, arm in arms.items():
        colour = choose_trail_colour(arm.points[-1], model)
        trails[side] = pose.points[arm.points[-1]][nearest], colour
        trails[f"{side}_robot"] = trajectory.hand[side][frames] @ R_WB.T + p_WB, colour
    return view_html(
        visuals,
        trajectory.time[frames],
        placed,
        meshes=parts,
        trails=trails,
        phases={"approach": [(0.0, float(trajectory.time[trajectory.approach_samples]))]},
        title=title,
        floor_z=floor_z,
    )


def view_html(
    visuals: Sequence[Visual],
    time: np.ndarray,
    placements: Mapping[str, tuple[np.ndarray, np.ndarray]],
    *,
    meshes: Sequence[MeshPart] = (),
    trails: Trails = MappingProxyType({}),
    angles: Mapping[str, np.ndarray] = MappingProxyType({}),
    phases: Phases = MappingProxyType({}),
    title: str = "",
    floor_z: float = FLOOR_Z,
) -> str:
    """The page that plays a motion, to open in any browser; equal arguments give equal text.

    `#t=12.3` at the end of its address opens it paused at that time, `#t=12.3&play` plays on from there.

    Parameters
    ----------
    visuals : shapes of the body; a link without a placement is not drawn
    time : (n,) [s], n >= 1, rising
    placements : link → (quat_WL (n, 4) xyzw, p_WL (n, 3) [m]); a link is hidden while its placement is NaN
    trails, angles : point → its way; name → (n,) [deg], shown beside the body
    floor_z : height [m] of the ground grid in W
    """
    time = np.asarray(time, dtype=float)
    drawn = [visual for visual in visuals if visual.link in placements]
    meshes = [mesh for mesh in meshes if mesh.link in placements]
    links = list(dict.fromkeys([*(v.link for v in drawn), *(mesh.link for mesh in meshes)]))
    motion = np.empty((len(links), len(time), 7), dtype="<f4")  # quat_WL xyzw, p_WL
    for k, link in enumerate(links):
        motion[k, :, :4], motion[k, :, 4:] = placements[link]
    data = {
        "begin": float(time[0]),
        "end": float(time[-1]),
        "offsets": _base64(time - time[0]),  # float32 holds an offset, not seconds since 1970
        "links": links,
        "motion": _base64(motion),
        "trails": [{"name": name, "colour": colour, "points": _base64(way)} for name, (way, colour) in trails.items()],
        "angles": [{"name": name, "values": _base64(values)} for name, values in angles.items()],
        "phases": [{"name": name, "spans": [[*map(float, span)] for span in each]} for name, each in phases.items()],
        "view": view([*drawn, *map(_find_box, meshes)], links, motion, [way for way, _ in trails.values()]),
        "scene": scene(drawn, links, meshes),
        "floor": floor_z,
    }
    return fill_page("report/templates/view.html.j2", data, title)


def fill_page(template: str, data: Mapping[str, Any], title: str) -> str:
    """A page of a template with the viewer in it, of its data and title."""
    return load_template(template).render(title=title, data=data, meshcat=_meshcat_source())


def frame_indices(time: np.ndarray, fps: float) -> np.ndarray:
    """(m,) int, rising: the samples nearest to a clock of `fps` a second, with the first and the last."""
    clock = np.append(np.arange(time[0], time[-1], 1.0 / fps), time[-1])
    nearest_changes = 0.5 * (time[:-1] + time[1:])
    return np.unique(np.searchsorted(nearest_changes, clock))


def scene(drawn: Sequence[Visual], links: Sequence[str], meshes: Sequence[MeshPart] = ()) -> dict[str, Any]:
    """The body as static/viewer.js builds it; a part's link is its place in `links`."""
    parts = [
        {
            "link": links.index(visual.link),
            "kind": visual.kind,
            "size": list(map(float, visual.size)),
            "quat": visual.quat_LV.tolist(),
            "position": visual.p_LV.tolist(),
            "rgba": list(map(float, visual.rgba)),
        }
        for visual in drawn
    ]
    solids = [
        {
            "link": links.index(mesh.link),
            "vertices": _base64(mesh.vertices),
            "triangles": _base64(mesh.triangles, "<u4"),
            "rgba": list(map(float, mesh.rgba)),
        }
        for mesh in meshes
    ]
    return {"parts": parts, "meshes": solids}


def _find_box(mesh: MeshPart) -> Visual:
    """The box around a mesh, for the camera."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return Visual(mesh.link, "box", tuple(high - low), np.array([0.0, 0.0, 0.0, 1.0]), 0.5 * (low + high), mesh.rgba)


def view(
    visuals: Sequence[Visual], links: Sequence[str], motion: np.ndarray, trails: Sequence[np.ndarray]
) -> list[list[float]]:
    """The motion's outermost points [m] in W, which the camera shows; a visual counts as the ball around it."""
    directions = np.array([*product((-1.0, -0.4, 0.4, 1.0), repeat=3), *np.eye(3), *-np.eye(3)]).T
    directions /= np.linalg.norm(directions, axis=0)
    balls_W = [(np.zeros((1, 3)), 0.0), *((trail[:: max(1, len(trail) // (4 * MOST_POSES))], 0.0) for trail in trails)]
    for visual in visuals:
        placed = motion[links.index(visual.link), :: max(1, motion.shape[1] // MOST_POSES)].astype(float)
        placed = placed[np.isfinite(placed).all(axis=1)]
        half = np.array(visual.size) * {"box": 0.5, "cylinder": (1.0, 0.5), "sphere": 1.0}[visual.kind]
        if len(placed):
            centre_W = Rotation.from_quat(placed[:, :4]).apply(visual.p_LV) + placed[:, 4:]
            balls_W.append((centre_W, float(np.linalg.norm(half))))
    centres_W = np.concatenate([centres for centres, _ in balls_W])
    radii = np.concatenate([np.full(len(centres), radius) for centres, radius in balls_W])
    known = np.isfinite(centres_W).all(axis=1)
    centres_W, radii = centres_W[known], radii[known]
    outermost = np.argmax(centres_W @ directions + radii[:, None], axis=0)
    points_W = centres_W[outermost] + radii[outermost, None] * directions.T
    return np.round(points_W, 4).tolist()


def choose_trail_colour(point: str, model: BodyModel) -> str:
    """The colour of a point's side."""
    return {"left": LEFT_COLOUR, "right": RIGHT_COLOUR}.get(model.table.side(point) or "", OTHER_COLOUR)


def _meshcat_source() -> Markup:
    """meshcat's viewer, safe inside a script element; its Python side, which brings a server, is not loaded."""
    script = distribution("meshcat").locate_file("meshcat/viewer/dist/main.min.js")
    source = Path(str(script)).read_text(encoding="utf-8")
    return Markup(source.replace("</script", "<\\/script").replace("<!--", "<\\!--"))


def _base64(values: np.ndarray, dtype: str = "<f4") -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode("ascii")
