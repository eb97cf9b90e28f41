import json
import math

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
    WorldObjects,
)
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


def test_summary_has_the_fields_that_scripts_read() -> None:
    summary = Summary("panda", 3, 5.0).as_dict()
    assert list(summary) == [
        "cell", "state", "placed", "targets", "rejected", "failures", "retries", "seconds", "plans",
        "frame_to_target_ms", "restarts", "seed", "speed", "truth", "figures", "overlooked", "unexplained",
    ]
    assert list(summary["seconds"]) == ["ready", "first_motion", "task", "moving", "planning"]
    assert list(summary["frame_to_target_ms"]) == ["p50", "p99"]
    assert summary["truth"] is None
    json.dumps(summary)


def test_rejected_position_is_listed_once_and_placed_objects_never() -> None:
    rejected = Rejected()
    rejected.add([at(0.9, 0.0), at(0.9, 0.02), at(0.9, 0.1), at(0.55, 0.25, "inside the container")])
    rejected.add([at(0.905, 0.0, "partly out of view")])
    assert [(place.position.y, place.reason) for place in rejected.places] == [
        (0.0, "partly out of view"), (0.1, "too far")
    ]


def test_of_invented_rejections_the_newest_are_listed() -> None:
    summary = Summary("panda", 1, 1.0)
    for number in range(12):
        summary.on_rejections(0.0, Rejections(header=Header(), rejected=[at(i, number) for i in range(1000)]))
        for plans in ([PLAN] * 1000, []):
            summary.on_status(status("IDLE", number, plans=plans))
    values = summary.as_dict()
    assert len(values["rejected"]) == 1000 and {each["position"][1] for each in values["rejected"]} == {11.0}
    assert len(values["plans"]) == 10_000


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), max_size=20))
def test_listed_positions_are_never_close_to_each_other(points: list[tuple[float, float]]) -> None:
    rejected = Rejected()
    for x, y in points:
        rejected.add([at(x, y)])
    # A newer rejection of a place may lie up to the limit from where the first was seen.
    assert len(rejected.places) <= len(points)
    for index, a in enumerate(rejected.places):
        assert all(a is not b for b in rejected.places[:index])


def test_skipped_targets_are_reported_with_the_rejected() -> None:
    summary = Summary("panda", 0, 1.0)
    summary.rejected.add([at(0.9, 0.0)])
    summary.on_status(status("DONE", 10, skipped=[at(0.4, -0.3, "no path"), at(0.9, 0.01, "no path")]))
    assert [place["reason"] for place in summary.as_dict()["rejected"]] == ["no path", "no path"]


def test_figures_of_a_task_that_was_restarted_add_up() -> None:
    summary = Summary("panda", 0, 1.0)
    first = {"task_seconds": 10, "moving_seconds": 8, "failures": 1, "plans": [PLAN] * 3, "placed": 2}
    summary.on_status(status("GRASPING", 100, **first))
    summary.on_status(status("GRASPING", 105, task_seconds=1, moving_seconds=0, placed=2))
    summary.on_status(status("DONE", 120, task_seconds=16, moving_seconds=9, retries=1, plans=[PLAN] * 4, placed=7))
    figures = summary.as_dict()
    assert (figures["placed"], figures["failures"], figures["retries"], len(figures["plans"])) == (7, 1, 1, 7)
    assert figures["seconds"]["moving"] == 17
    assert figures["seconds"]["task"] == 30  # from its first start, the time in between included


def test_first_motion_is_reported_once() -> None:
    summary = Summary("panda", 0, 1.0)
    summary.on_motion(3.0, MotionStatus(state="none"))
    summary.on_motion(4.5, MotionStatus(state="active"))
    summary.on_motion(9.0, MotionStatus(state="active"))
    assert summary.as_dict()["seconds"]["first_motion"] == 4.5


def test_truth_counts_objects_by_location() -> None:
    truth = Truth(("box", "tray"))
    assert truth.counted() is None and truth.settled
    truth.on_labels(balls("box", "box", "table", "held", "falling"))
    assert truth.counted() == {"in_box": 2, "on_table": 1, "elsewhere": 2, "containers": {"box": 2, "tray": 0}}
    assert not truth.settled
    truth.on_objects(WorldObjects())  # of an old recording, in which balls are no objects
    assert truth.counted() == {"in_box": 2, "on_table": 1, "elsewhere": 2, "containers": {"box": 2, "tray": 0}}
    truth.on_labels(balls("box"))
    assert truth.settled


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0.01, 1))
def test_percentile_is_a_value_with_that_share_below_it(values: list[float], fraction: float) -> None:
    found = percentile(values, fraction)
    assert found in values
    assert sum(value <= found for value in values) >= math.floor(fraction * len(values))


def test_text_summary_names_left_objects_and_restarts() -> None:
    summary = Summary("panda", 0, 1.0)
    summary.on_status(status("DONE", 10, placed=6, targets=6))
    summary.rejected.add([at(0.9, 0.0)])
    summary.truth.on_labels(balls(*["box"] * 6, "table"))
    summary.restarts = {"router": 0, "scene_manager": 2}
    text = "\n".join(describe(summary.as_dict(), Figures()))
    assert "panda: DONE, 6 of 6 done (truth: 6 in the box, 1 on the table)" in text
    assert "left at (0.900, 0.000, 0.030): too far" in text
    assert "scene_manager 2 x" in text
    assert "router" not in text


def test_placed_count_after_restarts_is_the_last_reported() -> None:
    summary = Summary("panda", 0, 1.0)
    lives = [("PLACING", 50, 5), ("IDLE", 55, 0), ("IDLE", 56, 5), ("PLACING", 60, 6), ("IDLE", 65, 0), ("DONE", 70, 7)]
    for state, seconds, done in lives:
        summary.on_status(status(state, seconds, done=done, total=7))
    figures = summary.as_dict()
    assert (figures["placed"], figures["targets"], figures["state"]) == (7, 7, "DONE")


def test_figures_of_the_task_are_copied_to_the_summary() -> None:
    summary = Summary("mine", 0, 1.0)
    summary.on_status(status("DONE", 10, done=1, total=1, figures={"moved_m": 0.31, "by": "edge"}))
    figures = summary.as_dict()
    assert figures["figures"] == {"moved_m": 0.31, "by": "edge"}
    assert describe(figures, Figures())[:2] == ["mine: DONE, 1 of 1 done", "  moved_m 0.31, by edge"]
