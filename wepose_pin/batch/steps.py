"""The steps of an item: each does what the command of its name does, into a folder of its name, and gives figures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import MissingFile
from ..readers import load_session
from ..recording import Recording
from ..subject import Subject, average_subject, load_subject
from ..tracking import TrackedRecording, track
from .plan import Body

Row = dict[str, Any]


class Given(NamedTuple):
    """What an item's steps work on, as local files, and where they write."""

    folder: Path
    session: Path
    subject_file: Path | None
    truth: Path | None
    body: Body
    made_by: Mapping[str, Any]


class Work:
    """The steps of one item, in order; what one finds the next ones use."""

    def __init__(self, given: Given) -> None:
        self.given = given
        self.subject: Subject | None = None
        self.pose: TrackedRecording | None = None
        self._recordings: dict[bool, Recording] = {}

    def run(self, step: str, options: Mapping[str, Any]) -> Row:
        """The step's figures, by column of the study's table.

        Raises
        ------
        WeposeError
            What the recording, the subject or an option lacks.
        """
        folder = self.given.folder / step
        folder.mkdir()
        row: Row = getattr(self, f"_{step}")(folder, **options)
        return row

    def _recording(self, gaps: bool) -> Recording:
        if gaps not in self._recordings:
            self._recordings[gaps] = load_session(self.given.session, gaps=gaps)
        return self._recordings[gaps]

    def _calibrate(self, folder: Path, *, protocol: str, method: str, gaps: bool, report: bool) -> Row:
        from ..calibration import calibrate_lengths, judge, load_protocol
        from ..model import load_model
        from ..writers.calibration import write_calibration
        from ..writers.result import write_subject

        body, what, recording = self.given.body, load_protocol(protocol), self._recording(gaps)
        average = average_subject(body.stature, body.sex)
        found = calibrate_lengths(recording, gauge=dict(body.gauge), prior=average, protocol=what, method=method)
        verdict = judge(found)
        write_subject(folder, found.subject, load_model(lengths=found.subject.lengths))
        self.subject = load_subject(folder)  # as it stands there: the same as for the commands one by one
        write_calibration(folder, found, verdict, self.given.made_by)
        if report:
            from ..report import write_calibration_page

            write_calibration_page(folder, found, recording, method=method, protocol=what, verdict=verdict)
        row: Row = {"grade": verdict.grade, "gap_mm": _finite(1e3 * found.rms_gap), "independent": found.independent}
        for name, value in found.subject.lengths.items():
            row |= {f"{name}_mm": 1e3 * value, f"{name}_std_mm": _finite(1e3 * found.subject.std(name))}
        return row

    def _track(
        self,
        folder: Path,
        *,
        method: str,
        causal: bool,
        gaps: bool,
        covariance: bool,
        limits: bool,
        torques: bool,
        model: str | None,
        view: bool,
        report: bool,
    ) -> Row:
        from ..model import load_model
        from ..writers.result import write_result

        recording = self._recording(gaps)
        if self.subject is None and self.given.subject_file is not None:
            self.subject = load_subject(self.given.subject_file)
        body = load_model(model) if model else None
        pose = track(recording, self.subject, method=method, model=body, causal=causal, limits=limits)
        found = None
        if torques:
            from ..angles.torques import pose_torques

            found = pose_torques(pose)
        write_result(folder, pose, covariance, recording.phases, found, self.given.made_by)
        self.pose = pose
        failed: list[str] = []
        if view or report:
            from ..report import write_track_pages

            failed = write_track_pages(folder, pose, view=view, report=report)
        about = pose.summary()
        still = [of["static_share"] for of in about["sensors"].values() if "static_share" in of]
        return {
            "samples": len(pose.time),
            "rate_hz": about["rate_hz"],
            "duration_s": about["duration_s"],
            "sensors": len(about["sensors"]),
            "static_share": float(np.mean(still)) if still else None,
            "warnings": len(about["warnings"]) + len(failed),
        }

    def _retarget(self, folder: Path, **options: Any) -> Row:
        from dataclasses import replace

        from .. import retargeting
        from ..writers.result import as_json, read_result

        robot, arm, task = options["robot"], options["arm"], options["task"]
        sides = None if arm is None else ("left", "right") if arm == "both" else (arm,)
        off = {name: 0.0 for name in ("position", "orientation") if task not in ("both", name)}
        pose, body, _ = read_result(self.given.folder / "track")
        model = retargeting.load(retargeting.find_map(robot), sides)
        trajectory = retargeting.retarget(
            pose,
            model,
            tasks=replace(retargeting.Tasks(), **off),
            **{name: options[name] for name in ("rate_hz", "scale", "smoothing_hz", "strict")},
        )
        held = retargeting.kept(retargeting.table(trajectory), model.map.urdf, model.map.acceleration, model.map.jerk)
        touched = retargeting.touching(model, trajectory.time, trajectory.u)
        retargeting.write_trajectory(folder, trajectory)
        found = as_json(retargeting.summary(trajectory, held, touched)) | {"made_by": dict(self.given.made_by)}
        (folder / "summary.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        if options["view"]:
            from ..report.page import PageWriter
            from ..report.viewer import retarget_html

            title = f"{self._recording(False).name} on {model.map.name}"
            writer = PageWriter(folder, ["view.html"])
            writer.write("view.html", lambda _: retarget_html(body, pose, trajectory, title=title))
            writer.add_warnings("summary.json")
        return {
            "trajectory_s": float(trajectory.time[-1]),
            "trajectory_limits_kept": held.all,
            "trajectory_touching": touched.samples,
        }

    def _export(self, folder: Path, *, formats: tuple[str, ...], names: str | None, rate_hz: float | None) -> Row:
        from ..writers.export import SUFFIXES, export

        notes = []
        for format in formats:
            file = folder / (f"placement{SUFFIXES[format]}" if format in SUFFIXES else f"motion.{format}")
            motion = format not in ("urdf", "placement")
            written = export(
                self.given.folder / "track",
                file,
                format,
                names=names if format == "mot" else None,
                rate_hz=rate_hz if motion else None,
            )
            notes += written.notes
        return {"export_notes": len(notes)}

    def _evaluate(self, folder: Path, *, interval: tuple[float, float] | None) -> Row:
        from ..evaluation import evaluate
        from ..pose import pose_from_table
        from ..readers.tables import read_table
        from ..writers.result import as_json

        assert self.pose is not None
        truth = self.given.truth or self.pose.recording.truth
        if truth is None:
            raise MissingFile(
                f"{self.given.session}: data.truth is missing; evaluate needs a reference, there or in a table's truth"
            )
        errors = evaluate(self.pose.pose, pose_from_table(read_table(truth), str(truth)), interval)
        text = json.dumps(as_json(asdict(errors)), indent=2)
        (folder / "errors.json").write_text(text + "\n", encoding="utf-8")
        row: Row = {f"{point}_error_mm": error.mean for point, error in errors.position.items()}
        row |= {f"{point}_arm_error_mm": error.mean for point, error in errors.position_from_shoulders.items()}
        row |= {f"{segment}_error_deg": error.total_rmse for segment, error in errors.attitude.items()}
        return row


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
