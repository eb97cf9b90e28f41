"""A request that is asked until somebody answers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Container
from typing import TypeVar

from common.errors import RemoteError, RequestFailed
from common.messages import Message
from common.transport.requests import Client

A = TypeVar("A", bound=Message)
Q = TypeVar("Q", bound=Message)

NOT_YET = ("no_scene", "no_state", "no_points")  # the planner has not heard enough to answer
# Too many ask, the server ends, the request or its answer came damaged.
NOT_TAKEN = (*NOT_YET, "busy", "internal", "invalid", "bad_answer")
AGAIN_AFTER = 0.1  # [s] wall


async def persist(
    client: Client[Q, A], request: Q, timeout: float, refused: Callable[[RemoteError], A], note: Callable[[str], None],
    again: Container[str] = NOT_YET,
) -> A:
    """The answer to a request that is asked again until there is one. Its id makes that safe: nothing is done twice.

    Args:
        client: of the request.
        request: with an id of its own.
        timeout: of each try [s, wall].
        refused: makes the answer that stands for a refusal.
        note: is told what went wrong in between.
        again: codes of refusals that are no answer.
    """
    while True:
        try:
            return await client.call(request, timeout=timeout)
        except RemoteError as error:
            if error.code not in again:
                return refused(error)
            note(str(error))
        except RequestFailed as error:
            note(str(error))
        await asyncio.sleep(AGAIN_AFTER)
