"""Arms without a prepared robot file: `zencell robot new --yes` for each, then seven balls in a world of its own reach.

    python -m benchmarks.arms [--only NAME] [--seeds A-B] [--folder DIR]
    python -m benchmarks.arms --urdf FILE [--gripper FILE] [--package-dir DIR]

Prints a table in Markdown. All runs are on the virtual clock. The descriptions are those of example-robot-data, which
comes with the project, those of the package rtb-data where that is installed (`pip install --no-deps rtb-data`), or
the one that is named with --urdf.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

from common.config import load_cell
from lab.campaign import seeds_of
from lab.simulation import Simulation

_RTB = importlib.util.find_spec("rtbdata")
RTB = Path(_RTB.submodule_search_locations[0]) / "xacro" if _RTB and _RTB.submodule_search_locations else None
TROSSEN = "trossen_descriptions/urdf"
DATA = "package://example-robot-data/robots"
GRIPPER = str(Path(__file__).resolve().parent.parent / "config" / "robots" / "robotiq_2f85.urdf")


@dataclass(frozen=True)
class Case:
    """An arm: its description, and that of a gripper where it has none."""

    name: str
    urdf: str
    gripper: str = ""
    package_dir: str = ""
    package: tuple[str, str] = ("", "")  # a name that the description calls its package by, and where that is


def _more(folder: Path) -> tuple[Case, ...]:
    """Those of rtb-data, whose xacro files lie in a folder."""
    kuka = f"{folder}/kuka_description"
    return (
        Case("iiwa14", f"{kuka}/kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf", GRIPPER,
             package=("kuka_lbr_iiwa_support", f"{kuka}/kuka_lbr_iiwa")),
        Case("puma560", f"{folder}/unimation_puma560_description/urdf/puma560_robot.urdf", GRIPPER, str(folder)),
        Case("irb140", f"{folder}/abb_irb140_description/urdf/irb140.urdf", GRIPPER, str(folder)),
        *(Case(name, f"{folder}/{TROSSEN}/{name}.urdf.xacro") for name in (
            "px100", "px150", "rx150", "rx200", "wx200", "wx250", "vx300", "wx250s", "vx300s")),
        Case("al5d", f"{folder}/lynxmotion_al5d_description/urdf/al5d_robot.urdf", package_dir=str(folder)),
    )


CASES = (
    Case("panda", f"{DATA}/panda_description/urdf/panda.urdf"),
    Case("ur3", f"{DATA}/ur_description/urdf/ur3_robot.urdf", GRIPPER),
    Case("ur5", f"{DATA}/ur_description/urdf/ur5_robot.urdf", GRIPPER),
    Case("ur10", f"{DATA}/ur_description/urdf/ur10_robot.urdf", GRIPPER),
    Case("xarm7", f"{DATA}/xarm_description/urdf/xarm7.urdf", GRIPPER),
    Case("kinova_j2s6s200", f"{DATA}/kinova_description/robots/kinova.urdf", GRIPPER),
    Case("tiago_pro", f"{DATA}/tiago_pro_description/robots/tiago_pro.urdf"),
    Case("tiago", f"{DATA}/tiago_description/robots/tiago_no_hand.urdf", GRIPPER),
    Case("talos_arm", f"{DATA}/talos_data/robots/talos_left_arm.urdf"),
    Case("baxter", f"{DATA}/baxter_description/urdf/baxter.urdf"),
    Case("z1", f"{DATA}/z1_description/urdf/z1.urdf"),
    Case("so101", f"{DATA}/so_arm_description/urdf/so101.urdf"),
    Case("two_dof", f"{DATA}/asr_twodof_description/urdf/TwoDofs.urdf"),
    *(_more(RTB) if RTB else ()),
)


def written(case: Case, folder: Path) -> str:
    """Nothing when the robot file and the cell were written; else the line that says why not."""
    if case.package[0]:
        named = folder / "packages" / case.package[0]
        named.parent.mkdir(exist_ok=True)
        if not named.exists():
            named.symlink_to(case.package[1])
        case = replace(case, package_dir=str(named.parent))
    options = ["--name", case.name, "--out", str(folder / f"{case.name}.yaml"), "--yes", "--force",
               "--cell", str(folder / f"{case.name}_cell.yaml"), *(["--gripper", case.gripper] if case.gripper else []),
               *(["--package-dir", case.package_dir] if case.package_dir else [])]
    done = subprocess.run([sys.executable, "-m", "zencell", "robot", "new", case.urdf, *options],
                          capture_output=True, text=True, check=False)
    print(f"--- {case.name}\n{done.stdout}{done.stderr}", file=sys.stderr, flush=True)
    if done.returncode == 0:
        return ""
    lost = [line.removeprefix("lost: ") for line in done.stdout.splitlines() if line.startswith("lost: ")]
    return "no cell: " + "; ".join(lost) if lost else done.stderr.strip().splitlines()[-1].removeprefix("zencell: ")


def outcome_of(cell: str, seed: int) -> str:
    """How a cell ended under one seed, which also says where everything lies, in a few words."""
    outcome = Simulation(load_cell(cell, seed=seed), seed).run()
    wrong = [*outcome.broken, *outcome.crashes]
    return (f"{outcome.state} {outcome.done} of {outcome.total} in {outcome.seconds:.0f} s"
            + (f" ({outcome.message})" if outcome.message and outcome.state != "DONE" else "")
            + (f", broken: {wrong[0]}" if wrong else ""))


def main() -> None:
    """Print a row for each arm."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", action="append", metavar="NAME", help="of the arms; repeatable")
    parser.add_argument("--seeds", default="1-1", metavar="A-B")
    parser.add_argument("--folder", metavar="DIR", help="where the files are written and stay [a temporary one]")
    parser.add_argument("--urdf", metavar="FILE", help="an arm of your own, in the place of those")
    parser.add_argument("--gripper", default="", metavar="FILE", help="for --urdf")
    parser.add_argument("--package-dir", default="", metavar="DIR", help="for --urdf")
    given = parser.parse_args()
    cases = (Case(Path(given.urdf).stem, given.urdf, given.gripper, given.package_dir),) if given.urdf else CASES
    print("| arm | gripper | edits | `robot new` | in the box |\n|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(given.folder or temporary)
        for case in cases:
            if given.only and case.name not in given.only:
                continue
            began = time.monotonic()
            refused = written(case, folder)
            took = time.monotonic() - began
            result = refused or "; ".join(
                f"seed {seed}: {outcome_of(str(folder / f'{case.name}_cell.yaml'), seed)}"
                for seed in seeds_of(given.seeds))
            gripper = Path(case.gripper).stem if case.gripper else "its own"
            print(f"| {case.name} | {gripper} | 0 | {took:.0f} s | {result} |", flush=True)


if __name__ == "__main__":
    main()
