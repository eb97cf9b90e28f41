"""Bad input gets one line with its name, its value and the choices; exit code 2 and no traceback."""

import contextlib
import io
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from cli.main import app
from cli.session.session import CellSession
from tests.cli.conftest import make_folder
from tests.harness import command_line, environment
from tests.recording.samples import joints, write

RECORDING = Path(__file__).parents[1] / "data" / "panda_first_release.mcap"
ROWS = [  # a command, and parts of its line
    ("run pnada", "unknown cell 'pnada'", "did you mean 'panda'?", "choices:"),
    ("run", "CELL"),
    ("rnu panda", "rnu", "run"),
    ("task dance", "'dance'", "choices:", "pause"),
    ("run panda --sped 2", "--sped", "--speed"),
    ("up nowhere.yaml", "nowhere.yaml", "is not a file"),
    ("run broken.yaml", "broken.yaml", "does not parse at line 2"),
    ("run list.yaml", "list.yaml", "must hold a mapping"),
    ("run empty.yaml", "empty.yaml", "must hold a mapping"),
    ("run taskless.yaml", "task: is missing", "nothing to run", "`zencell up`"),
    ("simulate taskless.yaml", "task: is missing"),
    ("run panda --set services={}", "services: smart_pick_place, the task of panda, is missing", "there are none"),
    ("run panda --set services=[]", "services: [] must be a mapping"),
    ("run panda --set services=null", "services: None must be a mapping"),
    ("run panda --set 'services={smart_pick_place: {}, motion_planner: {}}'",
     "services: trajectory_executor is missing", "needed by smart_pick_place"),
    ("simulate panda --set 'services={smart_pick_place: {}, trajectory_executor: {}}'",
     "services: motion_planner is missing", "needed by smart_pick_place"),
    ("up panda --set services.trajectory_executor.speed_scaling=nan", "services.trajectory_executor.speed_scaling",
     "'nan' must be a finite number"),
    ("up mine.yaml", "services.needs.gain: is missing"),
    ("up mine.yaml --set services.needs.gain=.inf", "services.needs.gain: inf must be a finite number"),
    ("up renamed.yaml", "services.vision_detector.topics: 'nonsense' is no key", "camera/image_raw"),
    ("run fake.yaml --set services.first.x=1", "services.fakes.first", "is not a module: there is no fakes in"),
    ("run panda --set application=common.tasks.none", "is not a module: there is no none in", "common/tasks"),
    ("check twice.yaml", "twice.yaml", "does not parse at line 3", "'cell' is given twice"),
    ("up panda --set 'services={trajectory_executor: {}, arm: {service: trajectory_executor}}'",
     "services.arm: is a second trajectory_executor", "one arm"),
    ("check 'a cell.yaml'", "'a cell' is no name of a cell", "letters"),
    ("check ~no_such_user/cell.yaml", "begins with ~", "without a home"),
    ("run panda --world moon", "unknown world 'moon'", "balls"),
    ("run panda --set world.simulator=no.such", "world.simulator", "is not a module: there is no no in"),
    ("run panda --set world.cuont=3", "world.cuont", "3", "choices:", "count"),
    ("run panda --set wrold.count=3", "wrold", "choices:", "world"),
    ("run panda --set world.count=9", "world.count", "9", "less than or equal to 8"),
    ("run panda --set motion.velocity_scaling=fast", "motion.velocity_scaling", "'fast'"),
    ("run panda --set motion.object_padding=.nan", "motion.object_padding", "nan"),
    ("run panda --set world.count", "--set", "'world.count'", "PATH=VALUE"),
    ("run panda --set 'world.balls=[[0.4, 0], [0.41, 0]]'", "world", "overlap"),
    ("run panda --set 'world.objects=[{id: crate, shape: box}]'", "world.objects", "crate", "size"),
    ("run panda --speed fast", "--speed", "fast"),
    ("robot identify-payload --poses 3", "--poses", "3", "must be 4 to 12"),
    ("robot identify-payload --poses many", "--poses", "many", "whole number"),
    ("robot identify-payload --poses -3", "--poses: '-3' must be a whole number, 4 to 12"),
    ("robot identify-payload --speed 2", "--speed", "2", "must be 0.01 to 1"),
    ("run panda --set robot.wrench.bandwidth=0", "robot.wrench.bandwidth", "0"),
    ("run panda --seed -1", "seed", "-1", "0 or more"),
    ("run panda --summary no/where/s.json", "--summary", "does not exist"),
    ("run panda --summary .", "--summary", "'.'", "is a folder"),
    ("run panda --chaos monkey", "--chaos", "'monkey'", "0 or more"),
    ("up panda --chaos 1 --chaos-rate 0", "--chaos-rate", "'0'", "at most 600"),
    ("run panda --chaos-rate 5", "--chaos-rate", "needs --chaos SEED"),
    ("run panda --ask", "'panda' needs a cell that outlines objects"),
    ("run panda --from .", "'panda' needs a cell that outlines objects"),
    ("run ur5 --ask", "--ask: needs a terminal"),
    ("run ur5 --from .", "is missing"),
    ("run tiny.yaml --record there.mcap", "--record: "),
    ("up panda --no-viewer --viewer-port 9000", "--viewer-port: '9000' needs a cell with a viewer"),
    ("up panda --no-viewer --viewer-host ::", "--viewer-host: '::' needs a cell with a viewer"),
    ("up panda --domain 233", "--domain", "233", "0 to 232"),
    ("node list --connect here", "--connect", "'here'", "tcp/"),
    ("task stop --cell *", "cell: '*'", "is not a valid name of a cell"),
    ("param set world.count", "param set", "'world.count'", "PATH=VALUE"),
    ("service no_such", "unknown service 'no_such'", "motion_planner"),
    ("topic info joint_state", "unknown key", "did you mean 'joint_states'?"),
    ("topic pub my//key {}", "unknown key 'my//key'", "choices:"),
    ("topic pub my/* {}", "unknown key 'my/*'", "choices:"),
    ("topic echo tf -n 0", "--count", "0"),
    ("topic echo motion/plan", "unknown published key 'motion/plan'"),
    ("topic echo tf --save tf.png", "--save: 'tf.png' is for images: tf carries TFMessage"),
    ("topic echo camera/image_raw --save seen.jpg", "'seen.jpg' must be a .png file"),
    ("topic echo camera/image_raw --save no/seen.png", "in an existing folder"),
    ("call motion/plan {}", "motion/plan.id", "is missing"),
    ("call gripper/command '{\"id\": \"a\"}'", "gripper/command.width: is missing"),
    ("call task/command '{'", "task/command: '{' is not JSON"),
    ("call task/command []", "must be a JSON object"),
    ("call task/command '{\"command\": \"fly\"}'", "task/command.command: 'fly' must be 'start', 'pause'"),
    ("call joint_states {}", "unknown request 'joint_states'"),
    ("task select purple", "choices: "),
    ("world add 0.4 nan", "Y: 'nan' must be a number"),
    ("world add 0.5 0 --size 1,2", "--size", "'1,2'", "three numbers"),
    ("world add 0.5 0 --shape cube", "world.shape", "'cube'", "cylinder"),
    ("world add 0.5 0 --color red", "--color", "red"),
    ("outline .", "camera_image.png: is missing"),
    ("graph ur5 -o it.png", "--output", "'it.png'", ".svg, .dot, .mmd"),
    ("graph ur5 -o no/it.svg --connect tcp/127.0.0.1:1", "no/it.svg", "cannot be written"),
    ("new taken", "DIR", "'taken'", "not empty"),
    ("new a_file", "DIR", "'a_file'", "not empty"),
    ("new a_file/below", "DIR", "'a_file/below'", "cannot be written"),
    ("new my-task", "DIR", "'my-task'", "letters, digits and _"),
    ("new class", "DIR", "'class'", "a name that Python can import"),
    ("new json", "DIR", "'json'", "a Python module that is there already"),
    ("new common", "DIR", "'common'", "a Python module that is there already"),
    ("new ~no_such_user/x", "begins with ~", "without a home"),
    ("new fine --task sort_cube", "unknown task 'sort_cube'", "did you mean 'sort_cubes'?", "choices:"),
    ("--install-completion tcsh", "zencell: unknown shell 'tcsh'; choices: bash, fish, zsh"),
    ("robot collisions pnada", "unknown robot 'pnada'", "did you mean 'panda'?", "ur5"),
    ("robot collisions panda --samples 0", "--samples", "0", "1 or more"),
    ("robot collisions panda --margin -1", "--margin", "-1", "0 or more"),
    ("robot collisions panda --margin wide", "--margin", "'wide'", "must be a number"),
    ("robot collisions panda --samples 1 -o no/x.srdf", "--output", "no/x.srdf", "cannot be written"),
    ("simulate panda --seeds 9-2", "--seeds: '9-2' must be a range"),
    ("simulate panda --seeds all", "--seeds: 'all' must be a range"),
    ("simulate panda --seed -3", "--seed"),
    ("simulate panda --seeds 1-2 --seed 1", "--seed: '1' does not go with --seeds"),
    ("simulate panda --trace a.mcap", "--trace: 'a.mcap' needs --seed N"),
    ("simulate panda --seed 1 --trace a.bag", "must end in .mcap"),
    ("simulate panda --jobs none", "--jobs"),
    ("simulate panda --limit 0", "--limit: '0' must be more than 0"),
    ("simulate panda --set robot.hardware.backend=nothing", "unknown hardware backend 'nothing'"),
    ("record motion/plan", "unknown published key 'motion/plan'"),
    ("record --duration 0", "--duration: '0' must be more than 0"),
    ("record --max-size 0.1", "--max-size: '0.1' must be 1 or more"),
    ("record -o there.mcap", "exists already; choose another name"),
    ("record -o no/such/a.mcap", "is in a folder that does not exist"),
    ("record -o a.bag", "must end in .mcap"),
    ("info none.mcap", "none.mcap: no such file"),
    ("info list.yaml", "list.yaml: is no MCAP file"),
    ("recover there.mcap -o there.mcap", "exists already"),
    ("play there.mcap --rate 0", "--rate: '0' must be more than 0"),
    ("play there.mcap --start-offset 99", "--start-offset: '99' must be 0 to 0.1"),
    ("play there.mcap --remap a=b", "--remap: 'a=b' must be FROM:=TO"),
    ("play there.mcap camera/image_raw", "is not in there.mcap; choices: joint_states"),
    ("play there.mcap --exclude .", "has no message of the selected topics"),
    ("play there.mcap --start-paused", "--start-paused: needs a terminal"),
    ("play panda.mcap --cell a/b", "--cell: 'a/b'", "is not a valid name"),
    ("export there.mcap", "needs one or more of --foxglove"),
    ("export there.mcap --video v.mp4", "needs one topic with images"),
    ("export there.mcap --csv there.mcap", "--csv: 'there.mcap' must be a folder"),
    ("export there.mcap --csv d --topics tf", "--topics: 'tf' is not in there.mcap; choices: joint"),
    ("report panda.mcap -o report.pdf", "--output", "report.pdf", "must end in .html"),
    ("report panda.mcap -o no/where/report.html", "--output", "report.html", "cannot be written"),
    ("report panda.mcap -o ~no_such_user/a.html", "begins with ~", "without a home"),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = make_folder(tmp_path_factory.mktemp("bad"))
    cell = "robot: panda\nworld: balls\npipeline: cartesian_ompl\n"
    task = "task: first\nservices: {fakes.first: {}}\n"
    for name, text in {"a cell": cell + task, "fake": cell + task, "broken": "cell: [1,\nrobot: }\n", "list": "- 1\n",
                       "twice": "cell: a\nrobot: panda\ncell: b\n",
                       "renamed": cell + "services: {vision_detector: {topics: {nonsense: x}}}\n",
                       "mine": cell + "services: {mine.needs: {}}\n",
                       "empty": "", "taskless": cell + "services: {motion_planner: {}}\n"}.items():
        (folder / f"{name}.yaml").write_text(text)
    write(folder / "there.mcap", [joints(n) for n in range(12)])
    (folder / "panda.mcap").symlink_to(RECORDING)
    (folder / "mine").mkdir()
    (folder / "mine" / "needs.py").write_text(
        "from common.config import Parameters\n\n\nclass Config(Parameters):\n    gain: float\n")
    (folder / "taken").mkdir()
    (folder / "taken" / "mine.txt").touch()
    (folder / "a_file").touch()
    return folder


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_bad_input_is_one_line_and_changes_no_file(row, files, monkeypatch, rejection):
    monkeypatch.chdir(files)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    monkeypatch.setattr("common.client.joining.CONNECT_TIMEOUT", 0.05)
    before = sorted(files.rglob("*"))
    line = rejection(*shlex.split(row[0]))
    assert all(part in line for part in row[1:]), line
    assert sorted(files.rglob("*")) == before


LONG = "x" * 300  # longer than a file system lets a name be


@pytest.mark.parametrize("arguments", [
    ["record", "-o", f"{LONG}.mcap"], ["check", f"{LONG}.yaml"], ["recover", str(RECORDING), "-o", f"{LONG}.mcap"],
    ["export", str(RECORDING), "--csv", "/proc/nowhere"], ["export", str(RECORDING), "--images", "/proc/nowhere"],
    ["robot", "new", f"{LONG}.urdf", "-y"], ["calibrate", "intrinsics", LONG],
], ids=lambda arguments: " ".join(arguments[:2])[:20])
def test_error_of_the_operating_system_is_one_line(arguments, tmp_path, monkeypatch, rejection):
    monkeypatch.chdir(tmp_path)
    line = rejection(*arguments, code=1)
    assert LONG[:100] in line or "/proc/nowhere" in line


def test_result_of_a_run_is_printed_although_its_file_cannot_be_written(tmp_path, monkeypatch, capsys, domain):
    async def run(session: CellSession, work: object) -> int:
        folder.rmdir()  # meanwhile
        return 1

    folder = tmp_path / "figures"
    folder.mkdir()
    monkeypatch.setattr(CellSession, "_run", run)
    assert app.execute(["run", "panda", "--domain", str(domain), "--summary", str(folder / "s.json")]) == 1
    shown = capsys.readouterr()
    assert "panda: IDLE, 0 of 0 placed" in shown.out
    assert shown.err.splitlines() == [f"zencell: {folder / 's.json.part'}: No such file or directory"]


def test_output_on_a_full_disk_is_one_line(monkeypatch, capsys):
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert app.execute(["cells"]) == 1
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()
    assert capsys.readouterr().err.splitlines() == ["zencell: No space left on device"]


def test_process_ends_with_the_exit_code_and_without_a_traceback(tmp_path):
    done = subprocess.run(command_line("run", "pnada"), cwd=tmp_path, env=environment(), capture_output=True, text=True,
                          timeout=100, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("zencell: unknown cell 'pnada' (did you mean 'panda'?); choices: ")


@pytest.mark.parametrize("command", ["node list", "task start", "param list", "topic echo tf", "topic hz tf"])
def test_without_a_running_cell_the_line_names_the_command_that_starts_one(command, domain, monkeypatch, rejection):
    monkeypatch.setattr("common.client.joining.CONNECT_TIMEOUT", 0.05)
    line = rejection(*command.split(), "--domain", str(domain), code=1)
    assert "zencell up panda" in line and str(7447 + domain) in line
