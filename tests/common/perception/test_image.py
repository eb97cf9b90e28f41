import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from common.messages import Header, Image
from common.perception.image import ENCODINGS, ImageError, array_to_image, image_to_array


def message(data, width=4, height=3, encoding="mono8", *, step=0, big=False):
    return Image(header=Header(), width=width, height=height, encoding=encoding, step=step, is_bigendian=big, data=data)


@st.composite
def pictures(draw):
    name = draw(st.sampled_from(sorted(ENCODINGS)))
    encoding = ENCODINGS[name]
    shape = (draw(st.integers(1, 12)), draw(st.integers(1, 12)), *([3] if encoding.channels == 3 else []))
    return name, draw(hnp.arrays(encoding.dtype, shape))


@given(pictures())
def test_round_trip_is_exact_and_the_array_a_writable_copy(picture):
    name, array = picture
    header = Header(stamp=12345, frame_id="camera_optical_frame")
    sent = array_to_image(array, name, header)
    assert sent.header == header
    before, back = bytes(sent.data), image_to_array(sent)
    assert back.dtype == array.dtype
    np.testing.assert_array_equal(back, array)
    assert back.flags.c_contiguous and back.flags.writeable and back.dtype.isnative
    back[...] = 0
    assert sent.data == before


@given(pictures(), st.integers(0, 5), st.booleans(), st.booleans())
@settings(max_examples=60)
def test_padding_zero_stride_and_byte_order_do_not_change_the_pixels(picture, padding, big, cut_last):
    name, array = picture
    size = ENCODINGS[name].pixel_bytes
    stored = array.astype(array.dtype.newbyteorder(">" if big else "<"))
    data = b"".join(row.tobytes() + b"\xee" * (padding * size) for row in stored)
    if cut_last and padding:
        data = data[: -padding * size]
    height, width = array.shape[:2]
    step = (width + padding) * size if padding else 0
    np.testing.assert_array_equal(image_to_array(message(data, width, height, name, step=step, big=big)), array)


def test_array_of_any_memory_layout_is_encoded():
    array = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    for view in (array[::-1], array[:, ::2], array.transpose(1, 0, 2), np.asfortranarray(array)):
        np.testing.assert_array_equal(image_to_array(array_to_image(view, "rgb8")), view)
    big = np.arange(6, dtype=">u2").reshape(2, 3)
    np.testing.assert_array_equal(image_to_array(array_to_image(big, "16UC1")), big)


@pytest.mark.parametrize(("image", "kind", "text"), [
    *((message(bytes(12 - missing)), "truncated", "too few for 4x3 mono8") for missing in (1, 5, 12)),
    (message(bytes(13)), "", "13 bytes are more than 4x3 mono8"),
    (message(bytes(12), encoding="yuv422"), "", "'yuv422' is not known; choices: bgr8, rgb8, mono8, 16UC1, 32FC1"),
    (message(bytes(100), encoding="bgr8", step=11), "step", "step 11 is shorter than a row of 4 bgr8 pixels"),
    *((message(bytes(step * 3), encoding=encoding, step=step), "step", "not a whole number")
      for encoding, step in (("bgr8", 13), ("16UC1", 9), ("32FC1", 18))),
])
def test_invalid_image_is_rejected(image, kind, text):
    with pytest.raises(ImageError, match=text) as caught:
        image_to_array(image)
    assert kind in caught.value.kind


@pytest.mark.parametrize(("array", "encoding"), [
    (np.zeros((2, 2), np.uint8), "bgr8"),
    (np.zeros((2, 2, 4), np.uint8), "rgb8"),
    (np.zeros((2, 2, 3), np.uint8), "mono8"),
    (np.zeros((0, 2), np.uint8), "mono8"),
    (np.zeros((2, 2, 3), np.float32), "bgr8"),
    (np.zeros((2, 2), np.int16), "16UC1"),
    (np.zeros((2, 2), np.float64), "32FC1"),
])
def test_array_of_wrong_shape_or_type_is_rejected(array, encoding):
    with pytest.raises(ImageError, match=f"{encoding} needs"):
        array_to_image(array, encoding)
    with pytest.raises(ImageError, match="'BGR8' is not known"):
        array_to_image(array, "BGR8")
