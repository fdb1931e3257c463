"""Bad tables and protocols give one line that says file, key, value and what would be right; foreign bodies load."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import run
from test_chain import urdf  # noqa: F401
from test_chain_calibration import arm  # noqa: F401
from test_model import example_robot_data_human

import wepose_pin as wp
from benchmarks.ur5_arm import BENT, SENSED, TABLE
from wepose_pin import BodyModel, ImuSensor, Recording, load_model
from wepose_pin.calibration.protocols import load_protocol
from wepose_pin.recording import CONFIGURATION, compute_mount
from wepose_pin.writers import write_session

ROOT = Path(__file__).parents[1]
GOOD = TABLE.format(segments="\n".join(f'{link} = "{link}"' for link in SENSED)).replace(
    "[points]", '[points]\nfoot = "base_link"'
)
HINGE = '[hinges.bend]\non = "upper_arm_link"\nmoves = "forearm_link"\naxis = [0.0, 1.0, 0.0]\n'
GIRDLE = """[girdles.elbow]
on = "upper_arm_link"
moves = "forearm_link"
joints = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"]
outward = "+y"
up_mm = [20.0, 10.0]
middle_mm = [8.0, 15.0]
back_mm = [2.0, 20.0]
back_angle_deg = 25.0
"""
AGAIN = 'again = { segment = "upper_arm_link", from = "base", to = "elbow" }\n'
SEGMENT = 'forearm_link = "forearm_link"'

# What is added to the table, what of it is exchanged for what, and what the line names.
TABLES: list[tuple[str, tuple[str, str], tuple[str, ...]]] = [
    (
        "",
        ('segment = "forearm_link", from = "elbow"', 'segment = "wrist_3_link", from = "elbow"'),
        ("lengths.forearm", "wrist_3_link", "name the segment between them"),
    ),
    ("", ('to = "elbow"', 'to = "base"'), ("lengths.upper_arm", "different places")),
    (AGAIN, ("", ""), ("lengths.upper_arm, lengths.again", "upper_arm_link", "different directions")),
    ("", ('to = "elbow"', 'to = "elbov"'), ("lengths.upper_arm", "elbov", "did you mean 'elbow'")),
    (HINGE, ('moves = "forearm_link"', 'moves = "upper_arm_link"'), ("hinges.bend", "two segments")),
    (HINGE, ('moves = "forearm_link"', 'moves = "wrist_1_link"'), ("wrist_1_link does not hang on upper_arm_link",)),
    (HINGE, ("[0.0, 1.0, 0.0]", "[0, 0, 0]"), ("hinges.bend", "an axis of some length")),
    (
        HINGE,
        ('on = "upper_arm', 'on = "uper_arm'),
        ("hinges.bend.on", "uper_arm_link", "did you mean 'upper_arm_link'"),
    ),
    ('[pairs]\nelbow = "tipp"\n', ("", ""), ("pairs", "'tipp' is not known", "did you mean 'tip'")),
    ("", ("0.15", "150.0"), ("points.tip.at", "150.0", "number [m] from -10 to 10")),
    (GIRDLE, ("girdles.elbow", "girdles.elbov"), ("girdles", "'elbov' is not known", "did you mean 'elbow'")),
    (GIRDLE, (', "elbow_joint"', ""), ("['shoulder_pan_joint', 'shoulder_lift_joint']", "3 texts")),
    (GIRDLE + "law_std = -0.5\n", ("", ""), ("girdles.elbow.law_std = -0.5", "a number from 0")),
    (
        "",
        (SEGMENT, 'forearm_link = { link = "forearm_link", soft_tissue = { pertwist = 1 } }'),
        ("segments.forearm_link.soft_tissue", "pertwist", "did you mean 'per_twist'"),
    ),
    (
        "",
        (SEGMENT, 'forearm_link = { link = "forearm_link", labels = "(" }'),
        ("segments.forearm_link.labels", "no regular expression"),
    ),
    (
        "",
        (SEGMENT, 'forearm_link = { link = "forearm_link", start_std_deg = [1, 2] }'),
        ("segments.forearm_link.start_std_deg", "[1, 2]"),
    ),
    ("[poses.folded]\nelbow_joint = 9.0\n", ("", ""), ("poses.folded.elbow_joint", "9", "-6.3 to 6.3")),
    ("", (GOOD, 'urdf = "arm.urdf"\nkind = "mechanism"\n'), ("segments is missing", "link is needed")),
    ("", (GOOD, 'urdf = "arm.urdf"\nlike = "uper_body"\n'), ("like", "uper_body", "did you mean 'upper_body'")),
    ("", (SEGMENT, 'forearm_link = "forearm"'), ("segments.forearm_link", "forearm", "did you mean 'forearm_link'")),
    ("", ('wrist = "wrist_1_link"', 'wrist = "wrist_link"'), ("points.wrist", "wrist_link", "did you mean")),
    ("", ('urdf = "arm.urdf"', 'urdf = "arm.urdf"\nup = "z"'), ("up = 'z'",)),
    ("", ('urdf = "arm.urdf"', 'urdf = "arm.urdf"\nup = "+x"'), ("is parallel to up",)),
    ("", (GOOD, "segments = ["), ("not valid TOML",)),
    ("", ("arm.urdf", "leg.urdf"), ("leg.urdf", "no such file")),
    ("", (GOOD, 'urdf = "fixed.urdf"\nlike = "upper_body"\n'), ("left_upper_arm", "revolute joints")),
]
PROTOCOL = """name = "mine"
[[closure]]
phase = "tip"
kind = "fixed_point"
points = ["tip"]
"""
PROTOCOLS: list[tuple[tuple[str, str], tuple[str, ...]]] = [
    (('["tip"]', '["tipp"]'), ("'tipp'", "did you mean 'tip'")),
    (("fixed_point", "fixed"), ("closure 1.kind", "'fixed'", "fixed_point")),
    (('["tip"]', '["tip", "elbow"]'), ("closure 1.points", "elbow", "takes 1")),
    (('["tip"]', '["tip"]\ndistance = "base"'), ("closure 1.distance", "is not a known key", "points")),
    (('["tip"]', '["tip"]\nat = [1.0, 2.0]'), ("closure 1.at", "[1.0, 2.0]", "3 numbers")),
    (('"fixed_point"', '"recorded"\norigin = "bass"'), ("'bass'", "did you mean 'base'")),
    (('"fixed_point"', '"recorded"\norigin = "tip"'), ("no sensor moves tip",)),
    (("fixed_point", "recorded"), ("session.toml", "data.truth is missing", "tip_x")),
    ((PROTOCOL, 'name = "mine"\n'), ("[[closure]]", "[[pose]]")),
    (('["tip"]', '["foot"]'), ("no sensor moves foot",)),
]


@pytest.fixture(scope="module")
def folder(arm: BodyModel, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A session of an arm that does not move, and its URDF."""
    folder = tmp_path_factory.mktemp("bad")
    time = np.arange(0.0, 20.0, 0.02)
    rng = np.random.default_rng(0)
    sensors = {}
    for link in SENSED:
        accel = [0.0, 0.0, 9.81] + rng.normal(scale=0.01, size=(len(time), 3))
        gyro = rng.normal(scale=1e-3, size=(len(time), 3))
        sensors[link] = ImuSensor(gyro_S=gyro, accel_S=accel, stated_quat_LS=compute_mount("+z", "+x"))
    phases = {"start": ((0.5, 4.5),), "tip": ((5.0, 19.0),)}
    recording = Recording("arm", time, 50.0, sensors, phases=phases, start_pose=CONFIGURATION, joints=BENT)
    write_session(folder, recording)
    shutil.copyfile(Path(arm.table.where).with_name("arm.urdf"), folder / "arm.urdf")
    (folder / "arm.toml").write_text(GOOD, encoding="utf-8")
    return folder


