from typing import Any

import pytest
from pydantic import ValidationError

from common.atomic_file import ROOM
from common.errors import Refused
from common.messages import CollisionObject, SceneEdit
from common.messages.scene import MAX_ADDED
from common.scene.added import AddedSolids, added


def edit(op: str = "add", name: str = "shelf", **more: Any) -> SceneEdit:
    said = {"shape": "box", "dimensions": [0.4, 0.2, 0.02], "pose": {"position": {"x": 0.5}}} if op == "add" else {}
    return SceneEdit.model_validate({"op": op, "id": name, **said, **more})


def test_what_was_added_is_a_fixture_with_a_name_that_nothing_else_has_until_it_is_removed() -> None:
    solids = AddedSolids().edited(edit()).edited(edit(name="pole", shape="cylinder", dimensions=[0.02, 1.0]))
    assert solids.ids == ["added/shelf", "added/pole"] and {one.role for one in solids.solids} == {"fixture"}
    ball = CollisionObject(id="shelf", role="target", shape="sphere", dimensions=[0.03], pose=solids.solids[0].pose)
    assert added([ball, *solids.solids]) == solids.solids
    assert solids.edited(edit("remove")).ids == solids.edited(edit("remove", "added/shelf")).ids == ["added/pole"]


def test_same_solid_said_again_changes_nothing_and_another_of_its_name_is_refused() -> None:
    solids = AddedSolids().edited(edit())
    assert solids.edited(edit(owner="somebody else")) is solids
    for asked, perceived, code in (
        (edit(dimensions=[1.0, 1.0, 1.0]), (), "exists"), (edit(name="cup"), ("added/cup",), "exists"),
        (edit("remove", "cup"), (), "unknown"),
    ):
        with pytest.raises(Refused, match=r"added/") as told:
            solids.edited(asked, perceived)
        assert told.value.code == code and "\n" not in str(told.value)


def test_there_are_no_more_than_fit_into_the_file_that_keeps_them() -> None:
    solids = AddedSolids()
    for number in range(MAX_ADDED):
        at, color = dict.fromkeys("xyz", -1 / 3), dict.fromkeys("rgba", 1 / 3)
        solids = solids.edited(
            edit(name=f"{number:ä>100}", dimensions=[1 / 3] * 3, pose={"position": at}, color=color))
    assert len(solids.model_dump_json(indent=1).encode()) < ROOM / 2
    with pytest.raises(Refused, match=f"{MAX_ADDED} solids") as told:
        solids.edited(edit())
    assert told.value.code == "too_many"
    assert AddedSolids.model_validate_json(solids.model_dump_json()) == solids


@pytest.mark.parametrize(("wrong", "words"), [
    ({"shape": None}, "has a shape"), ({"shape": "mesh"}, "shape"), ({"pose": None}, "has a pose"),
    ({"dimensions": [0.1]}, "3 dimensions"), ({"dimensions": [0.1, 0.1, 0.0]}, "0.001"),
    ({"dimensions": [0.1, 0.1, 11.0]}, "10"), ({"dimensions": [0.1, 0.1, float("nan")]}, "finite"),
    ({"dimensions": ["0.1", 0.1, 0.1]}, "number"), ({"pose": {"position": {"z": -10.5}}}, "position.z"),
    ({"pose": {"position": {"x": float("inf")}}}, "x"), ({"id": ""}, "id"), ({"id": "x" * 101}, "id"),
    ({"id": "a\nb"}, "id"), ({"role": "target"}, "role"),
])
def test_what_is_no_solid_nearby_is_no_edit(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        edit(**{"name": wrong.pop("id", "shelf"), **wrong})
