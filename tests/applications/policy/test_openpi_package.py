"""The package of openpi, from PyPI, understands the messages of the client and the server of the tests."""

import asyncio
import subprocess
import sys

import numpy as np
import pytest

from applications.policy.sources.msgpack_numpy import pack, unpack
from tests.applications.policy.openpi_server import Server, running

CLIENT = """
import sys
import numpy as np
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy
client = WebsocketClientPolicy(sys.argv[1])
assert client.get_server_metadata()["rest"].tolist() == [0, 1, 2]
seen = {"observation/image": np.zeros((4, 5, 3), np.uint8), "observation/state": np.arange(3.0), "prompt": "pick"}
actions = client.infer(seen)["actions"]
assert actions.shape == (2, 3) and actions.dtype == np.float32, actions
sys.stdout.buffer.write(msgpack_numpy.packb(seen))
"""


@pytest.mark.campaign  # downloads a package
async def test_package_of_openpi_understands_the_messages(tmp_path, monkeypatch):
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(tmp_path)]
    run = asyncio.to_thread(subprocess.run, [*pip, "openpi-client==0.1.2"], capture_output=True, text=True, check=False)
    if (loaded := await run).returncode:
        pytest.skip(f"openpi-client could not be installed: {loaded.stderr[-200:]}")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    answer = pack({"actions": np.zeros((2, 3), np.float32), "took": np.float64(1.5)})
    async with running(Server(lambda seen: answer, pack({"rest": np.arange(3)}))) as server:
        client = await asyncio.create_subprocess_exec(
            sys.executable, "-c", CLIENT, server.address, stdout=asyncio.subprocess.PIPE)
        data, _ = await client.communicate()
    assert client.returncode == 0
    assert data == pack(unpack(data)), "the same bytes"
    assert server.seen[0]["prompt"] == "pick" and server.seen[0]["observation/image"].shape == (4, 5, 3)
