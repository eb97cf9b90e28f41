"""What is simulated is found as it was, also when its process was killed in the middle of writing it."""

from __future__ import annotations

import math
import os
import socket
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.atomic_file import STATE_VARIABLE, Unreadable
from common.config import World
from common.messages import Header
from common.robot.transforms import tool_down
from common.sim.interface import ObjectSnapshot
from common.sim.kinematic import KinematicWorld
from common.sim.state_file import SLOT, SimulationState, StateFile, state_file

PLACES = [(0.40, -0.30), (0.52, -0.30), (0.40, -0.17)]
OPEN, GRIP, R = 0.08, 0.06, 0.03


def a_state(number: int) -> SimulationState:
    return SimulationState(layout={"ball_1": (0.4, -0.3, 0.03)}, q=[0.1 * number] * 7, width=0.01 * number,
                           commanded_width=None,
                           objects={"ball_1": ObjectSnapshot(pose=(0.4, -0.3, 0.01 * number, 0, 0, 0, 1))})


def the_world(config: World) -> KinematicWorld:
    return KinematicWorld(World.model_validate(config.model_dump(exclude={"objects"}) | {"balls": PLACES}))


def states(world: KinematicWorld) -> list[str]:
    return sorted(thing.state for thing in world.objects(Header()).objects)


def move(world: KinematicWorld, hand, width: float, now: float, gripping: bool = False) -> None:
    world.obstruction(hand, width)
    world.tick(now, hand, width, gripping)


def grasp(world: KinematicWorld, hand, now: float) -> None:
    move(world, hand, OPEN, now)
    move(world, hand, GRIP, now + 0.01, gripping=True)


@pytest.fixture
def world(world_config) -> KinematicWorld:
    """One ball in the box, one falling, one in the hand."""
    world = the_world(world_config)
    over_box, over_table = tool_down(0.55, 0.25, 0.25), tool_down(0.60, -0.05, 0.5)
    grasp(world, tool_down(*PLACES[0], R), 1.0)
    move(world, over_box, GRIP, 1.1, gripping=True)
    for k in range(100):
        move(world, over_box, OPEN, 1.2 + 0.01 * k)
    grasp(world, tool_down(*PLACES[1], R), 3.0)
    move(world, over_table, GRIP, 3.1, gripping=True)
    move(world, over_table, OPEN, 3.2)
    move(world, over_table, OPEN, 3.21)
    grasp(world, tool_down(*PLACES[2], R), 3.22)
    assert states(world) == ["contained", "falling", "held"]
    return world


def test_partly_changed_state_is_loaded_completely(tmp_path: Path) -> None:
    file, first, other = StateFile(tmp_path / "state"), a_state(1), a_state(2)
    for objects in (first.objects, first.objects, other.objects):
        state = SimulationState.model_construct(**vars(first) | {"q": [0.1 * len(objects)], "objects": objects})
        file.save(state)
        assert StateFile(tmp_path / "state").load() == state


def test_held_falling_and_contained_balls_are_restored(
    world: KinematicWorld, world_config, tmp_path: Path
) -> None:
    file = StateFile(tmp_path / "state")
    file.save(SimulationState(layout=world.layout, q=[0.0], objects=world.snapshot()))
    found = StateFile(tmp_path / "state").load()
    assert found is not None
    again = the_world(world_config)
    again.restore(found.objects)
    assert again.held == world.held != ""
    hand = tool_down(0.45, 0.0, 0.3)
    for k in range(100):  # the falling one comes to rest, the held one moves with the hand
        for each in (world, again):
            move(each, hand, GRIP, 3.3 + 0.01 * k, gripping=True)
        assert again.objects(Header()) == world.objects(Header())
    assert states(again) == ["contained", "held", "table"]
    for each in (world, again):
        move(each, tool_down(0.55, 0.25, 0.25), OPEN, 5.0)
        for k in range(100):
            move(each, hand, OPEN, 5.1 + 0.01 * k)
    assert states(again) == ["contained", "contained", "table"], "not where the first one lies"
    assert again.objects(Header()) == world.objects(Header())


