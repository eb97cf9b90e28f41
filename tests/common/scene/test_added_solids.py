from typing import Any

import pytest
from pydantic import ValidationError

from common.atomic_file import ROOM
from common.errors import Refused
from common.messages import CollisionObject, SceneEdit
from common.messages.scene import MAX_ADDED
from common.scene.fixtures import AddedSolids, added_solids


def edit(op: str = "add", name: str = "shelf", **more: Any) -> SceneEdit:
    shape = {"shape": "box", "dimensions": [0.4, 0.2, 0.02], "pose": {"position": {"x": 0.5}}} if op == "add" else {}
    return SceneEdit.model_validate({"op": op, "id": name, **shape, **more})


def test_added_solid_is_a_fixture_with_a_unique_id_until_it_is_removed() -> None:
    solids = AddedSolids().apply(edit()).apply(edit(name="pole", shape="cylinder", dimensions=[0.02, 1.0]))
    assert solids.ids == ["added/shelf", "added/pole"] and {one.role for one in solids.solids} == {"fixture"}
    ball = CollisionObject(id="shelf", role="target", shape="sphere", dimensions=[0.03], pose=solids.solids[0].pose)
    assert added_solids([ball, *solids.solids]) == solids.solids
    assert solids.apply(edit("remove")).ids == solids.apply(edit("remove", "added/shelf")).ids == ["added/pole"]


def test_repeated_edit_changes_nothing() -> None:
    solids = AddedSolids().apply(edit())
    assert solids.apply(edit(owner="another operator")) is solids


@pytest.mark.parametrize(("request_", "perceived", "code"), [
    (edit(dimensions=[1.0, 1.0, 1.0]), (), "exists"),
    (edit(name="cup"), ("added/cup",), "exists"),
    (edit("remove", "cup"), (), "unknown"),
])
def test_conflicting_edit_is_refused(request_: SceneEdit, perceived: tuple[str, ...], code: str) -> None:
    with pytest.raises(Refused, match=r"added/") as refusal:
        AddedSolids().apply(edit()).apply(request_, perceived)
    assert refusal.value.code == code and "\n" not in str(refusal.value)


def test_maximum_number_of_solids_fits_into_the_file() -> None:
    solids = AddedSolids()
    for number in range(MAX_ADDED):
        at, color = dict.fromkeys("xyz", -1 / 3), dict.fromkeys("rgba", 1 / 3)
        solids = solids.apply(edit(name=f"{number:ä>100}", dimensions=[1 / 3] * 3, pose={"position": at}, color=color))
    assert len(solids.model_dump_json(indent=1).encode()) < ROOM / 2
    with pytest.raises(Refused, match=f"{MAX_ADDED} solids") as refusal:
        solids.apply(edit())
    assert refusal.value.code == "too_many"
    assert AddedSolids.model_validate_json(solids.model_dump_json()) == solids


@pytest.mark.parametrize(("wrong", "message"), [
    ({"shape": None}, "needs a shape"), ({"shape": "mesh"}, "shape"), ({"pose": None}, "needs a pose"),
    ({"dimensions": [0.1]}, "3 dimensions"), ({"dimensions": [0.1, 0.1, 0.0]}, "0.001"),
    ({"dimensions": [0.1, 0.1, 11.0]}, "10"), ({"dimensions": [0.1, 0.1, float("nan")]}, "finite"),
    ({"dimensions": ["0.1", 0.1, 0.1]}, "number"), ({"pose": {"position": {"z": -10.5}}}, "position.z"),
    ({"pose": {"position": {"x": float("inf")}}}, "x"), ({"id": ""}, "id"), ({"id": "x" * 101}, "id"),
    ({"id": "a\nb"}, "id"), ({"role": "target"}, "role"),
])
def test_invalid_solid_is_rejected_by_the_message(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        edit(**{"name": wrong.pop("id", "shelf"), **wrong})
