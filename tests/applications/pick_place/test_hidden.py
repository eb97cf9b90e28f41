"""Occlusion: tracks, targets and slots stay, and the task does not end before an image shows their positions."""

import dataclasses

import numpy as np
import pytest

from applications.pick_place.ball_places import MOST_HIDDEN, VisibleTable, find_viewing_poses
from applications.pick_place.detections import HIDDEN, OccludedTargets
from applications.pick_place.perceived_scene import PerceivedScene
from applications.pick_place.tracks import SceneParameters, Sighting, Tracks
from common import messages as m
from common.perception.occlusion import Occlusion, RobotSilhouettes
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds
from tests.applications.pick_place.cell_double import CellDouble
from tests.applications.pick_place.rendered import AROUND, CAMERA, CELL

COVERED = Occlusion(CAMERA, "the lens is covered")
PLACE = (0.4, 0.0, 0.03)
ELSEWHERE = (0.6, -0.2, 0.03)


def at_place(place):
    return place[:2] == PLACE[:2]


def test_occluded_track_stays_and_a_visibly_missing_one_is_removed():
    tracks = Tracks(SceneParameters(confirm_frames=1))
    tracks.update([Sighting(PLACE), Sighting(ELSEWHERE)], 0.0)
    for k in range(1, 30):
        tracks.update([], 0.1 * k, hides=at_place)
    assert [track.position for track in tracks.confirmed()] == [PLACE]
    for k in range(30, 40):  # visibly missing in one of two views
        tracks.update([], 0.1 * k, hides=at_place)
        tracks.update([], 0.1 * k + 0.01, view=1)
    assert tracks.confirmed() == []


def test_target_is_remembered_while_occluded_unless_detected_again():
    remembered = OccludedTargets()
    assert remembered.hidden([PLACE, ELSEWHERE], [], None) == []
    assert remembered.hidden([ELSEWHERE], [], at_place) == [PLACE]
    assert remembered.hidden([(0.41, 0.0, 0.03)], [], at_place) == []
    assert remembered.hidden([], [], None) == []


def test_occluded_target_counts_only_while_in_the_planning_scene():
    view = CellDouble([(0.4, 0.0)]).view()
    poses = [m.Pose(position=m.Vector3(x=0.4, z=0.03)), m.Pose(position=m.Vector3(x=0.6, z=0.03))]
    seen = m.PoseArray(header=view.seen.header, poses=poses, labels=[HIDDEN, HIDDEN])
    assert dataclasses.replace(view, seen=seen).targets == [(0.4, 0.0, 0.03)]


@pytest.mark.parametrize(("z", "count"), [(0.035, 1), (0.095, 2)])  # the upper one lies on another
def test_contained_objects_stay_while_occluded(z, count):
    scene = PerceivedScene(SceneParameters(), AROUND, CELL.robot.gripper, "panda_hand_tcp")
    pixel = CAMERA.project([0.55 - 0.033, 0.25 - 0.033, z])
    ball = m.Marker(ns="ball", id=0, type="sphere", pose=m.Pose(), scale=m.Vector3(x=0.06, y=0.06, z=0.06),
                    pixel=tuple(pixel))
    for k in range(20):
        frame = m.MarkerArray(header=m.Header(stamp=int(1e9 + k * 1e8)), markers=[ball] if k < 2 else [])
        scene.update_detections(frame, CAMERA, None, hidden=COVERED if k >= 2 else None)
    assert [thing.role for thing in scene.scene().objects].count("contained") == count


def test_viewing_pose_is_the_smallest_rotation():
    robot, region = RobotModel.load(CELL.robot), VisibleTable(AROUND, WorkspaceBounds())
    silhouettes = RobotSilhouettes(robot, 0.03)
    within = region.within(CAMERA, silhouettes, robot)

    def hidden_share(q):
        return region.hidden([(within, silhouettes.occlusion(CAMERA, [np.asarray(q)]))])

    poses = find_viewing_poses(robot, [CAMERA], region, MOST_HIDDEN, 0.03)
    assert hidden_share(robot.named("home")) > 0.1 >= MOST_HIDDEN >= hidden_share(poses[0])
    assert abs(poses[0][0]) == min(abs(q[0]) for q in poses)
    assert region.hidden([(within, COVERED)]) == 1.0
    assert region.hidden([(within, COVERED), (within, None)]) == 0.0


class OccludedCell(CellDouble):
    """The robot hides a part of the table, or the camera sees nothing."""

    unseen = "the robot hides 20 % of the table within reach"

    def __init__(self, balls=(), is_blind=False, has_view=False):
        super().__init__(list(balls))
        self.is_blind, self.has_view = is_blind, has_view

    def view(self):
        view = super().view()
        hidden = "" if self.has_view and not self.is_blind else self.unseen
        seen = view.seen.model_copy(update={"unseen": hidden, "blind": self.is_blind and bool(hidden)})
        return dataclasses.replace(view, seen=seen)


def test_revealed_balls_are_taken_and_the_next_look_starts_with_the_first_pose():
    cell = OccludedCell()
    moved, left = False, [(0.4, -0.05 * k) for k in range(6)]
    while cell.task.status.state not in ("DONE", "ERROR"):
        running = cell.task.running
        if running is not None:
            moved, cell.has_view = running.stage.name == "look", False
        elif moved:  # from there the camera sees past the arm
            moved, cell.has_view = False, True
            cell.balls |= {f"found_{len(left)}": (*left.pop(), 0.03)} if left else {}
        cell.step()
    assert (cell.task.status.state, cell.task.status.done) == ("DONE", 6)
    assert cell.stages()[0] == cell.stages()[-1] == "look"


def test_separate_moments_without_view_do_not_add_up():
    cell = OccludedCell([(0.4, 0.0), (0.4, -0.1)], is_blind=True, has_view=True)
    cell.steps(15)
    assert cell.stages() == [] and "nothing can be seen" in cell.task.status.message
    cell.is_blind = False
    for done in (1, 2):
        cell.until("across")
        cell.is_blind = True
        cell.steps(15)
        status = cell.task.status
        assert (status.done, status.state) == (done, "IDLE") and "nothing can be seen" in status.message
        cell.is_blind = False
        cell.steps(4)
        cell.arrival += 2 * cell.task.p.look_timeout  # the next motion takes its time
    cell.until("DONE")


@pytest.mark.parametrize("blind", [True, False])
def test_task_without_a_view_ends_in_error_after_its_timeout_at_each_start(blind):
    cell = OccludedCell(is_blind=blind)
    cell.until("ERROR")
    assert cell.unseen in cell.task.status.message and cell.task.status.done == 0
    looks = cell.stages()
    assert set(looks) == (set() if blind else {"look"})
    cell.steps(5 * int(cell.task.p.look_timeout))
    cell.command("start")
    for _ in range(100):
        cell.step()
        assert cell.task.status.state != "ERROR"
    cell.until("ERROR")
    assert cell.stages() == 2 * looks


def test_time_held_by_the_operator_does_not_count_as_look_timeout():
    cell = OccludedCell(is_blind=True)
    cell.steps(20)
    cell.command("pause")
    cell.steps(20 * int(cell.task.p.look_timeout))
    cell.command("resume")
    cell.steps(20)
    assert cell.task.status.state == "IDLE"
