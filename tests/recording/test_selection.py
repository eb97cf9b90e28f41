import pytest

from common.errors import ConfigError
from recording.selection import Selection

KEYS = ["camera/image_raw", "camera/camera_info", "tf", "tf_static", "log", "depth_camera/depth/image_raw"]


def chosen(*keys: str, regex: str | None = None, exclude: str | None = None) -> list[str]:
    selection = Selection.of(keys, regex, exclude)
    return [key for key in KEYS if selection.wants(key)]


def test_empty_selection_selects_everything() -> None:
    assert chosen() == KEYS


def test_keys_match_completely() -> None:
    assert chosen("tf", "log") == ["tf", "log"]


def test_wildcards_match_as_in_zenoh() -> None:
    assert chosen("camera/*") == ["camera/image_raw", "camera/camera_info"]
    assert chosen("**/image_raw") == ["camera/image_raw", "depth_camera/depth/image_raw"]
    assert chosen("depth_camera/**") == ["depth_camera/depth/image_raw"]
    assert chosen("tf*") == ["tf", "tf_static"]
    assert chosen("**") == KEYS


def test_regular_expression_matches_anywhere_and_adds_to_keys() -> None:
    assert chosen(regex="^tf") == ["tf", "tf_static"]
    assert chosen("log", regex="info$") == ["camera/camera_info", "log"]


def test_exclusion_takes_precedence() -> None:
    assert chosen(exclude="image") == ["camera/camera_info", "tf", "tf_static", "log"]
    assert chosen("tf", "tf_static", exclude="static") == ["tf"]


@pytest.mark.parametrize(("option", "value"), [("regex", "["), ("exclude", "(?P<")])
def test_invalid_expression_is_rejected_by_name(option: str, value: str) -> None:
    with pytest.raises(ConfigError, match=f"--{option}.*is not a regular expression"):
        Selection.of([], **{option: value})


@pytest.mark.parametrize("key", ["", "/tf", "tf/", "a//b", "a b", "a?b", "a#", "a**", "a/b**/c"])
def test_invalid_key_is_rejected_by_name(key: str) -> None:
    with pytest.raises(ConfigError, match="is not a key"):
        Selection.of([key])


def test_key_expressions_cover_the_selection_and_little_else() -> None:
    assert Selection.of().expressions == ("**",)
    assert Selection.of(["tf"], regex="x").expressions == ("**",)
    assert Selection.of(["tf", "camera/*", "depth_camera/**", "tf*", "tf"]).expressions == (
        "tf", "camera/*", "depth_camera/**", "tf$*")
    assert Selection.of(["**/*"]).expressions == ("**",)
