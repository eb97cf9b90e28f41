import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.topics import PickPlaceStatus
from common.messages import (
    Header,
    MotionStatus,
    PlanFigure,
    Pose,
    PoseArray,
    Rejection,
    Rejections,
    Vector3,
    WorldObject,
    WorldObjects,
)
from common.messages.camera import PARTLY_OUT_OF_VIEW
from recording.report.application import Figures
from recording.report.history import Truth
from recording.report.summary import Rejected, Summary, describe, percentile

PLAN = PlanFigure(planner="cartesian", seconds=0.01, fraction=1.0, attempts=1)


def at(x: float, y: float, reason: str = "too far") -> Rejection:
    return Rejection(position=Vector3(x=x, y=y, z=0.03), reason=reason)


def balls(*labels: str) -> PoseArray:
    return PoseArray(poses=[Pose()] * len(labels), labels=list(labels))


def status(state: str, seconds: float, **values: object) -> PickPlaceStatus:
    fields = {"header": Header(stamp=int(seconds * 1e9)), "state": state, "started": True, **values}
    return PickPlaceStatus.model_validate(fields)


def test_summary_has_the_fields_that_scripts_read():
    summary = Summary("panda", 3, 5.0).as_dict()
    assert list(summary) == [
        "cell", "state", "placed", "targets", "rejected", "failures", "retries", "seconds", "plans",
        "frame_to_target_ms", "restarts", "seed", "speed", "truth", "figures", "overlooked", "unexplained",
    ]
    assert list(summary["seconds"]) == ["ready", "first_motion", "task", "moving", "planning"]
    assert list(summary["frame_to_target_ms"]) == ["p50", "p99"]
    assert summary["truth"] is None
    json.dumps(summary)


@pytest.mark.parametrize(("state", "problem"), [("ERROR", "lid: is out of reach"), ("DONE", None)])
def test_reason_of_an_error_is_part_of_the_summary(state, problem):
    summary = Summary("panda", 0, 1.0)
    summary.on_status(status(state, 10, message="lid: is out of reach"))
    assert summary.as_dict().get("problem") == problem
    assert ("  lid: is out of reach" in describe(summary.as_dict(), Figures())) == (problem is not None)


@pytest.mark.parametrize(("state", "moved", "listed"), [("DONE", False, 1), ("DONE", True, 0), ("ERROR", False, 0)])
def test_finished_world_of_an_earlier_run_is_named(state, moved, listed):
    summary = Summary("panda", 0, 1.0)
    summary.continued = "/data/panda.state"
    summary.on_status(status(state, 10))
    if moved:
        summary.on_motion(2.0, MotionStatus(state="active"))
    lines = [line for line in describe(summary.as_dict(), Figures()) if "an earlier run, /data/panda.state" in line]
    assert len(lines) == listed and all("world reset" in line for line in lines)


def test_rejected_position_is_listed_once_and_skipped_targets_with_it():
    rejected = Rejected()
    rejected.add([at(0.9, 0.0), at(0.9, 0.02), at(0.9, 0.1), at(0.55, 0.25, "inside the container")])
    rejected.add([at(0.905, 0.0, "partly out of view")])
    assert [(place.position.y, place.reason) for place in rejected.places] == [
        (0.0, "partly out of view"), (0.1, "too far")]
    summary = Summary("panda", 0, 1.0)
    summary.rejected.add([at(0.9, 0.0)])
    summary.on_status(status("DONE", 10, skipped=[at(0.4, -0.3, "no path"), at(0.9, 0.01, "no path")]))
    assert [place["reason"] for place in summary.as_dict()["rejected"]] == ["no path", "no path"]


@pytest.mark.parametrize(("position", "state", "listed"), [
    ((0.9, 0.02), "table", True), ((0.5, 0.0), "table", False), ((0.9, 0.0), "contained", False)])
def test_object_that_crossed_the_border_of_an_image_is_not_left_there(position, state, listed):
    summary = Summary("panda", 0, 1.0)
    summary.on_rejections(0.0, Rejections(header=Header(), rejected=[at(0.9, 0.0, PARTLY_OUT_OF_VIEW)]))
    assert len(summary.as_dict()["rejected"]) == 1, "without the truth all count"
    pose = Pose(position=Vector3(x=position[0], y=position[1], z=0.03))
    thing = WorldObject(id="ball_1", shape="sphere", pose=pose, state=state)
    summary.truth.on_objects(WorldObjects(objects=[thing]))
    assert len(summary.as_dict()["rejected"]) == listed


