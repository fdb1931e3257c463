"""A person's arms to a robot's: targets from a pose, limits, one quadratic programme a step, a trajectory.

Frames: the robot's root is the frame of its URDF; T is the person's torso, x forward, y left, z up. ``R_BT`` turns T's
coordinates into the root's. Values of joints are `u`, one for each joint that moves by itself; `q` is Pinocchio's.
"""

from .check import Kept, kept, touching
from .files import summary, table, write_episode, write_trajectory
from .maps import ROBOTS, RobotMap, find_map, read_map
from .person import Wish, wish
from .plan import Trajectory, retarget
from .robot import Robot, load
from .solver import Tasks

__all__ = [
    "ROBOTS",
    "Kept",
    "Robot",
    "RobotMap",
    "Tasks",
    "Trajectory",
    "Wish",
    "find_map",
    "kept",
    "load",
    "read_map",
    "retarget",
    "summary",
    "table",
    "touching",
    "wish",
    "write_episode",
    "write_trajectory",
]
