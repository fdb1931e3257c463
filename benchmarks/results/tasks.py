"""What `save` runs: tasks that do not depend on each other; the keys of their numbers begin with a command."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from . import adapter
from .arrays import Arrays, file_values, folder_values, values_of
from .inputs import REAL, makers, read_known

BROAD = ("01_undisturbed_slow_rotation_A.mat", "16_undisturbed_fast_translation_B.mat", "25_disturbed_tapping_B.mat")
# One of each kind: five joints on a table, two arms, shapes that the map places. The others are of these kinds.
OTHER_ROBOTS = ("so101", "baxter")
DEVICE_FILES = (
    ("mvnx", "test_mocap.mvnx"),
    ("mvnx", "Meri-020.mvnx"),
    ("mt_manager", "MT2022_ACC_GYRO_ROT_MAT_SPACE_00B42D4B.txt"),
    ("mt_manager", "apdm_format7.csv"),
)


class Missing(Exception):
    """What a task needs is not on this machine; it is skipped and named."""


class Failed(Exception):
    """A command ended as it should not have."""


@dataclass(frozen=True)
class Places:
    """Where a task finds its inputs and may write."""

    inputs: Path
    data: Path | None  # real recordings
    work: Path  # an empty folder of the task's own

    def session(self, name: str) -> Path:
        folder = self.inputs / name
        if not folder.is_dir():
            raise Missing(f"no recording {name}")
        return folder

    def real(self, *path: str) -> Path:
        if self.data is None or not self.data.joinpath(*path).exists():
            raise Missing(f"no {'/'.join(path)} among the real recordings")
        return self.data.joinpath(*path)


class Task(NamedTuple):
    """`cost`: about how many seconds it takes, so that long ones begin first."""

    name: str
    run: Callable[[Places], Arrays]
    cost: float = 10.0


def command(argv: list[str]) -> Arrays:
    """Run a command that has to succeed: its exit code."""
    outcome = adapter.run(argv)
    if outcome.code not in adapter.ACCEPTED.get(argv[0], (0,)):
        raise Failed(f"{' '.join(argv)}\nexit code {outcome.code}: {outcome.error}")
    return {"exit_code": np.array(float(outcome.code))}


def _under(key: str, arrays: Arrays) -> Arrays:
    return {f"{key}/{name}": values for name, values in arrays.items()}


# A person ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Person:
    """Calibrate, track, evaluate and export one input by one method."""

    recording: str
    method: str = "amekf"
    calibrated: bool = True
    subject_from: str = ""  # the input that calibrates, where it is another one
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"whole": ()})  # name → options of `track`
    exports: tuple[str, ...] = ()  # variants whose results are exported in all formats
    functions: bool = False  # what the Python functions give too

    def __call__(self, places: Places) -> Arrays:
        session = places.session(self.recording)
        known = read_known(session)
        where = f"{self.recording}/{self.method}"
        found: Arrays = {}
        subject = None
        if self.calibrated:
            by, subject = places.session(self.subject_from or self.recording), places.work / "subject"
            argv = adapter.calibrate(by, subject, method=self.method, protocol=known["protocol"], known=known)
            found |= _under(f"calibrate/{where}", command(argv)) | folder_values(subject, f"calibrate/{where}")
        for name, options in self.variants.items():
            result, at = places.work / name, f"{where}/{name}"
            found |= tracked(session, result, at, method=self.method, subject=subject, options=options)
            if (session / "truth.parquet").is_file():
                errors = adapter.errors_of(result, session / "truth.parquet")
                found |= values_of(errors, f"evaluate/{at}")
            if name in self.exports:
                found |= exported(result, places.work / f"{name}_exports", at)
        if self.functions:
            found |= values_of(adapter.recording_values(session), f"read/{self.recording}")
            found |= values_of(adapter.tracked_values(session, subject, self.method), f"function_track/{where}")
            if self.calibrated:
                values = adapter.calibration_values(session, known["measured"])
                found |= values_of(values, f"function_calibrate/{where}")
        return found


def tracked(session: Path, result: Path, key: str, **settings: Any) -> Arrays:
    """The numbers of `track`."""
    found = _under(f"track/{key}", command(adapter.track(session, result, **settings)))
    return found | folder_values(result, f"track/{key}")


def exported(result: Path, folder: Path, key: str) -> Arrays:
    """The numbers of all exported files."""
    folder.mkdir()
    found: Arrays = {}
    for name, options in adapter.EXPORTS:
        if name.endswith(".c3d") and importlib.util.find_spec("ezc3d") is None:
            continue
        command(adapter.export(result, folder / name, options))
        found |= file_values(folder / name, f"export/{key}/{name}")
    return found


def _methods(recording: str, exported_methods: Iterable[str] = ()) -> list[Task]:
    """A person tracked by each method in each way."""
    found = []
    for method in adapter.METHODS:
        variants: dict[str, tuple[str, ...]] = {"whole": ("covariance",)}
        if method not in adapter.OFFLINE:
            variants["causal"] = ("causal",)
        exports = ("whole",) if method in exported_methods else ()
        person = Person(recording, method, variants=variants, exports=exports, functions=method == "amekf")
        found.append(Task(f"{recording}/{method}", person, 20.0))
    return found


# Others ------------------------------------------------------------------------------------------------------------


def _model(places: Places) -> Arrays:
    """A body of 48 degrees of freedom, with torques."""
    urdf = places.real("human_urdf", "humanSubject01_48dof.urdf")
    session = places.session("mild")
    result, name = places.work / "limits", "48dof/limits"
    found = tracked(session, result, name, method="amekf", model=urdf, options=("torques",))
    return found | exported(result, places.work / "limits_exports", name)


def _chain(places: Places) -> Arrays:
    session = places.session("chain")
    settings = {"model": session / "arm.urdf", "options": ("torques",)}
    return tracked(session, places.work / "result", "chain/amekf/whole", method="amekf", **settings)


def _simulate(seed: int, preset: str, protocol: str, *changes: str) -> Callable[[Places], Arrays]:
    def run(places: Places) -> Arrays:
        command(adapter.simulate(places.work / "made", seed=seed, preset=preset, protocol=protocol, changes=changes))
        return folder_values(places.work / "made", f"simulate/{preset}_{protocol}")

    return run


def _retarget(robot: str, *options: str) -> Callable[[Places], Arrays]:
    def run(places: Places) -> Arrays:
        if not adapter.has_robot(robot):
            raise Missing(f"no model of {robot}")
        session, result = places.session("mild"), places.work / "result"
        known = read_known(session)
        subject, out = places.work / "subject", places.work / "out"
        command(adapter.calibrate(session, subject, method="amekf", protocol=known["protocol"], known=known))
        command(adapter.track(session, result, method="amekf", subject=subject))
        key = f"retarget/mild/{'_'.join([robot, *(option.lstrip('-') for option in options)])}"
        code = command(adapter.retarget(result, out, robot=robot, options=options))
        return _under(key, code) | folder_values(out, key)

    return run


def _demo(places: Places) -> Arrays:
    command(adapter.demo(places.work / "out"))
    return folder_values(places.work / "out", "demo")


def _batch(places: Places) -> Arrays:
    """What a study of one session makes; each step as the command of its name."""
    session, plan, out = places.session("mild"), places.work / "plan.toml", places.work / "out"
    adapter.write_plan(plan, session, read_known(session))
    command(adapter.batch(plan, out))
    return folder_values(out, "batch")


def _live(method: str) -> Callable[[Places], Arrays]:
    def run(places: Places) -> Arrays:
        file, result = places.work / "a.mcap", places.work / "result"
        command(adapter.live(places.session("mild"), file, method=method, subject=None))
        found = values_of(adapter.recording_values(file), f"live/mild/{method}/read")
        command(adapter.track_live_recording(file, result))
        return found | folder_values(result, f"live/mild/{method}")

    return run


def _broad(file: str) -> Callable[[Places], Arrays]:
    def run(places: Places) -> Arrays:
        from scipy.io import loadmat

        trial = loadmat(str(places.real("broad", file)))
        rate_hz = float(np.ravel(trial.get("sampling_rate", 2000.0 / 7.0))[0])
        return _orientations(f"broad_{file[:2]}", trial["imu_gyr"], trial["imu_acc"], rate_hz, (5.0, 20.0))

    return run


def _authors_trial(places: Places) -> Arrays:
    text = places.real("wepose_hr", "prova_HR.txt").read_text(encoding="utf-8").replace(";", " ")
    table = np.array([line.split() for line in text.splitlines() if line.strip()], dtype=float)
    return _orientations("authors_trial", table[:, 1:4], table[:, 4:7], 1000.0, (0.1, 0.9))


def _orientations(
    name: str, gyro: np.ndarray, accel: np.ndarray, rate_hz: float, static: tuple[float, float]
) -> Arrays:
    """One sensor by each method, with a static phase and without."""
    found: Arrays = {}
    for method in adapter.METHODS:
        for how, span in (("static", static), ("no_static", None)):
            values = adapter.orientation_values(gyro, accel, rate_hz, method, span)
            found |= values_of(values, f"orientation/{name}/{method}/{how}")
    return found


def _files(places: Places) -> Arrays:
    """Files of devices, as the session that `info` writes for them reads them."""
    found: Arrays = {}
    for folder, name in DEVICE_FILES:
        session = places.work / f"{name}.toml"
        command(adapter.info(places.real(folder, name), session))
        adapter.name_sensors(session, ("torso", "left_forearm"))
        found |= values_of(adapter.recording_values(session), f"read/{name}")
    return found


def _sessions(places: Places) -> Arrays:
    """Two clocks that become one, and phases that are looked for, as they are read."""
    found = values_of(adapter.recording_values(places.session("two_rates")), "read/two_rates")
    return found | values_of(adapter.recording_values(places.session("no_phases")), "read/no_phases")


def tasks() -> list[Task]:
    """All of them, the longest first."""
    plain = {"whole": (), "causal": ("causal",)}
    real = {"whole": ("torques",), "causal": ("causal",)}
    found = [
        *_methods("mild", ("amekf", "smoother")),
        Task("ideal", Person("ideal", variants=plain)),
        Task("unknown_mounts", Person("unknown_mounts", variants=plain)),
        Task("unknown_mounts/smekf", Person("unknown_mounts", "smekf")),
        Task("right_arm_only", Person("right_arm_only", calibrated=False, variants=plain)),
        Task("gaps", Person("gaps", calibrated=False, variants={"whole": ("gaps",)})),
        Task("two_rates", Person("two_rates", variants=plain)),
        Task("measured_orientations", Person("measured_orientations", calibrated=False)),
        Task("no_phases", Person("no_phases", calibrated=False)),
        Task("remounted", Person("remounted", subject_from="mild")),
        *(Task(f"{REAL}/{method}", Person(REAL, method, False, variants=real)) for method in ("amekf", "smekf")),
        Task(f"{REAL}/smoother", Person(REAL, "smoother", False, exports=("whole",))),
        Task("48dof", _model),
        Task("chain", _chain),
        Task("simulate/ideal", _simulate(11, "ideal", "clasp", "mount=any", "palm_slip=0.004"), 15.0),
        Task("simulate/mild", _simulate(12, "mild", "clasp"), 15.0),
        Task("demo", _demo, 40.0),
        Task("batch", _batch, 20.0),
        Task("retarget/panda", _retarget("panda"), 20.0),
        Task("retarget/panda_position", _retarget("panda", "--task=position"), 20.0),
        Task("retarget/ur5", _retarget("ur5"), 20.0),
        *(Task(f"retarget/{robot}", _retarget(robot), 30.0) for robot in OTHER_ROBOTS),
        Task("live/amekf", _live("amekf")),
        Task("live/smekf", _live("smekf")),
        Task("orientation/authors_trial", _authors_trial),
        *(Task(f"orientation/{file[:2]}", _broad(file)) for file in BROAD),
        Task("read/files", _files, 3.0),
        Task("read/sessions", _sessions, 3.0),
    ]
    assert {task.name.split("/")[0] for task in found} >= set(makers())
    return sorted(found, key=lambda task: -task.cost)
