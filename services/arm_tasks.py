"""The tasks of several arms as one task of the cell: forwards an operator's commands, and sums their states."""

from __future__ import annotations

import asyncio

from pydantic import Field

from common import messages as m
from common import topics
from common.application import find_application
from common.arms import arms_topic
from common.config import Arms, Members, Parameters
from common.errors import ConfigError, Refused, RequestFailed
from common.process.service import main
from common.tasks.several import combined
from common.transport.bus import Bus
from common.transport.reader import Reader


class Config(Parameters):
    """Timeouts."""

    arms: Arms
    members: Members
    timeout: float = Field(3.0, gt=0, le=60, description="of an answer of an arm's task [s, wall time]")


async def run(bus: Bus, config: Config) -> None:
    """Publish the status of all tasks after each change; forward commands to all of them."""
    arms = list(config.arms.robots)
    if not arms:
        raise ConfigError(f"services.{bus.service}", ..., "is for a cell with several robots: leave it out")
    status = find_application(config.members.application).status
    readers = {arm: bus.reader(arms_topic(status, arm)) for arm in arms}
    clients = {arm: bus.client(arms_topic(topics.TASK_COMMAND, arm)) for arm in arms}
    out = bus.writer(status)
    changed = asyncio.Event()

    def newest() -> m.TaskStatus:
        known = {arm: reader.latest for arm, reader in readers.items() if reader.latest is not None}
        return combined(status.message, known, len(arms))

    async def obey(command: m.TaskCommand) -> m.TaskStatus:
        answers = await asyncio.gather(
            *(clients[arm].call(command, config.timeout) for arm in arms), return_exceptions=True)
        failed = {arm: answer for arm, answer in zip(arms, answers, strict=True) if isinstance(answer, BaseException)}
        for arm, problem in failed.items():
            if not isinstance(problem, RequestFailed):
                raise problem
            code = getattr(problem, "code", "unanswered")
            done = [other for other in arms if other not in failed]
            raise Refused(code, f"{arm}: {problem}" + (f"; done by {', '.join(done)}" if done else ""))
        return combined(m.TaskStatus, {arm: each for arm, each in zip(arms, answers, strict=True) if isinstance(
            each, m.TaskStatus)}, len(arms))

    bus.serve(topics.TASK_COMMAND, obey)
    await bus.ready()

    async def wake_on(reader: Reader[m.TaskStatus]) -> None:
        async for _ in reader:
            changed.set()

    published: m.TaskStatus | None = None
    async with asyncio.TaskGroup() as group:
        for reader in readers.values():
            group.create_task(wake_on(reader))
        while True:
            await changed.wait()
            changed.clear()
            now = newest()
            if published is None or not published.equals_except(now, "header"):
                now.header, published = bus.header(), now
                out.put(now)


if __name__ == "__main__":
    main(run, Config)
