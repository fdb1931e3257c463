"""`wepose angles`: low-pass, stated uncertainty of ranges, tables, figures, page."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation
from test_export import write_folder

from wepose_pin import Pose, joint_angles

RATE = 100.0


def bend(n: int, seed: int, most_deg: float = 90.0, seconds: float = 2.0) -> np.ndarray:
    """Flexion of an elbow (n,) [rad], out and back every so many seconds, each a little different."""
    rng = np.random.default_rng(seed)
    phase = np.arange(n) / (RATE * seconds)
    height = np.radians(most_deg + rng.normal(0.0, 3.0, int(phase[-1]) + 1))[phase.astype(int)]
    return 0.5 * height * (1.0 - np.cos(2.0 * np.pi * phase))


def about(axis: str, angle: np.ndarray) -> Rotation:
    return Rotation.from_euler(axis, angle[:, None])


def pose_of(seed: int, most_deg: float = 90.0, n: int = 1401) -> Pose:
    """A person who bends the right elbow, in covariances of its own in each segment."""
    sway = 0.05 * np.sin(np.arange(n) / 300.0)
    upright = about("z", sway)
    upper_arm = upright * about("y", sway - 0.4)
    forearm = upper_arm * about("y", -bend(n, seed, most_deg))
    rotations = {"torso": upright, "right_upper_arm": upper_arm, "right_forearm": forearm}
    quat_WL = {name: rotation.as_quat() for name, rotation in rotations.items()}
    rng = np.random.default_rng(9)
    factors = {name: rng.normal(0.0, 0.02, (3, 3)) for name in quat_WL}
    cov = {name: np.broadcast_to(factor @ factor.T, (n, 3, 3)).copy() for name, factor in factors.items()}
    return Pose(np.arange(n) / RATE, quat_WL, {}, segment_cov=cov)


PHASES = {"start": [[0.0, 1.0]], "bend": [[2.0, 4.0], [4.0, 6.0], [6.0, 8.0]]}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two results of the same recording's name: bends of 90° and of 70°."""
    folders = []
    for name, most in (("before", 90.0), ("after", 70.0)):
        folder = write_folder(tmp_path_factory.mktemp("angles") / name, pose_of(1 if most > 80.0 else 2, most))
        about = {"recording": name, "recorded_phases": PHASES}
        (folder / "summary.json").write_text(json.dumps(about), encoding="utf-8")
        folders.append(folder)
    return folders[0], folders[1]


def read_tables(folder: Path) -> dict[str, pl.DataFrame]:
    return {path.stem: pl.read_csv(path) for path in folder.glob("*.csv")}


