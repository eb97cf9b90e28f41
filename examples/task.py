"""With `async`: start, monitor, pause and resume a task."""

import asyncio
import sys

from zencell import Cell, MotionFailed


async def main() -> None:
    async with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda", speed=4, overrides=["world.count=2"]) as cell:
        await cell.task.start()
        done = -1
        async for status in cell.task:
            if status.done > done:
                done = status.done
                print(f"{status.state}: {done} of {status.total}")
            if done == 1:
                break
        try:
            await cell.arm.move("home")
        except MotionFailed as error:
            print(error)  # rejected: the task has the motion authority
        await cell.task.pause()
        print("paused at", (await cell.arm.joints()).round(2))
        await cell.task.resume()
        ended = await cell.task.ended()
        print(f"{ended.state}: {ended.done} of {ended.total} in {ended.task_seconds:.1f} s")


asyncio.run(main())
