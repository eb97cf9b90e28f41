"""Grasps are ranked by score; failed places are avoided for a while, objects are given up after some tries."""

import math

import pytest

from applications.sorting.choice import Choice
from applications.sorting.rules import Rule
from applications.sorting.topics import GraspCandidate, Heap, Left, SeenObject
from common.messages import Header, Vector3
from common.robot.transforms import matrix_to_pose, tool_down


def thing(name, x, place="tray", color="red"):
    return SeenObject(id=name, place=place, center=Vector3(x=x, z=0.04), size=Vector3(x=0.04, y=0.03, z=0.03),
                      color_name=color)


def grasp(name, x=0.5, y=0.0, yaw=0.0, score=0.8, proved=True, number=0):
    pose = matrix_to_pose(tool_down(x, y, 0.03, yaw))
    return GraspCandidate(id=f"{name}/{number}", object=name, pose=pose, approach=pose, width=0.03, opening=0.05,
                          score=score, proved=proved)


def heap(objects, grasps, left=()):
    return Heap(header=Header(stamp=1), at_home=True, objects=objects, grasps=grasps, left=list(left))


@pytest.fixture
def choice():
    return Choice(Rule("color", {}, ("left", "right")), "tray", "y")


def offered(choice, seen, now=0.0):
    return [one.grasp.id for one in choice.options(seen, now, penalty=60.0, most_tries=3)]


def test_proved_grasps_near_the_best_score_are_offered_the_best_first(choice):
    seen = heap([thing("a", 0.5), thing("b", 0.6)], [
        grasp("a", score=0.75), grasp("b", 0.6, score=0.8), grasp("a", number=1, score=0.9, proved=False),
        grasp("a", y=0.05, score=0.6, number=2)])
    assert offered(choice, seen) == ["b/0", "a/0"]


def test_only_objects_of_the_tray_and_outside_of_containers_are_offered(choice):
    places = {"a": "tray", "b": "left", "c": "table"}
    seen = heap([thing(name, 0.4 + 0.1 * k, place) for k, (name, place) in enumerate(places.items())],
                [grasp(name, 0.4 + 0.1 * k) for k, name in enumerate(places)])
    assert offered(choice, seen) == ["a/0", "c/0"]


@pytest.mark.parametrize(("x", "yaw", "now", "again"), [
    (0.5, 0.0, 1.0, False),  # the same grasp
    (0.519, 0.0, 1.0, False),
    (0.521, 0.0, 1.0, True),  # more than 20 mm away
    (0.5, math.radians(29), 1.0, False),
    (0.5, math.radians(31), 1.0, True),
    (0.5, math.pi, 1.0, False),  # half a turn is the same line
    (0.5, 0.0, 61.0, True),  # forgotten after the penalty
])
def test_place_and_direction_of_a_failed_grasp_are_avoided_for_a_while(choice, x, yaw, now, again):
    choice.penalize(grasp("a"), 0.0, "empty")
    assert bool(offered(choice, heap([thing("a", 0.5)], [grasp("a", x, yaw=yaw)]), now)) is again


def test_object_is_given_up_after_its_tries_and_allowed_again_once_the_heap_was_stirred(choice):
    seen = heap([thing("a", 0.5)], [grasp("a", y=0.03, yaw=1.5)])
    for number in range(3):
        choice.penalize(grasp("a", yaw=0.5 * number), 0.0, f"failure {number}")
    assert offered(choice, seen) == []
    assert choice.reason(seen.objects[0], seen) == "3 attempts failed, the last one: failure 2"
    choice.forget()
    assert offered(choice, seen) == ["a/0"]


@pytest.mark.parametrize(("seen", "reason"), [
    (heap([thing("a", 0.5)], [], [Left(object="a", reason="no free edge")]), "no free edge"),
    (heap([thing("a", 0.5)], []), "no grasp was found"),
    (heap([thing("a", 0.5, "table")], []), "it lies on the table, outside of the tray: no grasp was found"),
])
def test_reason_of_an_object_without_attempts_is_that_of_the_detector(choice, seen, reason):
    assert choice.reason(seen.objects[0], seen) == reason


def test_object_without_destination_is_not_offered_and_says_why(tmp_path, monkeypatch):
    (tmp_path / "failing_rule_of_a_user.py").write_text("def choose(thing):\n    return 'middle'\n")
    monkeypatch.chdir(tmp_path)
    choice = Choice(Rule("failing_rule_of_a_user:choose", {}, ("left", "right")), "tray", "y")
    seen = heap([thing("a", 0.5)], [grasp("a")])
    assert offered(choice, seen) == []
    assert "returns 'middle', which is no destination; choices: left, right" in choice.reason(seen.objects[0], seen)
