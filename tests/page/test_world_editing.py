"""Edits of a simulated world, and undo."""

from contextlib import suppress
from typing import Any

import pytest

from common.config import load_cell
from common.errors import Refused, RemoteError
from common.messages import Header, Vector3, WorldEdit, WorldEditReply, WorldObject, WorldObjects
from common.sim.kinematic import KinematicWorld
from page.world_editing import NothingToUndo, WorldEditor, center_of, free_positions

Positions = dict[str, tuple[float, float, str]]


class World:
    """A simulated world with an editor."""

    def __init__(self, cell: str) -> None:
        self.world = KinematicWorld(load_cell(cell).world)
        self.editor = WorldEditor(self.request, self.truth)

    async def request(self, edit: WorldEdit) -> WorldEditReply:
        try:
            name = self.world.edit(edit, 0.0)
        except Refused as error:
            raise RemoteError("world/edit", error.code, str(error)) from None
        return WorldEditReply(id=name, ids=[thing.id for thing in self.truth().objects])

    def truth(self) -> WorldObjects:
        return self.world.objects(Header())

    def named(self, name: str) -> WorldObject:
        return next(thing for thing in self.truth().objects if thing.id == name)

    @property
    def positions(self) -> Positions:
        return {thing.id: (round(center_of(thing).x, 4), round(center_of(thing).y, 4), thing.shape)
                for thing in self.truth().objects}

    async def edit_at_free_position(self, x: float, y: float, spacing: float, **fields: Any) -> tuple[float, float]:
        """Edit with the first free position near x, y that is on the table; return it."""
        for at in free_positions(x, y, spacing, self.truth()):
            with suppress(RemoteError):
                edit = WorldEdit.model_validate({**fields, "position": {"x": at[0], "y": at[1]}})
                await self.editor.edit(edit)
                return at
        raise AssertionError("no free position")


@pytest.fixture(params=["panda", "ur5"])
def world(request: pytest.FixtureRequest) -> World:
    return World(request.param)


async def test_edits_are_undone_in_reverse_order(world: World) -> None:
    before = world.positions
    first = next(iter(before))
    x, y, _ = before[first]
    states: list[Positions] = []
    for edit in (WorldEdit(op="move", id=first, position=Vector3(x=x - 0.05, y=y - 0.12)), None,
                 WorldEdit(op="remove", id=first), WorldEdit(op="reset")):
        states.append(world.positions)
        if edit is None:
            await world.editor.add_like(world.named(first), x - 0.05, y - 0.12)
            assert len(world.positions) == len(before) + 1
        else:
            await world.editor.edit(edit)
        assert world.positions != states[-1]
    assert world.positions == before
    while states:
        assert world.editor.last
        await world.editor.undo()
        assert world.positions == states.pop()
    with pytest.raises(RemoteError):
        await world.editor.edit(WorldEdit(op="remove", id="unknown"))
    assert world.positions == before and not world.editor.last
    with pytest.raises(NothingToUndo, match="no edit"):
        await world.editor.undo()


async def test_removed_custom_object_is_restored_and_can_be_copied(world: World) -> None:
    center = center_of(world.truth().objects[0])
    x, y = await world.edit_at_free_position(
        center.x, center.y, 0.12, op="add", id="extra", shape="cylinder", size={"x": 0.05, "y": 0.05, "z": 0.04},
        color={"r": 0.2, "g": 0.4, "b": 0.6})
    added = world.named("extra")
    await world.editor.edit(WorldEdit(op="remove", id="extra"))
    await world.editor.undo()
    again = world.named("extra")
    assert (again.shape, again.size, again.color) == (added.shape, added.size, added.color)
    assert again.pose.position.x == pytest.approx(added.pose.position.x, abs=1e-4)
    await world.editor.add_like(again, x, y)
    assert len([thing for thing in world.truth().objects if (thing.shape, thing.size) == ("cylinder", added.size)]) == 2


@pytest.mark.parametrize(("one", "other"), [("ball_1", "ball_2"), ("ball_2", "ball_1")])
async def test_reset_is_undone_if_an_object_is_at_the_initial_position_of_another(one: str, other: str) -> None:
    world = World("panda")
    x, y, _ = world.positions[other]
    await world.edit_at_free_position(x, y, 0.09, op="move", id=other)
    await world.editor.edit(WorldEdit(op="move", id=one, position=Vector3(x=x, y=y)))
    before = world.positions
    await world.editor.edit(WorldEdit(op="reset"))
    assert world.positions != before
    await world.editor.undo()
    assert world.positions == before
