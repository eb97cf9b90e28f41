"""Bad input gets one line that names the thing, the value and the choices; exit code 2 and no traceback."""

import contextlib
import subprocess
import sys
from pathlib import Path

import pytest

from cli.main import app
from cli.session.session import CellSession
from tests.harness import ask, command_line, environment

RECORDING = str(Path(__file__).parents[1] / "data" / "panda_first_release.mcap")
CASES: dict[str, tuple[list[str], list[str]]] = {
    "simulator": (["run", "panda", "--set", "world.simulator=mujocco"], ["'mujocco'", "did you mean 'mujoco'?"]),
    "no simulator": (["run", "panda", "--set", "world.simulator=no.such"], ["world.simulator", "cannot be imported"]),
    "unknown cell": (["run", "pnada"], ["unknown cell 'pnada'", "did you mean 'panda'?", "choices:"]),
    "cell file that is not there": (["up", "nowhere.yaml"], ["nowhere.yaml", "is not a file"]),
    "unknown world": (["run", "panda", "--world", "moon"], ["unknown world 'moon'", "balls"]),
    "unknown parameter": (["run", "panda", "--set", "world.cuont=3"], ["world.cuont", "3", "choices:", "count"]),
    "unknown section": (["run", "panda", "--set", "wrold.count=3"], ["wrold", "choices:", "world"]),
    "unknown service": (["run", "panda", "--set", "services.viewre.port=1"], ["unknown service 'viewre'", "choices:"]),
    "out of bounds": (["run", "panda", "--set", "world.count=9"], ["world.count", "9", "less than or equal to 8"]),
    "not a number": (["run", "panda", "--set", "motion.velocity_scaling=fast"], ["motion.velocity_scaling", "'fast'"]),
    "not a number that is finite": (
        ["run", "panda", "--set", "motion.object_padding=.nan"], ["motion.object_padding", "nan"]
    ),
    "override without a value": (["run", "panda", "--set", "world.count"], ["--set", "'world.count'", "PATH=VALUE"]),
    "override that is no YAML": (
        ["run", "panda", "--set", "world.count=[1"], ["world.count", "'[1'", "not a YAML value"]
    ),
    "balls that overlap": (["run", "panda", "--set", "world.balls=[[0.4, 0], [0.41, 0]]"], ["world", "overlap"]),
    "cell that does not parse": (["run", "broken.yaml"], ["broken.yaml", "does not parse at line 2"]),
    "cell that is a list": (["run", "list.yaml"], ["list.yaml", "must hold a mapping"]),
    "cell that is empty": (["run", "empty.yaml"], ["empty.yaml", "must hold a mapping"]),
    "cell without a task": (["run", "taskless.yaml"], ["task: is missing"]),
    "service of nobody": (
        ["run", "tiny.yaml", "--set", "services.first.x=1"], ["services.fakes.first", "not a module"]
    ),
    "speed out of bounds": (["run", "panda", "--speed", "11"], ["--speed", "11", "0.1 to 10"]),
    "speed that is no number": (["run", "panda", "--speed", "fast"], ["--speed", "fast"]),
    "domain out of bounds": (["up", "panda", "--domain", "233"], ["--domain", "233", "0 to 232"]),
    "domain that is no number": (["topic", "echo", "tf", "--domain", "x"], ["--domain", "'x'", "0 to 232"]),
    "endpoint that is none": (["node", "list", "--connect", "here"], ["--connect", "'here'", "tcp/"]),
    "seed out of bounds": (["run", "panda", "--seed", "-1"], ["seed", "-1", "0 or more"]),
    "summary in no folder": (["run", "panda", "--summary", "no/where/s.json"], ["--summary", "does not exist"]),
    "report in the home of nobody": (["report", RECORDING, "-o", "~nobody_here/a.html"], ["begins with ~",
                                                                                      "without a home"]),
    "cell in the home of nobody": (["check", "~nobody_here/cell.yaml"], ["begins with ~", "without a home"]),
    "project in the home of nobody": (["new", "~nobody_here/x"], ["begins with ~", "without a home"]),
    "summary that is a folder": (["run", "panda", "--summary", "."], ["--summary", "'.'", "is a folder"]),
    "chaos of no seed": (["run", "panda", "--chaos", "monkey"], ["--chaos", "'monkey'", "0 or more"]),
    "chaos too often": (["up", "panda", "--chaos", "1", "--chaos-rate", "0"], ["--chaos-rate", "'0'", "at most 600"]),
    "rate of no chaos": (["run", "panda", "--chaos-rate", "5"], ["--chaos-rate", "needs --chaos SEED"]),
    "unknown option": (["run", "panda", "--sped", "2"], ["--sped", "--speed"]),
    "unknown verb": (["rnu", "panda"], ["rnu", "run"]),
    "unknown verb of a group": (["task", "dance"], ["'dance'", "choices:", "pause"]),
    "parameter without a value": (["param", "set", "world.count"], ["param set", "'world.count'", "PATH=VALUE"]),
    "no cell": (["run"], ["CELL"]),
    "unknown topic": (["topic", "info", "joint_state"], ["unknown key", "did you mean 'joint_states'?"]),
    "cell file whose name begins no key": (["check", "a cell.yaml"], ["'a cell' is no name of a cell", "letters"]),
    "cell that stands for several": (["task", "stop", "--cell", "*"], ["cell: '*'", "is not a valid name of a cell"]),
    "cell of two parts": (["play", RECORDING, "--cell", "a/b"], ["--cell: 'a/b'", "is not a valid name"]),
    "key of a part without a name": (["topic", "pub", "my//key", "{}"], ["unknown key 'my//key'", "choices:"]),
    "key that stands for several": (["topic", "pub", "my/*", "{}"], ["unknown key 'my/*'", "choices:"]),
    "service of no name": (["service", "nobody"], ["unknown service 'nobody'", "motion_planner"]),
    "call without fields": (["call", "motion/plan", "{}"], ["motion/plan.id", "is missing"]),
    "size of two numbers": (["world", "add", "0.5", "0", "--size", "1,2"], ["--size", "'1,2'", "three numbers"]),
    "shape that is none": (["world", "add", "0.5", "0", "--shape", "cube"], ["world.shape", "'cube'", "cylinder"]),
    "colour that is no number": (["world", "add", "0.5", "0", "--color", "red"], ["--color", "red"]),
    "box without a size": (
        ["run", "panda", "--set", "world.objects=[{id: crate, shape: box}]"], ["world.objects", "crate", "size"]),
    "count that counts nothing": (["topic", "echo", "tf", "-n", "0"], ["--count", "0"]),
}


