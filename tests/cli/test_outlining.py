"""Files of outlining that cannot be used are rejected in one line."""


import numpy as np
import pytest

from applications.outlining import stage_files

SIZE = (768, 1024)  # of the images of the UR5's camera
BLACK, FAR = np.zeros((*SIZE, 3), np.uint8), np.full(SIZE, 1.75, np.float32)
AT_THE_BORDER = BLACK.copy()
AT_THE_BORDER[300:400, :100] = (0, 255, 255)


@pytest.mark.parametrize(("image", "depth", "arguments", "code", "wanted"), [
    (BLACK, np.ones((10, 20), np.float32), [], 2, "20x10, but camera_image.png is 1024x768"),
    (BLACK[:48, :64], FAR[:48, :64], [], 2, "'64x48' must be as large as the camera's: 1024x768"),
    (BLACK, FAR * np.nan, [], 2, "no valid depth at all"),
    (BLACK, None, [], 2, "depth_data.npy: "),
    (BLACK, FAR, [], 1, "no contour"),
    (BLACK, FAR, ["--select", "purple"], 2, "choices: "),
    (BLACK, FAR, ["--select", "none"], 2, "chooses nothing"),
    (AT_THE_BORDER, FAR, [], 1, "every contour touches the border"),
], ids=lambda value: value if isinstance(value, str) else "")
def test_unusable_images_are_rejected(image, depth, arguments, code, wanted, tmp_path, rejection):
    stage_files.write_pictures(tmp_path, image, FAR if depth is None else depth)
    if depth is None:
        (tmp_path / stage_files.DEPTH).write_bytes(b"no array")
    assert wanted in rejection("outline", str(tmp_path), *arguments, code=code)


@pytest.mark.parametrize(("text", "wanted"), [
    ("", "is not valid JSON"), ("[[1, 2, 3]]", "at least 3 points"), ("[[0, 0, 1], [0, 1, 1], [1, 1]]", "entry 2")])
def test_unusable_coordinates_are_rejected(text, wanted, tmp_path, rejection):
    (tmp_path / stage_files.CLEARED).write_text(text)
    line = rejection("run", "ur5", "--from", str(tmp_path))
    assert f"{stage_files.CLEARED}: " in line and wanted in line
