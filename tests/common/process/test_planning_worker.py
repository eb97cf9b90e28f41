"""Planning workers, each forked by a fresh program without other threads."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[3]

SETUP = """
import asyncio, json, multiprocessing, os, signal, sys
from common.config import load_cell
from common.messages import CollisionObject, Header, JointGoal, PlanningScene, PlanRequest, Pose, Vector3
from common.process import planning_worker
from common.process.planning_worker import PlanningWorker, WorkerDied
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel

cell = load_cell("panda", ["pipeline.planners=[{name: ompl, options: {algorithm: AORRTC, improving_time: 60}}]"]
                 if "long" in sys.argv else [])
setup = cell.robot, cell.motion, cell.pipeline
worker, second = PlanningWorker(1), PlanningWorker(1)
for each in (worker, second):
    each.set_up(*setup, seed=3)
wall = CollisionObject(id="wall", role="fixture", shape="box", dimensions=[0.3, 0.02, 0.4],
                       pose=Pose(position=Vector3(x=0.55, z=0.2)))
scene = PlanningScene(header=Header(frame_id="world"), objects=[wall])
down = RobotModel.load(cell.robot).named("home") + [0.0, 0.5, 0, 0.1, 0, 0, 0]
left, right = [0.6, *down.tolist()[1:]], [-0.6, *down.tolist()[1:]]

runner = asyncio.Runner()

def show(value):
    print(json.dumps(value), flush=True)

def request(id, seconds=20.0):
    return PlanRequest(id=id, start=left, goal=JointGoal(positions=right), planning_time=seconds)

def plan(*arguments, by=worker):
    return runner.run(by.plan(*arguments))

def failure(*arguments, by=worker):
    try:
        plan(*arguments, by=by)
    except WorkerDied as error:
        return [str(error), by._process.exitcode]

def cancelled(after, by=worker):
    async def cancel_plan():
        task = asyncio.create_task(by.plan(request("a", 300.0), scene, None))
        await asyncio.sleep(after)
        task.cancel()
        await asyncio.wait({task})
        return task.cancelled()
    return runner.run(cancel_plan())
"""
DIED = ["the planning worker has ended", -9]


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
    show([[p.positions for p in each.trajectory.points] for each in answers])
""")
    assert by_worker == by_pipeline
    assert isinstance(by_worker, list) and by_worker[0] != by_worker[2]


def test_cancelled_worker_plans_the_next_request() -> None:
    loading, planning, answer = run_script("""
show(cancelled(0.0))
show(cancelled(1.0))
free = PlanningScene(header=Header(frame_id="world"))  # planned at once, also on a busy machine
show(plan(request("b", 1.0), free, None).ok)
""", "long")
    assert loading and planning and answer, "a worker that ignores the cancellation would be killed"


def test_worker_that_was_killed_or_stopped_is_reported_and_ended_and_no_other_is() -> None:
    killed, large, cancelled, reported, closed = run_script("""
planning_worker.OVERTIME = 0.1
third, fourth, last = PlanningWorker(1), PlanningWorker(1), PlanningWorker(1)
os.kill(worker._process.pid, signal.SIGKILL)
show(failure(request("a"), scene, None))
os.kill(second._process.pid, signal.SIGSTOP)
does_not_fit_into_the_pipe = {"header": Header.model_construct(frame_id="x" * 10_000_000)}
show(failure(request("a", 0.1), scene.model_copy(update=does_not_fit_into_the_pipe), None, by=second))
os.kill(third._process.pid, signal.SIGSTOP)
show(cancelled(0.0, by=third))
show(failure(request("b"), scene, None, by=third))
fourth.close()
show([fourth._process.exitcode, last._process.exitcode])
""")
    assert killed == large == reported == DIED
    assert cancelled is True
    assert closed == [-9, None]


def test_all_workers_end_when_their_parent_exits_also_planning_and_stopped_ones() -> None:
    pids = run_script("""
for process in multiprocessing.active_children():
    show(process.pid)
    while os.getpriority(os.PRIO_PROCESS, process.pid) == os.getpriority(os.PRIO_PROCESS, 0):
        pass  # it has just been forked
os.kill(second._process.pid, signal.SIGSTOP)
async def leave():
    planning = asyncio.create_task(worker.plan(request("a", 300.0), scene, None))
    await asyncio.sleep(0.5)
    os._exit(0)
runner.run(leave())
""", "long")
    assert len(pids) == 2
    for pid in pids:
        assert isinstance(pid, int)
        with contextlib.suppress(psutil.NoSuchProcess):
            psutil.Process(pid).wait(20)


def test_worker_finds_a_planner_on_a_search_path_that_its_parent_added_later(tmp_path: Path) -> None:
    (tmp_path / "of_a_user").mkdir()
    (tmp_path / "of_a_user/planner.py").write_text(
        "from common.planning.planners.joint_move import Options, plan\n", encoding="utf-8")
    assert run_script("""
sys.path.append(sys.argv[1])
cell = load_cell("panda", ["pipeline.planners=[{name: of_a_user.planner}]"])
worker.set_up(cell.robot, cell.motion, cell.pipeline, seed=3)
show(plan(request("a"), scene, None).planner)
""", str(tmp_path)) == ["planner"]
