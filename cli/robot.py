"""Robot files: which of their links need no collision check."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from cli import completion, options
from common.errors import ConfigError
from common.terminal import echo

app = typer.Typer(help="Prepare a robot.", no_args_is_help=True)


@app.callback()
def robot() -> None:
    """Prepare a robot."""


@app.command()
def collisions(
    name: Annotated[
        str, typer.Argument(metavar="ROBOT", help="a name of config/robots, or the path of a YAML file",
                            autocompletion=completion.robots)
    ],
    samples: Annotated[str, typer.Option("--samples", metavar="N", help="random configurations")] = "10000",
    margin: Annotated[str, typer.Option("--margin", metavar="M", help="pairs that come this close are checked [m]")]
    = "0.005",
    seed: Annotated[str, typer.Option("--seed", metavar="N", help="of the configurations")] = "0",
    output: Annotated[str, typer.Option("-o", "--output", metavar="FILE", help="write there, not here")] = "",
) -> None:
    """Compute an SRDF: groups, named poses, and the pairs of links that need no collision check."""
    import numpy as np

    from common.config import RobotConfig, check, find_file, read_robot
    from common.planning.disabled_collisions import disabled_pairs, srdf
    from common.robot.model import RobotModel

    count, number = options.whole("--samples", samples, 1), options.whole("--seed", seed, 0)
    distance = options.number("--margin", margin)
    if distance < 0:
        raise ConfigError("--margin", margin, "must be 0 or more")
    config = check(RobotConfig, read_robot(find_file("robots", name)), "robot")
    # The SRDF that the robot file names may be the one that is still to be made.
    model = RobotModel.load(config.model_copy(update={"srdf": ""}))
    pairs = disabled_pairs(model, samples=count or 1, margin=distance, rng=np.random.default_rng(number))
    text = srdf(model, pairs)
    if not output:
        echo(text, nl=False)
        return
    try:
        Path(output).expanduser().write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError("--output", output, f"cannot be written: {error.strerror}") from None
    found = Counter(pair.reason for pair in pairs)
    echo(f"{output}: {len(pairs)} pairs need no check "
               f"({', '.join(f'{found[reason]} {reason.lower()}' for reason in sorted(found))})")
