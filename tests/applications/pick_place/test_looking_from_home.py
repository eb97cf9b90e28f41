"""With a camera on the hand the task looks from home before each decision."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from applications.pick_place.choice import PickPlaceView
from common import messages as m
from common.config import CameraConfig, Surroundings, load_cell
from common.robot.home import is_home
from tests import pages
from tests.applications.pick_place.cell_double import CellDouble

CELL = load_cell(str(Path(__file__).parents[2] / "data" / "hand_camera.yaml"))
HOME = CELL.robot.named_poses["home"]
AWAY = [position + 0.3 for position in HOME]


class HandCell(CellDouble):
    """Its camera sees from home only; elsewhere the last image stays the newest."""

    def __init__(self, balls: list[tuple[float, float]], q: list[float], **parameters: Any) -> None:
        self.q, self._homes, self._seen = q, set[str](), None
        super().__init__(balls, world=CELL.section(Surroundings), **parameters)

    def view(self) -> PickPlaceView:
        self.camera_on = is_home(self.q, HOME)
        view = replace(super().view(), q=list(self.q))
        if self.camera_on:
            self._seen = view.scene, view.seen
        elif self._seen is not None:
            view = replace(view, scene=view.scene.model_copy(update={"objects": self._seen[0].objects}),
                           seen=self._seen[1])
        else:
            view = replace(view, scene=m.PlanningScene(header=m.Header()), seen=None)
        return view

    def answer(self, request: m.Message) -> None:
        if isinstance(request, m.PlanRequest) and isinstance(request.goal, m.JointGoal):
            self._homes.add(request.id)
        super().answer(request)

    def arrive(self, request: m.ExecuteRequest) -> None:
        super().arrive(request)
        self.q = HOME if request.plan in self._homes else AWAY


def test_task_looks_from_home_before_each_choice_and_before_done() -> None:
    cell = HandCell([(0.40, -0.10), (0.52, -0.10)], HOME)
    totals = set()
    for _ in range(400):
        cell.step()
        totals |= {cell.task.status.total} if cell.task.status.stage else set()
        if cell.task.status.state == "DONE":
            break
    assert (cell.task.status.state, cell.contained, cell.task.status.failures) == ("DONE", 2, 0)
    assert cell.stages() == ["pre-grasp", "across", "home"] * 2
    assert totals == {2} and cell.q == HOME


def test_task_goes_home_first_from_anywhere() -> None:
    cell = HandCell([(0.40, -0.10)], AWAY)
    cell.steps(3)
    assert cell.stages() == ["home"]
    cell.until("DONE")
    assert cell.contained == 1


def test_arm_moved_after_the_end_stays_there() -> None:
    cell = HandCell([], HOME)
    cell.until("DONE")
    cell.q = AWAY
    assert cell.steps(50) == []
    cell.command("start")
    cell.step()
    assert cell.stages()[-1] == "home"


def test_page_uses_the_camera_of_the_cell() -> None:
    texts = [text for kind, text in pages.blocks(pages.text_of("docs/calibration.md")) if kind == "yaml"]
    worlds = [block["world"] for block in map(yaml.safe_load, texts) if isinstance(block.get("world"), dict)]
    camera = worlds[0]["camera"]
    assert CameraConfig(**camera) == CELL.world.camera