@pytest.mark.parametrize("side", ["left", "right"])
def test_ranges_are_as_uncertain_as_drawn_errors_make_them(side: str, tmp_path: Path) -> None:
    """Errors of each segment, constant in W or in the segment: the larger spread of the two is stated."""
    rng = np.random.default_rng(5)
    n, draws = 60, 3000
    time = np.arange(n) / RATE
    arm = Rotation.from_euler("yxz", np.column_stack([-0.3 - 0.5 * time, 0.4 + 0.3 * time, 0.2 + 0.0 * time]))
    fore = arm * Rotation.from_euler("yz", np.column_stack([-0.5 - 2.0 * time, 0.3 + 0.5 * time]))
    names = (f"{side}_upper_arm", f"{side}_forearm")
    rotations = dict(zip(names, (arm, fore), strict=True))
    factors = {name: rng.normal(0.0, 0.01, (3, 3)) for name in names}
    cov = {name: np.broadcast_to(factor @ factor.T, (n, 3, 3)).copy() for name, factor in factors.items()}
    pose = Pose(time, {name: R.as_quat() for name, R in rotations.items()}, {}, segment_cov=cov)
    assert run("angles", write_folder(tmp_path / "result", pose), "-o", tmp_path / "angles") == 0
    row = (pl.col("joint") == f"{side}_elbow") & (pl.col("angle") == "flexion") & (pl.col("phase") == "all")
    [stated] = read_tables(tmp_path / "angles")["phases"].filter(row)["range_std_deg"]
    flexion = joint_angles(pose)[f"{side}_elbow"]["flexion"]
    ends, spreads = (int(flexion.argmax()), int(flexion.argmin())), []
    for constant in ("W", "L"):
        errors = {n: Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), cov[n][0], draws)) for n in names}
        drawn = []
        for sample in ends:
            quat_WL = {}
            for name, R in rotations.items():
                # The error of the middle of the movement, as it is in W, or as it is in the segment.
                error = errors[name] if constant == "W" else R[n // 2].inv() * errors[name] * R[n // 2]
                quat_WL[name] = (error * R[sample] if constant == "W" else R[sample] * error).as_quat()
            drawn.append(joint_angles(Pose(np.arange(draws) / RATE, quat_WL, {}))[f"{side}_elbow"]["flexion"])
        spreads.append(np.std(drawn[0] - drawn[1]))
    assert stated == pytest.approx(np.degrees(max(spreads)), rel=0.1)


def test_two_sessions_become_tables_figures_and_a_page(
    results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "angles"
    assert run("angles", *results, "-o", out, "--low-pass-hz", 6) == 0
    printed = capsys.readouterr().out
    assert re.search(r"before .* right elbow flexion rising +7 .* 1\.00", printed)
    assert "low-passed at 6 Hz" in printed
    tables = read_tables(out)
    assert set(tables) == {*("angles", "sessions", "repetitions", "phases", "summary", "curves")}
    assert tables["sessions"].select("session", "n", "low_pass_hz").rows() == [("before", 7, 6.0), ("after", 7, 6.0)]
    elbow = (pl.col("joint") == "right_elbow") & (pl.col("angle") == "flexion")
    repetitions = tables["repetitions"].filter(elbow & (pl.col("session") == "before"))
    true = np.degrees(bend(1401, 1)).reshape(-1)[:1400].reshape(7, 200).max(axis=1)
    np.testing.assert_allclose(repetitions["highest_deg"].to_numpy(), true, atol=0.3)
    np.testing.assert_allclose(repetitions["peak_rate_deg_s"].to_numpy(), np.pi / 2.0 * true, rtol=0.02)
    assert (repetitions["highest_std_deg"] > 0.0).all()
    summary = tables["summary"].filter(elbow)
    assert summary["range_mean_deg"][0] == pytest.approx(repetitions["range_deg"].mean(), abs=1e-3)
    assert summary["range_sd_deg"][0] == pytest.approx(repetitions["range_deg"].std(), abs=1e-3)
    curve = tables["curves"].filter(elbow & (pl.col("session") == "after"))
    assert curve["percent"].to_list() == list(range(101))
    assert curve["mean_deg"].max() == pytest.approx(70.0, abs=4.0)
    over_time = tables["angles"].filter(pl.col("session") == "before")
    assert over_time.height == 1401
    low_passed = sosfiltfilt(butter(2, 6.0, fs=RATE, output="sos"), np.degrees(bend(1401, 1)))
    np.testing.assert_allclose(over_time["right_elbow_flexion_deg"].to_numpy(), low_passed, atol=0.05)
    phases = tables["phases"].filter(elbow & (pl.col("session") == "before"))
    assert phases["phase"].to_list() == ["all", "start", "bend", "bend", "bend"]
    assert phases["highest_deg"][2] == pytest.approx(true[1], abs=0.3)
    for picture in ("repetitions", "curves-elbow", "curves-shoulder", "curves-thorax", "angles-1", "angles-2"):
        ET.fromstring((out / f"{picture}.svg").read_text(encoding="utf-8"))
    page = (out / "angles.html").read_text(encoding="utf-8")
    for words in ("half the amplitude there", "Z-X-Y", "<td>after</td>"):
        assert words in page
    assert re.search(r"the range of [\w ]+, [\w ]+ \((before|after)\) varies most", page)
    cells = [page.index(f"<td>{angle}</td>") for angle in ("thorax, extension", "right elbow, flexion")]
    assert cells == sorted(cells), "in the order of the body"
    assert "cannot be made" not in page
    assert run("angles", *results, "-o", out) == 2  # nothing is overwritten


def test_a_phase_marks_the_repetitions(results: tuple[Path, Path], tmp_path: Path) -> None:
    assert run("angles", results[0], "-o", tmp_path / "a", "--repetitions", "bend", "--interval", 3, 9) == 0
    table = pl.read_csv(tmp_path / "a" / "repetitions.csv").unique("repetition", maintain_order=True)
    assert table.select("from_s", "to_s").rows() == [(4.0, 6.0), (6.0, 8.0)]
    assert not (tmp_path / "a" / "repetitions.svg").exists()


def test_a_single_repetition_has_its_ranges_and_no_mean_curves(results: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "a"
    assert run("angles", results[0], "-o", out, "--repetitions", "bend", "--interval", 3, 6) == 0
    summary = pl.read_csv(out / "summary.csv").filter(
        (pl.col("joint") == "right_elbow") & (pl.col("angle") == "flexion")
    )
    assert summary["repetitions"].to_list() == [1]
    assert summary["cmc"].to_list() == [None]
    assert not [path for path in out.iterdir() if path.name.startswith("curves")]
    assert "fewer than two repetitions" in (out / "angles.html").read_text(encoding="utf-8")


def test_where_nothing_repeats_there_are_phases_all_the_same(
    results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("angles", *results, "-o", tmp_path / "a") == 0
    assert (
        run("angles", results[0], "-o", tmp_path / "a", "--phase", "start", "--force") == 0
    )  # the first's do not stay
    assert "no repetitions by right_elbow_flexion: the angle goes out and back" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "a").iterdir()} == {
        *("angles.csv", "sessions.csv", "phases.csv", "repetitions.svg", "angles.svg"),
        *("angles.html", "provenance.json"),
    }
    assert "goes out and back" in (tmp_path / "a" / "angles.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--low-pass-hz 60", "--low-pass-hz 60: above 0 and below 45 Hz"),
        ("--repetitions bent", "no such phase of the recording, and no such angle; did you mean 'bend'"),
        ("--repetitions right_elbow_flex", "and no such angle; did you mean 'right_elbow_flexion'"),
        ("--interval 5 99", "--interval 5 99: the recording runs from 0 to 14 s"),
        ("--phase bend", "--phase bend: bend has 3 intervals"),
        ("--shoulder XYZ", 'Invalid value "XYZ" for --shoulder'),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(
    results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    assert run("angles", results[0], "-o", tmp_path / "a", *words.split()) == 2
    line = capsys.readouterr().err
    assert said in line
    assert line.count("\n") == 1
    assert not (tmp_path / "a").exists()
