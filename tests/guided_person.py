"""A simulated person with five raw sensors in any rotation, who does what the guide says, or does it wrong."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from wepose_pin import MILD_PRESET, Simulation, simulate, simulate_person
from wepose_pin.live.sources import Source
from wepose_pin.recording.arrivals import Samples

RATE_HZ = 100.0
STAND = 60, 440  # samples of the simulation in which the person stands
RETURN_FASTER = 12  # times, back to the start pose: samples in between are left out
SHAKE_HZ, SHAKE_RATE = 3.0, 8.0  # amplitude in rad/s
NAMES = ("a7", "b2", "c9", "d4", "e5")


@lru_cache(maxsize=4)
def perform(seed: int, clasp_s: float) -> Simulation:
    """A person whose clasp lasts longer than the guide asks for."""
    lengths = simulate_person(seed).lengths
    imperfections = replace(MILD_PRESET, mount="any", dropped=0.0)
    return simulate(lengths, seed=seed, imperfections=imperfections, clasp_s=clasp_s, circles=0)


class GuidedPerson:
    """Plays the samples of a simulation to and fro: what is asked for decides where to.

    Attributes
    ----------
    doing : "stand", "clasp", or "shake SEGMENT"
    silent : segments whose sensors send nothing
    worn : sensor → segment that it sits on
    orientations : what sensors measure in place of rates and specific forces: "sensor" or "segment" orientations
    """

    def __init__(self, simulation: Simulation, worn: Mapping[str, str] | None = None, orientations: str = "") -> None:
        self.simulation, self.orientations = simulation, orientations
        self.worn = dict(zip(NAMES, simulation.gyro_S, strict=True)) if worn is None else dict(worn)
        self.doing, self.silent = "stand", set[str]()
        self.disturb: Callable[[str, np.ndarray], np.ndarray] = lambda _segment, gyro: gyro
        self._k, self._direction, self._sent = STAND[0], 1, 0

    def follow(self, step: str, highlight: str) -> None:
        """Do what the guide's view says."""
        shakes = step == "assignment" and highlight
        self.doing = f"shake {highlight}" if shakes else "clasp" if step in ("clasp", "quality") else "stand"

    def step(self) -> tuple[float, dict[str, tuple[np.ndarray, np.ndarray]]]:
        """Time [s] of the next sample, and sensor → gyro (3,) and accel (3,)."""
        before, simulation = self._k, self.simulation
        if self.doing == "clasp" and self._k < len(simulation.time) - 300:
            self._direction = 1
        elif self._k >= STAND[1] or self._k >= len(simulation.time) - 300:
            self._direction = -1
        elif self._k <= STAND[0]:
            self._direction = 1
        returns = self._direction < 0 and self._k > STAND[1] + RETURN_FASTER
        self._k += self._direction * (RETURN_FASTER if returns else 1)
        row = max(before, self._k)  # the rate over the interval between the two
        self._sent += 1
        time_s = self._sent / RATE_HZ
        samples = {}
        for sensor, segment in self.worn.items():
            bias = simulation.gyro_bias[segment][row]
            gyro = bias + self._direction * (simulation.gyro_S[segment][row] - bias)
            accel = simulation.accel_S[segment][self._k]
            if self.doing == f"shake {segment}" and time_s % 3.0 < 1.5:
                wave = 2.0 * np.pi * SHAKE_HZ
                gyro = gyro + SHAKE_RATE * np.cos(wave * time_s)
                accel = Rotation.from_rotvec(np.full(3, -SHAKE_RATE / wave * np.sin(wave * time_s))).apply(accel)
            gyro = self.disturb(segment, gyro)
            if segment in self.silent:
                continue
            if self.orientations:
                quat = self._orient(segment, time_s)
                samples[sensor] = quat[:3], np.array([quat[3], 0.0, 0.0])  # six numbers, as sources give them
            else:
                samples[sensor] = gyro, accel
        return time_s, samples

    def _orient(self, segment: str, time_s: float) -> np.ndarray:
        """Orientation (4,) xyzw of a segment in W, or of its sensor in a world of its own; a shake turns it."""
        if self.orientations == "segment":
            return self.simulation.quat_WL[segment][self._k]
        R = Rotation.from_quat(self.simulation.quat_WS[segment][self._k])
        if self.doing == f"shake {segment}" and time_s % 3.0 < 1.5:
            angle = SHAKE_RATE / (2.0 * np.pi * SHAKE_HZ) * np.cos(2.0 * np.pi * SHAKE_HZ * time_s)
            R = R * Rotation.from_rotvec([angle, 0.0, 0.0])
        own = Rotation.from_rotvec([0.0, 0.0, 0.7 * list(self.worn.values()).index(segment)])
        return np.array((own * R).as_quat())


class PersonSource(Source):
    """A source with a clock of its own: the person acts as fast as the guide takes samples."""

    def __init__(self, person: GuidedPerson, step_s: float = 0.1) -> None:
        super().__init__(person.worn, RATE_HZ)
        self.person = person
        self._rows, self._now = round(step_s * RATE_HZ), 0.0
        self.asleep_s = 0.0  # [s] for which nothing comes
        self.accel_scale = 1.0  # of the unit that it sends to SI

    @property
    def orientations(self) -> dict[str, bool]:
        aligned = self.person.orientations == "segment"
        return dict.fromkeys(self.person.worn, aligned) if self.person.orientations else {}

    def open(self) -> None: ...

    def clock(self) -> float:
        return self._now

    def read(self, timeout_s: float) -> list[Samples] | None:
        assert timeout_s > 0.0
        rows = [self.person.step() for _ in range(self._rows)]
        self._now = rows[-1][0]
        if self.asleep_s > 0.0:
            self.asleep_s -= self._rows / RATE_HZ
            return []
        samples = []
        for sensor in self.person.worn:
            own = [(t, *values[sensor]) for t, values in rows if sensor in values]
            if own:
                time_s, gyro, accel = (np.array(column) for column in zip(*own, strict=True))
                samples.append(Samples(sensor, time_s, gyro, self.accel_scale * accel))
        return samples

    def close(self) -> None: ...


class UdpPerson:
    """Sends the person's samples in real time, as JSON, from a thread of its own."""

    def __init__(self, person: GuidedPerson, port: int) -> None:
        self.person, self._to = person, ("127.0.0.1", port)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> UdpPerson:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            begin, sent = time.monotonic(), 0
            while not self._end.is_set():
                time.sleep(max(0.0, begin + sent / RATE_HZ - time.monotonic()))
                t, samples = self.person.step()
                sent += 1
                lines = [
                    json.dumps({"sensor": sensor, "t": t, "gyro": gyro.tolist(), "accel": accel.tolist()})
                    for sensor, (gyro, accel) in samples.items()
                ]
                sender.sendto("\n".join(lines).encode(), self._to)