def test_newest_of_many_rejections_are_listed():
    summary = Summary("panda", 1, 1.0)
    for number in range(12):
        rejections = Rejections(header=Header(), rejected=[at(i, number) for i in range(1000)])
        summary.on_rejections(0.0, rejections)
        for plans in ([PLAN] * 1000, []):
            summary.on_status(status("IDLE", number, plans=plans))
    values = summary.as_dict()
    assert len(values["rejected"]) == 1000 and {each["position"][1] for each in values["rejected"]} == {11.0}
    assert len(values["plans"]) == 10_000


def test_figures_of_a_restarted_task_add_up_and_the_placed_count_is_the_last():
    summary = Summary("panda", 0, 1.0)
    first = {"task_seconds": 10, "moving_seconds": 8, "failures": 1, "plans": [PLAN] * 3, "placed": 2}
    summary.on_status(status("GRASPING", 100, **first))
    summary.on_status(status("GRASPING", 105, task_seconds=1, moving_seconds=0, placed=2))
    summary.on_status(status("DONE", 120, task_seconds=16, moving_seconds=9, retries=1, plans=[PLAN] * 4, placed=7))
    figures = summary.as_dict()
    assert (figures["placed"], figures["failures"], figures["retries"], len(figures["plans"])) == (7, 1, 1, 7)
    assert figures["seconds"]["moving"] == 17
    assert figures["seconds"]["task"] == 30  # from its first start, the time in between included
    summary = Summary("panda", 0, 1.0)
    for state, seconds, done in [("PLACING", 50, 5), ("IDLE", 55, 0), ("IDLE", 56, 5), ("PLACING", 60, 6),
                                 ("IDLE", 65, 0), ("DONE", 70, 7)]:
        summary.on_status(status(state, seconds, done=done, total=7))
    figures = summary.as_dict()
    assert (figures["placed"], figures["targets"], figures["state"]) == (7, 7, "DONE")


def test_truth_counts_objects_by_location():
    truth = Truth(("box", "tray"))
    assert truth.counted() is None and truth.settled
    truth.on_labels(balls("box", "box", "table", "held", "falling"))
    counted = {"in_box": 2, "on_table": 1, "elsewhere": 2, "containers": {"box": 2, "tray": 0}}
    assert truth.counted() == counted and not truth.settled
    truth.on_objects(WorldObjects())  # of an old recording, in which balls are no objects
    assert truth.counted() == counted
    truth.on_labels(balls("box"))
    assert truth.settled


def test_truth_does_not_count_objects_in_a_container_that_they_are_taken_from_as_put_away():
    truth = Truth(("left",))
    truth.on_objects(WorldObjects(objects=[
        WorldObject(id=f"object_{n}", shape="sphere", pose=Pose(position=Vector3(x=0.2 * n)), state="contained",
                    container=name) for n, name in enumerate(("left", "tray", "tray"))]))
    assert truth.counted() == {"in_box": 1, "on_table": 0, "elsewhere": 0, "containers": {"left": 1, "tray": 2}}
    assert [each.container for each in truth.left([])] == ["tray", "tray"]


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0.01, 1))
def test_percentile_is_a_value_with_that_share_below_it(values, fraction):
    found = percentile(values, fraction)
    assert found in values
    assert sum(value <= found for value in values) >= math.floor(fraction * len(values))


def test_text_names_left_objects_restarts_and_figures_of_the_task():
    summary = Summary("panda", 0, 1.0)
    summary.on_status(status("DONE", 10, placed=6, targets=6, figures={"moved_m": 0.31, "by": "edge"}))
    summary.rejected.add([at(0.9, 0.0)])
    summary.truth.on_labels(balls(*["box"] * 6, "table"))
    summary.restarts = {"router": 0, "scene_manager": 2}
    lines = describe(summary.as_dict(), Figures())
    assert lines[:2] == ["panda: DONE, 6 of 6 done (truth: 6 in the box, 1 on the table)", "  moved_m 0.31, by edge"]
    text = "\n".join(lines)
    assert "left at (0.900, 0.000, 0.030): too far" in text
    assert "scene_manager 2 x" in text and "router" not in text
