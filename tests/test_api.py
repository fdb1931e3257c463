"""The Python interface: what is documented runs, results print, draw, show and save themselves."""

import doctest
import inspect
import json
import re
import sys
import types
import webbrowser
from dataclasses import replace
from html import escape, unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

import matplotlib.figure
import numpy as np
import pytest
from arms import write_arm

import wepose_pin as wp
from wepose_pin import Simulation
from wepose_pin.commands import main
from wepose_pin.commands.recordings import track as track_session
from wepose_pin.recording import find_mount_axes
from wepose_pin.writers import write_session

ROOT = Path(__file__).resolve().parents[1]
PUBLIC = {name: getattr(wp, name) for name in wp.__all__ if name != "__version__"}
FUNCTIONS = [name for name, value in PUBLIC.items() if inspect.isfunction(value)]
METHODS = [f"TrackResult.{name}" for name in ("to_dataframe", "to_pandas", "plot", "show", "save")] + ["Subject.save"]


@pytest.fixture(scope="module")
def simulated() -> Simulation:
    return wp.simulate(wp.population_subject(1.75).lengths, seed=1, clasp_s=10.0, circles=0)


@pytest.fixture(scope="module")
def result(simulated: Simulation) -> wp.TrackResult:
    return wp.track(simulated.recording(), wp.population_subject(1.75))


