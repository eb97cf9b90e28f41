import pytest

from common.errors import ConfigError
from recording.selection import Selection

KEYS = ["camera/image_raw", "camera/camera_info", "tf", "tf_static", "log", "depth_camera/depth/image_raw"]
IMAGE, INFO, TF, TF_STATIC, LOG, DEPTH = KEYS


@pytest.mark.parametrize(("keys", "options", "wanted"), [
    ([], {}, KEYS), (["**"], {}, KEYS), (["tf", "log"], {}, [TF, LOG]), (["camera/*"], {}, [IMAGE, INFO]),
    (["**/image_raw"], {}, [IMAGE, DEPTH]), (["depth_camera/**"], {}, [DEPTH]), (["tf*"], {}, [TF, TF_STATIC]),
    ([], {"regex": "^tf"}, [TF, TF_STATIC]), (["log"], {"regex": "info$"}, [INFO, LOG]),
    ([], {"exclude": "image"}, [INFO, TF, TF_STATIC, LOG]), (["tf", "tf_static"], {"exclude": "static"}, [TF]),
])
def test_keys_are_selected_as_in_zenoh_and_by_regular_expressions(keys, options, wanted):
    selection = Selection.of(keys, **options)
    assert [key for key in KEYS if selection.wants(key)] == wanted


@pytest.mark.parametrize(("option", "value"), [("regex", "["), ("exclude", "(?P<")])
def test_invalid_expression_is_rejected_by_name(option, value):
    with pytest.raises(ConfigError, match=f"--{option}.*is not a regular expression"):
        Selection.of([], **{option: value})


@pytest.mark.parametrize("key", ["", "/tf", "tf/", "a//b", "a b", "a?b", "a#", "a**", "a/b**/c"])
def test_invalid_key_is_rejected_by_name(key):
    with pytest.raises(ConfigError, match="is not a key"):
        Selection.of([key])


def test_key_expressions_cover_the_selection_and_little_else():
    assert Selection.of().expressions == Selection.of(["**/*"]).expressions == ("**",)
    assert Selection.of(["tf"], regex="x").expressions == ("**",)
    assert Selection.of(["tf", "camera/*", "depth_camera/**", "tf*", "tf"]).expressions == (
        "tf", "camera/*", "depth_camera/**", "tf$*")
