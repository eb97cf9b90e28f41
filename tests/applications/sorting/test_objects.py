"""Generated objects: convex pieces of permitted sizes; a heap of them falls into the tray and stays there."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from applications.sorting.objects import heap, kinds
from applications.sorting.objects.pieces import volume_and_center
from common.config import World, load_cell
from common.config.basics import check
from common.errors import ConfigError
from common.messages import Header, Vector3, WorldEdit
from common.robot.model import RobotModel
from common.sim.interface import load_world
from common.sim.objects import initial_pose, solid_of

DRAWS = 5  # objects of each kind


@pytest.fixture(autouse=True, scope="module")
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZENCELL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def tray() -> World:
    return World.model_validate({
        "fixtures": [{"id": "table", "dimensions": [0.9, 1.2, 0.05], "position": [0.45, 0.0, -0.025]}],
        "containers": {"tray": {"x": 0.55, "y": 0.0, "half_side": 0.2, "wall_height": 0.05, "source": True},
                       "left": {"x": 0.45, "y": 0.4, "half_side": 0.15}}, "simulator": "mujoco"})


def outside(part: np.ndarray) -> float:
    """Largest distance [m] of a corner in front of a triangle; 0 for a convex piece with normals outward."""
    normals = np.cross(part[:, 1] - part[:, 0], part[:, 2] - part[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    sound = lengths > 1e-12
    normals = normals[sound] / lengths[sound, None]
    points = part.reshape(-1, 3)
    return float((points @ normals.T - (part[sound, 0] * normals).sum(axis=1)).max())


@pytest.mark.parametrize("kind", kinds.KINDS)
def test_objects_are_unions_of_few_convex_pieces_of_graspable_size(kind: str) -> None:
    rng = np.random.default_rng(sum(kind.encode()))
    for _ in range(DRAWS):
        drawn = kinds.draw(kind, rng)
        sides = np.sort(drawn.size)
        assert 0.04 <= sides[2] <= 0.1401 and 0.004 <= sides[0] < 0.065
        assert len(drawn.triangles) <= kinds.MAX_TRIANGLES
        assert max(outside(part) for part in drawn.parts) < 1e-5
        corners = [set(map(tuple, part.astype(np.float32).reshape(-1, 3).tolist())) for part in drawn.parts]
        assert len(set().union(*corners)) == sum(map(len, corners)), "pieces that share a corner become one hull"
        measured = [volume_and_center(part) for part in drawn.parts]
        assert all(volume > 0 for volume, _ in measured)
        assert sum(volume * center for volume, center in measured) == pytest.approx(np.zeros(3), abs=1e-8)
        assert 0.05 <= drawn.mass <= 0.5 and 0.2 <= drawn.friction <= 0.6
        assert max(map(abs, np.subtract(drawn.color, kinds.PALETTE[drawn.color_name]))) <= kinds.SHADE


def test_kinds_to_test_with_are_not_those_to_train_with() -> None:
    assert not set(kinds.TRAIN_KINDS) & set(kinds.TEST_KINDS)
    assert min(len(kinds.TRAIN_KINDS), len(kinds.TEST_KINDS)) >= 12


def test_draws_follow_from_the_seed() -> None:
    one, same, other = (kinds.draw("hammer", np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert (one.triangles == same.triangles).all() and (one.mass, one.color) == (same.mass, same.color)
    assert one.mass != other.mass and one.size != pytest.approx(other.size)


@pytest.mark.parametrize(("options", "count", "of"), [
    ({}, 10, kinds.TEST_KINDS), ({"kinds": "train", "count": 16}, 16, kinds.TRAIN_KINDS),
    ({"kinds": ["mug"], "count": 3, "masses": [0.2, 0.2], "frictions": [0.3, 0.3]}, 3, ["mug"]),
    ({"count": 30, "kinds": "all"}, 30, kinds.KINDS), ({"count": 4, "placement": "spread"}, 4, kinds.TEST_KINDS),
])
def test_heap_lies_in_the_air_within_the_walls_of_the_tray(options: dict[str, Any], count: int, of: Any) -> None:
    world = tray()
    objects = heap.generate(world, heap.Options(**options), 3)
    assert objects == heap.generate(world, heap.Options(**options), 3) and len(objects) == count
    assert {each.id.rpartition("_")[0] for each in objects} <= set(of)
    inside = 0.2 - world.containers["tray"].wall_thickness
    for each in objects:
        solid, low, high = solid_of(each), *map(np.array, options.get("masses", kinds.MASSES))
        T = initial_pose(each, solid)
        corners = solid.corners @ T[:3, :3].T + T[:3, 3]
        assert (np.abs(corners[:, :2] - (0.55, 0.0)) < inside).all() and corners[:, 2].min() > 0.005
        assert low <= each.mass <= high and Path(each.mesh).is_file()


def test_objects_lie_on_the_floor_of_the_tray_where_nothing_falls() -> None:
    world = tray().model_copy(update={"simulator": "kinematic"})
    objects = heap.generate(world, heap.Options(count=6), 2)
    floor = world.containers["tray"].floor_thickness
    for each in objects:
        solid = solid_of(each)
        rotation = initial_pose(each, solid)[:3, :3]
        assert each.position is not None and each.position[2] + solid.lowest(rotation) == pytest.approx(floor, abs=1e-6)
        assert solid.highest(rotation) - solid.lowest(rotation) == pytest.approx(solid.size.min(), abs=1e-6)
    states = load_world(world, objects).objects(Header()).objects
    assert {each.container for each in states} == {"tray"}


@pytest.mark.parametrize(("options", "text"), [
    ({"count": 31}, "world.generator.count: 31 must be less than or equal to 30"),
    ({"kinds": ["mug", "cup"]}, "'cup' is no kind; choices: train, test, all, block, can,"),
    ({"kinds": "cups"}, "'cups' is no kind; choices: train, test, all, block, can,"),
    ({"kinds": []}, "must name at least one kind; choices: train, test, all, block, can,"),
    ({"masses": [0.5, 0.1]}, "0.5 is larger than 0.1: give the smallest first"),
    ({"container": "bin"}, "world.generator.container: 'bin' is no container; choices: tray, left"),
    ({"placement": "row"}, "world.generator.placement: 'row' must be 'heap' or 'spread'"),
])
def test_wrong_option_is_rejected_in_one_line(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        heap.generate(tray(), check(heap.Options, options, "world.generator"), 0)
    assert text in str(refused.value) and "\n" not in str(refused.value)


OBJ = "o it\n" + "".join(f"v {x} {y} {z}\n" for x in (0, 2) for y in (0, 1) for z in (0, 1)) + "".join(
    f"f {a} {b} {c}\n" for a, b, c in ((1, 2, 4), (1, 4, 3), (5, 8, 6), (5, 7, 8), (1, 6, 2), (1, 5, 6), (3, 4, 8),
                                       (3, 8, 7), (1, 3, 7), (1, 7, 5), (2, 6, 8), (2, 8, 4)))
URDF = """<robot name="r"><link name="l"><collision><origin xyz="1 0 0" rpy="0 0 1.5707963"/>
<geometry><mesh filename="it.obj" scale="0.05 0.05 0.05"/></geometry></collision></link></robot>"""


def test_meshes_of_a_folder_are_scaled_to_a_graspable_size(tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    (tmp_path / "plain" / "it.obj").write_text(OBJ)
    (tmp_path / "plain" / "broken.stl").write_text("solid")
    (tmp_path / "described").mkdir()
    (tmp_path / "described" / "it.obj").write_text(OBJ)
    (tmp_path / "described" / "it.urdf").write_text(URDF)
    objects = heap.generate(tray(), heap.Options(meshes=str(tmp_path), count=4), 0)
    sizes = [tuple(np.round(solid_of(each).size, 3).tolist()) for each in objects]
    assert sorted(set(sizes)) == [(0.05, 0.1, 0.05), (0.124, 0.062, 0.062)]  # of the URDF; limited by its shortest side
    assert sizes.count((0.05, 0.1, 0.05)) == 2 and {each.id for each in objects} == {f"it_{n}" for n in (1, 2, 3, 4)}


@pytest.mark.parametrize(("files", "text"), [
    ({}, "has no meshes; choices: .obj, .stl, .ply, .urdf"), (None, "is not a folder"),
    ({"a.obj": "v 0 0 0\n"}, "has no mesh that can be used"),
])
def test_folder_without_usable_meshes_is_rejected(files: dict[str, str] | None, text: str, tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    if files is not None:
        folder.mkdir()
    for name, content in (files or {}).items():
        (folder / name).write_text(content)
    with pytest.raises(ConfigError, match=r"world\.generator\.meshes: ") as refused:
        heap.generate(tray(), heap.Options(meshes=str(folder)), 0)
    assert text in str(refused.value)


class Cell:
    """The tray with a heap of objects, an arm at home, and a clock that tests drive by hand."""

    def __init__(self, config: World, **options: Any) -> None:
        pytest.importorskip("mujoco")
        self.robot = load_cell("panda").robot
        self.config = config
        self.objects = heap.generate(config, heap.Options(**options), 5)
        self.begin()
        self.now = 0.0
        self.wait(0.01)

    def begin(self) -> None:
        model = RobotModel.load(self.robot)
        self.world = load_world(self.config, self.objects, None, self.robot.gripper)
        self.world.hardware(model, None, np.array(model.named("home")))

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            self.now += 0.02
            self.world.advance(self.now)

    def where(self) -> dict[str, str]:
        return {each.id: each.container or each.state for each in self.world.objects(Header()).objects}

    def speed(self) -> float:
        cell, data = self.world.simulation
        return max(float(np.linalg.norm(data.qvel[at.dof: at.dof + 3])) for at in cell.objects.values())


def test_heap_falls_into_the_tray_and_stays_there() -> None:
    cell = Cell(tray())
    before = cell.world.layout
    assert set(cell.where().values()) != {"tray"}, "objects fall"
    cell.wait(2.0)
    assert cell.where() == dict.fromkeys(before, "tray") and cell.speed() < 0.2
    _, data = cell.world.simulation
    assert min(contact.dist for contact in data.contact) > -1e-3
    places = {each.id: each.pose.position for each in cell.world.objects(Header()).objects}
    saved = {name: type(each).model_validate(each.model_dump()) for name, each in cell.world.snapshot().items()}
    cell.begin()  # a restart of the executor
    cell.world.restore(saved)
    cell.wait(0.1)
    for each in cell.world.objects(Header()).objects:
        assert math.dist(*[(p.x, p.y, p.z) for p in (each.pose.position, places[each.id])]) < 5e-3


def test_operator_edits_a_heap() -> None:
    cell = Cell(tray(), count=4)
    cell.wait(1.5)
    first, second, *_ = cell.where()

    def edit(op: str, name: str, **values: Any) -> None:
        cell.world.edit(WorldEdit.model_validate({"op": op, "id": name, **values}), cell.now)
        cell.wait(1.0)

    edit("move", first, position=Vector3(x=0.45, y=0.4, z=0.0))
    assert cell.where()[first] == "left"
    edit("remove", second)
    edit("add", "more", like=first, position=Vector3(x=0.45, y=-0.3, z=0.0))
    assert second not in cell.where() and cell.where()["more"] == "table"
    edit("reset", "")
    assert list(cell.where().values()) == ["tray"] * 4
