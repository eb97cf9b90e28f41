"""Modules that were written after docs/extending.md of the first release still work, and say what to change."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from common import messages, topics
from common.applications.outlining import messages as outlining_messages
from common.applications.outlining import topics as outlining
from common.applications.pick_place import messages as pick_place_messages
from common.applications.pick_place import topics as pick_place
from common.config import load_cell, service_config
from common.messages import Header, Message, Pose, PoseArray, Vector3
from common.process.in_process import running_service
from common.process.wiring import wiring
from common.transport.local import LocalNetwork
from tests.harness import ask, free_domain
from tests.simulated.visited import no_processes
from tests.test_extending import DONE, environment

PAGE = (Path(__file__).parent / "data" / "extending_first_release.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^`([\w./]+)`:\n\n```\w+\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE))
MODULES = [name.removesuffix(".py").replace("/", ".") for name in FILES if name.endswith(".py")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder that the old page builds; its modules can be imported."""
    folder = tmp_path_factory.mktemp("first_release")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield folder
    forget()


def forget() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "my_pkg"]:
        del sys.modules[name]


def imported(name: str) -> tuple[ModuleType, list[str]]:
    """A module of the old page, read anew, and the warnings that it caused."""
    forget()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DeprecationWarning)
        module = importlib.import_module(name)
    mine = str(Path(module.__file__ or "").parent)
    assert all(str(warning.filename).startswith(mine) for warning in caught), "the warning names another file"
    return module, sorted(str(warning.message).partition(";")[0] for warning in caught)


@pytest.mark.parametrize("name", MODULES)
def test_modules_of_the_old_page_can_be_imported(folder: Path, name: str) -> None:
    _, told = imported(name)
    service = "common.transport.service.main is common.process.service.main now"
    writer = "nearest_target: leave 'nearest_target' out: a topic names no writer any more, the cell does"
    wanted = {
        "my_pkg.my_topics": [writer],
        "my_pkg.nearest_target": [service, writer],
        "my_pkg.evening_camera": ["common.perception.drawing.draw is common.sim.drawing.draw now", service],
    }
    assert told == wanted.get(name, [])


def test_inverse_kinematics_can_be_imported_from_where_it_was() -> None:
    old = importlib.import_module("common.robot.ik")
    with pytest.warns(DeprecationWarning, match=r"common\.robot\.ik\.solve_ik is common\.planning\.ik\.solve_ik now"):
        assert old.solve_ik is importlib.import_module("common.planning.ik").solve_ik


@pytest.mark.parametrize("name", ["evening_camera", "nearest_target"])
async def test_services_of_the_old_page_read_and_write_what_they_did(folder: Path, name: str) -> None:
    module, _ = imported(f"my_pkg.{name}")
    config = module.Config(world=load_cell("panda").world) if name == "evening_camera" else module.Config()
    with pytest.warns(DeprecationWarning, match=r"common\.topics\.\w+ is common\.applications\.pick_place\.topics"):
        wired = await wiring(module.run, config)
    keys = {topic.key for topic in wired.reads}, {topic.key for topic in wired.writes}
    assert keys == {
        "evening_camera": ({"scene_balls"}, {"camera/image_raw", "camera/camera_info"}),
        "nearest_target": ({"validated_targets"}, {"nearest_target"}),
    }[name]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
async def test_camera_of_the_old_page_draws_what_it_drew(folder: Path) -> None:
    module, _ = imported("my_pkg.evening_camera")
    net = LocalNetwork()
    bus = net.bus()
    images = bus.reader(topics.CAMERA_IMAGE)
    world = service_config(load_cell("panda"), "camera_simulator", importlib.import_module(
        "services.camera_simulator").Config).world
    async with running_service(net, module.run, module.Config(world=world, blue=0.5)):
        ball = Pose(position=Vector3(x=0.5, y=0.0, z=0.03))
        bus.writer(pick_place.SCENE_BALLS).put(
            PoseArray(header=Header(stamp=1, frame_id="world"), poses=[ball], labels=["table"]))
        image = await images.next()
    picture = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
    blue, green, red = picture[..., 0], picture[..., 1], picture[..., 2]
    assert ((red > 150) & (green < 80) & (blue < 40)).sum() > 500, "no ball"
    assert picture[1, 1, 0] * 2 == picture[1, 1, 1] == picture[1, 1, 2]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_cell_of_the_old_page_runs_to_its_end(folder: Path) -> None:
    for line in re.findall(r"^(?:xacro|zencell robot) .*$", PAGE, re.MULTILINE):
        done = subprocess.run(shlex.split(line), cwd=folder, env=environment(), text=True, capture_output=True,
                              timeout=100, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    with no_processes():
        ran = ask(folder, "run", "my_cell.yaml", "--no-viewer", "--set", "world.count=1", "--domain",
                  str(free_domain()))
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert DONE in ran.stdout


@pytest.mark.parametrize(("part", "new"), [(topics, pick_place), (topics, outlining),
                                           (messages, pick_place_messages), (messages, outlining_messages)],
                         ids=["pick_place topics", "outlining topics", "pick_place messages", "outlining messages"])
def test_words_that_went_to_applications_are_found_where_they_were(part: ModuleType, new: ModuleType) -> None:
    kinds = (topics.Topic, topics.Request)
    own = {name: value for name, value in vars(new).items()
           if (isinstance(value, kinds)
               and name not in ("STATUS", "DECIDED_BY", "REJECTED", "DETECTED", "ANNOTATED", "MASK"))
           or (isinstance(value, type) and issubclass(value, Message) and value.__module__ == new.__name__)}
    assert own
    for name, value in own.items():
        with pytest.warns(DeprecationWarning, match=rf"{part.__name__}\.{name} is {new.__name__}\.{name} now"):
            assert getattr(part, name) is value


@pytest.mark.parametrize("name", ["STATUS", "VIEWS", "Field", "computed_field", "NO_SUCH_TOPIC", "__path_of__"])
def test_nothing_else_is_found(name: str) -> None:
    for part in (topics, messages):
        with pytest.raises(AttributeError, match=name):
            getattr(part, name)