def test_missing_state_file_loads_nothing(tmp_path: Path) -> None:
    assert StateFile(tmp_path / "new" / "state").load() is None


def test_link_or_pipe_as_state_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "state").symlink_to(tmp_path / "other")
    os.mkfifo(tmp_path / "pipe")
    for name, why in (("state", "it is a link"), ("pipe", "it is not a regular file")):
        with pytest.raises(Unreadable, match=f"{tmp_path}/{name} cannot be read: {why}"):
            StateFile(tmp_path / name)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_non_finite_state_falls_back_to_the_previous_one(value: float, tmp_path: Path) -> None:
    file = StateFile(tmp_path / "state")
    file.save(a_state(1))
    file.save(SimulationState.model_construct(**vars(a_state(2)) | {"q": [0.0, value]}))
    assert StateFile(tmp_path / "state").load() == a_state(1)


def test_newest_state_is_loaded_and_numbering_continues(tmp_path: Path) -> None:
    file = StateFile(tmp_path / "state")
    for number in range(7):
        file.save(a_state(number))
        assert StateFile(tmp_path / "state").load() == a_state(number)
    again = StateFile(tmp_path / "state")
    again.load()
    again.save(a_state(50))
    assert StateFile(tmp_path / "state").load() == a_state(50)


def padded(path: Path) -> bytes:
    """The file with room for both states."""
    return path.read_bytes().ljust(2 * SLOT, b"\0")


@settings(max_examples=60, deadline=None)
@given(before=st.integers(1, 4), cut=st.integers(0, 400), rubbish=st.booleans())
def test_partly_written_state_falls_back_to_the_previous_one(
    tmp_path_factory: pytest.TempPathFactory, before: int, cut: int, rubbish: bool
) -> None:
    path = tmp_path_factory.mktemp("torn") / "state"
    file = StateFile(path)
    for number in range(before):
        file.save(a_state(number))
    old = padded(path)
    file.save(a_state(before))
    new = padded(path)
    (changed,) = (np.frombuffer(new, np.uint8) != np.frombuffer(old, np.uint8)).nonzero()
    at = SLOT * (before + 1 & 1)
    end = at + 16 + len(msgpack.packb(a_state(before), default=vars))
    assert at <= changed[0] and changed[-1] < end
    torn = min(at + cut, end)
    rest = bytes(b ^ 0x5A for b in old[torn:end]) if rubbish else old[torn:end]
    path.write_bytes(new[:torn] + rest + old[end:])
    whole = torn > changed[-1] and (torn == end or not rubbish)
    assert StateFile(path).load() == a_state(before if whole else before - 1)
    again = StateFile(path)
    again.load()
    again.save(a_state(9))
    assert StateFile(path).load() == a_state(9), "and the next one is written over what was torn"


def test_state_of_another_version_is_ignored(tmp_path: Path) -> None:
    class Later(SimulationState):
        wheels: int = 4

    file = StateFile(tmp_path / "state")
    file.save(Later(**a_state(1).model_dump()))
    assert StateFile(tmp_path / "state").load() is None
    again = StateFile(tmp_path / "state")
    again.save(a_state(2))
    assert StateFile(tmp_path / "state").load() == a_state(2)


def test_state_file_is_named_by_cell_and_host(tmp_path: Path) -> None:
    assert state_file("panda", {}) is None
    file = state_file("panda", {STATE_VARIABLE: str(tmp_path)})
    assert file is not None
    assert [path.name for path in tmp_path.iterdir()] == [f"panda-{socket.gethostname()}.state"]


def test_oversized_state_leaves_the_previous_one(tmp_path) -> None:
    file = StateFile(tmp_path / "state")
    file.save(a_state(1))
    file.save(a_state(2).model_copy(update={"q": [0.0] * (SLOT // 9)}))
    assert StateFile(tmp_path / "state").load() == a_state(1)
