"""The body model, against Pinocchio's own reading of the same URDF, the XML itself, and models of others."""

import importlib.metadata
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from wepose_pin import BodyModel, WeposeError, load_model

OURS = Path(__file__).resolve().parent.parent / "urdf" / "upper_body.urdf"
SEGMENTS = ["torso", "pelvis", "head"] + [
    f"{side}_{part}" for side in ("left", "right") for part in ("upper_arm", "forearm", "hand")
]
GAZEBO = {
    "48": "humanSubject01_48dof.urdf",
    "66": "humanSubject01_66dof.urdf",
    "spine": "humanSubjectWithSpinalCordMeshes.urdf",
}


def example_robot_data_human() -> Path:
    try:
        files = importlib.metadata.distribution("example-robot-data").files or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("example-robot-data is not installed")
    return Path(next(file for file in files if str(file).endswith("human_description/robots/human.urdf")).locate())


@pytest.fixture(params=["ours", "48", "66", "spine", "human"])
def urdf(request: pytest.FixtureRequest) -> Path:
    """Each of the models we know."""
    if request.param == "ours":
        return OURS
    if request.param == "human":
        return example_robot_data_human()
    return request.getfixturevalue("data") / "human_urdf" / GAZEBO[request.param]


# An independent way from one configuration to the other -----------------------------------------------------------


def configurations(text: str, body: BodyModel, rng: np.random.Generator) -> tuple[pin.Model, np.ndarray, np.ndarray]:
    """Pinocchio's own model of a URDF, a random configuration of it, and the same of `body`."""
    raw = pin.buildModelFromXML(text)
    angles = rng.uniform(-2.5, 2.5, raw.nv)
    q_raw = pin.integrate(raw, pin.neutral(raw), angles)
    data = raw.createData()
    pin.forwardKinematics(raw, data, q_raw)
    above = {joint.find("child").get("link"): joint for joint in ET.fromstring(text.encode()).findall("joint")}
    q = pin.neutral(body.pin)
    for k, name in enumerate(body.pin.names):
        first = body.pin.idx_qs[k]
        if name not in body.axes:
            if k:
                there = raw.idx_qs[raw.getJointId(name)]
                q[first : first + body.pin.nqs[k]] = q_raw[there : there + body.pin.nqs[k]]
            continue
        link, names = name, []
        for _ in range(3):
            names.append(above[link].get("name"))
            link = above[link].find("parent").get("link")
        ids = [raw.getJointId(joint) for joint in names[::-1]]
        at_zero = raw.jointPlacements[ids[0]] * raw.jointPlacements[ids[1]] * raw.jointPlacements[ids[2]]
        moved = data.oMi[raw.parents[ids[0]]].actInv(data.oMi[ids[2]])
        q[first : first + 4] = pin.Quaternion(at_zero.rotation.T @ moved.rotation).coeffs()
    return raw, q_raw, q


def link_placements(model: pin.Model, q: np.ndarray) -> dict[str, np.ndarray]:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return {f.name: data.oMf[k].homogeneous for k, f in enumerate(model.frames) if f.type == pin.FrameType.BODY}


def largest_difference(text: str, body: BodyModel, seed: int = 0, n: int = 10) -> tuple[float, int]:
    """Largest difference of link placements between `body` and Pinocchio's model of the text; and how many links.

    The URDF's root link may stand anywhere in W.
    """
    rng = np.random.default_rng(seed)
    worst, links = 0.0, 0
    for _ in range(n):
        raw, q_raw, q = configurations(text, body, rng)
        theirs, ours = link_placements(raw, q_raw), link_placements(body.pin, q)
        # A link that had to give way to one of our names is called <name>_link.
        ours |= {name[:-5]: M for name, M in ours.items() if name.endswith("_link") and name not in theirs}
        root = raw.frames[1].name
        M_WM = ours[root] @ np.linalg.inv(theirs[root])
        both = set(ours) & set(theirs)
        worst = max(worst, *(np.abs(M_WM @ theirs[name] - ours[name]).max() for name in both))
        links = len(both)
    return worst, links


# Ours -------------------------------------------------------------------------------------------------------------


