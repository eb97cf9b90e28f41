"""Episodes of a running cell: a file each and a manifest, also on a full disk and after a kill."""

import asyncio
import sys

import msgpack
import pytest

from cli.main import app
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import load_cell
from common.errors import ConfigError, RequestFailed
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from recording.datasets.manifest import read_manifest
from recording.reader import Recording
from recording.sample import RecordingError
from tests.recording.samples import fill_disk, write
from tools.teleoperation import planner_made
from tools.teleoperation.demonstrating import Demonstrating
from tools.teleoperation.devices import Reading
from tools.teleoperation.episodes import EpisodeFolder, EpisodeRecorder
from tools.teleoperation.planner_made import RunFailed, record_runs


class Pressed:
    """A device whose buttons a test presses."""

    help = ""

    def __init__(self):
        self.actions = ()

    def read(self, now):
        actions, self.actions = self.actions, ()
        return Reading(actions=actions)


class FakeClient:
    """A joined cell without services."""

    owner = "anna"

    def __init__(self, bus):
        self.bus, self.name, self.arm = bus, bus.cell, self

    async def pose(self):
        raise RequestFailed("no transforms")


@pytest.fixture
async def cell():
    network = LocalNetwork()
    buses = [Bus(network.session(), service=name, cell="panda", clock=Clock()) for name in ("teleop", "executor")]
    yield buses
    for bus in buses:
        await bus.close()


def demonstrating(bus, folder, **more):
    lines = []
    device = Pressed()
    recorder = EpisodeRecorder(bus, load_cell("panda"), folder)
    fields = {"episodes": 2, "task": "pick", "seed": 5, "reset": "hand", "say": lines.append, "devices": [device],
              "frame": "base", "speed": 0.2, "show": lambda _: None, **more}
    return Demonstrating(FakeClient(bus), recorder, folder, **fields), device, lines


async def until(condition):
    async with asyncio.timeout(10):
        while not condition():  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.01)


async def test_episodes_are_recorded_until_as_many_were_not_discarded(cell, tmp_path):
    bus, executor = cell
    folder = EpisodeFolder(tmp_path / "demos", "panda")
    session, device, lines = demonstrating(bus, folder)
    writer = executor.writer(topics.SET_POINTS)
    running = asyncio.create_task(session.run())
    for number, end in enumerate(("success", "discard", "failure")):
        device.actions = ("start",)
        await until(lambda: session._recorder.running and not session._requests)
        writer.put(m.SetPoints(header=m.Header(stamp=number + 1), name=["a"], position=[float(number)]))
        await asyncio.sleep(0.05)
        device.actions = (end,)
        await until(lambda: not session._recorder.running and (running.done() or not session._requests))
    await running
    assert [line.split(",")[0].split(":")[0] for line in lines] == [
        "episode 1 of 2", "episode discarded", "episode 2 of 2"]
    found = read_manifest(tmp_path / "demos").episodes
    assert [(each.success, each.task, each.seed) for each in found] == [(True, "pick", 5), (False, "pick", 5)]
    assert len(list((tmp_path / "demos").glob("*.mcap"))) == 2
    for each, position in zip(found, (0.0, 2.0), strict=True):
        with Recording(tmp_path / "demos" / each.file) as recording:
            assert recording.finished and "motion/set_points" in recording.topics()
            samples = [one for one in recording.samples() if one.topic == "motion/set_points"]
            assert len(samples) == 1 and m.SetPoints.model_validate(
                msgpack.unpackb(samples[0].payload)).position == [position]


async def test_full_disk_ends_the_session_with_the_reason_and_keeps_earlier_episodes(cell, tmp_path, monkeypatch):
    bus, executor = cell
    folder = EpisodeFolder(tmp_path / "demos", "panda")
    session, device, _ = demonstrating(bus, folder)
    writer = executor.writer(topics.SET_POINTS)
    running = asyncio.create_task(session.run())
    fill_disk(monkeypatch, 2000)
    device.actions = ("start",)
    with pytest.raises(RecordingError, match="the disk is full; to use what was written: zencell recover"):
        while not running.done():
            names = [f"{number}" * 40 for number in range(9)]
            writer.put(m.SetPoints(header=m.Header(stamp=1), name=names, position=[0.0] * 9))
            await asyncio.sleep(0.01)
        await running
    assert read_manifest(tmp_path / "demos").episodes == []


