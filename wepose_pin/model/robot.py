"""Frames of a robot's Pinocchio model."""

from __future__ import annotations

import pinocchio as pin


def distinguish_frames(model: pin.Model) -> pin.Model:
    """The model with other names for fixed joints that have the name of a link: Pinocchio finds frames by name."""
    links = {frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
    for frame in model.frames:
        if frame.type == pin.FrameType.FIXED_JOINT and frame.name in links:
            frame.name = f"{frame.name} (fixed joint)"
    return model
