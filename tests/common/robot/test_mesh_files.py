"""Mesh files of every format: the error for a damaged file is one line that names the field and the file."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from common.errors import ConfigError
from common.robot.mesh_files import parts_of, triangles_of

BOX = trimesh.creation.box((0.1, 0.2, 0.3))
DAMAGED = {
    "empty.stl": b"",
    "cut_off.stl": BOX.export(file_type="stl")[:200],
    "cut_off.dae": BOX.export(file_type="dae")[:400],
    "no_xml.dae": b"solid?",
    "out_of_range.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 300\n",
    "nothing.obj": b"# nothing\n",
    "unknown.xyzzy": b"?",
}


@pytest.mark.parametrize("suffix", ["stl", "dae", "obj"])
def test_mesh_is_read_from_every_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"box.{suffix}"
    path.write_bytes(data.encode() if isinstance(data := BOX.export(file_type=suffix), str) else data)
    assert np.ptp(triangles_of("robot.urdf", path).reshape(-1, 3), axis=0) == pytest.approx([0.1, 0.2, 0.3])
    (part,) = parts_of("robot.urdf", path)
    assert part.extents == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize("read", [triangles_of, parts_of])
@pytest.mark.parametrize("name", [*DAMAGED, "missing.stl"])
def test_damaged_mesh_is_named_in_a_line(tmp_path: Path, name: str, read) -> None:
    path = tmp_path / name
    if name in DAMAGED:
        path.write_bytes(DAMAGED[name])
    with pytest.raises(ConfigError) as refused:
        read("robot.urdf", path)
    message = str(refused.value)
    assert message.startswith(f"robot.urdf: {str(path)!r} is a mesh that cannot be read: ") and "\n" not in message
