"""Edits of the simulated world are taken back, one after the other, in a world that really does them."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest

from common.config import load_cell
from common.errors import Refused, RemoteError
from common.messages import Header, Vector3, WorldEdit, WorldEditReply, WorldObjects
from common.sim.kinematic import KinematicWorld
from page.world_editing import NothingToUndo, WorldEditor, free_places, middle_of

Places = dict[str, tuple[float, float, str]]


class World:
    """The simulated world as the page sees it: asked for edits, and told of."""

    def __init__(self, cell: str) -> None:
        self.world = KinematicWorld(load_cell(cell).world)
        self.edits = WorldEditor(self.ask, self.truth)

    async def ask(self, edit: WorldEdit) -> WorldEditReply:
        try:
            name = self.world.edit(edit, 0.0)
        except Refused as error:
            raise RemoteError("world/edit", error.code, str(error)) from None
        return WorldEditReply(id=name, ids=[thing.id for thing in self.truth().objects])

    def truth(self) -> WorldObjects:
        return self.world.objects(Header())

    @property
    def places(self) -> Places:
        return {thing.id: (round(middle_of(thing).x, 4), round(middle_of(thing).y, 4), thing.shape)
                for thing in self.truth().objects}


@pytest.fixture(params=["panda", "ur5"])
def world(request: pytest.FixtureRequest) -> World:
    return World(request.param)


async def test_each_edit_is_taken_back_last_one_first(world: World) -> None:
    before = world.places
    first = next(iter(before))
    x, y, _ = before[first]
    seen: list[Places] = []

    async def step(edit: WorldEdit) -> None:
        seen.append(world.places)
        await world.edits.do(edit)
        assert world.places != seen[-1]

    await step(WorldEdit(op="move", id=first, position=Vector3(x=x - 0.05, y=y - 0.12)))
    seen.append(world.places)
    thing = next(each for each in world.truth().objects if each.id == first)
    await world.edits.add_like(thing, x - 0.05, y - 0.12)
    assert len(world.places) == len(before) + 1
    await step(WorldEdit(op="remove", id=first))
    await step(WorldEdit(op="reset"))
    assert world.places == before
    while seen:
        assert world.edits.last
        await world.edits.undo()
        assert world.places == seen.pop()
    assert world.places == before and not world.edits.last
    with pytest.raises(NothingToUndo, match="no edit"):
        await world.edits.undo()


async def test_edit_that_is_refused_is_none_to_take_back(world: World) -> None:
    with pytest.raises(RemoteError):
        await world.edits.do(WorldEdit(op="remove", id="nothing_like_it"))
    assert not world.edits.last


async def test_what_was_added_by_hand_comes_back_as_it_was(world: World) -> None:
    some: Any = {"op": "add", "id": "extra", "shape": "cylinder", "size": {"x": 0.05, "y": 0.05, "z": 0.04},
                 "color": {"r": 0.2, "g": 0.4, "b": 0.6}}
    first = next(iter(world.truth().objects))
    for x, y in free_places(middle_of(first).x, middle_of(first).y, 0.12, world.truth()):
        with suppress(RemoteError):  # off the table
            await world.edits.do(WorldEdit.model_validate({**some, "position": {"x": x, "y": y}}))
            break
    added = next(thing for thing in world.truth().objects if thing.id == "extra")
    await world.edits.do(WorldEdit(op="remove", id="extra"))
    await world.edits.undo()
    again = next(thing for thing in world.truth().objects if thing.id == "extra")
    assert (again.shape, again.size, again.color) == (added.shape, added.size, added.color)
    assert again.pose.position.x == pytest.approx(added.pose.position.x, abs=1e-4)
    await world.edits.add_like(again, x, y)
    assert len([thing for thing in world.truth().objects if (thing.shape, thing.size) == ("cylinder", added.size)]) == 2


@pytest.mark.parametrize(("one", "other"), [("ball_1", "ball_2"), ("ball_2", "ball_1")])
async def test_reset_is_taken_back_where_one_object_lay_in_the_first_place_of_another(one: str, other: str) -> None:
    world = World("panda")
    x, y, _ = world.places[other]
    for at in free_places(x, y, 0.09, world.truth()):
        with suppress(RemoteError):  # off the table
            await world.edits.do(WorldEdit(op="move", id=other, position=Vector3(x=at[0], y=at[1])))
            break
    await world.edits.do(WorldEdit(op="move", id=one, position=Vector3(x=x, y=y)))
    before = world.places
    await world.edits.do(WorldEdit(op="reset"))
    assert world.places != before
    await world.edits.undo()
    assert world.places == before
