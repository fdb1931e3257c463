"""What a tracked motion is good for, and its pages: beside its result, in a saved folder, and in a notebook."""

import shutil
import sys
import tempfile
import webbrowser
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

import numpy as np
from markupsafe import escape

from ..angles import Angles
from ..body.kinematics import compute_axis_std
from ..diagnostics import Diagnostic
from ..documents import whole_file
from ..errors import reason
from ..tracking import TrackResult, TrackSummary, summarize
from ..tracking.summary import find_samples_after_start, finite_median, measure_reach
from ..writers.result import CALL, collect_provenance, result_folder, write_about, write_poses
from .page import write_pages
from .viewer import FRAMES_A_SECOND, compute_angles, pose_html
from .words import explain_no_covariance, listed, name_tips, plain

FRAME_HEIGHT = 560  # [px] of the view page in a notebook
MOST_FRAMES_INSIDE = 3000  # of the view inside a report
_CONTRADICTIONS = ("mount-contradicted", "heading-corrected-far", "hinge-implausible")  # beside them a ± means nothing


def write_track_pages(
    folder: Path, summary: TrackSummary, *, view: bool = True, report: bool = True
) -> tuple[str, list[Diagnostic]]:
    """Write ``view.html`` and ``report.html`` into a new result, as `write_pages`; return what the motion is good for.

    With it diagnostics of the pages that cannot be made.
    """
    tracked, recording = summary.tracked, summary.tracked.recording
    seconds = max(float(tracked.time[-1] - tracked.time[0]), 1e-3)
    angles = cache(lambda: compute_angles(tracked.pose))

    @cache
    def make_view(fps: float) -> str:
        return pose_html(
            tracked.model, tracked.pose, phases=recording.phases, title=recording.name, angles=angles(), fps=fps
        )

    def make_report() -> str:
        from .track import render_track_report  # with it comes matplotlib

        page = make_view(min(FRAMES_A_SECOND, MOST_FRAMES_INSIDE / seconds))
        return render_track_report(summary, reliance, angles(), page)

    try:
        reliance = describe_reliance(summary, angles())
    except Exception as error:  # the result is complete without it
        reliance = f"How far the motion can be trusted cannot be said: {reason(error)}"
    whole = partial(make_view, FRAMES_A_SECOND) if view else None
    pages = {"view.html": whole, "report.html": make_report if report else None}
    return reliance, write_pages(folder, pages)


def describe_reliance(summary: TrackSummary, angles: Angles | None) -> str:
    """What the motion is good for: the usual ± of hinges, hands and rotations, and the least certain angle."""
    wrong = {each["text"]["title"]: None for each in summary.content["diagnostics"] if each["code"] in _CONTRADICTIONS}
    if wrong:
        return f"**No ± holds** while a mount, a heading or a sensor's name is wrong: {'; '.join(wrong)}."
    tracked = summary.tracked
    after_start, table = find_samples_after_start(tracked), tracked.model.table
    lost = np.logical_or.reduce([np.zeros(len(after_start), dtype=bool), *tracked.pose.gap.values()])
    lost_share, known = lost[after_start].mean(), after_start & ~lost
    after_start = known if known.any() else after_start
    stds: dict[str, float] = {}  # median [deg] where an angle is determined, of the side where that is larger
    for joint, each in angles.joints.items() if angles is not None else ():
        for k, angle in enumerate(each.names):
            name, known = f"{plain(table.shared_name(joint))} {plain(angle)}", after_start & ~each.hidden(k)
            std = np.nan if each.std is None else float(np.degrees(finite_median(each.std[known, k])))
            if np.isfinite(std):
                stds[name] = max(std, stds.get(name, 0.0))
    hinges = [f"{plain(table.shared_name(hinge))} flexion" for hinge in table.hinges]
    best = next((name for name in stds if name in hinges), min(stds, key=stds.__getitem__, default=None))
    worst = max(stds, key=stds.__getitem__, default=None)
    good = [f"{best} to ± {stds[best]:.0f}°"] if best is not None else []
    covs, reaches = tracked.pose.point_cov, measure_reach(tracked.pose, table)
    tips = [finite_median(compute_axis_std(covs[name])[after_start]) for name in reaches if name in covs]
    if np.isfinite(tips).any():
        root = "the root" if table.is_mechanism else "the middle of the hips"
        good.append(f"{name_tips(table, table.drawn_limbs)} to ± {1e3 * np.nanmax(tips):.0f} mm from {root}")
    good += [f"{name} to ± {std:.0f}°" for name, std in stds.items() if name.endswith("rotation") and name != worst]
    if not good and tracked.pose.segment_cov:  # of a mechanism
        variances = [np.median(np.diagonal(cov[after_start], 0, 1, 2), 0) for cov in tracked.pose.segment_cov.values()]
        good = [f"the orientation of each link to ± {np.degrees(np.sqrt(np.max(variances))):.1f}°"]
    unless = f" while no sensor is lost (one is for {lost_share:.0%} of the time)" if lost_share >= 0.005 else ""
    sentences = [f"**Good for** {listed(good)}{unless}."] if good else []
    sentences += [f"Least certain: {worst}, ± {stds[worst]:.0f}°."] if worst not in (best, None) else []
    sentences += [explain_no_covariance(tracked)] if not (good and tracked.recording.imus) else []
    return " ".join(sentences)


def save_result(result: TrackResult, folder: str | Path, force: bool = False) -> Path:
    """Write what `wepose track -o` writes, whole or not at all, and return the folder; as `TrackResult.save`."""
    out, source = Path(folder), result.source
    with result_folder(out, force, "track") as partial:
        if isinstance(source, Path):
            for file in source.iterdir():
                if file.is_file():
                    shutil.copyfile(file, partial / file.name)
            return out
        summary = summarize(result)
        # Inputs and options of `track`, under the names that they have in `wepose track`.
        inputs = {"session": result.recording.source, "subject": result.subject.name, "model": result.model.table.name}
        write_poses(partial, [result])
        write_about(partial, result, summary, provenance=collect_provenance(CALL, inputs | dict(result.options)))
        write_track_pages(partial, summary)
    return out


@dataclass(frozen=True)
class ViewPage:
    """The page that plays a motion, which opens offline; a notebook shows it in a frame."""

    title: str  # of the motion
    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        look = f'sandbox="allow-scripts" style="width:100%;height:{FRAME_HEIGHT}px;border:0"'
        return f'<iframe title="{escape(self.title)}" {look} srcdoc="{escape(self.html)}"></iframe>'

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write the page to a file and return its path; `ExistingOutput` where it is there, without `force`."""
        with whole_file(Path(path), force) as partial:
            partial.write_text(self.html, encoding="utf-8")
        return Path(path)

    def open(self) -> bool:
        """Open the page in the browser, from a temporary file; returns whether there is one."""
        file = Path(tempfile.mkdtemp(prefix="wepose-")) / "view.html"
        return webbrowser.open(self.save(file).as_uri())


def show_result(result: TrackResult, open: bool = True) -> ViewPage:
    """Return the page that plays the motion, and open it in the browser where `open` and this is no notebook."""
    page = ViewPage(result.name, pose_html(result.model, result.pose, phases=result.phases, title=result.name))
    if open and "ipykernel" not in sys.modules:
        page.open()
    return page
