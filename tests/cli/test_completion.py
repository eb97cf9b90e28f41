import importlib
import subprocess
from pathlib import Path

import pytest

from cli import choices
from cli import choices as completion
from common.application import all_topics
from common.config import load_cell, names_of, service_config, service_names
from common.config.tunables import leaves
from common.planning.planners import planner_names
from common.topics import Topic
from tests.harness import PATIENCE, ask, command_line, environment


def offered(line: str, folder: Path, shell: str = "bash", **variables: str) -> list[str]:
    """Return what the shell's own protocol answers for the last word of a line."""
    words = line.split(" ")
    request = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)} if shell == "bash" else {
        "_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    done = ask(folder, environment={"_ZENCELL_COMPLETE": f"complete_{shell}"} | request | variables)
    assert done.stderr == ""
    return done.stdout.split("\n")[:-1]


@pytest.mark.parametrize(("line", "wanted"), [
    ("zencell run p", ["panda", "policy_panda"]),
    ("zencell run panda --world w", ["w1", "w2", "w3", "w4", "w5", "w6"]),
    ("zencell topic echo camera/", ["camera/camera_info", "camera/image_raw"]),
    ("zencell call gripper", ["gripper/command"]),
    ("zencell node info vision", ["vision_detector"]),
    ("zencell up panda --set motion.vel", ["motion.velocity_scaling="]),
    ("zencell task home --planner lin", ["lin"]),
    ("zencell gra", ["graph", "grasp"]),
    ("zencell --install-completion z", ["zsh"]),
])
def test_word_is_completed(line, wanted, tmp_path):
    assert offered(line, tmp_path) == wanted


def test_words_of_fish_and_zsh_have_a_description(tmp_path):
    (line,) = offered("zencell run u", tmp_path, "fish")
    assert line.startswith("ur5\tA UR5 ")
    assert '"ur5":' in "".join(offered("zencell run u", tmp_path, "zsh"))


def test_cells_of_another_configuration_are_completed(tmp_path):
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "mine.yaml").write_text("# A cell of mine.\ncell: mine\n")
    assert offered("zencell run m", tmp_path, ZENCELL_CONFIG=str(tmp_path)) == ["mine"]


@pytest.mark.parametrize("shell", completion.SHELLS)
def test_script_of_a_shell_calls_the_command(shell, tmp_path):
    done = ask(tmp_path, "--show-completion", shell)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"_ZENCELL_COMPLETE=complete_{shell}" in done.stdout


def test_bash_completes_after_installing(tmp_path):
    home = {"HOME": str(tmp_path)}
    done = ask(tmp_path, "--install-completion", "bash", environment=home)
    assert "bash completion installed" in done.stdout
    program = tmp_path / "zencell"  # the name of the command, as it would be on the PATH
    program.write_text('#!/bin/sh\nexec ' + " ".join(command_line()) + ' "$@"\n')
    program.chmod(0o755)
    script = (
        f'source "{tmp_path}/.bash_completions/zencell.sh"; COMP_WORDS=(zencell run pa); COMP_CWORD=2; '
        f'_zencell_completion "{program}"; echo "${{COMPREPLY[@]}}"'
    )
    bash = subprocess.run(["bash", "--norc", "-c", script], env=environment() | home, capture_output=True, text=True,
                          timeout=PATIENCE, check=True)
    assert bash.stdout.strip() == "panda"


def words(offered: list[tuple[str, str]]) -> set[str]:
    return {word for word, _ in offered}


def test_completed_names_are_those_of_the_code():
    topics = all_topics()
    assert words(choices.keys("")) == set(topics)
    assert words(choices.published("")) == {key for key, topic in topics.items() if isinstance(topic, Topic)}
    assert dict(choices.keys("tf")) == {key: topics[key].doc for key in ("tf", "tf_static")}
    for _, about in (*choices.parameters(""), *choices.keys(""), *choices.services("")):
        assert len(about) <= choices.LONGEST_DOC and "[" not in about
    assert words(choices.services("")) == set(service_names()) - {"router"}
    assert words(choices.planners("")) == set(planner_names())
    cells, wanted = [load_cell(name) for name in ("panda", *names_of("cells"))], set[str]()
    for name in set(service_names()) - {"router"}:
        cell = next((cell for cell in cells if name in cell.services), cells[0])
        config = service_config(cell, name, importlib.import_module(f"services.{name}").Config)
        wanted |= {path for path in leaves(config, name) if path.startswith("services.")}
    assert words(choices.parameters("services.")) == wanted
    assert {"motion.velocity_scaling", "world.count", "robot.hardware.backend"} <= words(choices.parameters(""))
    assert all(word.endswith("=") for word in words(choices.overrides("world.")))


@pytest.mark.parametrize("typed", ["", "s", "services", "services.v", "services.viewer.po", "motion", "motion.", "x"])
def test_every_parameter_with_the_typed_start_is_offered(typed):
    wanted = {word for word in words(choices.parameters("")) if word.startswith(typed)}
    assert words(choices.parameters(typed)) == wanted
