"""Concave meshes are split into convex pieces once; otherwise their hull collides, with a warning."""

from pathlib import Path

import numpy as np
import pytest

from common.sim.solids import extrude, primitive
from drivers.mujoco import decomposition
from drivers.mujoco.decomposition import connected_parts, is_convex, mesh_pieces, points_and_volume

NONE = np.empty((0, 2))
ELL = extrude(np.array([(0, 0), (0.1, 0), (0.1, 0.02), (0.02, 0.02), (0.02, 0.1), (0, 0.1)], float), NONE, 0.0, 0.02)
VOLUME = (0.1 * 0.02 + 0.08 * 0.02) * 0.02  # [m^3] of ELL
BOX = primitive("box", [0.04, 0.03, 0.02])


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENCELL_CACHE", str(tmp_path))
    monkeypatch.setattr(decomposition, "_spent", 0.0)


@pytest.mark.parametrize(("part", "convex"), [
    (BOX, True), (BOX[:, ::-1], True), (primitive("sphere", [0.03]), True), (primitive("cylinder", [0.02, 0.1]), True),
    (ELL, False), (ELL[:, ::-1], False), (0.01 * ELL, True),  # less deep than a millimeter
], ids=["box", "box inside out", "sphere", "cylinder", "L", "L inside out", "tiny L"])
def test_concave_parts_are_recognized(part: np.ndarray, convex: bool) -> None:
    assert is_convex(part) == convex and len(connected_parts(part)) == 1


def test_convex_parts_are_pieces_with_their_volume() -> None:
    pieces = mesh_pieces(np.concatenate([BOX, BOX + 0.1, BOX[:1] - 0.1]), "boxes")
    measured = [points_and_volume(piece) for piece in pieces]
    assert [len(points) for points, _ in measured] == [10, 10]  # with the middles of top and bottom
    assert [volume for _, volume in measured] == pytest.approx([0.04 * 0.03 * 0.02] * 2)


def test_concave_part_is_decomposed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("coacd")
    first = mesh_pieces(ELL, "bracket", limit=60.0)
    assert len(first) >= 2 and sum(points_and_volume(piece)[1] for piece in first) == pytest.approx(VOLUME, rel=0.2)
    monkeypatch.setattr(decomposition, "WORKER", Path("missing"))
    again = mesh_pieces(ELL, "bracket")
    assert [piece.tolist() for piece in again] == [piece.tolist() for piece in first]


@pytest.mark.parametrize(("worker", "limit", "installed", "reason"), [
    ("import time; time.sleep(60)", 1.0, True, "its decomposition takes more than 1 s; decompose it ahead of time by"),
    ("raise ValueError('open')", 60.0, True, "its decomposition fails: ValueError: open"),
    ("", 0.0, True, "no time is left at the start; decompose it ahead of time by"),
    ("", 60.0, False, "that needs the extra `meshes`: pip install 'zencell[meshes]'"),
])
def test_hull_collides_where_a_mesh_is_not_decomposed(
    worker: str, limit: float, installed: bool, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    script = tmp_path / "worker.py"
    script.write_text(worker)
    monkeypatch.setattr(decomposition, "WORKER", script)
    monkeypatch.setattr(decomposition, "find_spec", lambda _: installed or None)
    (piece,) = mesh_pieces(ELL, "bracket", limit)
    assert (piece == ELL).all()
    expected = f"bracket: its mesh is concave but collides as its convex hull: {reason}"
    assert [message[: len(expected)] for message in caplog.messages] == [expected]
