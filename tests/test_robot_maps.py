"""Maps of robots, and what is refused of a robot: each in a line that says where."""

from dataclasses import replace
from pathlib import Path

import pytest
from arms import person, write_arm

from wepose_pin import errors, retargeting
from wepose_pin.body.kinematics import Pose

pytest.importorskip("daqp")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> retargeting.Robot:
    return load(write_arm(tmp_path_factory.mktemp("arm")))


def load(urdf: Path) -> retargeting.Robot:
    return retargeting.load_robot(str(urdf))


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("elbow.limit", "joint 'elbow' has no position limits"),
        ("elbow.velocity", "joint 'elbow' has no velocity limit"),
        ("pitch.acceleration", "limits.acceleration: joint 'pitch' has none"),
    ],
)
def test_a_robot_without_limits_is_refused_with_the_joint_named(tmp_path: Path, key: str, text: str) -> None:
    with pytest.raises(errors.WeposeError, match=text):
        load(write_arm(tmp_path, without=key))


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("format = 1", "format = 2", "format = 2; this version reads format = 1"),
        ('up = "+z"', 'up = "z"', r"arm.toml: up = 'z' is not known; .*there is: \+x, \+y"),
        ('up = "+z"', 'up = "+x"', r"arm.toml: up, forward: \+x and \+x lie on one line"),
        (
            'link = "forearm"',
            'link = "foream"',
            "arms.right.elbow: no link 'foream' in arm.urdf; did you mean 'forearm'",
        ),
        ('"yaw"]', '"jaw"]', "arms.right.joints: no moving joint 'jaw' in arm.urdf; did you mean 'yaw'"),
        ("[arms.right]", "[arms.middle]", "arms.middle is not a known key"),
        ("shoulder =", "schoulder =", "arms.right.schoulder is not a known key; did you mean 'shoulder'"),
        ("elbow = -1.2", "elbow = 1.2", "rest.elbow = 1.2 is outside its limits, -2.6 to -0.02"),
        ("elbow = -1.2", "elbo = -1.2", "rest: no moving joint 'elbo' in arm.urdf; did you mean 'elbow'"),
        ("offset = [0.0, 0.0, -0.1]", "offset = [0.0, 0.0]", r"hand.offset = \[0.0, 0.0\]; a list of 3 numbers \[m\]"),
        ("yaw = 12.0", "yaw = 1e300", r"limits.acceleration.yaw = 1e\+300; a number from"),
        ("yaw = 12.0", "yaw = 12.0\n[limits.jerk]\nyaw = -5.0", "limits.jerk: joint 'yaw' is -5"),
        (
            "[limits.acceleration]",
            "[limits]\njerk = 'high'\n[limits.acceleration]",
            r"limits.jerk = 'high'; a number from -1e\+06 to 1e\+06, or a mapping",
        ),
        ("[rest]", "[limits.velocity]\njaw = 1.0\n[rest]", "limits.velocity: no moving joint 'jaw' in arm.urdf"),
        (
            "[rest]",
            "[limits.position]\nyaw = [1.0, -1.0]\n[rest]",
            r"limits.position.yaw = \[1, -1\]; the first must be smaller",
        ),
        ("yaw = 12.0", "yaw = -1.0", "limits.acceleration: joint 'yaw' is -1; a number above 0"),
        ("hand = {", "reach = 3.0\nhand = {", r"arms.right.reach = 3: the joints allow 0\.\d\d m at most"),
        ("[rest]", "[rest", "not valid TOML"),
    ],
)
def test_a_map_that_is_wrong_says_where(tmp_path: Path, old: str, new: str, text: str) -> None:
    urdf = write_arm(tmp_path)
    said = urdf.with_suffix(".toml").read_text()
    assert old in said
    urdf.with_suffix(".toml").write_text(said.replace(old, new, 1))
    with pytest.raises(errors.WeposeError, match=text):
        load(urdf)


@pytest.mark.parametrize(("up", "forward"), [("-z", "+x"), ("+z", "-x"), ("+x", "+y")])
def test_a_rest_of_another_mount_is_refused(tmp_path: Path, up: str, forward: str) -> None:
    urdf = write_arm(tmp_path, up=up, forward=forward)
    with pytest.raises(errors.WeposeError, match=r"arm.toml: rest: the right hand is .* give a rest for this mount"):
        load(urdf)
    text = urdf.with_suffix(".toml").read_text()
    urdf.with_suffix(".toml").write_text(text.replace("[rest]\nelbow = -1.2", ""))
    load(urdf)


def test_of_an_arm_that_is_not_there_the_message_says_what_to_do(arm) -> None:
    pose = person(2.0)

    def without(*parts: str) -> Pose:
        quat = {name: quat for name, quat in pose.quat_WL.items() if name not in parts}
        return replace(pose, quat_WL=quat, points={n: p for n, p in pose.points.items() if "torso" not in parts})

    with pytest.raises(
        errors.WeposeError,
        match="right_forearm, which the sensors do not measure; an arm needs sensors on torso, upper",
    ):
        retargeting.retarget(without("right_forearm"), arm)
    with pytest.raises(errors.WeposeError, match="torso, right_shoulder"):
        retargeting.retarget(without("torso"), arm)
    with pytest.raises(
        errors.WeposeError, match=r"right arm follows right_.*; an arm needs sensors on torso, upper arm and forearm$"
    ):
        retargeting.retarget(person(2.0, side="left"), arm)
    has_both = arm.map._replace(arms={**arm.map.arms, "left": arm.map.arms["right"]})  # of which one was selected
    with pytest.raises(errors.WeposeError, match=r"arm's right arm follows right_[^;]*;.* or choose arm left$"):
        retargeting.retarget(person(2.0, side="left"), replace(arm, map=has_both))


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    with pytest.raises(errors.WeposeError, match="`robot` pandas: not known; did you mean 'panda'"):
        retargeting.find_map("pandas")
    with pytest.raises(errors.WeposeError, match=r"`arm` left: arm has no left arm; there is: right"):
        retargeting.load_robot(str(urdf), ("left",))
    urdf.with_suffix(".toml").unlink()
    with pytest.raises(errors.WeposeError, match=r"no arm.toml beside it; a robot needs a map"):
        retargeting.find_map(str(urdf))