def test_folder_is_continued_and_a_file_of_a_killed_program_is_not_used_again(tmp_path):
    folder = EpisodeFolder(tmp_path / "demos", "panda")
    first = folder.next_file()
    first.touch()
    folder.add(first, success=True, task="pick", seed=None)
    folder.next_file().touch()  # and then the program is killed
    again = EpisodeFolder(tmp_path / "demos", "panda")
    assert (first.name, again.next_file().name) == ("episode_0000.mcap", "episode_0002.mcap")
    assert again.interrupted() == ["episode_0001.mcap"] and len(again.manifest.episodes) == 1
    with pytest.raises(ConfigError, match="has episodes of the cell panda, not ur5"):
        EpisodeFolder(tmp_path / "demos", "ur5")
    with pytest.raises(ConfigError, match=r"has files, but no episodes\.json"):
        EpisodeFolder(tmp_path, "panda")


def fake_run(code, recorded, output=""):
    """Return a command that acts as `zencell run` with an exit code and the bytes of its recording."""
    script = ("import sys, pathlib; file = sys.argv[sys.argv.index('--record') + 1]\n"
              f"data = {recorded!r}; data and pathlib.Path(file).write_bytes(data)\n"
              f"print({output!r}); sys.exit({code})")
    return [sys.executable, "-c", script]


def test_runs_of_the_task_have_seeds_of_their_own_and_failures_are_marked(tmp_path, monkeypatch):
    folder, lines = EpisodeFolder(tmp_path / "demos", "panda"), []
    complete = write(tmp_path / "run.mcap", []).read_bytes()
    for code in (0, 1):
        monkeypatch.setattr(planner_made, "module_command", lambda _, code=code: fake_run(code, complete, "ended"))
        record_runs("panda", [], folder, episodes=2, task="pick", first_seed=10 * code, say=lines.append,
                    show=lambda _: None)
    assert [(each.success, each.seed) for each in folder.manifest.episodes] == [
        (True, 0), (True, 1), (False, 10), (False, 11)]
    assert lines[3].startswith("episode 2 of 2: seed 11, failure (ended)")
    monkeypatch.setattr(planner_made, "module_command", lambda _: fake_run(2, b"", "zencell: bad"))
    with pytest.raises(RunFailed, match=r"^seed 3: bad$"):
        record_runs("panda", [], folder, episodes=1, task="", first_seed=3, say=lines.append, show=lines.append)
    monkeypatch.setattr(planner_made, "module_command", lambda _: fake_run(0, complete[:-30]))  # the disk is full
    with pytest.raises(RunFailed, match=r"^seed 3: .*episode_0004\.mcap: not finished"):
        record_runs("panda", [], folder, episodes=1, task="", first_seed=3, say=lines.append, show=lines.append)
    assert len(folder.manifest.episodes) == 4 and folder.interrupted() == ["episode_0004.mcap"]


@pytest.mark.parametrize("arguments, error", [
    ("teleop panda", "needs a terminal"), ("teleop panda --with mouse", "choices: keyboard, gamepad, spacemouse"),
    ("teleop panda --speed 2", "must be more than 0 and at most 1"), ("teleop panda --frame x", "choices: base"),
    ("demo record panda --by hand", "choices: operator, task"), ("demo record panda --episodes 0", "1 or more"),
    ("demo record panda --reset x --by task", "choices: home, hand"), ("demo record pandas --by task", "pandas"),
])
def test_bad_options_are_named_in_one_line(arguments, error, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert app.execute(arguments.split()) == 2
    said = capsys.readouterr().err
    assert error in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())
