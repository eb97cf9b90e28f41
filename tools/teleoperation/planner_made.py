"""Demonstrations by the task of a cell itself: each episode is a run with another seed of the layout."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from common.errors import ZencellError
from common.supervision.launch import module_command, pythonpath
from recording.formatting import format_bytes
from recording.reader import Recording
from tools.teleoperation.episodes import EpisodeFolder

BAD_INPUT, INTERRUPTED = 2, (130, -2)  # exit codes of `zencell run`
LAST_LINES = 3  # of the output of a run that failed


class RunFailed(ZencellError):
    """A run ended without a recording."""

    exit_code = 1


def record_runs(
    cell: str, options: Sequence[str], folder: EpisodeFolder, *, episodes: int, task: str, first_seed: int,
    say: Callable[[str], None], show: Callable[[str], None],
) -> None:
    """Run the task of a cell once for each episode, and record it.

    Args:
        cell: name or path.
        options: of `zencell run`, such as --set.
        folder: of the episodes.
        episodes: how many.
        task: what they show.
        first_seed: of the first episode; each further one has the next seed.
        say: called with a line that stays.
        show: called with a line that replaces the one before.

    Raises:
        RunFailed: a run wrote no recording, or not all of it.
        RecordingError: it is damaged.
        KeyboardInterrupt: a signal ended a run; its episode is discarded.
    """
    succeeded = 0
    for number in range(episodes):
        seed, file = first_seed + number, folder.next_file()
        show(f"episode {number + 1} of {episodes}, seed {seed}: recording, {succeeded} succeeded so far")
        code, output = _run(cell, [*options, "--seed", str(seed), "--record", str(file), "--no-viewer"])
        show("")
        if code in INTERRUPTED:
            file.unlink(missing_ok=True)
            raise KeyboardInterrupt
        if code == BAD_INPUT or not file.exists():
            file.unlink(missing_ok=True)
            raise RunFailed(f"seed {seed}: {output}")
        with Recording(file) as recording:
            if recording.flaw:  # as on a full disk, with which the run itself ends well
                raise RunFailed(f"seed {seed}: {file}: {recording.flaw}")
        success = code == 0
        succeeded += success
        folder.add(file, success=success, task=task, seed=seed)
        say(f"episode {number + 1} of {episodes}: seed {seed}, {'success' if success else f'failure ({output})'}, "
            f"{format_bytes(file.stat().st_size)}: {file}")


def _run(cell: str, options: Sequence[str]) -> tuple[int, str]:
    """Return the exit code of a run, and its last lines."""
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [*module_command("zencell"), "run", cell, *options], stdin=subprocess.DEVNULL, stdout=log,
            stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": pythonpath()})
        while True:
            try:
                code = process.wait()
                break
            except KeyboardInterrupt:  # the run got the signal, too, and shuts its cell down
                continue
        log.seek(0)
        lines = [line.strip() for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return code, " | ".join(lines[-LAST_LINES:]).removeprefix("zencell: ")


def absolute(folder: str | None, cell: str) -> Path:
    """Return the folder of the option --output; default: the cell's name with `_demos`."""
    return Path(folder or f"{Path(cell).stem}_demos").expanduser().absolute()
