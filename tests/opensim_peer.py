"""What the tests ask OpenSim, in a process of its own: its casadi and ours cannot live in one.

Nothing of wepose_pin is imported here, so that it shares no code.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import opensim as osim

osim.Logger.setLevelString("off")
osim.Logger.removeFileSink()  # it would leave opensim.log where the tests are run


def read(file: Path) -> dict[str, Any]:
    """A .mot or a .trc: `labels`, `time` (n,), `values` (n, columns, …), `header`.

    No class of this module: whoever unpickled one would import OpenSim.
    """
    table = {".mot": osim.TimeSeriesTable, ".trc": osim.TimeSeriesTableVec3}[file.suffix](str(file))
    labels = list(table.getColumnLabels())
    rows = []
    for i in range(table.getNumRows()):
        row = table.getRowAtIndex(i)
        if file.suffix == ".mot":
            rows.append(row.to_numpy())
        else:
            rows.append([row[k].to_numpy() for k in range(len(labels))])
    keys = [key for key in ("inDegrees", "Units", "DataRate") if table.hasTableMetaDataKey(key)]
    header = {key: table.getTableMetaDataString(key) for key in keys}
    time = np.array(table.getIndependentColumn())
    return {"labels": labels, "time": time, "values": np.array(rows), "header": header}


def arm_model() -> Any:
    """The joints of Rajagopal_2015.osim from the pelvis up, with the orientations of their frames as they stand there.

    Rotations alone: places of joints do not matter here.
    """
    model = osim.Model()
    vec, none = osim.Vec3, osim.Vec3(0.0)

    def body(name: str) -> Any:
        segment = osim.Body(name, 1.0, none, osim.Inertia(0.1))
        model.addBody(segment)
        return segment

    def custom(name: str, parent: Any, child: Any, coordinates: list[str], signs: tuple[float, float, float]) -> None:
        turn = osim.SpatialTransform()
        axes = (vec(0, 0, signs[0]), vec(signs[1], 0, 0), vec(0, signs[2], 0))
        for k, (coordinate, axis) in enumerate(zip(coordinates, axes, strict=True)):
            of = (turn.upd_rotation1, turn.upd_rotation2, turn.upd_rotation3)[k]()
            names = osim.ArrayStr()
            names.append(coordinate)
            of.setCoordinateNames(names)
            of.setAxis(axis)
            of.set_function(osim.LinearFunction(1.0, 0.0))
        model.addJoint(osim.CustomJoint(name, parent, none, none, child, none, none, turn))

    pelvis, torso = body("pelvis"), body("torso")
    custom("ground_pelvis", model.getGround(), pelvis, ["pelvis_tilt", "pelvis_list", "pelvis_rotation"], (1, 1, 1))
    custom("back", pelvis, torso, ["lumbar_extension", "lumbar_bending", "lumbar_rotation"], (1, 1, 1))
    for s, sign in (("r", 1.0), ("l", -1.0)):
        humerus, ulna, radius, hand = (body(f"{name}_{s}") for name in ("humerus", "ulna", "radius", "hand"))
        custom(f"acromial_{s}", torso, humerus, [f"arm_{of}_{s}" for of in ("flex", "add", "rot")], (1, sign, sign))
        elbow = vec(-0.0228627 * sign, 0.228018 * sign, 0.0051689)
        joint = osim.PinJoint(f"elbow_{s}", humerus, none, elbow, ulna, none, elbow)
        joint.updCoordinate().setName(f"elbow_flex_{s}")
        model.addJoint(joint)
        turn = vec(-1.56884 * sign, 0.056428 * sign, 1.53614)
        joint = osim.PinJoint(f"radioulnar_{s}", ulna, none, turn, radius, none, turn)
        joint.updCoordinate().setName(f"pro_sup_{s}")
        model.addJoint(joint)
        wrist = vec(-1.5708 * sign, 0.0, -1.5708 * sign)
        joint = osim.UniversalJoint(f"radius_hand_{s}", radius, none, wrist, hand, none, wrist)
        joint.updCoordinate(0).setName(f"wrist_flex_{s}")
        joint.updCoordinate(1).setName(f"wrist_dev_{s}")
        model.addJoint(joint)
    model.finalizeConnections()
    return model


def bodies(values: Mapping[str, np.ndarray], names: list[str]) -> dict[str, np.ndarray]:
    """Body → (n, 3, 3) in ground, with the coordinates at `values` (n,) [rad]."""
    model = arm_model()
    state = model.initSystem()
    handles = {name: model.getCoordinateSet().get(name) for name in values}
    by_body: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for k in range(len(next(iter(values.values())))):
        for name, handle in handles.items():
            handle.setValue(state, float(values[name][k]), False)
        model.realizePosition(state)
        for name, rows in by_body.items():
            R = model.getBodySet().get(name).getTransformInGround(state).R().asMat33()
            rows.append(np.array([[R.get(i, j) for j in range(3)] for i in range(3)]))
    return {name: np.array(rows) for name, rows in by_body.items()}


def opensense(folder: Path) -> dict[str, Any]:
    """Places the sensors of ``placement.sto`` on the model and follows those of ``x.sto``."""
    arm_model().printToXML(str(folder / "model.osim"))
    placer = osim.IMUPlacer()
    placer.set_model_file(str(folder / "model.osim"))
    placer.set_orientation_file_for_calibration(str(folder / "placement.sto"))
    placer.set_sensor_to_opensim_rotations(osim.Vec3(0.0))
    placer.set_output_model_file(str(folder / "placed.osim"))
    placer.run(False)
    tool = osim.IMUInverseKinematicsTool()
    tool.set_model_file(str(folder / "placed.osim"))
    tool.set_orientations_file(str(folder / "x.sto"))
    tool.set_sensor_to_opensim_rotations(osim.Vec3(0.0))
    tool.set_results_directory(str(folder / "ik"))
    tool.set_accuracy(1e-9)
    tool.run(False)
    return read(next((folder / "ik").glob("*.mot")))


def run_scale_tool(setup: Path, model: str) -> dict[str, np.ndarray]:
    """Body → where the joint that moves it is (3,) [m] in ground, all joints at zero, in the model that is written."""
    here = Path.cwd()
    os.chdir(setup.parent)
    try:
        assert osim.ScaleTool(setup.name).run()
        scaled = osim.Model(model)
    finally:
        os.chdir(here)
    coordinates = scaled.updCoordinateSet()
    for k in range(coordinates.getSize()):
        if not coordinates.get(k).getName().startswith("pelvis_t"):
            coordinates.get(k).setDefaultValue(0.0)
    state = scaled.initSystem()
    scaled.realizePosition(state)
    centres = {}
    for k in range(scaled.getJointSet().getSize()):
        child = scaled.getJointSet().get(k).getChildFrame()
        centres[child.findBaseFrame().getName()] = child.getPositionInGround(state).to_numpy()
    return centres
