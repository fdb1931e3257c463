"""The commands as a user types them."""

import inspect
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import options, run

import wepose_pin as wp
from wepose_pin import Recording, Simulation, __version__, load_subject
from wepose_pin.commands.options import COMMANDS, parse, read_descriptions
from wepose_pin.writers import write_session


@pytest.fixture
def session(simulation: Simulation, tmp_path: Path) -> Path:
    write_session(tmp_path, simulation.recording("made"), simulation.truth())
    return tmp_path / "session.toml"


@pytest.fixture
def short(half_minute: Recording, tmp_path: Path) -> Path:
    write_session(tmp_path, half_minute)
    return tmp_path / "session.toml"


def test_help_reads_like_a_manual(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each option says what happens when it is given; values have names, and what is off or on is no default."""
    monkeypatch.setenv("COLUMNS", "300")
    assert run("--help") == 0
    listed = capsys.readouterr().out
    for name in COMMANDS:
        assert name in listed
        assert run(name, "--help") == 0
        text = capsys.readouterr().out
        [example] = re.findall(r"^Example: wepose (.+)$", text, re.MULTILINE)
        assert parse(shlex.split(example))[0].__name__ == name
        for wrong in ("None", "True", "False", "{", "Path", "│", "╭"):
            assert wrong not in text, (name, wrong)
        for option, parameter in options(name).items():
            words = option.replace("_", "-")
            switch = f"--no-{words} Do not " if parameter.default is True else f"--{words}"
            assert switch in " ".join(text.split()), (name, switch)
    assert run("--version") == 0
    assert __version__ in capsys.readouterr().out


@pytest.mark.parametrize("name", ["track", "calibrate", "retarget", "export", "evaluate"])
def test_a_command_and_its_function_share_their_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each has one default and one description; the method of `wepose track` may be that of a live session."""
    function, command = inspect.signature(getattr(wp, name)).parameters, options(name)
    shared = {option for option in command if option in function} - {"out"}
    assert shared >= {"track": {"method", "causal"}, "export": {"names"}, "retarget": {"scale"}}.get(name, set())
    for option in shared - ({"method"} if name == "track" else set()):
        assert command[option].default == function[option].default, option
    assert run(name, "--help") == 0
    text, described = "".join(capsys.readouterr().out.split()), read_descriptions(getattr(wp, name).__doc__)
    for option in shared - {"force", "model", "method"}:
        assert "".join(described[option].split())[1:60] in text, option  # of a switch that is on: "Do not keep"


@pytest.mark.slow
def test_demo_makes_all_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "subject").mkdir()
    (tmp_path / "subject" / "notes.txt").write_text("")
    assert run("demo", "-o", tmp_path, "--seed", 2) == 2
    assert [path.name for path in tmp_path.rglob("*")] == ["subject", "notes.txt"]
    assert run("demo", "-o", tmp_path, "--seed", 2, "--force") == 0
    text = capsys.readouterr().out
    for word in ("left forearm", "measured", "Quality: pass", "Position error", "view.html"):
        assert word in text
    palm = re.search(r"right_palm .* (\d+\.\d) ±", text)
    assert palm is not None
    assert float(palm[1]) < 25.0  # [mm] from the shoulders
    subject, true = load_subject(tmp_path / "subject"), load_subject(tmp_path / "session")
    for name, length in true.lengths.items():
        assert abs(subject.lengths[name] - length) < 4 * subject.std(name)
    (tmp_path / "result" / "view.html").unlink()
    (tmp_path / "result" / "view.html").mkdir()  # is in the way of the last command
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    assert run("demo", "-o", tmp_path, "--seed", 3, "--force") == 2
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before


