"""A person's arms to a robot's: targets from a pose, limits, one quadratic programme a step, a trajectory.

Frames: B is the robot's root, the frame of its URDF; T is the person's torso, x forward, y left, z up; ``R_BT`` maps
coordinates in T to B. `u` holds the values of the joints of the arms, `q` is Pinocchio's configuration.
"""

from .controller import ControllerParams
from .files import (
    LimitCheck,
    SelfCollisions,
    build_table,
    check_limits,
    find_self_collisions,
    summarize,
    write_trajectory,
)
from .maps import ROBOTS, find_map, read_map
from .robot import Robot, load_robot
from .stream import ArmObserver, Command, CommandStream
from .targets import compute_arm_targets
from .trajectory import Trajectory, retarget
