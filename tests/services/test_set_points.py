"""The executor publishes what it commands while there is a subscriber."""

import numpy as np

from common import topics
from tests.services.executor_rig import HOME, ROBOT, executor, to_home_plus
from tests.services.fake_cell import latest


async def test_set_points_are_the_commands_of_each_cycle():
    async with executor() as client:
        reader = client.reader(topics.SET_POINTS)
        first = await latest(reader)
        assert first.name == list(ROBOT.joint_names) and np.allclose(first.position, HOME) and first.width is None
        await client.follow("a", to_home_plus(0.3))
        await client.grip("close", 0.02)
        joints = await latest(client.joints)
        found = await latest(reader, lambda each: each.header.stamp >= joints.header.stamp)
        assert found.width == 0.02
        assert np.allclose(found.position, joints.position[:7], atol=1e-3), "at the end of the motion"
