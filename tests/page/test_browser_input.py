"""Values that no unmodified browser sends: they are neither stored nor sent to other pages."""

import asyncio
import gc
import math
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import Any

import msgspec
import pytest
import viser
import zstandard
from websockets.asyncio.client import ClientConnection

from page.server import close_server, make_server
from page.viser_inside import element_id
from tests.page.fake_browser import CAMERA
from tests.page.test_server import open_page

PATIENCE = 20.0  # [s]
EXTREMES = (1e308, -1e13, 10**12 + 1, math.inf, math.nan, "1", 400_000 * "1", b"1", None, True, [1.0], {"a": 1})


class Pages:
    """Two open pages: one sends, the other receives."""

    def __init__(self, sender: ClientConnection, receiver: ClientConnection, server: viser.ViserServer) -> None:
        self._sender, self._receiver, self._server = sender, receiver, server

    async def send(self, **message: Any) -> None:
        """Send a message of a browser."""
        await self._sender.send(msgspec.msgpack.encode(message))

    async def set(self, field: Any, value: Any) -> None:
        """Send the value of a field."""
        await self.send(type="GuiUpdateMessage", uuid=element_id(field), updates={"value": value})

    async def received(self) -> list[dict[str, Any]]:
        """Return what the other page receives until everything that was sent before is processed."""
        mark = self._server.gui.add_checkbox("mark", False)
        await self.set(mark, True)
        found: list[dict[str, Any]] = []
        async with asyncio.timeout(PATIENCE):
            while not any(each.get("uuid") == element_id(mark) and "updates" in each for each in found):
                data = await self._receiver.recv()
                assert isinstance(data, bytes)
                size = int.from_bytes(data[8:16], "little")
                found += msgspec.msgpack.decode(zstandard.decompress(data[16:16 + size]))["messages"]
        return found

    async def received_or_closed(self) -> None:
        """Wait until everything that was sent is processed, or until viser has closed the sending page for it."""
        waiting = {asyncio.create_task(self.received()), asyncio.create_task(self._sender.wait_closed())}
        _, pending = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        for task in pending:
            task.cancel()


@asynccontextmanager
async def open_pages(server: viser.ViserServer) -> AsyncIterator[Pages]:
    async with open_page(server) as sender, open_page(server) as receiver:
        for connection in (sender, receiver):
            await connection.send(msgspec.msgpack.encode(CAMERA))
        yield Pages(sender, receiver, server)


@pytest.fixture
def own_server() -> Iterator[viser.ViserServer]:
    server = make_server("127.0.0.1", 0)
    yield server
    close_server(server)


async def test_field_keeps_its_value_when_a_browser_sends_another_type_or_an_unbounded_value(
    own_server: viser.ViserServer,
) -> None:
    gui = own_server.gui
    fields: list[tuple[Any, tuple[Any, ...]]] = [
        (gui.add_number("Integer", 7), EXTREMES), (gui.add_number("Float", 7.5), EXTREMES),
        (gui.add_slider("Slider", 0.0, 10.0, 0.1, 5.0), EXTREMES),
        (gui.add_vector3("Vector", (1.0, 2.0, 3.0)), (
            *EXTREMES, [1.0, 2.0], [1.0, 2.0, 1e308], [1.0, 2.0, "3"], [1.0, 2.0, [3.0]], 1000 * [1.0])),
        (gui.add_text("Text", "a"), (1, None, True, ["b"], 4001 * "x", 400_000 * "x", b"b")),
        (gui.add_checkbox("Checkbox", True), (0, 0.0, "", None, [])),
        (gui.add_dropdown("Dropdown", ["a", "b"]), ("c", 1, None, ["a"], 400_000 * "a")),
    ]
    before = [field.value for field, _ in fields]
    async with open_pages(own_server) as pages:
        await pages.received()
        for field, values in fields:
            for value in values:
                await pages.set(field, value)
            updated = {each["uuid"] for each in await pages.received() if "updates" in each}
            assert element_id(field) not in updated, "other pages receive nothing"
    assert [field.value for field, _ in fields] == before


