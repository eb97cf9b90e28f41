"""The model of a cell has the robot, the objects and the cameras where the configuration has them."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from common.config import ObjectConfig, World, load_cell
from common.messages import Header
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from common.sim.kinematic import KinematicWorld
from common.sim.objects import solid_of, solid_of_message
from drivers.mujoco.model import CellModel, build_model
from drivers.mujoco.robot import cached_arrays
from drivers.mujoco.scene import SceneObject

SHAPES = [
    {"id": "ball", "shape": "sphere", "radius": 0.03, "x": 0.3, "y": 0.0},
    {"id": "crate", "shape": "box", "size": [0.04, 0.06], "height": 0.05, "x": 0.4, "y": 0.0, "yaw": 0.5},
    {"id": "can", "shape": "cylinder", "radius": 0.03, "height": 0.08, "x": 0.5, "y": 0.0},
    {"id": "angle", "shape": "prism", "height": 0.03, "x": 0.6, "y": 0.0,
     "polygon": [[-0.02, -0.02], [0.03, -0.02], [0.03, 0.0], [0.0, 0.0], [0.0, 0.03], [-0.02, 0.03]]},
    {"id": "ring", "shape": "ring", "radius": 0.04, "inner_radius": 0.02, "height": 0.03, "x": 0.7, "y": 0.0},
]


def model_of(cell: str, visuals: bool = False, world: World | None = None) -> tuple[RobotModel, CellModel]:
    config = load_cell(cell)
    world, robot = world or config.world, RobotModel.load(config.robot)
    objects = [SceneObject(thing.id, solid_of_message(thing), (thing.color.r, thing.color.g, thing.color.b))
               for thing in KinematicWorld(world).objects(Header()).objects]
    return robot, build_model({"": robot}, world, objects, visuals=visuals)


def at_start(cell_model: CellModel) -> mujoco.MjData:
    data = mujoco.MjData(cell_model.model)
    data.qpos[:] = cell_model.start
    return data


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_link_poses_match_the_planner(cell: str) -> None:
    robot, cell_model = model_of(cell)
    data = mujoco.MjData(cell_model.model)
    rng, fingers = np.random.default_rng(1), robot.config.gripper
    for _ in range(5):
        q = rng.uniform(robot.lower, robot.upper)
        others = dict(zip(fingers.joints, finger_positions(fingers, rng.uniform(0.0, fingers.max_width)), strict=True))
        cell_model.set_joints(data, [*robot.joint_names, *others], [*q, *others.values()])
        mujoco.mj_kinematics(cell_model.model, data)
        for link, T in robot.link_poses(q, others).items():
            assert data.body(link).xpos == pytest.approx(T[:3, 3], abs=1e-9), link
            assert data.body(link).xmat == pytest.approx(T[:3, :3].ravel(), abs=1e-9), link


def test_joint_without_range_is_locked() -> None:
    config = load_cell("panda")
    robot = RobotModel.load(config.robot)
    robot.urdf = robot.urdf.replace("</robot>", '<link name="lid"><inertial><mass value="1"/><inertia ixx="0.01" '
                                    'iyy="0.01" izz="0.01"/></inertial></link><joint name="latch" type="revolute">'
                                    '<parent link="panda_link7"/><child link="lid"/><axis xyz="1 0 0"/><limit lower="0"'
                                    ' upper="0" effort="1" velocity="1"/></joint></robot>')
    cell_model = build_model({"": robot}, config.world, [])
    data = at_start(cell_model)
    data.qvel[cell_model.dofs["latch"]] = 1.0
    mujoco.mj_step(cell_model.model, data, 100)
    assert data.qpos[cell_model.joints["latch"]] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("cell", ["panda", "ur5"])
def test_home_pose_and_objects_that_are_not_placed_have_no_contacts(cell: str) -> None:
    config = load_cell(cell)
    box = solid_of(ObjectConfig(id="box", shape="box", size=[0.02, 0.02], height=0.02, x=0.0, y=0.0))
    objects = [SceneObject(f"box_{k}", box, (1.0, 0.0, 0.0)) for k in range(100)]
    cell_model = build_model({"": RobotModel.load(config.robot)}, config.world, objects)
    mujoco.mj_forward(cell_model.model, data := at_start(cell_model))
    assert data.ncon == 0


def test_visual_meshes_are_cached_and_do_not_affect_dynamics(
    monkeypatch: pytest.MonkeyPatch, mesh_cache_folder: Path
) -> None:
    _, bare = model_of("panda")
    _, first = model_of("panda", visuals=True)
    monkeypatch.setattr("common.robot.visual_meshes.visual_pieces", None)  # must not be called again
    _, again = model_of("panda", visuals=True)
    assert first.model.nmeshvert == again.model.nmeshvert > bare.model.nmeshvert
    assert first.joints == bare.joints and first.objects == bare.objects
    assert first.model.body_mass == pytest.approx(bare.model.body_mass)


def test_arrays_are_computed_when_their_cache_file_is_truncated_or_cannot_be_written(
    mesh_cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def total() -> float:
        return float(cached_arrays("hull", [b"cut"], lambda: {"points": np.ones(3)})["points"].sum())

    assert total() == 3
    newest = max(mesh_cache_folder.rglob("hull-*.npz"), key=lambda path: path.stat().st_mtime_ns)
    newest.write_bytes(newest.read_bytes()[:40])
    assert total() == 3
    monkeypatch.setenv("ZENCELL_CACHE", str(newest))  # no folder
    assert total() == total() == 3


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape["id"])
def test_every_shape_remains_where_it_is_placed(shape: dict[str, object]) -> None:
    world = World.model_validate({"fixtures": load_cell("panda").world.fixtures, "objects": [shape]})
    (message,) = KinematicWorld(world).objects(Header()).objects
    _, cell_model = model_of("panda", world=world)
    data = at_start(cell_model)
    before = pose_to_matrix(message.pose)
    cell_model.set_object(data, message.id, before)
    for _ in range(500):
        mujoco.mj_step(cell_model.model, data)
    after = cell_model.pose_of(data, message.id)
    assert after[:3, 3] == pytest.approx(before[:3, 3], abs=1e-3)
    assert after[:3, :3] == pytest.approx(before[:3, :3], abs=0.01)
    assert cell_model.model.body_mass[cell_model.objects[message.id].body] == pytest.approx(0.1)
