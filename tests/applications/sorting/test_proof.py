"""The kernel's proof of grasps: positions that reach them, and reasons where something obstructs them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from applications.sorting.grasps.candidates import Candidates, Options, candidates
from applications.sorting.grasps.gripper_shape import GripperShape
from applications.sorting.grasps.height_map import HeightMap
from applications.sorting.grasps.proof import POINTS, Proof, ProofOptions, Prover, measured_spheres
from common.config import Container, RobotConfig, Surroundings
from common.config.loading import load_robot
from common.robot.transforms import pose_to_matrix
from tests.applications.sorting.surfaces import FLOOR, WALLS, Solid, box, cylinder, seen

ROBOTS = ("panda", "ur5")
AROUND = Surroundings(containers={"tray": Container(id="tray", x=0.55, y=0.0, half_side=0.2, wall_height=0.05)})
PATIENT = ProofOptions(seconds=5.0, wanted=30, for_each=30)


def robot_config(name: str) -> RobotConfig:
    config = load_robot(name)
    return config if name == "panda" else config.model_copy(update={"base_position": (0.0, 0.0, 0.15)})


@cache
def prover(name: str) -> Prover:
    return Prover(robot_config(name), AROUND, PATIENT)


def examined(name: str, *solids: Solid, behind: tuple[Solid, ...] = ()) -> tuple[Candidates, Proof]:
    """Return candidates for some solids, and their proof with further solids that the candidates ignored."""
    shape = GripperShape.of(prover(name).geometry)
    surface, labels = seen(solids)
    found = candidates(surface, labels, shape, Options(), np.random.default_rng(0), [WALLS])
    if behind:
        found = replace(found, heights=HeightMap(*seen([*solids, *behind]), [WALLS]))
    return found, prover(name).prove(found, [f"object_{k}" for k in range(len(solids))])


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("solid", [
    box(0.62, 0.08, 0.06, 0.03, 0.04, 0.5),
    box(0.48, -0.08, 0.06, 0.03, 0.04, 2.0),
    cylinder(0.55, 0.1, 0.02, 0.06),
    cylinder(0.55, -0.05, 0.05, 0.03, hole=0.04),
    box(0.55 + 0.192 - 0.02, 0.0, 0.04, 0.04, 0.04),
    box(0.55, -0.192 + 0.02, 0.04, 0.04, 0.04),
    box(0.55, 0.0, 0.08, 0.05, 0.005),
])
def test_proved_positions_reach_approach_and_grasp(name: str, solid: Solid) -> None:
    found, proof = examined(name, solid)
    robot = prover(name).robot
    assert proof.grasps[0].proved
    assert proof.reasons == {}
    for grasp in (each for each in proof.grasps if each.proved):
        i = int(grasp.id.rpartition("/")[2])
        T, before = robot.fk(grasp.q), robot.fk(grasp.q_approach)
        np.testing.assert_allclose(T, pose_to_matrix(grasp.pose), atol=1e-3)
        np.testing.assert_allclose(before, pose_to_matrix(grasp.approach), atol=1e-3)
        np.testing.assert_allclose(T[:3, 3], found.T[i, :3, 3], atol=1e-4)
        assert abs(T[:3, 1] @ found.T[i, :3, 1]) == pytest.approx(1.0, abs=1e-3)
        assert np.linalg.norm(T[:3, 3] - before[:3, 3]) >= 0.07 - 1e-4
        assert np.abs(np.array(grasp.q) - grasp.q_approach).max() < 1.0
        assert robot.within_limits(grasp.q)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_finger_that_would_meet_a_measured_point_is_rejected(name: str) -> None:
    cube = box(0.55, 0.0, 0.04, 0.04, 0.04)
    around = tuple(box(0.55 + dx, dy, 0.02 if dx else 0.11, 0.11 if dx else 0.02, 0.06)
                   for dx, dy in ((0.045, 0), (-0.045, 0), (0, 0.045), (0, -0.045)))
    found, proof = examined(name, cube, behind=around)
    assert len(found) > 0
    assert not any(grasp.proved for grasp in proof.grasps)
    assert all(POINTS in grasp.why for grasp in proof.grasps)
    assert POINTS in proof.reasons[0]


def test_a_grasp_out_of_reach_says_how_far_it_is() -> None:
    found, _ = examined("panda", box(0.55, 0.0, 0.04, 0.04, 0.04))
    T = found.T.copy()
    T[:, 0, 3] += 1.5
    proof = prover("panda").prove(replace(found, T=T), ["far"])
    assert not any(grasp.proved for grasp in proof.grasps)
    assert "the arm reaches" in proof.reasons[0]


def test_faces_between_cells_have_points() -> None:
    surface, labels = seen([box(0.55, 0.0, 0.04, 0.04, 0.05)])
    spheres = measured_spheres(HeightMap(surface, labels), 0.004, 0.002)
    side = spheres[np.abs(np.abs(spheres[:, :2] - (0.55, 0.0)).max(axis=1) - 0.02) < 0.004]
    heights = np.unique(np.round(side[:, 2] - FLOOR, 3))
    assert heights.min() < 0.012
    assert np.diff(heights).max() <= 0.005
    assert (spheres[:, 2] < FLOOR + 0.05 + 1e-6).all()


def test_proving_ends_with_its_time_or_with_enough() -> None:
    solids = [box(0.45 + 0.07 * i, 0.1 * j, 0.03, 0.03, 0.04) for i in range(4) for j in (-1, 0, 1)]
    shape = GripperShape.of(prover("panda").geometry)
    found = candidates(*seen(solids), shape, Options(), np.random.default_rng(0), [WALLS])
    few = Prover(robot_config("panda"), AROUND, ProofOptions(seconds=5.0, wanted=6, for_each=1))
    proof = few.prove(found, [f"object_{k}" for k in range(12)])
    proved = [grasp.object for grasp in proof.grasps if grasp.proved]
    assert len(proved) == len(set(proved)) == 6
    assert len(proof.reasons) == 6
