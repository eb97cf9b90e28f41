"""Parts drawn by a seed, decisions about lost parts, and the check by ground truth."""

from __future__ import annotations

import math
from itertools import combinations

import pytest

from applications.tending.parts import Options, generate
from applications.tending.task import PALLET, Config, Part, Tending
from applications.tending.topics import TendingStatus
from common import messages as m
from common.application import find_application
from common.config import Surroundings, World, load_cell, service_config
from common.errors import ConfigError
from common.tasks.palletizing import slots
from common.tasks.stages import View
from common.transport.codec import encode
from lab.invariants import ACCEPTED, Checks, WorldInvariants
from recording.report.aggregator import RunAggregator

CELL = load_cell("tending")
HOME = list(CELL.robot.named_poses["home"])


def test_parts_depend_on_the_seed_and_leave_room_for_fingers() -> None:
    found = {seed: generate(World(count=0), Options(count=6), seed) for seed in (1, 2)}
    assert found[1] == generate(World(count=0), Options(count=6), 1) != found[2]
    for one, other in combinations(found[1], 2):
        assert math.dist((one.x, one.y), (other.x, other.y)) >= 0.085  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"world\.generator\.count: 8 parts do not fit 0\.2 m apart"):
        generate(World(count=0), Options(count=8, separation=0.2), 1)


def part(name: str, x: float, y: float, z: float = 0.015) -> m.CollisionObject:
    pose = m.Pose(position=m.Vector3(x=x, y=y, z=z))
    return m.CollisionObject(id=name, role="target", shape="box", dimensions=list(PALLET.item), pose=pose, kind="part")


def decided(state: str, *parts: m.CollisionObject) -> Tending:
    """Return the task after one decision at home with an empty gripper."""
    sections = {"robot": CELL.robot, "run": CELL.run, "grasp": CELL.grasp, "world": CELL.section(Surroundings),
                "io": CELL.io}
    task = Tending(Config.model_validate(sections), TendingStatus(), "t")
    task.remember(Part.model_validate({"state": state}))
    scene = m.PlanningScene(header=m.Header(stamp=int(10e9)), objects=list(parts))
    tcp = m.Pose(position=m.Vector3(x=0.3, z=0.5), orientation=m.Quaternion(x=1.0, w=0.0))
    task.decide(View(10.0, scene, m.GripperState(width=0.08), m.MotionStatus(), HOME, tcp))
    return task


RAW, CLAMPED = part("raw", 0.45, -0.25), part("clamped", 0.6, 0.0)
STORED = [part(f"stored_{n}", slot.pose.position.x, slot.pose.position.y, slot.pose.position.z)
          for n, slot in enumerate(slots(PALLET))]


@pytest.mark.parametrize(("state", "parts", "stages", "subject"), [
    ("raw", [RAW, *STORED[:1]], ["open", "pre-grasp"], "raw"),
    ("raw", [RAW, CLAMPED], ["set clamp", "clamp"], "clamped"),
    ("machining", [RAW, CLAMPED], ["set start", "machine works"], "clamped"),
    ("machined", [RAW, CLAMPED], ["open", "pre-grasp"], "clamped"),
])
def test_next_stages_follow_from_what_is_seen_and_how_far_the_part_is(
    state: str, parts: list[m.CollisionObject], stages: list[str], subject: str
) -> None:
    task = decided(state, *parts)
    assert [stage.name for stage in task.queue][:2] == stages
    cycle = task.queue[0].cycle
    assert cycle is not None and cycle.subject == subject


def test_motions_into_and_out_of_the_fixture_require_an_idle_machine_and_an_open_clamp() -> None:
    for state, parts in (("raw", [RAW]), ("machined", [CLAMPED])):
        moves = [stage for stage in decided(state, *parts).queue if hasattr(stage, "requires")]
        assert moves and all(move.requires == {"busy": False, "clamp_closed": False} for move in moves)


@pytest.mark.parametrize("state", ["machining", "machined"])
def test_part_that_left_the_fixture_is_asked_for_instead_of_taking_a_raw_one_for_it(state: str) -> None:
    task = decided(state, RAW, *STORED[:1])
    assert task.status.state == "ERROR" and task.status.message == (
        f"the part that was {state} is not in the fixture any more: put it onto the pallet or away, then start "
        "the task")
    task.on_restart()
    assert task.memory.state == "raw"


def test_full_pallet_is_reported() -> None:
    task = decided("raw", RAW, *STORED)
    assert not task.queue and task.status.message == "the pallet is full"


def truth_of(*places: m.Pose) -> m.WorldObjects:
    return m.WorldObjects(objects=[
        m.WorldObject(id=f"p{n}", shape="box", state="table", pose=pose) for n, pose in enumerate(places)])


FIRST, SECOND = (slot.pose for slot in slots(PALLET)[:2])
TWO_ROWS = slots(PALLET.model_copy(update={"rows": 2}))


@pytest.mark.parametrize(("settings", "places", "missing"), [
    ([], [slot.pose for slot in slots(PALLET)], ""),
    ([], [FIRST, FIRST], "p0, p1"),
    ([], [FIRST, RAW.pose], "p1"),
    (["services.tender.pallet.rows=2"], [slot.pose for slot in TWO_ROWS], ""),
    (["services.tender.pallet.rows=2"], [TWO_ROWS[0].pose, SECOND], "p1"),
])
def test_end_is_checked_by_the_pallet_of_the_cell(settings: list[str], places: list[m.Pose], missing: str) -> None:
    invariants = WorldInvariants(checks := Checks(lambda: 1.0), load_cell("tending", settings))
    invariants.on_truth(encode(truth_of(*places)))
    invariants.on_end(0, "DONE")
    assert [line.rpartition(f"{ACCEPTED}: ")[2] for line in checks.broken] == (
        [f"missing among the parts on the pallet: {missing}"] if missing else [])


def test_summary_counts_parts_in_slots_of_their_own_by_ground_truth() -> None:
    truth = truth_of(FIRST, SECOND, RAW.pose)

    def counted(**parameters: object) -> dict[str, object] | None:
        aggregator = RunAggregator("tending", find_application("tending"), parameters=parameters)
        aggregator.on("scene_objects", truth, 0.0, 0)
        return aggregator.summary.as_dict()["truth"]

    assert counted() == {"in_box": 0, "on_table": 1, "in_place": 2, "elsewhere": 0, "containers": {},
                         "achieved": "2 of 3 parts on the pallet"}
    one_column = {"item": PALLET.item, "columns": 1}  # complete: around the origin, as for the task
    for pallet in ({"position": [0.45, -0.25, 0.0]}, one_column):
        found = counted(pallet=pallet)
        assert found and (found["on_table"], found["achieved"]) == (3, "0 of 3 parts on the pallet")


def test_single_value_of_the_pallet_keeps_the_others() -> None:
    config = service_config(load_cell("tending", ["services.tender.pallet.rows=2"]), "tender", Config)
    assert config.pallet == PALLET.model_copy(update={"rows": 2})
    with pytest.raises(ConfigError, match=r"services\.tender\.pallet\.rows: 0 must be greater"):
        service_config(load_cell("tending", ["services.tender.pallet.rows=0"]), "tender", Config)
