"""The insertion cell on a virtual clock with physics, and its installed world."""

from __future__ import annotations

import math

import pytest

from applications.peg_in_hole.figures import InsertionFigures
from applications.peg_in_hole.task import Config
from applications.peg_in_hole.topics import INSERTION_STATUS
from common import messages as m
from common import topics
from common.config import load_cell, service_config
from common.errors import ConfigError
from common.transport.bus import Bus
from lab.simulation import Simulation

FASTER = ["services.depth_camera.rate=1.0", "world.camera.width=320", "world.camera.height=240", "world.camera.fx=400",
          "world.camera.fy=400", "world.camera.cx=160", "world.camera.cy=120"]  # half the resolution


@pytest.mark.slow
def test_peg_that_the_camera_sees_is_inserted_a_millimetre_and_a_degree_off() -> None:
    pytest.importorskip("mujoco")
    pegs: list[tuple[float, float, float]] = []
    forces: list[str] = []

    async def visit(bus: Bus) -> None:
        truth, motions = bus.reader(topics.SCENE_OBJECTS), bus.reader(topics.MOTION_STATUS)
        wrench = bus.reader(topics.WRENCH)
        async for status in bus.reader(INSERTION_STATUS):
            if motions.latest is not None and motions.latest.message.startswith("inserted"):
                forces.append(motions.latest.message)
                assert wrench.latest is not None and wrench.latest.zeroed, "by the stage itself"
            if status.state in ("DONE", "ERROR"):
                assert truth.latest is not None
                at = truth.latest.objects[0].pose.position
                pegs.append((at.x, at.y, at.z))
                return

    outcome = Simulation(load_cell("insertion", FASTER, seed=1), 1, visit=visit).run()
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 1, 1, []), outcome
    x, y, z = pegs[0]
    assert math.dist((x, y), (0.5, 0.15)) < 5e-4 and z - 0.035 < 0.03 - 0.0145, "14.5 mm deep by the truth"
    assert forces and forces[0].startswith("inserted 15.")


def test_hole_of_the_installed_world_is_a_tenth_of_a_millimetre_wider_than_its_peg() -> None:
    cell = load_cell("insertion")
    hole = cell.services["inserter"].parameters["hole"]
    walls = [fixture for fixture in cell.world.fixtures if fixture.id in hole["around"]]
    (x, y, top), (peg,) = hole["position"], cell.world.objects
    assert peg.radius == 0.01 and len(walls) == 12
    gaps, turns = [], []
    for wall in walls:
        dx, dy = wall.position[0] - x, wall.position[1] - y
        turn = wall.rpy[2]
        gaps.append(dx * math.cos(turn) + dy * math.sin(turn) - wall.dimensions[0] / 2)
        turns.append(round(math.degrees(turn)) % 360)
        assert abs(dy * math.cos(turn) - dx * math.sin(turn)) < 1e-6
        assert wall.position[2] + wall.dimensions[2] / 2 == top
        assert wall.dimensions[1] / 2 > gaps[-1] * math.tan(math.pi / 12), "no gap between walls"
    assert sorted(turns) == list(range(0, 360, 30))
    assert [2 * (gap - peg.radius) for gap in gaps] == pytest.approx([1e-4] * 12, abs=2e-6)


def test_world_without_forces_is_refused_before_anything_moves() -> None:
    cell = load_cell("insertion", ["world.simulator=kinematic"])
    with pytest.raises(ConfigError, match=r"world\.simulator: 'kinematic' has no forces.*: use mujoco"):
        service_config(cell, "inserter", Config).require_usable()


@pytest.mark.parametrize(("z", "state", "counted"), [(0.01, "table", 1), (0.06, "table", 0), (0.01, "held", 0)])
def test_summary_counts_pegs_in_the_hole_by_ground_truth(z: float, state: str, counted: int) -> None:
    figures = InsertionFigures()
    figures.parameters = load_cell("insertion").services["inserter"].parameters
    x, y, surface = figures.parameters["hole"]["position"]
    pose = m.Pose(position=m.Vector3(x=x, y=y, z=surface + z))
    peg = m.WorldObject(id="peg", shape="cylinder", state=state, pose=pose,
                        size=m.Vector3(x=0.02, y=0.02, z=0.05))
    assert figures.in_place(m.WorldObjects(objects=[peg])) == [peg][:counted]
