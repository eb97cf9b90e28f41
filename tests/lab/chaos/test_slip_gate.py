"""When chaos lets the held object slip: it must stay visible and reachable."""

from types import SimpleNamespace

import pytest

from common.application import all_topics
from common.config import load_cell
from common.messages import Header, Pose, Vector3, WorldObject, WorldObjects
from lab.chaos import agent
from lab.chaos.slip_gate import SlipGate

RADIUS, EVERY = 0.03, 20_000_000  # [m], [ns]
KINEMATIC, PHYSICS = load_cell("panda").world, load_cell("panda", ["world.simulator=mujoco"]).world


def held_at(x, y, stamp, state="held"):
    """A ball 25 cm above the table."""
    size = Vector3(x=2 * RADIUS, y=2 * RADIUS, z=2 * RADIUS)
    ball = WorldObject(id="ball", shape="sphere", state=state, pose=Pose(position=Vector3(x=x, y=y, z=0.25)), size=size)
    return WorldObjects(header=Header(stamp=stamp), objects=[ball])


def may_slip(world, x, y, vx=0.0, vy=0.0):
    """Whether a ball at (x, y) [m] with this velocity [m/s] may slip."""
    gate, step = SlipGate(world), EVERY * 1e-9
    gate.may(held_at(x - vx * step, y - vy * step, EVERY))
    return gate.may(held_at(x, y, 2 * EVERY))


@pytest.mark.parametrize(("world", "x", "y", "vx", "vy", "allowed"), [
    (PHYSICS, 0.40, -0.20, 0.0, 0.0, True), (PHYSICS, 0.40, -0.20, 0.3, 0.0, True),
    (PHYSICS, 0.40, -0.20, 0.7, 0.0, False), (PHYSICS, 0.60, -0.20, 0.4, 0.0, False),
    (PHYSICS, 0.60, -0.20, -0.4, 0.0, True), (PHYSICS, 0.40, -0.40, 0.0, -0.3, False),
    (PHYSICS, 0.55, 0.25, 0.0, 0.0, True), (PHYSICS, 0.55, 0.12, 0.0, 0.0, False),
    (PHYSICS, 0.50, -0.05, 0.0, 0.4, False), (KINEMATIC, 0.60, -0.20, 2.0, 0.0, True),
    (KINEMATIC, 0.55, 0.12, 0.0, 0.0, False),
])
def test_object_must_stop_in_view_and_clear_of_walls_and_without_physics_stops_at_once(world, x, y, vx, vy, allowed):
    assert may_slip(world, x, y, vx, vy) == allowed


def test_no_slip_before_the_velocity_is_known():
    assert SlipGate(KINEMATIC).may(held_at(0.60, -0.20, EVERY)), "it does not matter without physics"
    gate = SlipGate(PHYSICS)
    assert not gate.may(None) and not gate.may(held_at(0.4, -0.2, EVERY, "table"))
    assert not gate.may(held_at(0.4, -0.2, EVERY))
    assert gate.may(held_at(0.4, -0.2, 2 * EVERY)) and gate.may(held_at(0.4, -0.2, 2 * EVERY))
    assert not gate.may(held_at(0.4, -0.2, 20 * EVERY)), "the observation before is too old"
    assert gate.may(held_at(0.4, -0.2, 21 * EVERY))


def test_camera_on_the_gripper_counts_from_the_home_pose(monkeypatch):
    cell = load_cell("panda", ["world.simulator=mujoco",
                               "world.camera={mount: tcp, position: [0.06, 0.0, -0.1], rpy: [0, 0, 1.5708]}"])
    worlds = []
    monkeypatch.setattr(agent, "Chaos", lambda bus, plan, pids, world, known: worlds.append(world))
    supervisor = SimpleNamespace(statuses=[SimpleNamespace(name=entry.name, pid=1) for entry in cell.services.values()])
    bus = SimpleNamespace(clock=SimpleNamespace(speed=1.0))
    agent.create_chaos(bus, cell, supervisor, all_topics(), 1, 6.0, until_ended=True)
    assert may_slip(worlds[0], 0.40, -0.05) and not may_slip(worlds[0], 0.40, -0.60)