def refuse(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The one line with which a command ends, exit 2."""
    assert run(*arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize(("more", "change", "named"), TABLES)
def test_a_bad_table_says_what_and_where(
    more: str, change: tuple[str, str], named: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "bad.toml").write_text((GOOD + more).replace(*change), encoding="utf-8")
    text = (ROOT / "urdf" / "upper_body.urdf").read_text(encoding="utf-8")
    fixed = re.sub(r'(name="left_upper_arm_[xyz]" type=)"revolute"', r'\1"fixed"', text)
    assert fixed != text
    (folder / "fixed.urdf").write_text(fixed, encoding="utf-8")
    for command in ("calibrate", "track"):
        line = refuse(capsys, command, folder, "--model", folder / "bad.toml", "-o", folder / "out")
        assert [part for part in named if part not in line] == []
        assert "bad.toml: " in line or "leg.urdf: " in line
    assert not (folder / "out").exists()


def test_a_link_without_a_segment_on_the_way_says_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "bad.toml").write_text(GOOD.replace('shoulder_link = "shoulder_link"', 'shoulder_link = "base_link"'))
    model = ("--model", folder / "bad.toml", "--protocol", "tip")
    line = refuse(capsys, "calibrate", folder, *model, "-o", folder / "out")
    for part in ("session.toml", "a sensor behind joint shoulder_pan_joint", "the place of tip is not known"):
        assert part in line


@pytest.mark.parametrize(("change", "named"), PROTOCOLS)
def test_a_bad_protocol_says_what_and_where(
    change: tuple[str, str], named: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "bad_protocol.toml").write_text(PROTOCOL.replace(*change), encoding="utf-8")
    model = ("--model", folder / "arm.toml", "--protocol", folder / "bad_protocol.toml")
    line = refuse(capsys, "calibrate", folder, *model, "-o", folder / "out")
    assert [part for part in named if part not in line] == []
    assert "bad_protocol.toml" in line or "'mine'" in line or "session.toml" in line
    assert not (folder / "out").exists()


# Foreign bodies ------------------------------------------------------------------------------------------------------

GAZEBO = 'like = "human_gazebo"\nroot = "Pelvis"\n'
COSMIK = """like = "upper_body"
up = "+y"
root = "pelvis"
segments.torso = "torso"
segments.left_upper_arm = "upperarmL"
segments.left_forearm = "lowerarmL"
segments.right_upper_arm = "upperarmR"
segments.right_forearm = "lowerarmR"
points = { left_wrist = {link="lowerarmL", at=[0, -0.26, 0]}, right_wrist = {link="lowerarmR", at=[0, -0.26, 0]} }
"""
HUMAN = """like = "example_robot_data_human"
up = "+y"
root = ["left_upperleg", "right_upperleg"]
points = { left_hip = "left_upperleg", right_hip = "right_upperleg" }
lengths = { hip_width = { segment = "pelvis", from = "right_hip", to = "left_hip" } }
"""


def format_arm_table(upper_arm: str, forearm: str, hand: str, wrist: str, tip: str) -> str:
    """The table of a robot's arm by its links: three with sensors, and those at whose origins wrist and tip are."""
    segments = ", ".join(f'{link} = "{link}"' for link in (upper_arm, forearm, hand))
    return f"""kind = "mechanism"
segments = {{ {segments} }}
points = {{ shoulder = "{upper_arm}", elbow = "{forearm}", wrist = "{wrist}", tip = "{tip}" }}
[lengths]
upper_arm = {{ segment = "{upper_arm}", from = "shoulder", to = "elbow" }}
forearm = {{ segment = "{forearm}", from = "elbow", to = "wrist" }}
"""


UR = format_arm_table("upper_arm_link", "forearm_link", "wrist_3_link", wrist="wrist_1_link", tip="tool0")
PANDA = format_arm_table("panda_link2", "panda_link4", "panda_link7", wrist="panda_link5", tip="panda_hand")
# URDF, its table without the line that names it, and what the line says that asks for a table where none is needed.
HUMANS = {
    "cosmik_human.urdf": (COSMIK, ("cosmik_human.urdf: no link", "upperarmL", "docs/models.md")),
    "humanSubject01_66dof.urdf": (GAZEBO, ()),
}
ROBOTS = {
    "human_description/robots/human.urdf": (HUMAN, ()),
    "ur_description/urdf/ur5_robot.urdf": (UR, ("ur5_robot.urdf: no link", "upper_arm_link", "docs/models.md")),
    "panda_description/urdf/panda.urdf": (PANDA, ("panda.urdf: no link", "panda_link5", "docs/models.md")),
}


def check_foreign(
    path: Path, text: str, named: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The body loads by the table, with lengths that scale it; without it, or one line says what is missing."""
    table = folder / "foreign.toml"
    table.write_text(f'urdf = "{path}"\n{text}', encoding="utf-8")
    assert len(table.read_text(encoding="utf-8").splitlines()) <= 10
    body = load_model(table)
    assert len(body.lengths) >= 2
    assert set(body.reaches) == set(body.table.points)  # raises where a length does not act as the table says
    for name, value in body.lengths.items():
        assert body.with_lengths({name: 1.1 * value}).lengths[name] == pytest.approx(1.1 * value, rel=1e-9)
    if named:
        with pytest.raises(wp.WeposeError) as caught:
            load_model(path)
        assert "\n" not in str(caught.value)
        for part in named:
            assert part in str(caught.value)
        refuse(capsys, "calibrate", folder, "--model", path, "-o", folder / "out")
    else:
        assert set(load_model(path).lengths) <= set(body.lengths)


@pytest.mark.parametrize("name", list(HUMANS))
def test_a_foreign_person_loads(name: str, data: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, named = HUMANS[name]
    check_foreign(data / "human_urdf" / name, text, named, folder, capsys)


@pytest.mark.parametrize("name", list(ROBOTS))
def test_a_foreign_robot_loads(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, named = ROBOTS[name]
    check_foreign(example_robot_data_human().parents[2] / name, text, named, folder, capsys)


@pytest.mark.parametrize("adapter", ["0 0 0", "0 0 -0.02"])
def test_one_arm_with_a_rigid_hand_has_the_length_of_each(adapter: str, tmp_path: Path) -> None:
    text = (ROOT / "urdf" / "upper_body.urdf").read_text(encoding="utf-8")
    text = re.sub(r'(name="right_hand_[xyz]" type=)"revolute"', r'\1"fixed"', text)
    wrist = '(<child link="right_hand_y_link"/><origin xyz=")0 0 0'  # what is between forearm and hand is the forearm's
    (tmp_path / "arm.urdf").write_text(re.sub(wrist, rf"\g<1>{adapter}", text))
    links = "".join(f'{name} = "{name}"\n' for name in ("torso", "right_upper_arm", "right_forearm", "right_hand"))
    (tmp_path / "arm.toml").write_text(f'like = "upper_body"\n[segments]\n{links}[points]\nright_palm = "right_palm"\n')
    body = load_model(tmp_path / "arm.urdf")
    load_protocol("free").check_body(body.table)  # it names a length that this body does not have, as an example
    for name, value in body.lengths.items():
        assert body.with_lengths({name: 1.1 * value}).lengths == pytest.approx(body.lengths | {name: 1.1 * value})


def test_a_session_on_a_robot_without_a_table_says_what_is_missing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("recording.parquet", "arm.urdf"):
        shutil.copyfile(folder / name, tmp_path / name)
    text = (folder / "session.toml").read_text(encoding="utf-8")
    (tmp_path / "session.toml").write_text('model = "arm.urdf"\n' + text, encoding="utf-8")
    line = refuse(capsys, "calibrate", tmp_path, "--protocol", "tip", "-o", tmp_path / "out")
    for part in ("arm.urdf: this body has no lengths", "docs/models.md"):
        assert part in line
