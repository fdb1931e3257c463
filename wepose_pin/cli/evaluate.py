"""``wepose evaluate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..jobs.evaluate import EvaluateJob, run_evaluate
from .output import print_table, progress_bar, say
from .parser import Command
from .tables import mean_std

if TYPE_CHECKING:
    from ..evaluation import Registration


def run(job: EvaluateJob) -> int:
    """Compare; print the errors."""
    with progress_bar() as progress:
        errors = run_evaluate(job, progress)
    from ..recording import format_span

    say(f"{errors.samples} samples from {format_span(errors.interval)}")
    if errors.registration is not None:
        _say_registration(errors.registration)
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
    if errors.registration is not None and errors.agreement:
        print_table(
            "Agreement of joint angles [deg]: Bland-Altman bias and 95 % limits; root mean square; ICC(A,1); range",
            ("joint", "angle", "bias", "limits of agreement", "rms", "ICC", "range"),
            [
                (
                    joint,
                    angle,
                    f"{each.bias:+.2f}",
                    f"{each.lower:+.2f} to {each.upper:+.2f}",
                    f"{each.rmse:.2f}",
                    f"{each.icc:.3f}",
                    f"{each.range:.0f}",
                )
                for joint, angles in errors.agreement.items()
                for angle, each in angles.items()
            ],
        )
    if errors.position:
        on_limb = errors.position_on_limb
        print_table(
            "Position error [mm], mean ± std",
            ("point", "from the root", "from where its limb begins"),
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


def _say_registration(registration: Registration) -> None:
    """Say how the reference was brought to the result, and by which seconds."""
    from ..recording import format_span

    fitted = registration.correlation == registration.correlation  # NaN where the offset was stated
    clock = "stated" if not fitted else f"speeds correlate by {registration.correlation:.3f}"
    say(f"The reference was aligned by {format_span(registration.fitted)}, which are not scored:")
    say(f"  its clock {registration.offset_s:+.3f} s ({clock})")
    say(f"  its world: {registration.up} is up, rotated by {registration.heading_deg:+.1f} deg about the vertical")
    if any(registration.shift_m):
        x, y, z = registration.shift_m
        say(f"  its points moved by {x:+.3f} {y:+.3f} {z:+.3f} m")
    if registration.frames_deg:
        listed = ", ".join(f"{segment} {angle:.1f}" for segment, angle in registration.frames_deg.items())
        say(f"  its segments' frames rotated [deg], so that no constant error of these is left: {listed}")


COMMAND = Command(
    EvaluateJob,
    run,
    example="evaluate result truth.parquet --interval 72 115",
    arguments=("result", "truth"),
)
