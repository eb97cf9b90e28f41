"""For how long nothing was heard of an arm: by who listened, not by who was held up meanwhile."""

from __future__ import annotations

import pytest

from drivers.ur import LATEST, LOOK, Silence


def test_silence_grows_with_the_time_that_was_listened_and_ends_with_a_word() -> None:
    silence = Silence()
    assert silence.lasts(10.0, True) == 0.0
    lengths = [silence.lasts(10.0 + 0.002 * n, False) for n in range(1, 101)]
    assert lengths[-1] == pytest.approx(0.2) and lengths[70] <= LATEST < lengths[80]
    assert silence.lasts(10.3, True) == 0.0


def test_who_was_held_up_has_not_listened() -> None:
    silence = Silence()
    silence.lasts(10.0, True)
    assert silence.lasts(11.0, False) == LOOK
    assert silence.lasts(11.002, False) == pytest.approx(LOOK + 0.002)
