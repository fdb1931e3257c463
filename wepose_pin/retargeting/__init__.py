"""A person's arms to a robot's: targets from a pose, limits, one quadratic programme a step, a trajectory.

Frames: B is the robot's root, the frame of its URDF; T is the person's torso, x forward, y left, z up; ``R_BT`` maps
coordinates in T to B. `u` holds the values of the joints of the arms, `q` is Pinocchio's configuration.
"""

from .checks import LimitCheck, SelfCollisions, check_limits, find_self_collisions
from .controller import ControllerParams
from .files import build_table, summarize, write_trajectory
from .maps import ROBOTS, RobotMap, find_map, read_joint_limits, read_map
from .robot import Robot, load_robot
from .stream import ArmObserver, Command, CommandStream
from .targets import ArmTargets, compute_arm_targets
from .trajectory import Trajectory, retarget

__all__ = [
    "ROBOTS",
    "ArmObserver",
    "ArmTargets",
    "Command",
    "CommandStream",
    "ControllerParams",
    "LimitCheck",
    "Robot",
    "RobotMap",
    "SelfCollisions",
    "Trajectory",
    "build_table",
    "check_limits",
    "compute_arm_targets",
    "find_map",
    "find_self_collisions",
    "load_robot",
    "read_joint_limits",
    "read_map",
    "retarget",
    "summarize",
    "write_trajectory",
]