def test_our_segment_frames_equal_w_in_the_n_pose() -> None:
    body = load_model()
    at = link_placements(body.pin, pin.neutral(body.pin))
    for segment in SEGMENTS:
        np.testing.assert_allclose(at[segment][:3, :3], np.eye(3), atol=1e-15)


# All that we know -------------------------------------------------------------------------------------------------


def test_it_moves_as_pinocchios_own_model_does(urdf: Path) -> None:
    text = urdf.read_text(encoding="utf-8")
    worst, links = largest_difference(text, load_model(urdf))
    assert links > 10
    assert worst < 1e-12


def test_mass_and_centre_of_mass_are_kept(urdf: Path) -> None:
    text = urdf.read_text(encoding="utf-8")
    body = load_model(urdf)
    mass = sum(float(m.get("value")) for m in ET.fromstring(text.encode()).iter("mass"))
    assert sum(inertia.mass for inertia in body.pin.inertias) == pytest.approx(mass, rel=1e-12)
    raw, q_raw, q = configurations(text, body, np.random.default_rng(1))
    root = link_placements(body.pin, q)
    of_root = root.get(raw.frames[1].name, root.get(f"{raw.frames[1].name}_link"))
    com = of_root[:3, :3] @ pin.centerOfMass(raw, raw.createData(), q_raw) + of_root[:3, 3]
    np.testing.assert_allclose(pin.centerOfMass(body.pin, body.pin.createData(), q), com, atol=1e-12)


def test_every_point_is_an_affine_function_of_the_lengths(urdf: Path) -> None:
    """By which calibration and headings know where points are: against Pinocchio, for any lengths and orientations."""
    rng, body = np.random.default_rng(0), load_model(urdf)
    assert set(body.reaches) == set(body.point_frames)
    body = body.with_lengths({name: value * rng.uniform(0.7, 1.3) for name, value in body.lengths.items()})
    m, data = body.pin, body.pin.createData()
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in (m.lowerPositionLimit, m.upperPositionLimit))
    q = pin.normalize(m, rng.uniform(low, high))
    q[[m.idx_qs[m.getJointId(joint)] for girdle in body.table.girdles.values() for joint in girdle.joints]] = 0.0
    pin.framesForwardKinematics(m, data, q)
    R_WK = {m.names[joint]: data.oMi[joint].rotation for joint in range(m.njoints)}
    R_WK |= {s: data.oMf[m.getFrameId(s)].rotation for s in body.table.segments}
    lengths = np.array(list(body.lengths.values()))
    for point, parts in body.reaches.items():
        place = np.sum([R_WK[link] @ (B @ lengths + c) for link, (B, c) in parts.items()], axis=0)
        expected = data.oMf[m.getFrameId(body.point_frames[point])].translation
        np.testing.assert_allclose(place, expected, atol=1e-12)


def test_one_length_leaves_the_others_and_the_directions_alone(urdf: Path) -> None:
    body = load_model(urdf)
    before = link_placements(body.pin, pin.neutral(body.pin))
    for name, value in body.lengths.items():
        longer = body.with_lengths({name: 1.3 * value})
        for other, same in body.lengths.items():
            assert longer.lengths[other] == pytest.approx(1.3 * same if other == name else same, abs=1e-12)
        after = link_placements(longer.pin, pin.neutral(longer.pin))
        for link, M in before.items():
            np.testing.assert_allclose(after[link][:3, :3], M[:3, :3], atol=1e-12)
        d = {k: after[f"left_{k}"][:3, 3] - before[f"left_{k}"][:3, 3] for k in ("upper_arm", "forearm", "hand")}
        if name == "left_forearm":
            np.testing.assert_allclose(d["forearm"], 0.0, atol=1e-12)
            along = before["left_hand"][:3, 3] - before["left_forearm"][:3, 3]
            np.testing.assert_allclose(d["hand"], 0.3 * along, atol=1e-12)


def test_a_longer_segment_is_heavier_by_its_volume() -> None:
    body = load_model()
    longer = body.with_lengths({"left_upper_arm": 1.5 * body.lengths["left_upper_arm"]})
    before, after = (each.pin.inertias[each.pin.getJointId("left_upper_arm")] for each in (body, longer))
    assert after.mass == pytest.approx(1.5 * before.mass)
    np.testing.assert_allclose(after.lever, before.lever * [1.0, 1.0, 1.5])


