"""Files whose headers claim more than a machine can hold are rejected before they are decoded."""

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest

from common.errors import ConfigError
from common.perception.image_files import read_array, read_image
from common.perception.image_sources import open_source


def png(width, height, data=b""):
    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def bmp(width, height):
    header = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + header


def npy(shape, kind="<f4", data=b""):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


@pytest.mark.parametrize(("name", "content", "size", "problem"), [
    ("bomb.png", png(32000, 32000), 0, "too many pixels; at most 89,478,485"),
    ("wide.png", png(2**31 - 1, 1), 0, "too many pixels"),
    ("bomb.bmp", bmp(2**30, 2**30), 0, "too many pixels"),
    ("sparse.bmp", bmp(64, 64), 8 * 2**30, "8,589,934,592 bytes; at most 16,842,752"),
    ("short.png", png(64, 64), 0, "not a readable image"),
    ("text.png", b"no image", 0, "not a readable image"),
    ("lying.npy", npy((40000, 40000)), 0, "no array that numpy can read"),
    ("overflow.npy", npy((2**62, 4)), 0, "no array that numpy can read"),
    ("negative.npy", npy((-3, 4)), 0, "no array that numpy can read"),
    ("sparse.npy", npy((2**31,)), 8 * 2**30, "8,589,934,592 bytes"),
    ("objects.npy", npy((3,), "|O"), 0, "no array that numpy can read"),
    ("missing.png", None, 0, "not a file"),
])
def test_file_that_lies_about_its_size_is_rejected_unread(tmp_path, name, content, size, problem):
    path = tmp_path / name
    if content is not None:
        with path.open("wb") as file:
            file.write(content)
            file.truncate(size or len(content))
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError, match=problem) as caught:
            read_array(path) if name.endswith(".npy") else read_image(path)
        assert tracemalloc.get_traced_memory()[1] < 4e6
    finally:
        tracemalloc.stop()
    assert name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tiff", "webp"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_images_and_arrays_are_read_as_bgr8_and_as_stored(tmp_path, suffix, kind):
    image = np.full((6, 8, 3), (10, 100, 200), np.uint8)
    wide = kind is np.uint16 and suffix in ("png", "tiff")
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), image.astype(kind) * 257 if wide else image)
    assert np.abs(read_image(path).astype(int) - image).max() <= 6
    np.save(path.with_suffix(".npy"), image)
    np.testing.assert_array_equal(read_array(path.with_suffix(".npy")), image)


def test_video_of_huge_frames_is_rejected_and_one_image_is_a_source(tmp_path, monkeypatch):
    (path := tmp_path / "one.png").write_bytes(png(8, 6, (b"\0\xff") * 6))
    assert open_source(str(path), None, None, loop=False).read().shape == (6, 8, 3)
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    monkeypatch.setattr("common.perception.image_sources.MAX_PIXELS", 1000)
    with pytest.raises(ConfigError, match="frames of 64x48; at most 1,000 pixels"):
        open_source(str(tmp_path / "v.avi"), None, None, loop=False)
