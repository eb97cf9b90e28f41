"""What a recorder takes of a cell whose services have keys under names of their own, or messages of a person's own."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from common import messages as m
from common import topics
from common.clock import Clock
from common.config import load_cell
from common.transport.bus import Bus
from common.transport.codec import encode
from common.transport.local import LocalNetwork
from common.transport.session import RawSample
from recording.capture import Capture, CustomTopics
from recording.reader import Recording
from recording.sample import Sample, schema_of
from recording.selection import Selection
from recording.sink import Sink
from recording.writer import SplitWriter

TWO_CAMERAS = str(Path(__file__).parents[1] / "data" / "two_cameras.yaml")
RENAMED = {"camera/*": "left/camera/*"}
INFO = m.CameraInfo(header=m.Header(), height=1, width=1, d=[0.0] * 5, k=[1.0] * 9)


class Kept:
    """A sink that knows what the renamed state was taken for."""

    def __init__(self) -> None:
        self.kind: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def offer(self, sample: Sample) -> None:
        """Take note of the first that was waited for."""
        if sample.topic == "left/camera/camera_info" and not self.kind.done():
            self.kind.set_result(sample.kind)


def bus_of(network: LocalNetwork, name: str, renamed: dict[str, str] | None = None) -> Bus:
    """The place of a service in a cell."""
    return Bus(network.session(), service=name, cell="cell", clock=Clock(), topics=renamed)


async def kind_of(network: LocalNetwork, own: CustomTopics | None, *, ready_first: bool) -> str:
    """What a renamed state, first written after the recorder began, is recorded as."""
    kept, recorder = Kept(), bus_of(network, "recorder")
    capture = Capture(recorder, Selection.of(), kept, own)  # type: ignore[arg-type]
    await capture.start()
    camera = bus_of(network, "left_camera", RENAMED)
    infos = camera.writer(topics.CAMERA_INFO)
    if ready_first:
        await camera.ready()
    infos.put(INFO)
    async with asyncio.timeout(10):
        found = await kept.kind
    capture.stop()
    for bus in (camera, recorder):
        await bus.close()
    return found


async def test_a_state_under_another_name_that_begins_later_is_recorded_as_a_state() -> None:
    assert await kind_of(LocalNetwork(), None, ready_first=True) == "state"


async def test_where_the_cell_is_known_a_renamed_state_is_one_before_its_service_is_ready() -> None:
    own = CustomTopics.of(load_cell(TWO_CAMERAS))
    assert CustomTopics.read(str(own)) == own and not own.modules
    assert await kind_of(LocalNetwork(), own, ready_first=False) == "state"


def test_modules_of_a_persons_own_bring_their_messages_and_kinds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "brought").mkdir()
    (tmp_path / "brought" / "polishing.py").write_text(
        "from common import messages as m\nfrom common.topics import Topic\n"
        "class Shine(m.Message):\n    header: m.Header = m.Header()\n    gloss: float = 0.0\n"
        "STATUS = Topic('shine', m.TaskStatus, 'state', 'how far it is')\n"
        "SHINE = Topic('gloss', Shine, 'event', 'how it shines')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    own = CustomTopics(("brought.polishing", "brought.missing"), ({"gloss": "left/gloss"},))
    assert not schema_of("Shine")
    kinds = own.kinds(own.topics())
    assert (kinds["shine"], kinds["left/gloss"], kinds["joint_states"]) == ("state", "event", "stream")
    assert json.loads(schema_of("Shine"))["properties"]["gloss"]["type"] == "number"


@pytest.mark.parametrize("told", [{"speed": 1e12}, {"world": "w" * 4000}, {"overrides": ["o=" + "o" * 2000]}])
async def test_run_is_that_of_a_supervisor_that_there_can_be(told: dict[str, object], tmp_path: Path) -> None:
    sink = Sink(SplitWriter(tmp_path / "a.mcap", {"cell": "cell"}))
    capture = Capture(bus_of(LocalNetwork(), "recorder"), Selection.of(), sink)
    for said in (told, {"speed": 2.0}):
        status = m.SupervisorStatus.model_validate({"cell": "cell", "services": [], **said})
        capture.on_sample(RawSample("cell/supervisor/status", encode(status)))
    sink.close({"reason": "test"})
    with Recording(tmp_path / "a.mcap") as recording:
        assert recording.run.speed == 2.0