@pytest.fixture(scope="module")
def wrong_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    base = "robot: panda\nworld: balls\npipeline: cartesian_ompl\n"
    (folder / "a cell.yaml").write_text(base + "task: first\nservices: {fakes.first: {}}\n")
    (folder / "broken.yaml").write_text("cell: [1,\nrobot: }\n")
    (folder / "list.yaml").write_text("- 1\n")
    (folder / "empty.yaml").write_text("")
    (folder / "taskless.yaml").write_text(base + "services: {motion_planner: {}}\n")
    (folder / "tiny.yaml").write_text(base + "task: first\nservices: {fakes.first: {}}\n")
    return folder


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_line_and_exit_code_2(
    case: str, wrong_files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, wanted = CASES[case]
    monkeypatch.chdir(wrong_files)
    monkeypatch.setattr(sys, "path", list(sys.path))  # services of one's own are looked for
    code = app.execute(arguments)
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines() or ["nothing"]
    assert line.startswith("zencell: ")
    for part in wanted:
        assert part in line
    assert code == 2
    assert shown.out == ""


LONG = "x" * 300  # longer than a file system lets a name be


@pytest.mark.parametrize("arguments", [
    ["record", "-o", f"{LONG}.mcap"], ["check", f"{LONG}.yaml"], ["recover", RECORDING, "-o", f"{LONG}.mcap"],
    ["export", RECORDING, "--csv", "/proc/nowhere"], ["export", RECORDING, "--images", "/proc/nowhere"],
    ["robot", "new", f"{LONG}.urdf", "-y"], ["calibrate", "intrinsics", LONG],
], ids=lambda arguments: " ".join(arguments[:2]))
def test_what_the_system_does_not_let_us_do_is_one_line(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert app.execute(arguments) in (1, 2)
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert line.startswith("zencell: ") and (LONG[:100] in line or "/proc/nowhere" in line)
    assert shown.out == ""


def test_what_became_of_a_run_is_said_although_its_file_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], domain: int
) -> None:
    async def operate(operation: CellSession, work: object) -> int:
        folder.rmdir()  # meanwhile
        return 1

    folder = tmp_path / "figures"
    folder.mkdir()
    monkeypatch.setattr(CellSession, "_run", operate)
    assert app.execute(["run", "panda", "--domain", str(domain), "--summary", str(folder / "s.json")]) == 1
    shown = capsys.readouterr()
    assert "panda: IDLE, 0 of 0 placed" in shown.out
    assert shown.err.splitlines() == [f"zencell: {folder / 's.json.part'}: No such file or directory"]


def test_disk_that_takes_no_output_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert app.execute(["cells"]) == 1
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()
    assert capsys.readouterr().err.splitlines() == ["zencell: No space left on device"]


def test_the_process_ends_with_the_exit_code_and_without_a_traceback(tmp_path: Path) -> None:
    done = subprocess.run(command_line("run", "pnada"), cwd=tmp_path, env=environment(), capture_output=True, text=True,
                          timeout=100, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("zencell: unknown cell 'pnada' (did you mean 'panda'?); choices: ")


@pytest.mark.slow  # `make test` does it with tiny services, in test_bring_up.py
@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        pytest.param("robot.urdf=package://example-robot-data/robots/nobody/nobody.urdf", "nobody.urdf", id="a file"),
        ("services.vision_detector.min_aera=3", "services.vision_detector.min_aera"),
    ],
)
def test_what_only_a_service_can_tell_is_one_line_too(
    zencell, wrong_files: Path, override: str, wanted: str  # type: ignore[no-untyped-def]  # noqa: ANN001
) -> None:
    command = zencell("run", "panda", "--set", override)
    assert command.end() == 2
    errors = [line for line in command.lines if line.startswith("zencell: ")]
    assert len(errors) == 1
    assert wanted in errors[0]
    assert not any("Traceback" in line for line in command.lines)
    assert not command.children()


@pytest.mark.parametrize("verb", [
    ["node", "list"], ["task", "start"],
    *(pytest.param(verb, marks=pytest.mark.slow) for verb in (["topic", "echo", "tf"], ["topic", "hz", "tf"])),
])
def test_where_no_cell_is_up_the_hint_says_how_to_start_one(verb: list[str], tmp_path: Path, domain: int) -> None:
    done = ask(tmp_path, *verb, "--domain", str(domain))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "zencell up panda" in line
    assert str(7447 + domain) in line
