"""Any URDF as it is, for chains that are no upper body: Pinocchio's own reading, no joint made spherical."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin

from ..arguments import check_arguments
from ..errors import BadModel, BadSession, native_stderr_muted, one_of
from .body import read_urdf
from .tree import parse_tree


def load_robot(path: str | Path) -> pin.Model:
    """The model of a URDF; W is its root link, which stands with z up.

    Raises
    ------
    MissingFile, BadModel
        Not there; not a URDF; no tree with one root; nothing in it moves.
    """
    check_arguments(load_robot, locals())
    path = Path(path)
    parse_tree(read_urdf(path), str(path))
    try:
        with native_stderr_muted():
            model = distinguish_frames(pin.buildModelFromUrdf(str(path)))
    except Exception as error:  # what C++ throws
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadModel(f"{path}: Pinocchio cannot build it: {reason}") from error
    if model.nv == 0:
        raise BadModel(f"{path}: no joint moves; a chain of revolute or prismatic joints is wanted")
    return model


def distinguish_frames(model: pin.Model) -> pin.Model:
    """The model with other names for fixed joints that have the name of a link: Pinocchio finds frames by name."""
    links = {frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
    for frame in model.frames:
        if frame.type == pin.FrameType.FIXED_JOINT and frame.name in links:
            frame.name = f"{frame.name} (fixed joint)"
    return model


def start_configuration(model: pin.Model, values: Mapping[str, float], where: str) -> np.ndarray:
    """`q` (nq,) with joints at `values` [rad or m], the others at zero; `where` begins an error's text.

    Raises
    ------
    BadSession
        A joint that the model does not have, of more than one axis, or a value outside its limits.
    """
    v = np.zeros(model.nv)
    names = [name for k, name in enumerate(model.names) if k and model.nvs[k] == 1]
    for name, value in values.items():
        if name not in names:
            raise BadSession(f"{where}: joints.{name} is no joint of one axis of {model.name}; {one_of(names, name)}")
        joint = model.getJointId(name)
        v[model.idx_vs[joint]] = value
        if model.nqs[joint] == 1:
            low, high = (a[model.idx_qs[joint]] for a in (model.lowerPositionLimit, model.upperPositionLimit))
            if not low - 1e-6 <= value <= high + 1e-6:
                raise BadSession(f"{where}: joints.{name} = {value:g} is outside its limits, {low:g} to {high:g}")
    return pin.integrate(model, pin.neutral(model), v)


def joint_values(model: pin.Model, q: np.ndarray) -> dict[str, np.ndarray]:
    """Joint → its value (n,) [rad or m] of configurations (n, nq); only joints of one axis. Without end: unwrapped."""
    values = {}
    for joint in range(1, model.njoints):
        first = model.idx_qs[joint]
        if model.nqs[joint] == 1:
            values[model.names[joint]] = q[:, first]
        elif model.nvs[joint] == 1:
            values[model.names[joint]] = np.unwrap(np.arctan2(q[:, first + 1], q[:, first]))
    return values
