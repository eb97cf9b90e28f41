"""The simulated state survives a restart, also when its process was killed while writing it."""

import math
import os
import socket
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from common.atomic_file import STATE_VARIABLE, Unreadable
from common.messages import Header
from common.sim.interface import ObjectSnapshot
from common.sim.state_file import SLOT, SimulationState, StateFile, state_file
from tests.common.sim.rig import BOX, Rig


def a_state(number: int) -> SimulationState:
    return SimulationState(layout={"ball_1": (0.4, -0.3, 0.03)}, q=[0.1 * number] * 7, width=0.01 * number,
                           commanded_width=None,
                           objects={"ball_1": ObjectSnapshot(pose=(0.4, -0.3, 0.01 * number, 0, 0, 0, 1))})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state"


@pytest.fixture
def file(path: Path) -> StateFile:
    return StateFile(path)


def test_held_falling_and_contained_balls_are_restored(path: Path, file: StateFile) -> None:
    rig = Rig.holding_ball((0.40, -0.30), (0.52, -0.30), (0.40, -0.17))
    rig.put_down(*BOX)
    rig.grasp(0.52, -0.30)
    rig.release(0.60, -0.05, 0.5)
    rig.grasp(0.40, -0.17)
    assert sorted(thing.state for thing in rig.objects().values()) == ["contained", "falling", "held"]
    file.save(SimulationState(layout=rig.world.layout, q=[0.0], objects=rig.world.snapshot()))
    found = StateFile(path).load()
    assert found is not None
    again = Rig(config=rig.config)
    again.world.restore(found.objects)
    again.now, again.tool, again.width = rig.now, rig.tool, rig.width
    for _ in range(100):  # the falling one comes to rest
        for each in (rig, again):
            each.tick()
        assert again.world.objects(Header()) == rig.world.objects(Header())
    assert sorted(thing.state for thing in again.objects().values()) == ["contained", "held", "table"]
    for each in (rig, again):
        each.put_down(*BOX)
    states = sorted(thing.state for thing in again.objects().values())
    assert states == ["contained", "contained", "table"], "not in the slot of the first one"
    assert again.world.objects(Header()) == rig.world.objects(Header()) and again.world.held == ""


def test_partly_changed_state_is_loaded_completely(path: Path, file: StateFile) -> None:
    first, other = a_state(1), a_state(2)
    for objects in (first.objects, first.objects, other.objects):
        state = SimulationState.model_construct(**vars(first) | {"q": [0.1 * len(objects)], "objects": objects})
        file.save(state)
        assert StateFile(path).load() == state


def test_missing_state_file_loads_nothing(tmp_path: Path) -> None:
    assert StateFile(tmp_path / "new" / "state").load() is None


def test_link_or_pipe_as_state_file_is_rejected(tmp_path: Path, path: Path) -> None:
    path.symlink_to(tmp_path / "other")
    os.mkfifo(tmp_path / "pipe")
    for name, why in (("state", "it is a link"), ("pipe", "it is not a regular file")):
        with pytest.raises(Unreadable, match=f"{tmp_path}/{name} cannot be read: {why}"):
            StateFile(tmp_path / name)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("state", [
    SimulationState.model_construct(**vars(a_state(2)) | {"q": [0.0, math.nan]}),
    SimulationState.model_construct(**vars(a_state(2)) | {"q": [0.0, math.inf]}),
    a_state(2).model_copy(update={"q": [0.0] * (SLOT // 9)}),  # larger than a slot
], ids=["nan", "infinite", "oversized"])
def test_invalid_state_leaves_the_previous_one(state: SimulationState, path: Path, file: StateFile) -> None:
    file.save(a_state(1))
    file.save(state)
    assert StateFile(path).load() == a_state(1)


def test_newest_state_is_loaded_and_numbering_continues(path: Path, file: StateFile) -> None:
    for number in range(7):
        file.save(a_state(number))
        assert StateFile(path).load() == a_state(number)
    again = StateFile(path)
    again.load()
    again.save(a_state(50))
    assert StateFile(path).load() == a_state(50)


def padded(path: Path) -> bytes:
    """The file with room for both states."""
    return path.read_bytes().ljust(2 * SLOT, b"\0")


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(before=st.integers(1, 4), cut=st.integers(0, 400), rubbish=st.booleans())
def test_partly_written_state_falls_back_to_the_previous_one(path: Path, before: int, cut: int, rubbish: bool) -> None:
    path.unlink(missing_ok=True)
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
    complete = torn > changed[-1] and (torn == end or not rubbish)
    assert StateFile(path).load() == a_state(before if complete else before - 1)
    again = StateFile(path)
    again.load()
    again.save(a_state(9))
    assert StateFile(path).load() == a_state(9), "the next one overwrites the torn one"


def test_state_of_another_version_is_ignored(path: Path, file: StateFile) -> None:
    class Later(SimulationState):
        wheels: int = 4

    file.save(Later(**a_state(1).model_dump()))
    assert StateFile(path).load() is None
    StateFile(path).save(a_state(2))
    assert StateFile(path).load() == a_state(2)


def test_state_file_is_named_by_cell_and_host(tmp_path: Path) -> None:
    assert state_file("panda", {}) is None
    assert state_file("panda", {STATE_VARIABLE: str(tmp_path)}) is not None
    assert [path.name for path in tmp_path.iterdir()] == [f"panda-{socket.gethostname()}.state"]
