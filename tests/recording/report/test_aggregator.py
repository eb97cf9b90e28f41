"""Aggregator of a run: its figures come from the topics and figures class of each application."""

import sys
from types import ModuleType

import pytest

from applications.pick_place.topics import PickPlaceStatus
from common import topics
from common.application import Application, ApplicationTopics, find_application
from common.messages import Header, MotionStatus, Pose, PoseArray, TaskStatus, WorldObject, WorldObjects
from common.topics import Topic
from recording.report.aggregator import RunAggregator, recorded_application
from recording.report.application import Figures, figures_of, format_truth
from recording.report.history import RunHistory
from recording.report.summary import describe


def summary_truth(aggregator: RunAggregator) -> object:
    return aggregator.summary.as_dict()["truth"]


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"placed": 3, "targets": 7, "state": "GRASPING", "target": "ball_4", "started": True},
         "3 of 7 placed - GRASPING ball_4"),
        ({"targets": 2}, "0 of 2 placed - IDLE (waits for `zencell task start`)"),
        ({"paused": True, "started": True}, "0 of 0 placed - IDLE (paused)"),
    ],
)
def test_progress_is_one_line(values: dict[str, object], line: str) -> None:
    aggregator = RunAggregator("panda", find_application("pick_place"))
    assert aggregator.progress == "no task status received yet"
    aggregator.on("pick_place_status", PickPlaceStatus.model_validate(values), 0.0, 0)
    assert aggregator.progress == line


def test_topics_include_status_and_decisions_of_each_application() -> None:
    keys = {topic.key for topic in RunAggregator("panda", find_application("pick_place")).topics}
    assert keys == {"pick_place_status", "validated_targets", "rejected_targets", "motion/status", "scene_objects",
                     "scene_balls"}
    assert "joint_states" not in keys
    outlining = RunAggregator("ur5", find_application("outlining"))
    assert {"outline_status", "contour_path"} <= {t.key for t in outlining.topics}


def test_frame_age_is_measured_in_cell_time() -> None:
    history = RunHistory()
    aggregator = RunAggregator("panda", find_application("pick_place"), speed=5.0, history=history)
    aggregator.on("validated_targets", PoseArray(header=Header(stamp=1_000_000_000)), 1.0, 1_100_000_000)
    assert history.latencies == [20.0]
    assert aggregator.summary.as_dict()["frame_to_target_ms"] == {"p50": 20.0, "p99": 20.0}


def test_application_of_a_recording_is_found_by_its_status() -> None:
    found = recorded_application(["joint_states", "outline_status"])
    assert found is not None and found.name == "outlining"
    assert recorded_application(["joint_states"]) is None


class MoveStatus(TaskStatus):
    """Of an application that is one file and says nothing of its figures."""


@pytest.fixture
def own() -> Application:
    module = ModuleType("my_pkg.move")
    status = Topic("move_status", MoveStatus, "state", "state")
    module.APPLICATION = Application(topics=ApplicationTopics(status=status))  # type: ignore[attr-defined]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "my_pkg", ModuleType("my_pkg"))
        patch.setitem(sys.modules, "my_pkg.move", module)
        yield find_application("my_pkg.move")


def test_custom_application_has_a_default_summary(own: Application) -> None:
    aggregator = RunAggregator("mine", own)
    assert figures_of(own) is Figures
    aggregator.on("move_status", MoveStatus(state="LIFTING", done=0, total=1, subject="cube", started=True), 1.0, 0)
    assert aggregator.progress == "0 of 1 done - LIFTING cube"
    aggregator.on(topics.MOTION_STATUS.key, MotionStatus(state="active"), 2.5, 0)
    done = MoveStatus(state="DONE", done=1, total=1, started=True, figures={"moved_m": 0.3})
    aggregator.on("move_status", done, 3.0, 0)
    figures = aggregator.summary.as_dict()
    assert (figures["state"], figures["placed"], figures["targets"]) == ("DONE", 1, 1)
    assert figures["figures"] == {"moved_m": 0.3} and figures["seconds"]["first_motion"] == 2.5
    assert describe(figures, aggregator.figures)[:2] == ["mine: DONE, 1 of 1 done", "  moved_m 0.3"]


def test_truth_names_several_containers() -> None:
    truth = {"in_box": 3, "on_table": 1, "elsewhere": 0, "containers": {"box": 3}}
    assert format_truth(truth) == "3 in the box, 1 on the table"
    truth = {"in_box": 3, "on_table": 1, "elsewhere": 2, "containers": {"left": 1, "right": 2}}
    assert format_truth(truth) == "1 in left, 2 in right, 1 on the table, 2 elsewhere"


def test_world_objects_with_state_are_the_truth() -> None:
    aggregator = RunAggregator("panda", find_application("pick_place"))
    aggregator.on("scene_objects", WorldObjects(), 0.0, 0)
    assert summary_truth(aggregator) == {"in_box": 0, "on_table": 0, "elsewhere": 0, "containers": {}}
    aggregator.on("scene_balls", PoseArray(poses=[Pose()], labels=["box"]), 0.0, 0)  # all that older recordings have
    assert summary_truth(aggregator) == {"in_box": 1, "on_table": 0, "elsewhere": 0, "containers": {"box": 1}}
    states = [("contained", "tray"), ("contained", "tray"), ("table", ""), ("held", "")]
    things = [WorldObject(id=f"cube_{k}", shape="box", state=state, container=into)
              for k, (state, into) in enumerate(states)]
    aggregator.on("scene_objects", WorldObjects(objects=things), 0.0, 0)
    assert summary_truth(aggregator) == {"in_box": 2, "on_table": 1, "elsewhere": 1, "containers": {"tray": 2}}
    assert not aggregator.summary.truth.settled
