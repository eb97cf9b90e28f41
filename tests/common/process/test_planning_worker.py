"""Planning workers, each forked by a fresh program without other threads."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[3]

SETUP = """
import asyncio, json, os, signal, sys, time
from common.config import load_cell
from common.messages import CollisionObject, Header, JointGoal, PlanningScene, PlanRequest, Pose, Vector3
from common.process.planning_worker import PlanningWorker, WorkerDied
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel

cell = load_cell("panda", ["pipeline.planners=[{name: ompl, options: {algorithm: AORRTC, improving_time: 60}}]"]
                 if "long" in sys.argv else [])
setup = cell.robot, cell.motion, cell.pipeline
worker = PlanningWorker(1)
worker.set_up(*setup, seed=3)
wall = CollisionObject(id="wall", role="fixture", shape="box", dimensions=[0.3, 0.02, 0.4],
                       pose=Pose(position=Vector3(x=0.55, z=0.2)))
scene = PlanningScene(header=Header(frame_id="world"), objects=[wall])
down = RobotModel.load(cell.robot).named("home") + [0.0, 0.5, 0, 0.1, 0, 0, 0]
left, right = [0.6, *down.tolist()[1:]], [-0.6, *down.tolist()[1:]]

runner = asyncio.Runner()

def request(id, seconds=20.0):
    return PlanRequest(id=id, start=left, goal=JointGoal(positions=right), planning_time=seconds)

def plan(*arguments):
    return runner.run(worker.plan(*arguments))

def cancelled(after):
    async def cancel_plan():
        task = asyncio.create_task(worker.plan(request("a", 300.0), scene, None))
        await asyncio.sleep(after)
        task.cancel()
        await asyncio.wait({task})
        return task.cancelled()
    return runner.run(cancel_plan())
"""


def run_script(script: str, *arguments: str) -> list[object]:
    """Return the JSON lines that a program printed."""
    done = subprocess.run([sys.executable, "-c", SETUP + script, *arguments], cwd=ROOT, capture_output=True, text=True,
                          check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_worker_plans_like_the_pipeline_also_with_a_new_scene() -> None:
    by_worker, by_pipeline = run_script("""
own = PlanningPipeline(RobotModel.load(cell.robot), *setup[1:], seed=3)
empty = PlanningScene(header=Header(frame_id="world"))
for planner in (plan, own.plan):
    answers = [planner(request(name), where, None) for name, where in (("a", scene), ("b", scene), ("c", empty))]
    print(json.dumps([[p.positions for p in each.trajectory.points] for each in answers]))
""")
    assert by_worker == by_pipeline
    assert isinstance(by_worker, list) and by_worker[0] != by_worker[2]


def test_cancelled_worker_plans_the_next_request() -> None:
    loading, planning, answer = run_script("""
for after in (0.0, 2.0):
    print(json.dumps(cancelled(after)))
print(json.dumps(plan(request("b", 0.5), scene, None).ok))
""", "long")
    assert loading and planning and answer, "a worker that ignores the cancellation would be killed"


def test_killed_worker_is_reported() -> None:
    assert run_script("""
import multiprocessing
process, = multiprocessing.active_children()
os.kill(process.pid, signal.SIGKILL)
try:
    plan(request("a"), scene, None)
except WorkerDied as error:
    print(json.dumps(str(error)))
""") == ["the planning worker has ended"]


def test_worker_ends_when_its_parent_exits() -> None:
    pids = run_script("""
import multiprocessing
print(json.dumps(multiprocessing.active_children()[0].pid), flush=True)
async def leave():
    planning = asyncio.create_task(worker.plan(request("a", 300.0), scene, None))
    await asyncio.sleep(0.5)
    os._exit(0)
runner.run(leave())
""", "long")
    assert isinstance(pids[0], int)
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(pids[0]).wait(20)


def test_all_workers_end_when_their_parent_exits_also_a_stopped_one() -> None:
    pids = run_script("""
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


def test_stopped_worker_is_killed_and_reported_though_the_scene_does_not_fit_into_the_pipe() -> None:
    assert run_script("""
import common.process.planning_worker
common.process.planning_worker.OVERTIME = 0.1
scene = scene.model_copy(update={"header": Header.model_construct(frame_id="x" * 10_000_000)})
os.kill(worker._process.pid, signal.SIGSTOP)
try:
    plan(request("a", 0.1), scene, None)
except WorkerDied as error:
    print(json.dumps([str(error), worker._process.exitcode]))
""") == [["the planning worker has ended", -9]]


def test_stopped_worker_is_killed_when_it_is_cancelled() -> None:
    assert run_script("""
import common.process.planning_worker
common.process.planning_worker.OVERTIME = 0.1
os.kill(worker._process.pid, signal.SIGSTOP)
print(json.dumps(cancelled(0.0)))
try:
    plan(request("b"), scene, None)
except WorkerDied as error:
    print(json.dumps(str(error)))
""") == [True, "the planning worker has ended"]


def test_closed_worker_leaves_no_process_behind() -> None:
    assert run_script("""
second = PlanningWorker(1)
worker.close()
print(json.dumps([worker._process.exitcode, second._process.exitcode]))
""") == [[-9, None]]


def test_worker_finds_a_planner_on_a_search_path_that_its_parent_added_later(tmp_path: Path) -> None:
    (tmp_path / "of_a_user").mkdir()
    (tmp_path / "of_a_user/planner.py").write_text(
        "from common.planning.planners.joint_move import Options, plan\n", encoding="utf-8")
    assert run_script("""
sys.path.append(sys.argv[1])
cell = load_cell("panda", ["pipeline.planners=[{name: of_a_user.planner}]"])
worker.set_up(cell.robot, cell.motion, cell.pipeline, seed=3)
print(json.dumps(plan(request("a"), scene, None).planner))
""", str(tmp_path)) == ["planner"]
