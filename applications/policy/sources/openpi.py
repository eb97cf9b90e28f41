"""A policy on a server of openpi: https://github.com/Physical-Intelligence/openpi, docs/remote_inference.md.

Protocol of `openpi_client.websocket_client_policy` 0.1.2: over one WebSocket the server sends its metadata first; then
each observation, a map of arrays and texts, is answered by a map with `actions` (n, columns), or by a text with the
traceback of its failure. Answers carry no number: after a time limit the connection is closed, so that a late answer is
never taken for that of a newer observation.
"""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidURI, WebSocketException
from websockets.uri import parse_uri

from applications.policy.interface import Chunk, Observation, PolicyFailed
from applications.policy.sources.actions import chunk_of, gripper_value, one_line
from applications.policy.sources.msgpack_numpy import MAX_BYTES, WrongMessage, pack, unpack
from applications.policy.sources.settings import PolicyCell, SourceConfig
from applications.policy.sources.state import state_vector
from common import time_source
from common.errors import ConfigError

RETRY = 0.2  # [s] between attempts to connect
_CLOSING = 0.5  # [s] for a server to confirm the end


class OpenpiPolicy:
    """Client of a server of openpi; connects when needed, and reconnects after each failure."""

    def __init__(self, config: SourceConfig, cell: PolicyCell) -> None:
        """Prepare; the server need not run yet.

        Raises:
            ConfigError: the address is no ws://host:port, or `keys.images` names a camera that there is not.
        """
        self._address, self._timeout = config.openpi, config.timeout
        self._keys, self._form, self._cell = config.keys, config.actions, cell
        try:
            parse_uri(self._address)
        except (InvalidURI, ValueError):
            raise ConfigError("source.openpi", self._address, "must be ws://host:port") from None
        for camera in self._keys.images:
            if camera not in cell.cameras:
                raise ConfigError("source.keys.images", camera, f"is no camera of the observation; choices: "
                                                                f"{', '.join(cell.cameras) or 'none'}")
        self._images = self._keys.images or _image_keys(list(cell.cameras))
        self._connection: ClientConnection | None = None
        self._lock = asyncio.Lock()

    async def infer(self, observation: Observation) -> Chunk:
        """Return the next actions; see `PolicySource`."""
        message = pack(self._message(observation))
        async with self._lock:
            awaited, complete = "connection", False
            try:
                async with asyncio.timeout(self._timeout):
                    if self._connection is None:
                        self._connection = await self._connect()
                    await self._require_silence(self._connection)
                    awaited = "answer"
                    await self._connection.send(message)
                    answer = self._decoded(await self._connection.recv())
                complete = True
            except TimeoutError:
                raise self._failure(f"no {awaited} within {self._timeout:g} s") from None
            except (OSError, WebSocketException) as error:
                raise self._failure(f"the connection ended: {one_line(error)}") from None
            finally:
                if not complete:
                    self._abort()
        if "actions" not in answer:
            raise self._failure(f"the answer has no actions, but {_names(answer)}")
        return chunk_of(answer["actions"], observation, self._form, self._cell)

    async def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            try:
                async with asyncio.timeout(_CLOSING):
                    await self._connection.close()
            except TimeoutError:
                pass
            finally:
                self._abort()

    async def _connect(self) -> ClientConnection:
        """Return a connection whose server has sent its metadata; tries again while there is no server."""
        headers = {"Authorization": f"Api-Key {self._keys.api_key}"} if self._keys.api_key else None
        until = time_source.monotonic() + self._timeout - RETRY
        while True:
            try:
                # The server cannot answer pings while it computes: no keepalive, but a time limit.
                connection = await connect(
                    self._address, compression=None, max_size=MAX_BYTES, max_queue=4, ping_interval=None, proxy=None,
                    open_timeout=None, close_timeout=_CLOSING, additional_headers=headers)
                break
            except OSError as error:
                if time_source.monotonic() > until:
                    raise self._failure(f"no connection: {one_line(error)}") from None
                await asyncio.sleep(RETRY)
        try:
            self._decoded(await connection.recv())
        except BaseException:
            connection.transport.abort()
            raise
        return connection

    async def _require_silence(self, connection: ClientConnection) -> None:
        """Return if nothing has arrived that was not requested; it would be taken for the next answer."""
        try:
            async with asyncio.timeout(0):
                await connection.recv()
        except TimeoutError:
            return
        raise self._failure("it sent a message that was not requested")

    def _decoded(self, data: str | bytes) -> dict[Any, Any]:
        if isinstance(data, str):  # a traceback
            last = data.strip().rpartition("\n")[2].strip()
            raise self._failure(f"the server failed: {last[:200] or 'without a reason'}")
        try:
            message = unpack(data)
        except WrongMessage as error:
            raise self._failure(str(error)) from None
        if not isinstance(message, dict):
            raise self._failure(f"a message is {type(message).__name__}, not a map")
        return message

    def _message(self, observation: Observation) -> dict[str, Any]:
        keys = self._keys
        gripper = gripper_value(observation.gripper, self._form, self._cell)
        found: dict[str, Any] = {key: np.ascontiguousarray(observation.images[camera])
                                 for camera, key in self._images.items() if key}
        if keys.state:
            found[keys.state] = state_vector(observation, keys.state_parts, gripper).astype(np.float32)
        if keys.joints:
            found[keys.joints] = observation.positions.astype(np.float32)
        if keys.gripper:
            found[keys.gripper] = np.array([gripper], np.float32)
        if keys.prompt:
            found[keys.prompt] = observation.instruction
        return found

    def _failure(self, reason: str) -> PolicyFailed:
        return PolicyFailed(f"policy server {self._address}: {reason}")

    def _abort(self) -> None:
        """End the connection without waiting for the server."""
        if self._connection is not None:
            self._connection.transport.abort()
            self._connection = None


def _image_keys(cameras: list[str]) -> dict[str, str]:
    return {name: "observation/image" if len(cameras) == 1 else f"observation/{name}" for name in cameras}


def _names(answer: dict[Any, Any]) -> str:
    return ", ".join(str(key)[:40] for key in list(answer)[:8]) or "nothing"
