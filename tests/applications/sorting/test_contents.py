"""Images of a container show whether more objects arrived than were released there."""

import pytest

from applications.sorting.contents import Contents, gap, separate
from applications.sorting.topics import SeenObject
from common.messages import Color, Vector3

COLORS = {"red": Color(r=1.0, g=0.0, b=0.0), "blue": Color(r=0.0, g=0.0, b=1.0), "orange": Color(r=1.0, g=0.1, b=0.0)}


def at(name, x, color="red", volume=4e-5):
    return SeenObject(id=name, place="left", center=Vector3(x=x, y=0.4), size=Vector3(x=0.04, y=0.03, z=0.03),
                      volume=volume, color=COLORS[color], color_name=color)


OLD, NEW = at("old", 0.40), at("new", 0.50)
FAR, NEAR, BLUE = at("far", 0.565), at("near", 0.55), at("blue", 0.545, "blue")


@pytest.mark.parametrize(("known", "pending", "images", "extra", "new"), [
    ([OLD], ["red"], [[OLD, NEW]], 0, []),
    ([OLD], ["red"], [[OLD, NEW, FAR]], 1, ["new", "far"]),
    ([OLD], ["red"], [[OLD, NEW, BLUE]], 1, ["new", "blue"]),
    ([], ["red"], [[NEW, BLUE]], 1, ["new", "blue"]),
    ([OLD], ["red"], [[OLD, NEW, NEAR]], 0, []),  # may be one that is seen as two
    ([OLD], ["red"], [[OLD, NEW, BLUE], [OLD, NEW]], 0, []),  # noise of one image
    ([OLD], ["red"], [[OLD, NEW, at("chip", 0.6, "blue", 1e-6)]], 0, []),
    ([OLD], ["red"], [[OLD, NEW, at("part", 0.54, "orange")]], 0, []),  # a shadow changed the name of a color
    ([OLD], ["red", "blue"], [[OLD, NEW, BLUE]], 0, []),
    ([OLD], ["red", "blue"], [[OLD, NEW, BLUE, FAR]], 1, ["new", "blue", "far"]),
    ([OLD], [], [[OLD, NEW, BLUE]], 0, []),  # by an operator
    ([OLD], ["red"], [[at("x", 0.35), at("y", 0.60)]], 0, []),  # the old one was pushed
])
def test_more_objects_than_were_released_are_found(known, pending, images, extra, new):
    contents = Contents(pending=pending).model_copy(update=vars(Contents().updated([known])) | {"pending": pending})
    found, things = contents.more(images * 2 if len(images) == 1 else images)
    assert (found, {each.id for each in things}) == (extra, set(new))


def test_object_that_was_covered_is_not_new_when_it_is_visible_again():
    contents = Contents().updated([[OLD, BLUE]]).updated([[OLD]])
    contents = contents.model_copy(update={"pending": ["red"]})
    assert contents.more([[OLD, NEW, BLUE]] * 2) == (0, [])


def test_gap_is_that_of_the_outlines():
    assert gap(NEW, FAR) == pytest.approx(0.025, abs=1e-4) and gap(NEW, at("o", 0.51)) == 0.0
    assert {each.id for each in separate([NEW, NEAR, FAR, BLUE])} == {"new", "far", "blue"}
