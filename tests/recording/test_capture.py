"""Recording of cells with renamed keys or custom messages."""

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
from recording.capture import Capture, CustomTopics, Sink
from recording.reader import Recording
from recording.sample import Sample, schema_of
from recording.selection import Selection
from recording.writer import SplitWriter

TWO_CAMERAS = str(Path(__file__).parents[1] / "data" / "two_cameras.yaml")


def bus_of(network: LocalNetwork, name: str, renamed: dict[str, str] | None = None) -> Bus:
    return Bus(network.session(), service=name, cell="cell", clock=Clock(), topics=renamed)


@pytest.mark.parametrize("cell_is_known", [False, True])
async def test_renamed_state_is_recorded_as_a_state(cell_is_known):
    """Where the cell is unknown, the kind is known once its service is ready."""
    own = CustomTopics.of(load_cell(TWO_CAMERAS)) if cell_is_known else None
    assert own is None or (CustomTopics.read(str(own)) == own and not own.modules)
    network, kind = LocalNetwork(), asyncio.get_running_loop().create_future()

    class KindSink:
        def offer(self, sample: Sample) -> None:
            if sample.topic == "left/camera/camera_info" and not kind.done():
                kind.set_result(sample.kind)

    recorder, camera = bus_of(network, "recorder"), bus_of(network, "left_camera", {"camera/*": "left/camera/*"})
    capture = Capture(recorder, Selection.of(), KindSink(), own)
    await capture.start()
    infos = camera.writer(topics.CAMERA_INFO)
    if not cell_is_known:
        await camera.ready()
    infos.put(m.CameraInfo(header=m.Header(), height=1, width=1, d=[0.0] * 5, k=[1.0] * 9))
    assert await asyncio.wait_for(kind, 10) == "state"
    capture.stop()
    for bus in (camera, recorder):
        await bus.close()


def test_custom_modules_define_messages_and_kinds(tmp_path, monkeypatch):
    (tmp_path / "brought").mkdir()
    (tmp_path / "brought" / "polishing.py").write_text(
        "from common import messages as m\nfrom common.topics import Topic\n"
        "class Shine(m.Message):\n    header: m.Header = m.Header()\n    gloss: float = 0.0\n"
        "STATUS = Topic('shine', m.TaskStatus, 'state', 'how far it is')\n"
        "SHINE = Topic('gloss', Shine, 'event', 'how it shines')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    own = CustomTopics(("brought.polishing", "brought.missing"), ({"gloss": "left/gloss"},))
    assert not schema_of("Shine")
    kinds = own.kinds(own.topics())
    assert (kinds["shine"], kinds["left/gloss"], kinds["joint_states"]) == ("state", "event", "stream")
    assert json.loads(schema_of("Shine"))["properties"]["gloss"]["type"] == "number"


@pytest.mark.parametrize("invalid", [{"speed": 1e12}, {"world": "w" * 4000}, {"overrides": ["o=" + "o" * 2000]}])
async def test_run_is_described_by_the_first_valid_status_of_a_supervisor(invalid, tmp_path):
    sink = Sink(SplitWriter(tmp_path / "a.mcap", {"cell": "cell"}))
    capture = Capture(bus_of(LocalNetwork(), "recorder"), Selection.of(), sink)
    for values in (invalid, {"speed": 2.0}):
        status = m.SupervisorStatus.model_validate({"cell": "cell", "services": [], **values})
        capture.on_sample(RawSample("cell/supervisor/status", encode(status)))
    sink.close({"reason": "test"})
    with Recording(tmp_path / "a.mcap") as recording:
        assert recording.run.speed == 2.0


async def test_stream_that_has_ceased_is_named(tmp_path, monkeypatch):
    network = LocalNetwork()
    recorder, camera = bus_of(network, "recorder"), bus_of(network, "camera")
    sink = Sink(SplitWriter(tmp_path / "a.mcap", {"cell": "cell"}))
    capture = Capture(recorder, Selection.of(), sink)
    await capture.start()
    now = [0]
    monkeypatch.setattr(capture, "_now_ns", lambda: now[0])
    joints = camera.writer(topics.JOINT_STATES)
    for _ in range(12):
        joints.put(m.JointState(header=m.Header(), name=[], position=[]))
    await asyncio.sleep(0)
    assert capture.silent() == {}
    now[0] = 7_000_000_000
    assert capture.silent() == {"joint_states": 7.0}
    capture.stop()
    sink.close({"reason": "test"})
    for bus in (camera, recorder):
        await bus.close()
