"""Decomposes one mesh by CoACD, in a process of its own that can be ended: arrays from stdin, arrays to stdout."""

import io
import os
import sys

import numpy as np

MOST = 16  # pieces
CORNERS = 32  # of a piece
THRESHOLD = 0.08  # concavity of a piece, by the size of the mesh


def main() -> None:
    """Write the triangles (n, 3, 3) of each piece as .npz."""
    given = np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False)
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # the library may print
    import coacd

    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(given["points"], given["faces"]), threshold=THRESHOLD, max_convex_hull=MOST, max_ch_vertex=CORNERS,
        decimate=True, preprocess_resolution=50, resolution=500, mcts_nodes=8, mcts_iterations=30, mcts_max_depth=2)
    arrays = {}
    for number, (points, faces) in enumerate(found):
        arrays[str(number)] = np.asarray(points, float)[np.asarray(faces, int)]
    np.savez(output, **arrays)
    output.close()


if __name__ == "__main__":
    main()
