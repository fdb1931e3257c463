"""A device's files, a format, a source and an output that wepose-pin does not have: `pip install examples/plugin`."""

from pathlib import Path

import numpy as np

from wepose_pin.live import Output
from wepose_pin.live.sources import SourceKind
from wepose_pin.live.sources.replay import ReplaySource
from wepose_pin.readers import load_session, registry
from wepose_pin.readers.device import Signal, make_device
from wepose_pin.writers import export


def read(path, use, rate_hz):  # a file a sensor: rows of time [s], gyro [rad/s], accel [m/s²]
    time, *values = np.loadtxt(path, unpack=True)
    signals = {"gyro": Signal(time, np.transpose(values[:3])), "accel": Signal(time, np.transpose(values[3:]))}
    return make_device(path, {path.stem: signals}, "gyro and accel", use, rate_hz)


def write(path, motion):  # rows of time [s] and the right palm [m]
    np.savetxt(path, np.column_stack([motion.pose.time, motion.pose.points["right_palm"]]))


class PalmHeight(Output):
    def __init__(self, argument):
        self.file = Path(argument).open("w")  # noqa: SIM115

    def start(self, info):
        self.palm = info.points.index("right_palm")

    def show(self, pose):
        print(pose.time, pose.points[self.palm, 2], file=self.file)

    def close(self):
        self.file.close()


READER = registry.Format("recording of an Acme Band", lambda path, _: path.suffix == ".acme", read)
WRITER = export.Format(export.PERSON, write)
SOURCE = SourceKind("acme:SESSION", lambda session, _: ReplaySource(load_session(session)))