def test_the_written_urdf_reads_the_same_everywhere(urdf: Path, tmp_path: Path) -> None:
    body = load_model(urdf)
    rng = np.random.default_rng(4)
    body = body.with_lengths({name: value * rng.uniform(0.8, 1.25) for name, value in body.lengths.items()})
    text = body.urdf()
    worst, links = largest_difference(text, body)
    assert links >= len(SEGMENTS)
    assert worst < 1e-12

    file = tmp_path / "subject.urdf"
    file.write_text(text, encoding="utf-8")
    again = load_model(file)  # bears our names now: no table is needed
    assert again.pin.names.tolist() == body.pin.names.tolist()
    assert again.table.girdles == body.table.girdles
    q = pin.randomConfiguration(body.pin, -np.ones(body.pin.nq), np.ones(body.pin.nq))
    ours, theirs = link_placements(body.pin, q), link_placements(again.pin, q)
    assert max(np.abs(ours[name] - theirs[name]).max() for name in ours) < 1e-12
    for name, value in body.lengths.items():
        assert again.lengths[name] == pytest.approx(value, abs=1e-12)


# Models of others -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["48", "66"])
def test_human_gazebo_stands_in_the_t_pose_at_zero(name: str, data: Path) -> None:
    body = load_model(data / "human_urdf" / GAZEBO[name])
    at = link_placements(body.pin, pin.neutral(body.pin))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        R_WL = Rotation.from_rotvec([sign * np.pi / 2.0, 0.0, 0.0]).as_matrix()  # lifted sideways, palms down
        for part in ("upper_arm", "forearm", "hand"):
            # Its wrist lies a few tenths of a millimetre off the line.
            np.testing.assert_allclose(at[f"{side}_{part}"][:3, :3], R_WL, atol=2e-3)
    for segment in ("torso", "pelvis", "head"):
        np.testing.assert_allclose(at[segment][:3, :3], np.eye(3), atol=1e-12)
    # A segment frame is where its link is, and moves with it.
    np.testing.assert_array_equal(at["left_forearm"][:3, 3], at["LeftForeArm"][:3, 3])
    np.testing.assert_array_equal(at["left_palm"][:3, 3], at["LeftHandCOM"][:3, 3])


# Small bodies, to see one thing at a time -------------------------------------------------------------------------

ARMS = {"left": 0.2, "right": -0.2}
TRIPLE = ("1 0 0", "0 1 0", "0 0 1")


def triple(
    parent: str, child: str, at: str, axes: tuple[str, ...] = TRIPLE, rpy: tuple[str, ...] = ("0 0 0",) * 3
) -> str:
    links = [f"{child}_{k}" for k in range(len(axes) - 1)] + [child]
    text = "".join(f'<link name="{link}"/>' for link in links[:-1])
    for k, (axis, turn) in enumerate(zip(axes, rpy, strict=True)):
        text += (
            f'<joint name="{child}_j{k}" type="revolute"><parent link="{([parent, *links])[k]}"/>'
            f'<child link="{links[k]}"/><origin xyz="{at if k == 0 else "0 0 0"}" rpy="{turn}"/><axis xyz="{axis}"/>'
            f'<limit lower="-{k + 1}" upper="{k + 1}" effort="1" velocity="1"/></joint>'
        )
    return text


def fixed(parent: str, child: str, at: str, kind: str = "fixed") -> str:
    return (
        f'<joint name="{child}_{kind}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}"/></joint>'
    )


def small(torso: str | None = None, elbow: str | None = None, more: str = "") -> str:
    """A body of triples without inertias; `torso` and `elbow` (left) in place of the usual joints."""
    text = '<link name="root"/><link name="torso"/>' + (torso or triple("root", "torso", "0 0 0"))
    for side, y in ARMS.items():
        a, f, h, p = (f"{side}_{part}" for part in ("upper_arm", "forearm", "hand", "palm"))
        text += "".join(f'<link name="{link}"/>' for link in (a, f, h, p))
        text += triple("torso", a, f"0 {y} 0.5") + triple(f, h, "0 0 -0.25") + fixed(h, p, "0 0 -0.07")
        text += elbow if elbow and side == "left" else triple(a, f, "0 0 -0.3")
    return f'<robot name="small">{text}{more}</robot>'


