"""What a client of Foxglove may do in a cell: commands to the task as services, parameters to read and to set."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Coroutine, Sequence
from typing import Any, TypeVar

from foxglove import MessageSchema, Parameter, Schema, Service, ServiceRequest, ServiceSchema

from common import topics
from common.client.parameters import change, listing, look_up
from common.client.subscriptions import Subscriptions
from common.client.task import TaskControl
from common.errors import UnknownName, ZencellError
from common.transport.bus import Bus

OWNER = "foxglove"  # of its commands: what it holds, it can release
COMMANDS = {"start": True, "pause": False, "resume": True, "stop": False}  # whether it may override other operators
TIMEOUT = 10.0  # [s] for the cell to answer; its own timeouts are shorter
REQUEST = {"type": "object", "properties": {"override": {
    "type": "boolean", "default": False, "description": "even if another operator holds the robot"}}}
EMPTY = {"type": "object", "properties": {}}

CALLED: Sequence[topics.Request[Any, Any]] = (topics.TASK_COMMAND, topics.MOTION_STOP, topics.MOTION_HOLD)

T = TypeVar("T")


class CallFailed(Exception):
    """The cell refused a call or did not answer; the text goes to the client."""


class Controls:
    """Calls from threads of the server, carried out on the event loop of the bridge."""

    def __init__(self, bus: Bus) -> None:
        """Declare the requests.

        Args:
            bus: of the bridge, on its running loop.
        """
        self._bus, self._loop = bus, asyncio.get_running_loop()
        self._task = TaskControl(Subscriptions(bus), OWNER)
        for request in CALLED:
            bus.client(request)  # so that `zencell graph` and access rules know them

    def services(self) -> list[Service]:
        """Return a service for each command: task/start, task/pause, task/resume and task/stop."""
        return [Service(
            name=f"task/{command}", handler=self._command,
            schema=ServiceSchema(
                name=f"task/{command}",
                request=_schema(f"task/{command} request", REQUEST if may_override else EMPTY),
                response=_schema("answer", {"type": "object"})))
            for command, may_override in COMMANDS.items()]

    def _command(self, request: ServiceRequest) -> bytes:
        """Send a command to the task, and return the answer as JSON.

        Raises:
            CallFailed: the request is malformed, or the cell refused it or did not answer.
        """
        command = request.service_name.rpartition("/")[2]
        try:
            fields = json.loads(request.payload or b"{}")
        except (ValueError, RecursionError) as error:
            raise CallFailed(f"{request.service_name}: is not JSON: {error}") from None
        allowed = {"override"} if COMMANDS[command] else set()
        if not isinstance(fields, dict) or fields.keys() - allowed or not all(
            isinstance(value, bool) for value in fields.values()
        ):
            raise CallFailed(f"{request.service_name}: must be an object"
                             f"{' with at most override, true or false' if allowed else ' without fields'}")
        answer = self._await(getattr(self._task, command)(**fields))
        self._bus.log.info("task %s by %s, client %d", command, OWNER, request.client_id)
        return str(answer.model_dump_json()).encode()

    def get(self, names: Sequence[str]) -> list[Parameter]:
        """Return parameters by path, those of the services that answer; all if no name is given.

        Raises:
            CallFailed: no service answers.
        """
        found = self._await(listing(self._bus, None)).parameters
        known = {each.path: each.value for parameters in found.values() for each in parameters}
        return [to_parameter(name, known[name]) for name in names or known if name in known]

    def set(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Change parameters, all of them or none, and return their values.

        Raises:
            CallFailed: a name is unknown, a value is not valid, or a service refuses.
        """
        values = {each.name: each.get_value() for each in parameters}
        changed = self._await(self._change(values))
        return [to_parameter(name, value) for name, value in changed.items()]

    async def _change(self, values: dict[str, Any]) -> dict[str, Any]:
        texts = {name: value for name, value in values.items() if isinstance(value, str)}
        if texts:  # of values that Foxglove has no type for
            known = await look_up(self._bus, texts)
            values |= {name: _from_text(text) for name, text in texts.items() if known[name][1].type != "string"}
        return {name: after for name, (_, after) in (await change(self._bus, values)).items()}

    def _await(self, work: Coroutine[Any, Any, T]) -> T:
        """Return the result of a coroutine; on a thread of the server.

        Raises:
            CallFailed: it failed, or took too long.
        """
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(TIMEOUT)
        except (ZencellError, UnknownName) as error:
            raise CallFailed(str(error)) from None
        except TimeoutError:
            future.cancel()
            raise CallFailed(f"no answer within {TIMEOUT:g} s") from None


def to_parameter(name: str, value: Any) -> Parameter:
    """Return a parameter; a value that Foxglove has no type for, such as a list with null, as JSON text."""
    try:
        return Parameter(name, value=value)
    except (TypeError, ValueError, OverflowError):
        return Parameter(name, value=json.dumps(value))


def _from_text(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text  # the service refuses it, with the reason


def _schema(name: str, schema: dict[str, Any]) -> MessageSchema:
    described = Schema(name=name, encoding="jsonschema", data=json.dumps({"title": name, **schema}).encode())
    return MessageSchema(encoding="json", schema=described)
