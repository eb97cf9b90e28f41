"""Write joint states to a CSV file; read any other key."""

import csv
import sys
from pathlib import Path

from zencell.blocking import Cell

with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda", autostart=True) as cell:
    joints = cell.arm.description().joints
    file = Path("joints.csv")
    with file.open("w", newline="") as out:
        rows = csv.writer(out)
        rows.writerow(["seconds", *joints])
        began = None
        for state in cell.listen("joint_states"):
            began = began or state.header.stamp
            seconds = 1e-9 * (state.header.stamp - began)
            positions = dict(zip(state.name, state.position, strict=True))
            rows.writerow([f"{seconds:.3f}", *(f"{positions[name]:.5f}" for name in joints)])
            if seconds > 2.0:
                break
    print(f"{file.absolute()}: {len(file.read_text().splitlines()) - 1} rows")
    for line in cell.listen("motion/status"):
        print(f"goal {line.id or 'none'}: {line.state}")
        break
    answer = cell.call("motion/hold", hold=True, owner=cell.owner)  # any request, by its fields
    print("held:", answer.held)
    cell.call("motion/hold", hold=False, owner=cell.owner)
