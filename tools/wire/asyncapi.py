"""An AsyncAPI 3.0 document of a cell: a channel for each key, an operation for each direction, all messages.

It describes the cell as the application: the cell sends what its services publish, and receives requests and commands.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from common.messages import SCHEMA_VERSION, Message
from common.supervision.wiring import ServiceWiring
from common.topics import (
    COUNTERS,
    LOG,
    PARAMETERS,
    SERVICE,
    SUPERVISOR_STATUS,
    Request,
    Topic,
    general_key,
)
from common.transport.codec import MSGPACK, encoding_of
from tools.wire.json_schema import shared_schemas, to_draft_07

VERSION = "3.0.0"
SUPERVISOR = "supervisor"
PLACE = "#/components/schemas/"
ERROR = "ErrorReply"
KINDS = {
    "stream": "The newest message counts; a slow reader loses older ones.",
    "event": "Every message counts; they arrive in order.",
    "state": "A Zenoh get returns the current value at any time; it is repeated each second.",
    "request": "A Zenoh get with a payload; the reply has the answer, or is an error reply.",
}
ABOUT = (
    "Payloads are msgpack maps. The Zenoh encoding names the message: `application/msgpack;Image`. The attachment of a "
    "sample is the msgpack array [writer, sequence, schema version, trace, checksum]; readers may ignore it, writers "
    "may leave it out. A bin is a string of the format binary here.")
ATTACHMENT = {
    "type": "array", "minItems": 4, "maxItems": 5, "description": "msgpack array in the attachment of a Zenoh sample",
    "items": [
        {"type": "string", "description": "writer: new for each start of a service"},
        {"type": "integer", "minimum": 0, "description": "sequence number of this writer and key"},
        {"const": SCHEMA_VERSION, "description": "schema version"},
        {"type": "string", "description": "trace: id of the cause"},
        {"type": "integer", "description": "checksum: CRC-32 of the full key, then of the first 64 KiB of the payload; "
                                           "its start value is the length of the payload"},
    ],
}
ERROR_REPLY = {
    "type": "object", "required": ["code", "message"], "additionalProperties": False,
    "properties": {"code": {"type": "string", "description": "for programs"},
                   "message": {"type": "string", "description": "for people"}},
}

AnyTopic = Topic[Any] | Request[Any, Any]
Document = dict[str, Any]


@dataclass
class Key:
    """A key of a cell, and the services on both of its sides; `services` are the choices of a key with a variable."""

    topic: AnyTopic
    writers: list[str] = field(default_factory=list)  # or servers
    readers: list[str] = field(default_factory=list)  # or clients
    services: list[str] = field(default_factory=list)

    @property
    def channel(self) -> str:
        """The name of its channel."""
        return self.topic.key.replace(f"/{SERVICE}", "").replace("/", ".")

    def address(self, cell: str) -> str:
        """Return the key on the wire, with a variable for the service."""
        return f"{cell}/{self.topic.key.replace(SERVICE, '{service}')}"

    @property
    def messages(self) -> list[type[Message]]:
        """The messages on this key."""
        return [self.topic.message, self.topic.answer] if isinstance(self.topic, Request) else [self.topic.message]


def keys_of(services: Sequence[ServiceWiring]) -> list[Key]:
    """Return the keys of a cell, those that every service has last."""
    found: dict[str, Key] = {}
    for service in services:
        for key in (*service.writes, *service.serves):
            found.setdefault(key, Key(service.topics[key])).writers.append(service.name)
    for service in services:
        for key in (*service.reads, *service.calls):
            found.setdefault(key, Key(service.topics[key])).readers.append(service.name)
    names = [service.name for service in services]
    found[SUPERVISOR_STATUS.key] = Key(
        SUPERVISOR_STATUS, [SUPERVISOR], [each.name for each in services if SUPERVISOR_STATUS.key in each.reads])
    everywhere: list[tuple[AnyTopic, list[str]]] = [
        (LOG, [*names, SUPERVISOR]), (COUNTERS, [*names, SUPERVISOR]), (PARAMETERS, names)]
    own = [key for name, key in found.items() if general_key(name) == name]
    return own + [Key(topic, writers=writers, services=writers) for topic, writers in everywhere]


def document(cell: str, services: Sequence[ServiceWiring], endpoint: str) -> Document:
    """Return the AsyncAPI document of a cell.

    Args:
        cell: its name.
        services: their keys.
        endpoint: of its router, such as tcp/127.0.0.1:7489.
    """
    keys = keys_of(services)
    models = list(dict.fromkeys(model for key in keys for model in key.messages))
    references, schemas = shared_schemas(models, PLACE)
    return {
        "asyncapi": VERSION,
        "info": {"title": f"zencell cell {cell}", "version": str(SCHEMA_VERSION), "description": ABOUT},
        "defaultContentType": MSGPACK,
        "servers": {"router": {
            "host": endpoint.partition("/")[2], "protocol": "zenoh",
            "description": f"The cell's Zenoh router, for Zenoh clients at {endpoint}."}},
        "channels": {key.channel: _channel(key, cell) for key in keys},
        "operations": {name: operation for key in keys for name, operation in _operations(key)},
        "components": {
            "messages": {
                **{model.__name__: _message(model, references[model]) for model in models},
                ERROR: {"name": ERROR, "contentType": MSGPACK, "payload": {"$ref": PLACE + ERROR},
                        "summary": "Why a request was refused: the payload of a Zenoh error reply."}},
            "schemas": {**to_draft_07(schemas), "Attachment": ATTACHMENT, ERROR: ERROR_REPLY},
        },
    }


def messages_of(services: Sequence[ServiceWiring]) -> list[type[Message]]:
    """Return all messages on the keys of a cell, by name."""
    found = {model.__name__: model for key in keys_of(services) for model in key.messages}
    return [found[name] for name in sorted(found)]


def _message(model: type[Message], payload: Document) -> Document:
    about = (model.__doc__ or "").strip().partition("\n")[0]
    return {"name": model.__name__, "summary": about, "contentType": MSGPACK, "payload": payload,
            "x-zenoh-encoding": encoding_of(model), "x-max-bytes": model.max_bytes}


def _channel(key: Key, cell: str) -> Document:
    names = [model.__name__ for model in key.messages] + ([ERROR] if isinstance(key.topic, Request) else [])
    found: Document = {
        "address": key.address(cell), "title": key.topic.key, "summary": key.topic.doc,
        "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in names},
        "x-kind": key.topic.kind, "x-written-by": key.writers, "x-read-by": key.readers,
    }
    if key.services:
        found["parameters"] = {"service": {"enum": key.services, "description": "name of a service"}}
    return found


def _operations(key: Key) -> Iterator[tuple[str, Document]]:
    """Yield the operations on a key, from the point of view of the cell."""
    kind, topic = KINDS[key.topic.kind], key.topic
    channel = {"$ref": f"#/channels/{key.channel}"}

    def message(name: str) -> Document:
        return {"$ref": f"{channel['$ref']}/messages/{name}"}

    common = {"channel": channel, "summary": kind, "messages": [message(topic.message.__name__)]}
    if isinstance(topic, Request):
        answers = [message(topic.answer.__name__), message(ERROR)]
        yield f"receive.{key.channel}", {"action": "receive", **common,
                                         "reply": {"channel": channel, "messages": answers}}
        return
    if key.writers:
        yield f"send.{key.channel}", {"action": "send", **common}
    if not key.writers or (isinstance(topic, Topic) and topic.commands):
        yield f"receive.{key.channel}", {"action": "receive", **common}
