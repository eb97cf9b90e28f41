"""A policy server with the protocol of openpi's websocket_policy_server.py, and ways to break it."""

import asyncio
import traceback
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import msgpack
import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed


def packed(message: Any) -> bytes:
    """As openpi_client.msgpack_numpy 0.1.2."""
    return msgpack.packb(message, default=lambda value: {
        b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape})


def unpacked(data: bytes) -> Any:
    def array(found: dict) -> Any:
        if b"__ndarray__" in found:
            return np.ndarray(buffer=found[b"data"], dtype=np.dtype(found[b"dtype"]), shape=found[b"shape"])
        return found

    return msgpack.unpackb(data, object_hook=array)


class Server:
    """Answers with `infer`, whose result is sent as it is if it is bytes or text; None: no answer."""

    def __init__(self, infer: Callable[[dict], Any], metadata: Any = b"\x80") -> None:
        self.infer, self.metadata = infer, metadata
        self.seen: list[dict] = []
        self.connections: list[ServerConnection] = []
        self.headers: list[str] = []
        self.address = ""

    async def handle(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        self.headers.append(connection.request.headers.get("Authorization", ""))
        if self.metadata is not None:
            await connection.send(self.metadata)
        while True:
            try:
                self.seen.append(unpacked(await connection.recv()))
                answer = self.infer(self.seen[-1])
                if asyncio.iscoroutine(answer):
                    answer = await answer
                if answer is not None:
                    await connection.send(answer if isinstance(answer, bytes | str) else packed(answer))
            except ConnectionClosed:
                return
            except Exception:
                await connection.send(traceback.format_exc())
                await connection.close(code=1011)
                return


@asynccontextmanager
async def running(server: Server, port: int = 0) -> AsyncIterator[Server]:
    """Serve on a port of localhost inside the block."""
    async with serve(server.handle, "127.0.0.1", port, compression=None, max_size=None, close_timeout=0.1) as listening:
        server.address = f"ws://127.0.0.1:{next(iter(listening.sockets)).getsockname()[1]}"
        yield server
