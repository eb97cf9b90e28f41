"""Occlusion: tracks, targets and slots stay, and the task does not end before an image shows their positions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from applications.pick_place.ball_places import MOST_HIDDEN, VisibleTable, find_viewing_poses
from applications.pick_place.detections import HIDDEN, OccludedTargets
from applications.pick_place.perceived_scene import PerceivedScene, SceneParameters, Sighting, Tracks
from common import messages as m
from common.config import Surroundings, load_cell
from common.perception.occlusion import Occlusion, RobotSilhouettes
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds
from tests.applications.pick_place.cell_double import CellDouble

CELL = load_cell("panda")
AROUND = CELL.section(Surroundings)
assert isinstance(AROUND, Surroundings)
CAMERA = Pinhole.from_config(AROUND.camera)
BLIND = Occlusion(CAMERA, "the lens is covered")
PLACE = (0.4, 0.0, 0.03)
ELSEWHERE = (0.6, -0.2, 0.03)


def at_place(place: tuple[float, float, float]) -> bool:
    return place[:2] == PLACE[:2]


def test_occluded_track_stays_and_a_visibly_missing_one_is_removed() -> None:
    tracks = Tracks(SceneParameters(confirm_frames=1))
    tracks.update([Sighting(PLACE), Sighting(ELSEWHERE)], 0.0)
    for k in range(1, 30):
        tracks.update([], 0.1 * k, hides=at_place)
    assert [track.position for track in tracks.confirmed()] == [PLACE]
    for k in range(30, 40):
        tracks.update([], 0.1 * k)
    assert tracks.confirmed() == []


def test_track_visibly_missing_in_one_view_is_removed() -> None:
    tracks = Tracks(SceneParameters(confirm_frames=1))
    tracks.update([Sighting(PLACE)], 0.0, view=0)
    for k in range(1, 10):
        tracks.update([], 0.1 * k, view=0, hides=at_place)
        tracks.update([], 0.1 * k + 0.01, view=1)
    assert tracks.confirmed() == []


def test_target_is_remembered_while_occluded_unless_detected_again() -> None:
    remembered = OccludedTargets()
    assert remembered.hidden([PLACE, ELSEWHERE], [], None) == []
    assert remembered.hidden([ELSEWHERE], [], at_place) == [PLACE]
    assert remembered.hidden([(0.41, 0.0, 0.03)], [], at_place) == []
    assert remembered.hidden([], [], None) == []


def test_contained_objects_stay_while_occluded() -> None:
    assert CELL.robot.gripper is not None
    scene = PerceivedScene(SceneParameters(), AROUND, CELL.robot.gripper, "panda_hand_tcp")
    u, v = CAMERA.project([0.55 - 0.033, 0.25 - 0.033, 0.035])
    ball = m.Marker(ns="ball", id=0, type="sphere", pose=m.Pose(), scale=m.Vector3(x=0.06, y=0.06, z=0.06),
                    pixel=(u, v))
    for k in range(20):
        frame = m.MarkerArray(header=m.Header(stamp=int(1e9 + k * 1e8)), markers=[ball] if k < 2 else [])
        scene.update_detections(frame, CAMERA, None, hidden=BLIND if k >= 2 else None)
    assert [thing.role for thing in scene.scene().objects].count("contained") == 1


def test_viewing_pose_is_the_smallest_rotation() -> None:
    robot, region = RobotModel.load(CELL.robot), VisibleTable(AROUND, WorkspaceBounds())
    silhouettes = RobotSilhouettes(robot, 0.03)
    within = region.within(CAMERA, silhouettes, robot)

    def share(q: object) -> float:
        return region.hidden([(within, silhouettes.occlusion(CAMERA, [np.asarray(q)]))])

    poses = find_viewing_poses(robot, [CAMERA], region, MOST_HIDDEN, 0.03)
    assert share(robot.named("home")) > 0.1 >= MOST_HIDDEN >= share(poses[0])
    assert share(poses[0]) <= MOST_HIDDEN and abs(poses[0][0]) == min(abs(q[0]) for q in poses)
    assert region.hidden([(within, BLIND)]) == 1.0 and region.hidden([(within, BLIND), (within, None)]) == 0.0


class Behind(CellDouble):
    """What its pictures do not show, and whether they show anything."""

    unseen, is_blind = "the robot hides 20 % of the table within reach", False

    def view(self):  # type: ignore[no-untyped-def]
        view = super().view()
        assert view.seen is not None
        hidden = "" if self.tcp_away() and not self.is_blind else self.unseen
        seen = view.seen.model_copy(update={"unseen": hidden, "blind": self.is_blind and bool(hidden)})
        return dataclasses.replace(view, seen=seen)

    def tcp_away(self) -> bool:
        return any(request.stage == "look" for request in self.requests if isinstance(request, m.PlanRequest)) and \
            self.motion.state == "succeeded"


def test_task_moves_aside_and_looks_before_done() -> None:
    cell = Behind([])
    cell.until("DONE")
    assert cell.stages() == ["look"]


@pytest.mark.parametrize("blind", [True, False])
def test_task_without_a_view_ends_in_error_with_the_reason(blind: bool) -> None:
    cell = Behind([])
    cell.is_blind = blind
    cell.tcp_away = lambda: False  # type: ignore[method-assign]
    cell.until("ERROR")
    assert cell.unseen in cell.task.status.message and cell.task.status.done == 0
    assert (len(cell.stages()) == 0) if blind else (set(cell.stages()) == {"look"})


def test_revealed_balls_are_taken_and_the_next_look_starts_with_the_first_pose() -> None:
    cell = Behind([])
    clear, moved, left = False, False, [(0.4, -0.05 * k) for k in range(6)]
    cell.tcp_away = lambda: clear  # type: ignore[method-assign]
    while cell.task.status.state not in ("DONE", "ERROR"):
        running = cell.task.running
        if running is not None:
            moved, clear = running.stage.name == "look", False
        elif moved:  # from there the camera sees past the arm
            moved, clear = False, True
            cell.balls |= {f"found_{len(left)}": (*left.pop(), 0.03)} if left else {}
        cell.step()
    assert (cell.task.status.state, cell.task.status.done) == ("DONE", 6)


def test_separate_moments_without_view_do_not_add_up() -> None:
    cell = Behind([(0.4, 0.0), (0.4, -0.1)])
    cell.tcp_away = lambda: True  # type: ignore[method-assign]
    for done in (1, 2):
        cell.until("across")
        cell.is_blind = True
        for _ in range(15):
            cell.step()
        status = cell.task.status
        assert (status.done, status.state) == (done, "IDLE") and "nothing can be seen" in status.message
        cell.is_blind = False
        for _ in range(4):
            cell.step()
        cell.arrival += 2 * cell.task.p.look_timeout  # the next motion takes its time
    cell.until("DONE")


@pytest.mark.parametrize("blind", [True, False])
def test_restarted_task_gets_the_full_look_timeout(blind: bool) -> None:
    cell = Behind([])
    cell.is_blind = blind
    cell.tcp_away = lambda: False  # type: ignore[method-assign]
    cell.until("ERROR")
    looks = len(cell.stages())
    for _ in range(5 * int(cell.task.p.look_timeout)):  # an operator comes
        cell.step()
    cell.command("start")
    for _ in range(100):
        cell.step()
        assert cell.task.status.state != "ERROR"
    cell.until("ERROR")
    assert len(cell.stages()) == 2 * looks


def test_time_held_by_the_operator_does_not_count_as_look_timeout() -> None:
    cell = Behind([])
    cell.is_blind = True
    cell.tcp_away = lambda: False  # type: ignore[method-assign]
    for _ in range(20):
        cell.step()
    cell.command("pause")
    for _ in range(20 * int(cell.task.p.look_timeout)):
        cell.step()
    cell.command("resume")
    for _ in range(20):
        cell.step()
    assert cell.task.status.state == "IDLE"


def test_blank_image_starts_nothing() -> None:
    cell = Behind([(0.4, 0.0)])
    cell.is_blind = True
    for _ in range(50):
        cell.step()
    assert cell.stages() == [] and "nothing can be seen" in cell.task.status.message


def test_occluded_target_counts_only_while_in_the_planning_scene() -> None:
    view = CellDouble([(0.4, 0.0)]).view()
    poses = [m.Pose(position=m.Vector3(x=0.4, z=0.03)), m.Pose(position=m.Vector3(x=0.6, z=0.03))]
    seen = m.PoseArray(header=view.seen.header, poses=poses, labels=[HIDDEN, HIDDEN])  # type: ignore[union-attr]
    assert dataclasses.replace(view, seen=seen).targets == [(0.4, 0.0, 0.03)]