@pytest.fixture(scope="module")
def saved(result: wp.TrackResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return result.save(tmp_path_factory.mktemp("api") / "result")


@pytest.fixture
def workplace(simulated: Simulation, saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which the examples run."""
    write_session(tmp_path, simulated.recording())
    wp.population_subject(1.75).save(tmp_path / "subject.toml")
    write_arm(tmp_path)
    (tmp_path / "result").symlink_to(saved)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("workplace")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "retarget")) for name in (*FUNCTIONS, *METHODS)]
)
def test_examples_of_the_documentation_run(name: str, simulated: Simulation, result: wp.TrackResult) -> None:
    if name == "retarget":
        pytest.importorskip("daqp")
    if name.endswith("to_pandas"):
        pytest.importorskip("pandas")
    if name == "TrackResult.save":
        Path("result").unlink()
    function: Any = wp
    for part in name.split("."):
        function = getattr(function, part)
    known = {"wp": wp, "simulation": simulated, "recording": simulated.recording(), "result": result}
    [test] = doctest.DocTestFinder(recurse=False).find(function, name, globs=known)
    assert test.examples
    lines: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=lines.append)
    assert not lines, "".join(lines)


@pytest.mark.usefixtures("workplace")
@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_python_of_the_pages_runs(page: str) -> None:
    Path("result").unlink()
    known: dict[str, Any] = {}
    for block in re.findall(
        r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        exec(compile(block, page, "exec"), known)
    assert known["angles"]["right_elbow"]["flexion"].shape == known["result"].time.shape


@pytest.mark.parametrize("name", FUNCTIONS)
def test_documentation_of_a_function_is_whole(name: str) -> None:
    text = inspect.getdoc(PUBLIC[name]) or ""
    sections = dict(re.findall(r"^(\w+)\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", text, re.MULTILINE | re.DOTALL))
    assert {"Parameters", "Returns", "Raises", "Examples"} <= set(sections)
    parameters = inspect.signature(PUBLIC[name]).parameters.values()
    assert all(each.kind not in (each.VAR_KEYWORD, each.VAR_POSITIONAL) for each in parameters)
    described = re.findall(r"^(\w[\w, ]*)(?: :|$)", sections["Parameters"], re.MULTILINE)
    assert [each for line in described for each in line.split(", ")] == [each.name for each in parameters]


@pytest.mark.parametrize("name", [name for name, value in PUBLIC.items() if inspect.isclass(value)])
def test_a_class_is_documented(name: str) -> None:
    first = (PUBLIC[name].__doc__ or "").strip().splitlines()[0]
    assert first.endswith((".", ":")), first


def test_a_result_reads_back_and_is_saved_again(result: wp.TrackResult, saved: Path, tmp_path: Path) -> None:
    loaded = wp.load_result(str(saved))
    assert repr(loaded) == repr(result)
    assert (loaded.diagnostics, loaded.phases) == (result.diagnostics, result.phases)
    for segment, quat in result.quat_WL.items():
        np.testing.assert_allclose(loaded.quat_WL[segment], quat, atol=1e-12)
    np.testing.assert_allclose(loaded.q, result.q, atol=1e-9)
    again = loaded.save(str(tmp_path / "again"))
    assert {file.name: file.read_bytes() for file in again.iterdir()} == {
        file.name: file.read_bytes() for file in saved.iterdir()
    }
    with pytest.raises(wp.WeposeError, match="again"):
        result.save(again)


def test_a_saved_result_says_what_made_it_as_that_of_the_command_does(workplace: Path) -> None:
    result = wp.track(wp.load_session("session.toml"), wp.load_subject("subject.toml"), method="smekf", causal=True)
    result.save(workplace / "mine")
    track_session(Path("session.toml"), out=Path("theirs"), subject=Path("subject.toml"), method="smekf", causal=True)
    folders = workplace / "mine", workplace / "theirs"
    files = {*("pose.parquet", "subject.toml", "subject.urdf", "summary.json", "view.html", "report.html")}
    assert [{file.name for file in folder.iterdir()} for folder in folders] == [files] * 2
    summaries = [json.loads((folder / "summary.json").read_text(encoding="utf-8")) for folder in folders]
    assert summaries[0].keys() == summaries[1].keys() == {*result.summary, "versions", "recorded_phases", "provenance"}
    made, theirs = (summary["provenance"] for summary in summaries)
    same = ("format", "version", "commit", "code", "packages", "machine")
    assert [made[name] for name in same] == [theirs[name] for name in same]
    assert made["inputs"] == {"session": theirs["inputs"]["session"]}
    options = made["options"]
    assert (options["method"], options["causal"], options["subject"]) == ("smekf", True, "population")


def test_the_table_of_pandas_is_that_of_polars(result: wp.TrackResult, saved: Path) -> None:
    pytest.importorskip("pandas")
    for each in (result, wp.load_result(saved)):
        table, own = each.to_pandas(), each.to_dataframe()
        assert list(table.columns) == own.columns
        for name in own.columns:
            np.testing.assert_array_equal(table[name].to_numpy(), own[name].to_numpy())


def test_without_pandas_one_line_says_how_to_install_it(
    result: wp.TrackResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(wp.WeposeError) as caught:
        result.to_pandas()
    assert str(caught.value).endswith("pip install pandas")


def test_figures_are_whole_files_and_a_notebook_shows_them(result: wp.TrackResult, tmp_path: Path) -> None:
    figures = result.plot()
    page = figures._repr_html_()
    assert page.count("<svg") == len(figures) == 3
    for file in figures.save(tmp_path / "figures").iterdir():
        text = file.read_text(encoding="utf-8")
        assert ElementTree.fromstring(text).tag.endswith("svg")
        assert text == figures[file.stem]._repr_svg_()
    with pytest.raises(KeyError, match=r"no figure 'elbow'; .* angles"):
        figures["elbow"]


def test_a_figure_is_matplotlibs_and_can_be_changed(result: wp.TrackResult) -> None:
    figure = result.plot()["angles"]
    assert isinstance(figure, matplotlib.figure.Figure)
    panels = {ax.get_title("left"): ax for ax in figure.axes if ax.get_visible()}
    assert [line.get_label() for line in panels["elbow: flexion [°]"].lines] == ["left", "right"]
    flexion = panels["elbow: flexion [°]"].lines[1].get_ydata()
    assert np.nanmax(flexion) == pytest.approx(np.degrees(wp.joint_angles(result)["right_elbow"]["flexion"].max()))
    panels["elbow: flexion [°]"].set_title("Beugung", loc="left")
    assert "Beugung" in figure.svg()
    assert "matplotlib.pyplot" not in sys.modules or matplotlib.pyplot.get_fignums() == []


def test_a_motion_is_shown_in_the_browser_or_in_the_notebook(
    result: wp.TrackResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    page = result.show()
    [address] = opened
    file = Path(unquote(urlsplit(address).path))
    assert file.read_text(encoding="utf-8") == page.html
    file.unlink()
    frame = re.fullmatch(r'<iframe title="simulated" .*srcdoc="(.*)"></iframe>', page._repr_html_(), re.DOTALL)
    assert frame is not None
    assert unescape(frame.group(1)) == page.html
    monkeypatch.setitem(sys.modules, "ipykernel", types.ModuleType("ipykernel"))
    result.show()
    assert len(opened) == 1


def test_a_result_goes_into_each_step_as_object_and_as_folder(
    result: wp.TrackResult, saved: Path, tmp_path: Path
) -> None:
    wp.export(result, str(tmp_path / "object.mot"))
    wp.export(str(saved), tmp_path / "folder.mot")
    table = [np.loadtxt(tmp_path / f"{name}.mot", skiprows=12) for name in ("object", "folder")]
    np.testing.assert_allclose(*table, atol=1e-5)
    wp.export(result, tmp_path / "person.urdf")
    assert (tmp_path / "person.urdf").read_text("utf-8") == (saved / "subject.urdf").read_text("utf-8")
    angles = wp.joint_angles(result)
    np.testing.assert_array_equal(
        angles["left_elbow"]["flexion"], wp.joint_angles(result.pose)["left_elbow"].values[:, 0]
    )
    with pytest.raises(KeyError, match="no joint 'elbow'; did you mean 'left_elbow'"):
        angles["elbow"]
    with pytest.raises(KeyError, match="no angle 'bend'; there is: flexion, carrying_angle, pronation"):
        angles["left_elbow"]["bend"]


@pytest.mark.slow
def test_a_result_is_retargeted_as_object_and_as_folder(result: wp.TrackResult, saved: Path, tmp_path: Path) -> None:
    pytest.importorskip("daqp")
    urdf = write_arm(tmp_path)
    chosen = {"arm": "right", "task": "position", "speed_scale": 0.5, "limit_margin": 0.1, "interval": (10.0, 16.0)}
    moved, read = (
        wp.retarget(result_, robot, rate_hz=10.0, **chosen) for result_, robot in ((result, urdf), (saved, str(urdf)))
    )
    np.testing.assert_allclose(moved.joint_position, read.joint_position, atol=1e-6)
    assert repr(moved) == repr(read)
    assert (moved.robot.speed_scale, moved.robot.limit_margin) == (0.5, 0.1)
    assert moved.params.orientation == 0.0
    assert moved.recorded_time[[0, -1]] == pytest.approx([10.0, 16.0], abs=0.02)
    with pytest.raises(wp.WeposeError, match="a Robot has arms and margins of its own"):
        wp.retarget(result, moved.robot, speed_scale=0.9)
    with pytest.raises(wp.WeposeError, match="`arm` left: arm has no left arm"):
        wp.retarget(result, urdf, arm="left")


def test_objects_print_in_one_line(simulated: Simulation, result: wp.TrackResult) -> None:
    objects = [simulated, simulated.recording(), result, result.pose, result.subject, result.model, result.plot()]
    objects += [*simulated.recording().sensors.values(), wp.joint_angles(result), wp.joint_angles(result)["thorax"]]
    objects += [wp.evaluate(result, simulated.truth()), result.show(open=False)]
    objects += [result.source, wp.StaticTest()]
    for each in objects:
        assert re.fullmatch(r"\w+\(.{10,200}\)", repr(each)), repr(each)[:300]


def test_a_result_shows_itself_in_a_notebook(result: wp.TrackResult) -> None:
    page = result._repr_html_()
    assert escape(repr(result)) in page
    assert ElementTree.fromstring(f"<div>{page}</div>") is not None


@pytest.mark.parametrize("name", ["anna", 'a"b\\c', "é α 漢", "line\nend\ttab", "\x00\x07\x7f\x80\u2028"])
def test_a_subject_is_saved_as_a_file_or_into_a_folder(name: str, tmp_path: Path) -> None:
    subject = replace(wp.population_subject(1.68, "f"), name=name)
    for file in (subject.save(str(tmp_path / "anna")), subject.save(tmp_path / "bea.toml")):
        assert wp.load_subject(file).lengths == pytest.approx(dict(subject.lengths), abs=1e-6)
        with pytest.raises(wp.WeposeError, match="exists"):
            subject.save(file)
    assert wp.load_subject(str(tmp_path / "anna")).name == subject.name


def test_a_subject_whose_calibration_failed_is_refused(
    workplace: Path, simulated: Simulation, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = replace(wp.population_subject(1.75), name="anna", quality="fail")
    (workplace / "subject.toml").unlink()
    failed.save(workplace / "subject.toml")
    line = r"subject 'anna': its calibration failed \(quality = \"fail\"\).*calibrate again"
    with pytest.raises(wp.WeposeError, match=line):
        wp.track(simulated.recording(), failed)
    assert wp.track(simulated.recording(), failed, accept_failed=True).subject.quality == "fail"
    track = ["track", "session.toml", "--subject", "subject.toml", "-o", "out", "--no-view", "--no-report"]
    live = ["live", "--source", "replay:session.toml", "--subject", "subject.toml", "--no-page"]
    for argv in (track, live):
        with pytest.raises(SystemExit, match="2"):
            main(argv)
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert re.search(line, err)
    with pytest.raises(SystemExit, match="0"):
        main([*track, "--accept-failed"])
    assert wp.load_result("out").subject.quality == "fail"


def test_a_recording_of_arrays_is_that_of_the_session(simulated: Simulation) -> None:
    recording = simulated.recording()
    arrays = {name: (sensor.gyro_S, sensor.accel_S) for name, sensor in recording.imus.items()}
    mounts = {name: find_mount_axes(sensor.stated_quat_LS) for name, sensor in recording.imus.items()}
    made = wp.Recording.from_arrays(100, name="mine", phases=recording.phases, mounts=mounts, **arrays)
    assert np.array_equal(wp.track(made).points["right_palm"], wp.track(recording).points["right_palm"])
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (900, 1))
    assert isinstance(wp.Recording.from_arrays(50.0, torso=quat).sensors["torso"], wp.OrientationSensor)
    for wrong, said in (
        ({"rate_hz": 0.0, "torso": quat}, "rate_hz = 0.0; a finite number above 0 is needed"),
        ({"rate_hz": 50.0}, "no sensors"),
        ({"rate_hz": 50.0, "torso": (quat, quat)}, "torso: the arrays gyro_S and accel_S, "),
        ({"rate_hz": 50.0, "torso": quat, "mounts": {"torso": ("z", "+x")}}, "mounts: torso.up = 'z' is not known"),
        ({"rate_hz": 50.0, "torso": quat, "mounts": {"torso": "+z"}}, "mounts.torso = '+z'; a list of 2 texts"),
        ({"rate_hz": 50.0, "torso": (5, 5)}, "or quat_VS, (n, 4), are needed, not int and int"),
        ({"rate_hz": 50.0, "torso": quat, "left_arm": quat}, "sensors.left_arm is no segment"),
    ):
        with pytest.raises(wp.WeposeError, match=re.escape(said)):
            wp.track(wp.Recording.from_arrays(**wrong))
