"""A person's arms to a robot's: targets from a pose, limits, one quadratic programme a step, a trajectory.

Frames: B is the robot's root, the frame of its URDF; T is the person's torso, x forward, y left, z up; ``R_BT`` maps
coordinates in T to B. `u` holds the values of the joints of the arms, `q` is Pinocchio's configuration.
"""

from .controller import ControllerParams as ControllerParams
from .files import LimitCheck as LimitCheck
from .files import SelfCollisions as SelfCollisions
from .files import build_table as build_table
from .files import check_limits as check_limits
from .files import find_self_collisions as find_self_collisions
from .files import summarize as summarize
from .files import write_trajectory as write_trajectory
from .maps import ROBOTS as ROBOTS
from .maps import find_map as find_map
from .maps import read_map as read_map
from .robot import Robot as Robot
from .robot import load_robot as load_robot
from .stream import ArmObserver as ArmObserver
from .stream import Command as Command
from .stream import CommandStream as CommandStream
from .targets import compute_arm_targets as compute_arm_targets
from .trajectory import Trajectory as Trajectory
from .trajectory import retarget as retarget
