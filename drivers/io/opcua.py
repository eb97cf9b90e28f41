"""Inputs and outputs of an OPC UA server, by `asyncua` (extra `opcua`). A channel is the id of a node.

An analog signal has the unit of its node: values are not converted. A digital node is a boolean, or a number that is 0
for off.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import Field

from common.config import Parameters, Signal
from common.config.io import Value
from common.errors import ConfigError, Refused
from common.hardware.signals import IoLost, Unreadable, channel_error

LOST = ("BadConnectionClosed", "BadSessionIdInvalid", "BadSessionClosed", "BadSecureChannelClosed", "BadTimeout")
TIMEOUT = 0.8  # [s] for an answer: shorter than the service waits for all of them


class IoOptions(Parameters):
    """Address of the server, and how to log in."""

    url: str = Field(pattern="^opc.tcp://.+", description="such as opc.tcp://192.168.1.20:4840")
    user: str = Field("", description="user name; empty: anonymous")
    password: str = Field("", repr=False, description="of the user")
    security: str = Field("", description="suite, mode, certificate and key, such as "
                                          "Basic256Sha256,SignAndEncrypt,cert.der,key.pem; empty: none")


class OpcUaIo:
    """A session on the server; all signals are read with one request."""

    def __init__(self, signals: Mapping[str, Signal], options: IoOptions) -> None:
        """Start without a session."""
        self._signals, self._options = signals, options
        self._client: Any = None
        self._nodes: dict[str, Any] = {}
        self._types: dict[str, Any] = {}  # of the values of outputs
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # the service logs a loss, once

    async def connect(self) -> None:
        """Open a session, and read the types of outputs."""
        ua, client = _library(), importlib.import_module("asyncua").Client
        self._client = client(self._options.url, timeout=TIMEOUT, auto_reconnect=False)
        if self._options.user:
            self._client.set_user(self._options.user)
            self._client.set_password(self._options.password)
        try:
            if self._options.security:
                await self._client.set_security_string(self._options.security)
            await self._client.connect()
        except (OSError, TimeoutError, ua.UaError) as error:
            raise self._lost(error) from None
        self._nodes = {name: self._client.get_node(signal.channel) for name, signal in self._signals.items()}
        self._types = {}

    def _lost(self, error: Exception) -> IoLost:
        reason = " ".join(str(error).split()) or type(error).__name__
        return IoLost(f"{self._options.url}: {reason}")

    async def read(self) -> Mapping[str, Value | Unreadable]:
        """Return all signals."""
        ua = _library()
        try:
            answers = await self._client.read_attributes(list(self._nodes.values()), ua.AttributeIds.Value)
        except (OSError, TimeoutError, ua.UaError) as error:
            raise self._lost(error) from None
        return {name: self._value(self._signals[name], answer)
                for name, answer in zip(self._nodes, answers, strict=True)}

    def _value(self, signal: Signal, answer: Any) -> Value | Unreadable:
        if answer.StatusCode is not None and not answer.StatusCode.is_good():
            return Unreadable(f"{signal.channel}: {answer.StatusCode.name}")
        value = answer.Value.Value if answer.Value is not None else None
        if not isinstance(value, bool | int | float):
            return Unreadable(f"{signal.channel} holds {type(value).__name__}, not a number or boolean")
        return bool(value) if signal.range is None else float(value)

    async def write(self, name: str, value: Value) -> None:
        """Write the value of a node in its own type."""
        ua, node = _library(), self._nodes[name]
        try:
            if name not in self._types:
                self._types[name] = await node.read_data_type_as_variant_type()
            whole = self._types[name].name.startswith(("Int", "UInt", "Byte", "SByte"))
            typed = bool(value) if self._types[name].name == "Boolean" else round(value) if whole else float(value)
            await node.write_attribute(ua.AttributeIds.Value, ua.DataValue(ua.Variant(typed, self._types[name])))
        except (OSError, TimeoutError) as error:
            raise self._lost(error) from None
        except ua.UaStatusCodeError as error:
            if error.code in (getattr(ua.StatusCodes, code) for code in LOST):
                raise self._lost(error) from None
            raise Refused("device", f"{name}: {' '.join(str(error).split())}") from None

    async def close(self) -> None:
        """Close the session; nodes hold their values."""
        client, self._client = self._client, None
        if client is not None:
            ua = _library()
            try:
                await client.disconnect()
            except (OSError, TimeoutError, ua.UaError):
                client.disconnect_socket()  # the server is gone


def _library() -> Any:
    return importlib.import_module("asyncua.ua")  # untyped: its types are incomplete


def create_io(signals: Mapping[str, Signal], options: IoOptions, now: Callable[[], float]) -> OpcUaIo:
    """Create a session on an OPC UA server."""
    try:
        ua = _library()
    except ImportError:
        raise ConfigError("io.backend", "opcua", "needs the extra `opcua`: pip install 'zencell[opcua]'") from None
    for name, signal in signals.items():
        try:
            if not isinstance(signal.channel, str):
                raise ValueError
            ua.NodeId.from_string(signal.channel)
        except (ValueError, ua.UaError):
            raise channel_error(name, signal, "must be the id of a node, such as ns=2;s=Clamp or ns=2;i=7") from None
    return OpcUaIo(signals, options)
