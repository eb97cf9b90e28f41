"""Whether motions continue after hold-ups: the speed slider of the arm, freezes of its driver or of the executor.

Run as `python -m benchmarks.held_up slider|stop|freeze|grid [--backend ur|mock|lag] [--count N]`. The arm of
Universal Robots is the double of the tests; set-points are sent by an executor in this process, every 10 ms.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from common.config import load_cell
from common.control.executor import Executor
from common.errors import Refused
from common.hardware.backends import load_hardware
from common.hardware.interface import Hardware, Limits
from common.messages import ExecuteRequest, Header, HoldRequest, JogCommand, MotionStatus, StopRequest
from common.robot.model import RobotModel
from tests.common.control.trajectories import rest_to_rest
from tests.doubles.ur_host import UrHost

HOST, PERIOD = f"127.0.1.{os.getpid() % 250 + 1}", 0.01
SEQUENCES = ("1 0 1", "1 0.02 1", "1 0.3 1")
FREEZES = (0.025, 0.04, 0.06, 0.25)  # [s]; the last one is too long


class Rig:
    """An executor and its arm; `ahead` and `speed` as in the cells."""

    def __init__(self, backend: str, ahead: float, host: UrHost | None) -> None:
        config = load_cell("ur5").robot
        robot = RobotModel.load(config)
        real = backend not in ("mock", "lag")
        options = {"host": HOST, "model": "ur5e", "world": "simulated", "ahead": ahead} if real else {}
        config = config.model_copy(update={"hardware": config.hardware.model_copy(
            update={"backend": backend, "options": options}), "gripper": None})
        self.limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
                             np.array(config.deceleration_limits), robot.jerk)
        self.start = np.array([0, -1.9, 1.9, -1.6, -1.57, 0.0])
        self.hardware: Hardware = load_hardware(config, self.limits, self.start)
        self.executor = Executor(self.hardware, self.limits, self.start, kinematics=robot)
        self.host, self.goals, self.notes = host, 0, list[str]()
        self.jogs: tuple[str, float] | None = None
        self.due, self.gap = time.monotonic(), 0.0

    def cycle(self) -> MotionStatus:
        """Do one cycle, and wait for the next."""
        if self.jogs is not None:
            with contextlib.suppress(Refused):
                self.executor.jog(JogCommand(owner="ann", joints={self.jogs[0]: self.jogs[1]}))
        report = self.executor.cycle(Header(stamp=time.time_ns()))
        self.notes += [note for note in report.notes if "continues" not in note]
        if report.joints:
            self.q = np.array(report.joints.position[:6])
            self.dq = np.array(report.joints.velocity[:6])
        self.gap = max(self.gap, time.monotonic() - self.due)
        self.due = max(self.due + PERIOD, time.monotonic())
        time.sleep(max(self.due - time.monotonic(), 0))
        return self.executor.arm.status

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Run cycles for so long, or until a condition holds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            self.cycle()

    def settle(self) -> None:
        """Wait until the arm can be moved, at rest."""
        end = time.monotonic() + 30
        since = time.monotonic()
        while time.monotonic() - since < 0.4:
            self.cycle()
            if self.executor.arm.reports.fault or not self.executor.arm.at_rest or np.abs(self.dq).max() > 1e-3:
                since = time.monotonic()
            if time.monotonic() > end:
                raise TimeoutError(self.executor.arm.reports.fault)

    def move(self, joints: np.ndarray, speed: float) -> str:
        """Start a motion by these angles [rad]; return its id."""
        self.goals += 1
        q = self.executor.arm.set_point
        duration = max(1.875 * np.abs(joints).max() / speed, 0.3)
        path = rest_to_rest(q, q + joints, duration, 41, self.limits.names)
        status = self.executor.execute(ExecuteRequest(id=f"goal{self.goals}", trajectory=path), time.time())
        assert status.state == "active", status
        return f"goal{self.goals}"

    def slider(self, share: str) -> None:
        """Set the slider of the arm."""
        assert self.host is not None
        self.host.command(f"slider {share}")

    def recover(self) -> None:
        """Have the arm recover, if it was stopped, and wait until it can move."""
        if self.executor.robot.mode == "protective_stop":
            number = self.hardware.order("recover")  # type: ignore[attr-defined]
            self.run(5, lambda: self.hardware.outcome(number) is not None)  # type: ignore[attr-defined]
        self.run(5, lambda: self.executor.robot.mode == "running")


def outcome(rig: Rig, good: bool, why: Counter[str]) -> int:
    """Return 1 for a motion that continued; else note why it did not."""
    status = rig.executor.arm.status
    if good:
        return 1
    why[f"{status.state}, longest cycle {1e3 * rig.gap:.0f} ms late: {status.message} {rig.notes}"] += 1
    return 0


def report(what: str, good: int, count: int, why: Counter[str], rig: Rig) -> None:
    """Print a line, and the most frequent reasons of failures."""
    resumed = rig.executor.arm.gaps.resumed
    print(f"{what}: {good} of {count} go on (interrupted and resumed so far: {resumed})", flush=True)
    for reason, number in why.most_common(4):
        print(f"    {number}: {reason}", flush=True)


def start(rig: Rig, kind: str, speed: float) -> None:
    """Start a motion or a jog, and wait until it is under way."""
    rig.settle()
    rig.notes.clear()
    rig.gap, sign = 0.0, -1 if rig.q[0] > 0 else 1
    if kind == "motion":
        rig.move(sign * np.array([0.6, 0.2, -0.2, 0.1, 0, 0]), speed)
    else:
        rig.jogs = ("shoulder_pan_joint", sign * speed)
    rig.run(0.9 if speed < 0.5 else 0.6)


def sliders(rig: Rig, count: int, speed: float, wait: float) -> None:
    """Move the slider in motions and jogs."""
    assert rig.host is not None
    for kind in ("motion", "jog"):
        for sequence in SEQUENCES:
            good, why = 0, Counter[str]()
            for _ in range(count):
                stops = rig.host.command()["stops"]
                start(rig, kind, speed)
                for share in sequence.split()[1:]:
                    rig.slider(share)
                    rig.run(wait)
                rig.jogs = None
                rig.run(60, lambda: rig.executor.arm.status.state != "active")
                rig.run(0.5)
                stopped = rig.host.command()["stops"] - stops
                rig.notes += ["PROTECTIVE STOP"] * stopped
                done = kind == "jog" or rig.executor.arm.status.state == "succeeded"
                good += outcome(rig, not rig.notes and done, why)
                rig.slider("1")
                rig.recover()
            report(f"{kind} {sequence}", good, count, why, rig)


def stops(rig: Rig, count: int, speed: float) -> None:
    """STOP while the slider is low: the arm comes to rest, and stays there when the slider is raised."""
    for share in ("1", "0.3", "0.02", "0"):
        times, after, states = list[float](), list[float](), Counter[str]()
        for _ in range(count):
            start(rig, "motion", speed)
            rig.slider(share)
            rig.run(0.6)
            began = time.monotonic()
            rig.executor.authority.stop(StopRequest(owner="ann"), time.time())
            rig.run(20, lambda: rig.executor.arm.status.state != "active")
            states[rig.executor.arm.status.state] += 1
            times.append(time.monotonic() - began)
            where = rig.q.copy()
            rig.run(0.3)
            rig.slider("1")
            rig.run(1.0)
            after.append(float(np.abs(rig.q - where).max()))
            rig.executor.authority.hold(HoldRequest(
                hold=False, owner="ann", stops=True, acknowledged=time.time_ns()), time.time())
            rig.recover()
        print(f"STOP at {share}: {dict(states)} after {max(times):.2f} s, then moves {max(after):.4f} rad", flush=True)


def freeze(process: int, seconds: float) -> int:
    """Freeze a process for so long; return the id of the one that lets it go on."""
    code = f"kill -STOP {process}; sleep {seconds}; kill -CONT {process}"
    return os.posix_spawn("/bin/sh", ["sh", "-c", code], os.environ)


def freezes(rig: Rig, count: int, speed: float) -> None:
    """Freeze the driver, or this process, in motions and jogs."""
    drivers = [child.pid for child in multiprocessing.active_children() if child.is_alive()]
    for what, process in [*(("driver", pid) for pid in drivers), ("executor", os.getpid())]:
        for kind in ("motion", "jog"):
            for seconds in FREEZES:
                good, why = 0, Counter[str]()
                for _ in range(count):
                    start(rig, kind, speed)
                    helper = freeze(process or 0, seconds)
                    rig.run(0.8)
                    if kind == "motion":
                        rig.run(60, lambda: rig.executor.arm.status.state != "active")
                    done = rig.executor.arm.status.state == "succeeded"
                    if kind == "jog":
                        done = np.abs(rig.dq).max() > 0.5 * speed
                    rig.jogs = None
                    os.waitpid(helper, 0)
                    rig.run(0.3)
                    good += outcome(rig, not rig.notes and bool(done), why)
                    rig.recover()
                report(f"{what} frozen for {1e3 * seconds:.0f} ms in a {kind}", good, count, why, rig)


def differences(times: np.ndarray, q: np.ndarray, limits: Limits) -> np.ndarray:
    """Return accelerations relative to the limit, of the joint closest to it."""
    v = np.diff(q, axis=0) / np.diff(times)[:, None]
    between = (times[2:] - times[:-2]) / 2
    return np.asarray((np.abs(np.diff(v, axis=0) / between[:, None]) / limits.acceleration).max(axis=1))


def grid(rig: Rig, count: int, speed: float) -> None:
    """Accelerations of set-points in motions: as the controller reads them each 2 ms, and by the times they arrived."""
    assert rig.host is not None
    for n in range(count):
        rig.host.command("targets")
        rig.settle()
        rig.host.command("forget")
        rig.move((-1) ** n * np.array([0.6, 0.2, -0.2, 0.1, 0, 0]), speed)
        rig.run(60, lambda: rig.executor.arm.status.state != "active")
        state = rig.host.command("targets")
        q, arrivals = np.array(state["targets"]), np.array(state["arrivals"])
        read = differences(np.arange(len(q)) * 0.002, q, rig.limits)
        even = np.arange(arrivals[0, 0], arrivals[-1, 0], 0.02)
        by_arrival = np.array([np.interp(even, arrivals[:, 0], joint) for joint in arrivals.T[1:]]).T
        true = differences(even, by_arrival, rig.limits)
        print(f"read each 2 ms: {100 * np.mean(read > 1.1):.2f} % of cycles above the limit, largest {read.max():.1f}; "
              f"by arrival over 20 ms: largest {true.max():.2f}; {rig.executor.arm.status.state}, "
              f"{rig.executor.arm.gaps.resumed} interruptions", flush=True)


def main() -> None:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("slider", "stop", "freeze", "grid"))
    parser.add_argument("--backend", default="ur", help="ur, mock, lag or a dotted module")
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--ahead", type=float, default=0.05)
    parser.add_argument("--speed", type=float, default=0.3, help="of the fastest joint [rad/s]")
    parser.add_argument("--wait", type=float, default=1.5, help="at each position of the slider [s]")
    parser.add_argument("--priority", action="store_true", help="real-time priority for executor and double")
    args = parser.parse_args()
    with contextlib.ExitStack() as stack:
        host = None
        if args.backend not in ("mock", "lag"):
            host = stack.enter_context(UrHost(HOST, q="0,-1.9,1.9,-1.6,-1.57,0"))
        if args.priority:  # as on a host that is not busy
            for process in (os.getpid(), *([host._process.pid] if host else [])):
                os.sched_setscheduler(process, os.SCHED_FIFO, os.sched_param(10))
        rig = Rig(args.backend, args.ahead, host)
        stack.callback(rig.executor.close)
        rig.run(20, lambda: rig.executor.robot.mode == "running")
        if args.what == "slider":
            sliders(rig, args.count, args.speed, args.wait)
        elif args.what == "grid":
            grid(rig, args.count, args.speed)
        elif args.what == "stop":
            stops(rig, args.count, args.speed)
        else:
            freezes(rig, args.count, args.speed)


if __name__ == "__main__":
    main()
