"""Tracks of detections: they start after two frames, keep their ids, and expire."""

from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.tracks import SceneParameters, Sighting, Tracks


def at(x, y, z=0.03, **fields):
    return Sighting(position=(x, y, z), **fields)


def tracks(**options):
    defaults = {"match_radius": 0.08, "confirm_frames": 2, "forget_after": 0.5, "smoothing": 0.5, "still": 0.003}
    return Tracks(SceneParameters(**{**defaults, **options}))


def test_track_exists_after_two_frames_and_expires():
    t = tracks()
    t.update([at(0.4, 0.0)], 1.0)
    assert t.confirmed() == []
    t.update([at(0.4, 0.0)], 1.1)
    assert [b.id for b in t.confirmed()] == ["track_1"]
    t.update([], 1.5)
    assert len(t.confirmed()) == 1
    t.update([], 1.7)
    assert t.confirmed() == []


def test_tracks_of_an_occasional_view_expire_only_when_it_looks_again():
    t = tracks()
    for now in (1.0, 1.1):
        t.update([at(0.4, 0.0)], now, 1, True)  # of the hand
    for now in (1.2, 5.0, 9.0):
        t.update([at(0.6, 0.0)], now, 0)  # of a fixed camera, which does not see the first one
    assert {b.id for b in t.confirmed()} == {"track_1", "track_2"}
    t.update([at(0.42, 0.0)], 9.1, 1, True)  # it was moved meanwhile
    assert {b.position[0] for b in t.confirmed() if b.id == "track_1"} == {0.42}
    for now in (9.2, 14.9):
        t.update([at(0.6, 0.0)], now, 0)
    t.update([], 15.0, 1, True)  # the first image of the hand after a long time counts
    assert {b.id for b in t.confirmed()} == {"track_2"}


def test_touching_balls_keep_their_ids_when_one_is_taken_away():
    t = tracks()
    a, b = at(0.40, 0.0), at(0.46, 0.0)
    for now in (1.0, 1.1):
        t.update([a, b], now)
    ids = {b.id: b.position for b in t.confirmed()}
    t.update([b], 1.2)
    t.update([b], 1.7)
    (left,) = t.confirmed()
    assert ids[left.id] == b.position


def test_still_ball_is_smoothed_and_a_jumping_one_not():
    t = tracks()
    t.update([at(0.40, 0.0)], 1.0)
    t.update([at(0.402, 0.0)], 1.1)
    assert abs(t.confirmed()[0].position[0] - 0.401) < 1e-9
    t.update([at(0.43, 0.0)], 1.2)
    assert t.confirmed()[0].position[0] == 0.43


coordinate = st.floats(0.2, 0.8, allow_nan=False)


@given(st.lists(st.lists(st.tuples(coordinate, coordinate, st.just(0.03)), max_size=8), min_size=1, max_size=6))
def test_matching_is_one_to_one_for_any_detections(frames):
    t = tracks(confirm_frames=1, forget_after=0.0)
    for number, frame in enumerate(frames):
        t.update([at(*place) for place in frame], float(number))
        assert len({b.id for b in t.confirmed()}) == len(t.confirmed()) == len(frame)


def test_box_near_a_ball_track_does_not_match_it():
    t = tracks(confirm_frames=1)
    t.update([at(0.4, 0.0, kind="ball"), at(0.44, 0.0, kind="cube", shape="box", size=(0.04, 0.04, 0.04))], 1.0)
    ids = {b.sighting.kind: b.id for b in t.confirmed()}
    t.update([at(0.42, 0.0, kind="cube", shape="box", size=(0.04, 0.04, 0.04))], 1.1)
    assert {b.sighting.kind: b.id for b in t.confirmed() if b.last_seen == 1.1} == {"cube": ids["cube"]}


def test_finger_width_selects_the_held_neighbor():
    for width, kind in ((0.06, "ball"), (0.03, "cube"), (0.0, "cube")):
        t = tracks(confirm_frames=1)
        t.update([at(0.41, 0.0, kind="ball", size=(0.06, 0.06, 0.06)),
                  at(0.405, 0.0, kind="cube", shape="box", size=(0.03, 0.03, 0.03))], 1.0)
        taken = t.take((0.4, 0.0, 0.03), 0.08, width)
        assert taken is not None and taken.sighting.kind == kind
