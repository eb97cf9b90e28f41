"""Quick checks of a cell in a subprocess."""

import os
from pathlib import Path

from common.config import load_cell
from tools.check.cell import quick_warnings, warnings_in_subprocess

ROOT = str(Path(__file__).resolve().parents[3])


async def test_prints_of_user_modules_do_not_mix_with_the_findings(tmp_path):
    (tmp_path / "loud.py").write_text("""
import os
from tools.check import warning
from common.application import Application, ApplicationTopics, Checks
from common.messages import TaskStatus
from common.topics import Topic
print("hello")
os.system("echo hello from a program")
STATUS = Topic("loud_status", TaskStatus, "state", "")
def quick(cell):
    yield warning("the cell is loud", "whisper")
APPLICATION = Application(topics=ApplicationTopics(status=STATUS), checks=Checks(quick=quick))
""", encoding="utf-8")
    (tmp_path / "loud_app").mkdir()
    (tmp_path / "loud_app" / "__init__.py").touch()
    (tmp_path / "loud_app" / "app.py").write_text("from loud import APPLICATION\n", encoding="utf-8")
    cell = load_cell("panda").model_copy(update={"application": "loud_app.app"})
    path = os.pathsep.join([str(tmp_path), ROOT])
    found = await warnings_in_subprocess(cell, {**os.environ, "PYTHONPATH": path})
    assert any("the cell is loud" in each.line for each in found)


async def test_findings_are_those_of_a_check_in_this_process():
    cell = load_cell("panda")
    assert await warnings_in_subprocess(cell, {**os.environ, "PYTHONPATH": ROOT}) == quick_warnings(cell)
