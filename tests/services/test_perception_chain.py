"""Camera, detector and validator together: from ground truth to targets through images only."""

from contextlib import asynccontextmanager

import numpy as np

from applications.pick_place.topics import REJECTED_TARGETS, VALIDATED_TARGETS
from common import topics
from common.config import Run, Surroundings, load_cell, service_config
from common.perception.pinhole import Pinhole
from services import camera_simulator, vision_detector, workspace_validator
from tests.common.sim.spheres import spheres
from tests.services.fake_cell import FakeCell, until

CELL = load_cell("panda")
AROUND = CELL.section(Surroundings)


class Cell(FakeCell):
    """The services, with the truth before them and the targets after them."""

    def __init__(self):
        super().__init__()
        self.targets = self.reader(VALIDATED_TARGETS)
        self.calibrate(Pinhole.from_config(AROUND.camera), AROUND.camera.frame)

    async def targets_follow(self, places, targets=None, states=()):
        """Publish balls; return the message with exactly the targets, each within 3 mm."""
        self.put(topics.SCENE_OBJECTS, spheres([(*p, 0.03)[:3] if len(p) < 3 else p for p in places], AROUND, states))
        wanted = np.array([p[:2] for p in (places if targets is None else targets)])

        def match(message):
            found = np.array([(p.position.x, p.position.y) for p in message.poses]).reshape(-1, 2)
            return len(found) == len(wanted) and all(np.linalg.norm(found - w, axis=1).min() < 0.003 for w in wanted)

        return await until(self.targets, match)


@asynccontextmanager
async def running(**camera_parameters):
    cell = Cell()
    camera = camera_simulator.Config(world=AROUND, robot=CELL.robot, run=Run(cell="test"), **camera_parameters)
    detector = service_config(CELL, "vision_detector", vision_detector.Config)
    validator = service_config(CELL, "workspace_validator", workspace_validator.Config)
    async with (cell.running(camera_simulator, camera), cell.running(vision_detector, detector),
                cell.running(workspace_validator, validator)):
        yield cell


async def test_targets_follow_the_objects_on_the_table():
    async with running(rate=50.0) as cell:
        rejected, places = cell.reader(REJECTED_TARGETS), list(CELL.world.spots[:7])
        message = await cell.targets_follow(places)
        assert 0 < message.header.stamp <= cell.clock.now_ns()
        await cell.targets_follow(places, places[1:], ["held", *["table"] * 6])
        c = AROUND.container
        contained = [(c.x - 0.033, c.y - 0.033, 0.035), *places[1:]]
        await cell.targets_follow(contained, places[1:], ["contained", *["table"] * 6])
        assert rejected.received == 0
        near = [(0.46, 0.0), (0.52, 0.0), (0.49, 0.052)]
        await cell.targets_follow([(0.2, 0.0), *near], near)
        assert (await until(rejected)).rejected[0].reason.startswith("pre-grasp at (0.200, 0.000, 0.130)")


async def test_noise_and_dimming_change_nothing():
    async with running(rate=50.0, noise_std=8.0, brightness=-20.0) as cell:
        await cell.targets_follow([(0.40, -0.30), (0.46, -0.30), (0.64, -0.25), (0.40, -0.17)])