def written(tmp_path: Path, text: str, name: str = "small.urdf") -> Path:
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("axes", "rpy"),
    [
        (("0 0 1", "1 0 0", "0 1 0"), ("0 0 0", "0 0 0", "0 0 0")),
        (("0 0 -1", "1 0 0", "0 1 0"), ("0 0 0", "0 0 0", "0 0 0")),  # left-handed
        (("0 1 0", "0 0 1", "1 0 0"), ("0.3 -0.2 0.5", "0 0 0", "0 0 0")),
        (("1 0 0", "1 0 0", "1 0 0"), ("0 0 0", "0 0 1.5707963267948966", "0 -1.5707963267948966 0.4")),
        (("2 0 0", "0 3 0", "0 0 4"), ("0 0 0", "0 0 0", "0 0 0")),  # axes of any length
    ],
)
def test_three_orthogonal_axes_in_any_order_are_one_spherical_joint(
    axes: tuple[str, ...], rpy: tuple[str, ...], tmp_path: Path
) -> None:
    text = small(elbow=triple("left_upper_arm", "left_forearm", "0 0 -0.3", axes, rpy))
    file = written(tmp_path, text)
    body = load_model(file)
    assert "left_forearm" in body.axes
    worst, _ = largest_difference(text, body)
    assert worst < 1e-12
    # Each axis, turned alone, is the rotation about the axis that the body states.
    raw = pin.buildModelFromXML(text)
    for k in range(3):
        angles = pin.neutral(raw)
        angles[raw.idx_qs[raw.getJointId(f"left_forearm_j{k}")]] = 0.5
        zero, turned = (link_placements(raw, q)["left_forearm"][:3, :3] for q in (pin.neutral(raw), angles))
        np.testing.assert_allclose(
            Rotation.from_matrix(zero.T @ turned).as_rotvec(), 0.5 * body.axes["left_forearm"][k], atol=1e-12
        )


def test_meshes_stay_in_the_urdf_and_are_not_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mesh = (
        '<visual><geometry><mesh filename="package://nowhere/arm.stl" scale="0.001 0.001 0.001"/></geometry></visual>'
    )
    text = small().replace('<link name="left_upper_arm"/>', f'<link name="left_upper_arm">{mesh}</link>')
    body = load_model(written(tmp_path, text)).with_lengths({"left_upper_arm": 0.6})
    rods = [visual for visual in body.visuals if visual.link == "left_upper_arm"]
    assert [(rod.kind, rod.size) for rod in rods] == [("cylinder", (0.02, pytest.approx(0.6)))]  # to the elbow
    np.testing.assert_allclose(rods[0].p_LV, (0.0, 0.0, -0.3), atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(rods[0].quat_LV).apply((0.0, 0.0, 1.0)), (0.0, 0.0, -1.0), atol=1e-12)
    assert '<mesh filename="package://nowhere/arm.stl" scale="0.001 0.001 0.002"/>' in body.urdf()
    assert caplog.records == []


@pytest.mark.parametrize("change", [{"left_upper_arm": 1.10}, {"trunk": 0.1}, {}])
def test_implausible_lengths_are_warned_of(change: dict[str, float]) -> None:
    diagnostics = load_model(lengths=change).diagnostics
    assert {d.place: d.value for d in diagnostics} == pytest.approx(change)
    assert {d.code for d in diagnostics} <= {"model-implausible"}
    for diagnostic in diagnostics:
        assert f"is {change[diagnostic.place]:g} m long; adults have " in str(diagnostic)


