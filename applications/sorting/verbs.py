"""Commands about grasps: try them in physics, train the learned scorer, compare scorers in the same scenes."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any

import typer

from common.errors import ConfigError
from common.terminal import Progress, echo
from common.verbs import Verbs

if TYPE_CHECKING:
    from applications.sorting.learning.options import DataOptions, EvaluateOptions, TrainOptions

CELL = "sorting"  # a cell of the project
CellOption = Annotated[str, typer.Option("--cell", metavar="CELL", help="whose tray, depth camera and gripper")]
Processes = Annotated[str, typer.Option("--processes", metavar="N", help="number of processes")]
Force = Annotated[str, typer.Option("--force", metavar="N", help="of each finger [N]")]


def data(
    out: Annotated[str, typer.Option("--out", metavar="FILE.npz", help="file of the tries; replaced if it exists")],
    tries: Annotated[str, typer.Option("--tries", metavar="N", help="number of grasps, at least")] = "20000",
    cell: CellOption = CELL, processes: Processes = "2", overrides: list[str] | None = None, seed: str | None = None,
) -> None:
    """Try grasps of random objects in physics without an arm, and store what was seen and whether they held.

    An interrupted run continues with the groups of scenes in FILE.npz.parts.
    """
    _require_physics("grasp data")
    options: DataOptions = _options("DataOptions", out=out, tries=tries, processes=processes, seed=seed or 0)
    from applications.sorting.learning.data import collect
    from applications.sorting.learning.tries import Tries

    with Progress("trying grasps") as show:
        for done in collect(cell, overrides or (), options.out, options.tries, options.seed, options.processes):
            show(done / options.tries)
    made = Tries.read(options.out)
    echo(f"{options.out}: {len(made)} tries, {100 * made.held.mean():.0f} % held")


def train(
    file: Annotated[str, typer.Argument(metavar="FILE.npz", help="tries of `zencell grasp data`")],
    out: Annotated[str, typer.Option("--out", metavar="FILE.onnx", help="network; its card is written next to it")],
    note: Annotated[str, typer.Option("--note", metavar="TEXT", help="about the data, for the card")] = "",
    seed: str | None = None,
) -> None:
    """Train the learned scorer; write it as ONNX with a card that says how well it ranks grasps."""
    options: TrainOptions = _options("TrainOptions", file=file, out=out, note=note, seed=seed or 0)
    from applications.sorting.learning.train import train as train_network

    card = train_network(options.file, options.out, options.seed, options.note, echo)
    areas = ", ".join(f"{name} {groups['all']:.3f}" for name, groups in card.auc.items())
    echo(f"{options.out}: {card.parameters} weights; area under the curve on {card.tries['test']} tries: {areas}")


def evaluate(
    scenes: Annotated[str, typer.Option("--scenes", metavar="N", help="number of scenes")] = "600",
    objects: Annotated[str, typer.Option("--objects", metavar="N", help="in each scene")] = "1",
    force: Force = "20",
    error: Annotated[
        str, typer.Option("--error", metavar="X", help="of the tool's pose, in multiples of 3 mm and 3 degrees")] = "1",
    meshes: Annotated[
        str | None, typer.Option("--meshes", metavar="DIR", help="folder of meshes instead of the test kinds")] = None,
    scorer: Annotated[
        str | None, typer.Option("--scorer", metavar="FILE.onnx", help="another network than the included one")] = None,
    cell: CellOption = CELL, processes: Processes = "2", overrides: list[str] | None = None, seed: str | None = None,
) -> None:
    """Let the scorers choose grasps in the same scenes, try them in physics, and compare how many hold."""
    _require_physics("grasp evaluate")
    options: EvaluateOptions = _options(
        "EvaluateOptions", scenes=scenes, objects=objects, force=force, error=error, meshes=meshes, scorer=scorer,
        processes=processes, seed=seed or 0)
    from applications.sorting.learning.evaluate import Job, evaluate, table

    job = Job(cell, tuple(overrides or ()), options.scorer, options.force, options.error, options.objects, options.seed,
              options.meshes)
    trials = []
    with Progress("trying grasps") as show:
        for trial in evaluate(job, options.scenes, options.processes):
            trials.append(trial)
            show((trial.scene + 1) / options.scenes)
    echo(table(trials))


def _options(kind: str, **values: Any) -> Any:
    """Return validated options; numbers are texts of the command line.

    Raises:
        ConfigError: names the option, its value and what is expected.
    """
    from applications.sorting.learning import options
    from common.config.basics import check

    try:
        return check(getattr(options, kind), values)
    except ConfigError as error:
        raise ConfigError(f"--{error.field}", error.value, error.expected) from None


def _require_physics(verb: str) -> None:
    if find_spec("mujoco") is None:
        raise ConfigError(verb, ..., "needs the extra `physics`: pip install 'zencell[physics]'")


VERBS = Verbs(
    commands={"grasp data": data, "grasp train": train, "grasp evaluate": evaluate},
    groups={"grasp": "Try grasps in physics without an arm, and learn which ones hold."},
)
