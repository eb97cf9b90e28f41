"""Makers' descriptions as they ship: `robot new --yes --cell`, `robot check`, and seven balls on the virtual clock.

    python -m benchmarks.robots FOLDER [--only NAME] [--run] [--docs docs/robots.md]

FOLDER holds unpacked repositories, each in a folder OWNER+NAME; what is not there is reported as not run. Results of
earlier calls are read from FOLDER/results.json, and replaced for the arms that ran. Prints a table in Markdown, and
writes it into a page between its two markers.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.arms import outcome_of

LONGEST = 900.0  # of one command [s]
BEGIN, END = "<!-- table of benchmarks/robots.py -->", "<!-- end of that table -->"
GRIPPER = "robotiq_2f85.urdf"


@dataclass(frozen=True)
class Arm:
    """A description in a repository, with the arguments of its xacro file and further options of `robot new`."""

    name: str
    repository: str
    file: str
    options: tuple[str, ...] = ()
    gripper: str = ""


def _bare(name: str, repository: str, file: str, *options: str) -> Arm:
    """Return an arm without fingers, on which the Robotiq 2F-85 of config/robots is mounted."""
    return Arm(name, repository, file, options, GRIPPER)


UR, XARM = "UniversalRobots/Universal_Robots_ROS2_Description", "xArm-Developer/xarm_ros2"
ABB, KUKA, COBOT = "ros-industrial/abb", "ros-industrial/kuka_experimental", "elephantrobotics/mycobot_ros2"
ROBOTIS, OM = "ROBOTIS-GIT/open_manipulator", "open_manipulator_description/urdf"
SO, ELEPHANT = "TheRobotStudio/SO-ARM100", "elephantrobotics/mycobot_ros"
ARMS = (
    *(_bare(name, UR, "urdf/ur.urdf.xacro", f"ur_type:={name.lower()}", "name:=ur")
      for name in ("UR3e", "UR10e", "UR16e")),
    _bare("xArm 6", XARM, "xarm_description/urdf/xarm_device.urdf.xacro", "dof:=6"),
    _bare("Lite6", XARM, "xarm_description/urdf/xarm_device.urdf.xacro", "robot_type:=lite", "dof:=6"),
    Arm("FR3", "frankarobotics/franka_description", "robots/fr3/fr3.urdf.xacro", ("hand:=true",)),
    _bare("Gen3", "Kinovarobotics/ros2_kortex", "kortex_description/robots/gen3.xacro", "gripper:=", "dof:=7"),
    Arm("Gen3 lite", "Kinovarobotics/ros_kortex", "kortex_description/robots/gen3_lite_gen3_lite_2f.xacro"),
    _bare("iiwa 14", KUKA, "kuka_lbr_iiwa_support/urdf/lbr_iiwa_14_r820.xacro"),
    _bare("KR6 R900", KUKA, "kuka_kr6_support/urdf/kr6r900sixx.xacro"),
    _bare("KR16", KUKA, "kuka_kr16_support/urdf/kr16_2.xacro"),
    _bare("M1013", "doosan-robotics/doosan-robot2", "dsr_description2/xacro/m1013.urdf.xacro"),
    _bare("SIA20D", "ros-industrial/motoman", "motoman_sia20d_support/urdf/sia20d.xacro"),
    _bare("GP7", "ros-industrial/motoman", "motoman_gp7_support/urdf/gp7.xacro"),
    _bare("LR Mate 200iD", "ros-industrial/fanuc", "fanuc_lrmate200id_support/urdf/lrmate200id.xacro"),
    _bare("Elfin5", "hans-robot/elfin_robot", "elfin_description/urdf/elfin5.urdf.xacro"),
    _bare("IRB 2400", ABB, "abb_irb2400_support/urdf/irb2400.xacro",
          "--srdf", "abb_irb2400_moveit_config/config/abb_irb2400.srdf"),
    _bare("IRB 6640", ABB, "abb_irb6640_support/urdf/irb6640_185_280.xacro",
          "--srdf", "abb_irb6640_moveit_config/config/abb_irb6640_185_280.srdf"),
    Arm("SO-100", SO, "Simulation/SO100/so100.urdf"),
    Arm("SO-101", SO, "Simulation/SO101/so101_new_calib.urdf"),
    Arm("OpenMANIPULATOR-X", ROBOTIS, f"{OM}/open_manipulator_x/open_manipulator_x.urdf.xacro"),
    Arm("OpenMANIPULATOR-Y", ROBOTIS, f"{OM}/omy_f3m/omy_f3m.urdf.xacro"),
    _bare("myCobot 280", COBOT, "mycobot_description/urdf/mycobot_280_m5/mycobot_280_m5.urdf"),
    _bare("myCobot 320", COBOT, "mycobot_description/urdf/mycobot_320_m5_2022/mycobot_320_m5_2022.urdf"),
    Arm("myCobot Pro 600", ELEPHANT, "mycobot_description/urdf/mycobot_pro_600/mycobot_pro_600_gripper.urdf"),
    Arm("Fetch", "ZebraDevs/fetch_ros", "fetch_description/robots/fetch.urdf"),
    Arm("Baxter, left arm", "RethinkRobotics/baxter_common", "baxter_description/urdf/baxter.urdf.xacro",
        ("--tip", "left_gripper_base")),
    _bare("Sawyer", "RethinkRobotics/sawyer_robot", "sawyer_description/urdf/sawyer.urdf.xacro"),
    Arm("Stretch RE1", "hello-robot/stretch_urdf",
        "stretch_urdf/RE1V0/stretch_description_RE1V0_tool_stretch_gripper.urdf"),
    _bare("Ned2", "NiryoRobotics/ned_ros", "niryo_robot_description/urdf/ned2/niryo_ned2.urdf.xacro", "--srdf",
          "niryo_robot_moveit_config/niryo_moveit_config_standalone/config/ned2/niryo_ned2.srdf"),
)


def _zencell(*words: str, folder: Path) -> tuple[int, str, str, float]:
    began = time.monotonic()
    try:
        done = subprocess.run([sys.executable, "-m", "zencell", *words], cwd=folder, capture_output=True, text=True,
                              timeout=LONGEST, check=False)
    except subprocess.TimeoutExpired:
        return 1, "", f"took more than {LONGEST:.0f} s", LONGEST
    return done.returncode, done.stdout, done.stderr, time.monotonic() - began


def result_of(arm: Arm, folder: Path, *, run: bool) -> dict[str, str]:
    """Return the cells of an arm's row: how it ended, and how long `robot new` took."""
    repository = folder / arm.repository.replace("/", "+")
    if not (repository / arm.file).is_file():
        return {"end": "not run: its description was not fetched", "time": ""}
    out, name = folder / "made", "".join(each if each.isalnum() else "_" for each in arm.name.lower())
    out.mkdir(exist_ok=True)
    options = [str(repository / each) if each.endswith(".srdf") else each for each in arm.options]
    status, said, errors, took = _zencell(
        "robot", "new", str(repository / arm.file), *options, "--yes", "--force", "--name", name, "--cell",
        f"{name}_cell.yaml", "--package-dir", str(repository), *(["--gripper", arm.gripper] if arm.gripper else []),
        folder=out)
    (out / f"{name}.log").write_text(said + errors)
    made = {"time": f"{took:.0f} s"}
    lost = [line for line in said.splitlines() if line.startswith("lost: ")]
    if status:
        return made | {"end": "; ".join([*errors.strip().splitlines()[-1:], *lost]).removeprefix("zencell: ")}
    for words in (("robot", "check", f"{name}.yaml"), ("check", f"{name}_cell.yaml")):
        status, said, errors, _ = _zencell(*words, folder=out)
        if status:
            return made | {"end": f"{' '.join(words[:-1])}: {(said + errors).strip().splitlines()[0]}"}
    return made | {"end": outcome_of(str(out / f"{name}_cell.yaml"), 1) if run else "checked, not run"}