def test_calibrate_track_evaluate_view(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--measured", "shoulder_width=0.35", "--stature", 1.67, "--no-report")
    assert run("calibrate", session, *options, "-o", tmp_path / "subject") == 0
    printed = capsys.readouterr().out
    assert "Palm to palm, root mean square of the samples used" in printed
    assert "Quality: pass" in printed
    assert run("track", session, "--subject", tmp_path / "subject", "-o", tmp_path / "result", "--no-report") == 0
    assert re.search("amekf, lengths: hands together.*Good for elbow flexion to ±", capsys.readouterr().out, re.DOTALL)
    assert run("evaluate", tmp_path / "result", tmp_path / "truth.parquet", "--interval", 53, 80) == 0
    assert "right_forearm" in capsys.readouterr().out
    assert run("view", tmp_path / "result", "-o", tmp_path / "page.html", "--no-open") == 0
    assert (tmp_path / "page.html").read_text().startswith("<!")
    # The truth as CSV, and against itself.
    pl.read_parquet(tmp_path / "truth.parquet").write_csv(tmp_path / "truth.csv")
    assert run("evaluate", tmp_path / "result", tmp_path / "truth.csv") == 0
    assert wp.evaluate(wp.load_result(tmp_path / "result"), str(tmp_path / "truth.csv")).attitude


def test_simulate_with_mounts_anywhere_is_tracked_with_its_subject(tmp_path: Path) -> None:
    made = tmp_path / "made"
    simulate_it = ("simulate", "-o", made, "--preset", "mild", "--rate-hz", 50)
    assert run(*simulate_it, "--imperfection", "mount=any", "--imperfection", "dropped=0") == 0
    assert "mount =" not in (made / "session.toml").read_text()
    track_it = ("track", made / "session.toml", "--no-view", "--no-report", "-o", tmp_path / "result")
    assert run(*track_it) == 2
    assert run(*track_it, "--subject", made / "subject.toml") == 0
    pose, truth = (pl.read_parquet(p) for p in (tmp_path / "result" / "pose.parquet", made / "truth.parquet"))
    off = np.sqrt(sum((pose[c] - truth[c]) ** 2 for c in ("right_palm_x", "right_palm_y", "right_palm_z")))
    assert off.mean() < 0.03


def test_nothing_is_overwritten_without_force(short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    track_it = ("track", short, "-o", tmp_path / "result", "--no-report")
    assert run(*track_it) == 0
    mine = tmp_path / "mine.html"
    mine.write_text("keep")
    before = {path.name: path.read_bytes() for path in (tmp_path / "result").iterdir()}
    for words in (track_it, ("view", tmp_path / "result", "-o", mine, "--no-open")):
        capsys.readouterr()
        assert run(*words) == 2
        assert "--force replaces it" in capsys.readouterr().err
        assert {path.name: path.read_bytes() for path in (tmp_path / "result").iterdir()} == before
        assert mine.read_text() == "keep"
        assert run(*words, "--force") == 0
    assert mine.read_text().startswith("<!")
    assert '"clasp"' in mine.read_text()  # the phases of the recording, as on the page that track made


@pytest.mark.kill
@pytest.mark.parametrize("seconds", [0.8, 1.6, 2.4])
def test_an_interrupt_leaves_nothing(session: Path, tmp_path: Path, seconds: float) -> None:
    """Ctrl-C, and the SIGTERM of a cluster, at any time: exit 130, and all of the output or nothing."""
    command = [sys.executable, "-m", "wepose_pin", "calibrate", str(session), "-o", str(tmp_path / "subject")]
    for number in (signal.SIGINT, signal.SIGTERM):
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        time.sleep(seconds)
        process.send_signal(number)
        _, printed = process.communicate(timeout=60)
        left = {path.name for path in tmp_path.iterdir()} - {"session.toml", "recording.parquet", "truth.parquet"}
        if process.returncode == 130:
            assert printed.endswith("wepose: stopped\n")
            assert "Traceback" not in printed
            if left:
                assert {path.name for path in (tmp_path / "subject").iterdir()} >= {"subject.toml", "report.html"}
                break
        else:
            assert left <= {"subject"}
            break


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["trak"], "did you mean 'track'?"),
        (["--nope", "track"], "'--nope' is not a command; there is: demo, info, simulate, "),
        (["simulate", "-o", "OUT", "--seed", "1.5"], "'1.5' is not a whole number; see wepose simulate --help"),
        (["track"], "wepose track needs a value for SESSION; see wepose track --help"),
        (["track", "s.toml"], "wepose track needs a value for --out"),
        (["track", "s.toml", "-o"], "wepose track needs a value for -o; see wepose track --help"),
        (["track", "s.toml", "-o", "OUT", "-o", "OUT"], "-o specified multiple times; see wepose track --help"),
        (["track", "s.toml", "t.toml", "-o", "OUT"], "'t.toml' is one word too many for wepose track"),
        (["track", "nowhere.toml", "-o", "OUT"], "nowhere.toml: no such file"),
        (["track", "s.toml", "-o", "OUT", "--method", "ekf"], 'Invalid value "ekf" for --method. Choose from: "amekf"'),
        (["evaluate", "a", "b", "--interval", "3"], "needs 2 values for --interval and not 1"),
        (["simulate", "-o", "OUT", "--rate-hz", "fast"], 'unable to convert "fast" into float; see wepose simulate'),
        (["simulate", "-o", "OUT", "--rate-hz", "nan"], 'Invalid value "nan" for --rate-hz. Must be <= 2000; see'),
        (["evaluate", "a", "b", "--time-offset", "nan"], 'Invalid value "nan" for --time-offset. a number is needed'),
        (["retarget", "a", "--robot", "ur5", "-o", "OUT", "--scale", "nan"], "for --scale. a number is needed"),
        (["simulate", "-o", "OUT", "--rate-hz", "2"], "for --rate-hz. Must be >= 20; see"),
        (["simulate", "-o", "OUT", "--prset", "ideal"], "not an option of wepose simulate; did you mean '--preset'?"),
        (["calibrate", "s.toml", "-o", "OUT", "--protocol", "poses"], "protocol 'poses' is not known"),
        (["calibrate", "s.toml", "-o", "OUT", "--measured", "trunk=wide"], "'wide' is not a number; NAME=METRES"),
        (["calibrate", "s.toml", "-o", "OUT", "--measured", "0.4"], "--measured: '0.4': NAME=METRES is needed"),
        (["calibrate", "-o", "OUT", "--measured", "a=1", "--measured", "a=2", "s.toml"], "'a' is given twice"),
        (["calibrate", "s.toml", "-o", "OUT", "--stature", "175"], "stature 175 is not a body height"),
        (["view", "nowhere"], "no pose.parquet in it"),
        (["simulate", "-o", "OUT", "--imperfection", "palm_slide=0"], "palm_slip"),
        (["simulate", "-o", "OUT", "--imperfection", "palm_slip=much"], "palm_slip = 'much'; a finite number"),
        (["simulate", "-o", "OUT", "--imperfection", "mount=taped"], "there is: stated, any"),
        (["simulate", "-o", "OUT", "--imperfection", "bits=9.5"], "bits = 9.5; a whole number at least 0 is needed"),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(
    words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*words) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("wepose: ")
    assert captured.err.count("\n") == 1
    assert says in captured.err
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []
