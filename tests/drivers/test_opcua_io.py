"""The OPC UA backend against the server of the same package."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from common.config import Io, check
from common.errors import ConfigError, Refused
from common.hardware.signals import IoLost, Unreadable, load_io
from tests.domains import free_port

pytest.importorskip("asyncua")
from asyncua import Server, ua

SIGNALS: dict[str, Any] = {
    "closed": {"input": "ns=2;s=closed"}, "count": {"input": "ns=2;s=count"}, "gone": {"input": "ns=2;s=gone"},
    "name": {"input": "ns=2;s=name"}, "clamp": {"output": "ns=2;s=clamp"}, "locked": {"output": "ns=2;s=locked"},
    "pressure": {"input": "ns=2;s=pressure", "range": [0, 10]}, "valve": {"output": "ns=2;s=valve", "range": [0, 9]},
}
VALUES = {"closed": True, "count": 0, "name": "text", "clamp": False, "locked": False, "pressure": 4.25, "valve": 2}


async def server(port: int) -> tuple[Server, dict[str, Any]]:
    """Return a server that is not started, and its nodes by name; takes seconds."""
    made = Server()
    await made.init()
    made.set_endpoint(f"opc.tcp://127.0.0.1:{port}/cell")
    made.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    index = await made.register_namespace("urn:cell")
    assert index == 2
    nodes = {}
    for name, value in VALUES.items():
        kind = ua.VariantType.UInt16 if name == "valve" else None
        nodes[name] = await made.nodes.objects.add_variable(ua.NodeId(name, index), name, value, varianttype=kind)
        if name in ("clamp", "valve"):
            await nodes[name].set_writable()
    return made, nodes


def connection(port: int) -> Any:
    options = {"url": f"opc.tcp://127.0.0.1:{port}/cell"}
    return load_io(check(Io, {"backend": "opcua", "signals": SIGNALS, "options": options}, "io"), lambda: 0.0)


async def test_nodes_are_read_and_written_in_their_own_type_and_a_lost_server_is_reported() -> None:
    port = free_port()
    made, nodes = await server(port)
    io = connection(port)
    with pytest.raises(IoLost, match=rf"opc.tcp://127.0.0.1:{port}/cell: "):
        await io.connect()
    await io.close()
    await made.start()
    await io.connect()
    found = await io.read()
    assert found.pop("gone") == Unreadable("ns=2;s=gone: BadNodeIdUnknown")
    assert found.pop("name") == Unreadable("ns=2;s=name holds str, not a number or boolean")
    assert found == {"closed": True, "count": False, "clamp": False, "locked": False, "pressure": 4.25, "valve": 2.0}
    await io.write("clamp", True)
    await io.write("valve", 7.0)
    assert (await nodes["clamp"].read_value(), await nodes["valve"].read_value()) == (True, 7)
    assert ((await io.read())["clamp"], (await io.read())["valve"]) == (True, 7.0)
    with pytest.raises(Refused, match="locked: "):
        await io.write("locked", True)
    await made.bserver.stop()  # the listening socket and all connections
    with pytest.raises(IoLost):
        for _ in range(20):
            await asyncio.sleep(0.05)
            await io.read()
    await io.close()
    await made.bserver.start()
    await io.connect()
    assert (await io.read())["clamp"] is True
    await io.close()
    await made.stop()


@pytest.mark.parametrize(("signal", "options", "words"), [
    ({"input": 3}, {"url": "opc.tcp://h"}, "io.signals.s.input: 3 must be the id of a node, such as ns=2;s=Clamp"),
    ({"output": "clamp"}, {"url": "opc.tcp://h"}, "'clamp' must be the id of a node"),
    ({"input": "i=1"}, {"url": "http://h"}, "io.options.url: 'http://h'"),
])
def test_bad_channels_and_options(signal: dict[str, Any], options: dict[str, Any], words: str) -> None:
    section = check(Io, {"backend": "opcua", "signals": {"s": signal}, "options": options}, "io")
    with pytest.raises(ConfigError) as error:
        load_io(section, lambda: 0.0)
    assert words in str(error.value)