HINGE = triple("left_upper_arm", "left_forearm", "0 0 -0.3", ("0 1 0",), ("0 0 0",))
A = "left_upper_arm"
WRONG = {
    "no xml": ("no robot", "is no complete XML file"),
    "loop": (small(more=fixed("left_palm", "right_palm", "0 0 0", "floating")), "right_palm' hangs on two joints"),
    "ring": (
        small(more='<link name="a"/><link name="b"/>' + fixed("a", "b", "0 0 0") + fixed("b", "a", "0 0 0")),
        "'a' hangs in a loop",
    ),
    "two roots": (small(more='<link name="table"/>'), "2 links without a joint above them (root, table)"),
    "no such link": (small(more=fixed("nowhere", "torso", "0 0 0")), "'torso_fixed' names a link that is not there"),
    "twice": (small(more='<link name="torso"/>'), "'torso' occurs 2 times"),
    "planar": (small(more='<link name="x"/>' + fixed("torso", "x", "0 0 0", "planar")), "of type 'planar'"),
    "zero axis": (small(elbow=HINGE.replace("0 1 0", "0 0 0")), "axis [0.0, 0.0, 0.0]"),
    "a rigid elbow": (
        small(elbow='<link name="cuff"/>' + fixed(A, "cuff", "0 0 -0.1") + fixed("cuff", "left_forearm", "0 0 -0.2")),
        "moves left_forearm against left_upper_arm",
    ),
    "a sliding elbow": (
        small(elbow=fixed(A, "left_forearm", "0 0 -0.3", "prismatic")),
        "moves left_forearm against left_upper_arm",
    ),
    "other names": (small().replace("left_forearm", "ulna"), "no link 'left_forearm'; name the segments' links"),
}


@pytest.mark.parametrize("case", WRONG)
def test_the_wrong_model_says_so_in_one_line(case: str, tmp_path: Path) -> None:
    text, message = WRONG[case]
    with pytest.raises(WeposeError) as raised:
        load_model(written(tmp_path, text))
    assert message in str(raised.value)
    assert "small" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_file_that_is_not_there_and_lengths_that_cannot_be(tmp_path: Path) -> None:
    for path in (tmp_path / "none.urdf", tmp_path / "none.toml"):
        with pytest.raises(WeposeError, match=path.name):
            load_model(path)
    for lengths, said in (
        ({"left_forarm": 0.2}, "did you mean 'left_forearm'"),
        ({"left_forearm": -0.2}, "above 0 and below 10 m"),
    ):
        with pytest.raises(WeposeError, match=said):
            load_model(lengths=lengths)


# The table --------------------------------------------------------------------------------------------------------

OTHER = {name: f"L_{name}" for name in SEGMENTS if name not in ("head", "pelvis")}


def other_names(text: str) -> str:
    root = ET.fromstring(text)
    for element in root.iter():
        for key in ("name", "link"):
            if element.get(key) in OTHER and element.tag in ("link", "parent", "child"):
                element.set(key, OTHER[element.get(key)])
    return ET.tostring(root, encoding="unicode")


def table_toml(segments: dict[str, str] = OTHER, more: str = "") -> str:
    rows = "\n".join(f"{segment} = {value if value[0] == '{' else repr(value)}" for segment, value in segments.items())
    return f'like = "upper_body"\n[segments]\n{rows}\n{more}'


PALMS = '[points]\nleft_palm = "left_palm"\nright_palm = {link = "L_right_hand", at = [0, 0, -0.07]}'


def test_a_table_is_given_or_lies_beside_its_urdf(tmp_path: Path) -> None:
    written(tmp_path, other_names(small()))
    by_table = load_model(written(tmp_path, f'urdf = "small.urdf"\n{table_toml(more=PALMS)}', "model.toml"))
    model = load_model(tmp_path / "small.urdf")
    plain = load_model(written(tmp_path, small(), "plain.urdf"))
    for body in (by_table, model):
        assert body.lengths == pytest.approx(plain.lengths, abs=1e-12)
        assert set(body.axes) == {OTHER.get(name, name) for name in plain.axes}
    again = load_model(written(tmp_path, model.urdf(), "again.urdf"))  # beside a table for another file
    assert again.lengths == pytest.approx(plain.lengths, abs=1e-12)


def test_up_and_forward_turn_the_body_upright(tmp_path: Path) -> None:
    text = other_names(small()).replace('<link name="root" />', '<link name="base"/><link name="root"/>')
    written(tmp_path, text.replace("</robot>", fixed("base", "root", "0 0 0") + "</robot>"))
    table = f'urdf = "small.urdf"\nup = "+z"\nforward = "-y"\n{table_toml()}'
    body = load_model(written(tmp_path, table, "any.toml"))
    at = link_placements(body.pin, pin.neutral(body.pin))
    np.testing.assert_allclose(at["base"][:3, :3] @ [0.0, -1.0, 0.0], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(at["torso"][:3, :3], np.eye(3), atol=1e-12)
