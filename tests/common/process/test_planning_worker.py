"""The second planner in a process of its own; forked where nothing else runs yet, so by programs of their own."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[3]

BEGIN = """
import asyncio, json, os, signal, sys, time
from common.config import load_cell
from common.messages import CollisionObject, Header, JointGoal, PlanningScene, PlanRequest, Pose, Vector3
from common.process.planning_worker import PlanningWorker, WorkerDied
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel

cell = load_cell("panda", ["pipeline.planners=[{name: ompl, options: {algorithm: AORRTC, improving_time: 60}}]"]
                 if "long" in sys.argv else [])
setup = cell.robot, cell.motion, cell.pipeline
helper = PlanningWorker(1)
helper.set_up(*setup, seed=3)
wall = CollisionObject(id="wall", role="fixture", shape="box", dimensions=[0.3, 0.02, 0.4],
                       pose=Pose(position=Vector3(x=0.55, z=0.2)))
scene = PlanningScene(header=Header(frame_id="world"), objects=[wall])
down = RobotModel.load(cell.robot).named("home") + [0.0, 0.5, 0, 0.1, 0, 0, 0]
left, right = [0.6, *down.tolist()[1:]], [-0.6, *down.tolist()[1:]]

runner = asyncio.Runner()

def asked(id, seconds=20.0):
    return PlanRequest(id=id, start=left, goal=JointGoal(positions=right), planning_time=seconds)

def plan(*request):
    return runner.run(helper.plan(*request))

def given_up(after):
    async def give_up():
        task = asyncio.create_task(helper.plan(asked("a", 300.0), scene, None))
        await asyncio.sleep(after)
        task.cancel()
        await asyncio.wait({task})
        return task.cancelled()
    return runner.run(give_up())
"""


def told(script: str, *arguments: str) -> list[object]:
    """What a program printed, line by line, as JSON."""
    done = subprocess.run([sys.executable, "-c", BEGIN + script, *arguments], cwd=ROOT, capture_output=True, text=True,
                          check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_helper_plans_as_the_pipeline_itself_does_also_on_the_next_scene() -> None:
    answers, own = told("""
own = PlanningPipeline(RobotModel.load(cell.robot), *setup[1:], seed=3)
empty = PlanningScene(header=Header(frame_id="world"))
for asks in (plan, own.plan):
    answers = [asks(asked(name), where, None) for name, where in (("a", scene), ("b", scene), ("c", empty))]
    print(json.dumps([[p.positions for p in each.trajectory.points] for each in answers]))
""")
    assert answers == own
    assert isinstance(answers, list) and answers[0] != answers[2]


def test_helper_gives_up_when_it_is_told_to_and_is_there_for_the_next_request() -> None:
    loading, planning, answer = told("""
for after in (0.0, 2.0):
    print(json.dumps(given_up(after)))
print(json.dumps(plan(asked("b", 0.5), scene, None).ok))
""", "long")
    assert loading and planning and answer, "one that does not give up is ended, and has no answer to the next"


def test_helper_that_was_killed_is_said_to_be_lost() -> None:
    assert told("""
import multiprocessing
process, = multiprocessing.active_children()
os.kill(process.pid, signal.SIGKILL)
try:
    plan(asked("a"), scene, None)
except WorkerDied as lost:
    print(json.dumps(str(lost)))
""") == ["the planning worker has ended"]


def test_helper_ends_with_its_parent_however_that_ends() -> None:
    pids = told("""
import multiprocessing
print(json.dumps(multiprocessing.active_children()[0].pid), flush=True)
async def leave():
    planning = asyncio.create_task(helper.plan(asked("a", 300.0), scene, None))
    await asyncio.sleep(0.5)
    os._exit(0)
runner.run(leave())
""", "long")
    assert isinstance(pids[0], int)
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(pids[0]).wait(20)


def test_helpers_end_with_their_parent_also_while_one_of_them_is_stopped() -> None:
    pids = told("""
import multiprocessing
second = PlanningWorker(1)
for process in multiprocessing.active_children():
    print(json.dumps(process.pid), flush=True)
    while os.getpriority(os.PRIO_PROCESS, process.pid) == os.getpriority(os.PRIO_PROCESS, 0):
        pass  # it has just been forked
os.kill(second._process.pid, signal.SIGSTOP)
os._exit(0)
""")
    for pid in pids:
        assert isinstance(pid, int)
        with contextlib.suppress(psutil.NoSuchProcess):
            psutil.Process(pid).wait(20)


def test_helper_that_is_stopped_is_ended_and_said_to_be_lost_though_the_scene_does_not_fit_into_the_pipe() -> None:
    assert told("""
import common.process.planning_worker
common.process.planning_worker.OVERTIME = 0.1
scene = scene.model_copy(update={"header": Header.model_construct(frame_id="x" * 10_000_000)})
os.kill(helper._process.pid, signal.SIGSTOP)
try:
    plan(asked("a", 0.1), scene, None)
except WorkerDied as lost:
    print(json.dumps([str(lost), helper._process.exitcode]))
""") == [["the planning worker has ended", -9]]


def test_helper_that_is_stopped_is_ended_when_giving_up_is_told_to_it() -> None:
    assert told("""
import common.process.planning_worker
common.process.planning_worker.OVERTIME = 0.1
os.kill(helper._process.pid, signal.SIGSTOP)
print(json.dumps(given_up(0.0)))
try:
    plan(asked("b"), scene, None)
except WorkerDied as lost:
    print(json.dumps(str(lost)))
""") == [True, "the planning worker has ended"]


def test_helper_that_is_let_go_of_leaves_no_process_behind() -> None:
    assert told("""
second = PlanningWorker(1)
helper.close()
print(json.dumps([helper._process.exitcode, second._process.exitcode]))
""") == [[-9, None]]


def test_helper_finds_a_planner_that_lies_where_only_its_parent_looks_by_now(tmp_path: Path) -> None:
    (tmp_path / "of_a_person").mkdir()
    (tmp_path / "of_a_person/planner.py").write_text(
        "from common.planning.planners.joint_move import Options, plan\n", encoding="utf-8")
    assert told("""
sys.path.append(sys.argv[1])
cell = load_cell("panda", ["pipeline.planners=[{name: of_a_person.planner}]"])
helper.set_up(cell.robot, cell.motion, cell.pipeline, seed=3)
print(json.dumps(plan(asked("a"), scene, None).planner))
""", str(tmp_path)) == ["planner"]