def table(results: dict[str, dict[str, str]]) -> str:
    """Return the table of all arms in Markdown."""
    lines = ["| arm | repository | gripper | `robot new` | how it ended |", "|---|---|---|---|---|"]
    for arm in ARMS:
        row = results.get(arm.name, {"end": "not run", "time": ""})
        end, gripper = row["end"].replace("|", "\\|"), "2F-85" if arm.gripper else "its own"
        lines.append(f"| {arm.name} | {arm.repository} | {gripper} | {row['time']} | {end} |")
    return "\n".join(lines)


def main() -> None:
    """Run the selected arms and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--only", action="append", metavar="NAME", help="of the arms; repeatable")
    parser.add_argument("--run", action="store_true", help="also run each cell, on the virtual clock with seed 1")
    parser.add_argument("--docs", type=Path, metavar="FILE.md", help="page into which the table is written")
    given = parser.parse_args()
    folder = given.folder.resolve()
    store = folder / "results.json"
    results = json.loads(store.read_text()) if store.is_file() else {}
    for arm in ARMS:
        if not given.only or arm.name in given.only:
            results[arm.name] = result_of(arm, folder, run=given.run)
            print(f"{arm.name}: {results[arm.name]}", file=sys.stderr, flush=True)
            store.write_text(json.dumps(results, indent=1))
    rows = table(results).replace(str(folder), "...")
    print(rows)
    if given.docs:
        before, _, rest = given.docs.read_text().partition(BEGIN)
        _, _, after = rest.partition(END)
        given.docs.write_text(f"{before}{BEGIN}\n\n{rows}\n\n{END}{after}")


if __name__ == "__main__":
    main()
