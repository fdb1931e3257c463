"""``wepose evaluate``."""

from __future__ import annotations

from ..jobs.evaluate import EvaluateJob, run_evaluate
from .output import print_table, progress_bar, say
from .parser import Command
from .tables import mean_std


def run(job: EvaluateJob) -> int:
    """Compare; print the errors."""
    with progress_bar() as progress:
        errors = run_evaluate(job, progress)
    from ..recording import format_span

    say(f"{errors.samples} samples from {format_span(errors.interval)}")
    if errors.attitude:
        print_table(
            "Attitude error [deg]: mean ± std of the absolute; root mean square; drift of the heading [deg/min]",
            ("segment", "roll", "pitch", "yaw", "inclination", "heading", "total", "drift"),
            [
                (
                    name,
                    *(f"{mean:.2f} ± {std:.2f}" for mean, std in (error.roll, error.pitch, error.yaw)),
                    *(f"{rmse:.2f}" for rmse in (error.inclination_rmse, error.heading_rmse, error.total_rmse)),
                    f"{error.drift_deg_min:+.2f}",
                )
                for name, error in errors.attitude.items()
            ],
        )
    if errors.joints:
        print_table(
            "Joint angle error [deg]: mean; root mean square; largest (near gimbal lock left out)",
            ("joint", "angle", "mean", "rms", "largest"),
            [
                (joint, angle, f"{error.mean:+.2f}", f"{error.rmse:.2f}", f"{error.worst:.2f}")
                for joint, angles in errors.joints.items()
                for angle, error in angles.items()
            ],
        )
    if errors.position:
        on_limb = errors.position_on_limb
        print_table(
            "Position error [mm], mean ± std",
            ("point", "from the root", "from where its limb hangs"),
            [
                (name, mean_std(error), mean_std(on_limb[name]) if name in on_limb else "")
                for name, error in errors.position.items()
            ],
        )
    points = {f"{name} (point)": stated for name, stated in errors.position_uncertainty.items()}
    if stated := {**errors.attitude_uncertainty, **points}:
        print_table(
            "Stated uncertainty: right are a normalised squared error of 3, and 68 % and 95 % of the errors within",
            ("of", "normalised", "within 1 std", "within 2 std"),
            [
                (name, f"{u.nees:.2f}", f"{100 * u.within_1:.0f} %", f"{100 * u.within_2:.0f} %")
                for name, u in stated.items()
            ],
        )
    return 0


COMMAND = Command(
    EvaluateJob,
    run,
    example="evaluate result truth.parquet --interval 72 115",
    arguments=("result", "truth"),
)