@pytest.mark.parametrize(("entered", "stored"), [(3.0, 3.0), (3, 3.0), (-1e6, 0.0), (11.0, 10.0)])
async def test_entered_number_is_stored_within_the_limits_of_its_field(
    own_server: viser.ViserServer, entered: float, stored: float
) -> None:
    gui = own_server.gui
    fields = gui.add_slider("Slider", 0.0, 10.0, 0.1, 5.0), gui.add_number("Number", 5.0, min=0.0, max=10.0)
    async with open_pages(own_server) as pages:
        for field in fields:
            await pages.set(field, entered)
        await pages.received()
    assert [field.value for field in fields] == [stored, stored]


async def test_uploads_and_messages_for_other_pages_are_dropped(own_server: viser.ViserServer) -> None:
    field = element_id(own_server.gui.add_text("Text", ""))
    async with open_pages(own_server) as pages:
        for number in range(3):
            await pages.send(type="FileTransferStartUpload", source_component_uuid=field, transfer_uuid=f"{number}",
                             filename="a", mime_type="b", part_count=2, size_bytes=2_000_000)
            await pages.send(type="FileTransferPart", source_component_uuid=field, transfer_uuid=f"{number}",
                             part_index=0, content=bytes(1_000_000))
            await pages.send(type="GuiFormDirtyMessage", uuid=f"{number}" + 100_000 * "x")
        types = {each["type"] for each in await pages.received()}
    assert not types & {"FileTransferPartAck", "GuiFormDirtyMessage"}
    assert own_server.gui._current_file_upload_states == {}


@pytest.mark.parametrize("invalid", [
    {"wxyz": [0.0, 0.0, 0.0, 0.0]}, {"wxyz": [math.nan, 0.0, 0.0, 0.0]}, {"fov": 0.0}, {"fov": math.nan},
    {"position": [1e308, 0.0, 0.0]}, {"position": [1.0, 2.0]}, {"position": "abc"}, {"image_height": 10**18},
    {"look_at": [1.0, "a", 2.0]}, {"up_direction": 100_000 * [1.0]},
])
@pytest.mark.filterwarnings("ignore:.*does not match annotation:UserWarning")
async def test_invalid_camera_is_not_stored(own_server: viser.ViserServer, invalid: dict[str, Any]) -> None:
    async with open_pages(own_server) as pages:
        await pages.received()
        await pages.send(**CAMERA | invalid)
        await pages.received_or_closed()
        for client in own_server.get_clients().values():
            camera = client.camera
            assert [*camera.position] == CAMERA["position"] and [*camera.wxyz] == CAMERA["wxyz"]
            assert (camera.fov, camera.image_height) == (CAMERA["fov"], CAMERA["image_height"])
            assert [*camera.look_at] == CAMERA["look_at"] and [*camera.up_direction] == CAMERA["up_direction"]


async def test_pose_of_a_gizmo_is_bounded(own_server: viser.ViserServer) -> None:
    gizmo = own_server.scene.add_transform_controls("/gizmo")
    async with open_pages(own_server) as pages:
        await pages.received()
        for change in ({"position": [math.nan, 0.0, 0.0]}, {"position": [1e308, 0.0, 0.0]},
                       {"wxyz": [0.0, 0.0, 0.0, 0.0]}, {"name": 400_000 * "x"}):
            await pages.send(type="TransformControlsUpdateMessage", **{
                "name": "/gizmo", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, 0.0, 0.0], "owner": "", **change})
        types = {each["type"] for each in await pages.received()}
        assert not types & {"SetPositionMessage", "SetOrientationMessage"}
        assert [*gizmo.position] == [0.0, 0.0, 0.0] and [*gizmo.wxyz] == [1.0, 0.0, 0.0, 0.0]
        await pages.send(type="TransformControlsUpdateMessage", name="/gizmo", owner="", wxyz=[1.0, 0.0, 0.0, 0.0],
                         position=[0.5, 0.0, 0.0])
        await pages.received()
        assert [*gizmo.position] == [0.5, 0.0, 0.0], "a valid pose is stored"


async def test_list_in_place_of_a_name_raises_nothing(
    own_server: viser.ViserServer, caplog: pytest.LogCaptureFixture
) -> None:
    async with open_pages(own_server) as pages:
        for fields in ({"type": "GuiUpdateMessage", "updates": {"value": 1}}, {"type": "CommandTriggerMessage"}):
            await pages.send(uuid=[1.0], **fields)
        await pages.received()
    gc.collect()  # reports exceptions of tasks
    assert not caplog.records
