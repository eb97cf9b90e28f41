import numpy as np
import pytest

from common.sim.sensors import EXPOSURE, REFERENCE, Sensor, SensorParameters, grey_balance, tint

DAY = np.full(3, REFERENCE)


def flat(value=80, height=240, width=320):
    return np.full((height, width, 3), value, np.uint8)


def sensor(seed=0, **parameters):
    return Sensor(SensorParameters(**parameters), np.random.default_rng(seed))


def exposed(picture, level=DAY, seed=0, **parameters):
    return sensor(seed, **parameters).expose([picture], np.asarray(level))


def test_default_sensor_returns_the_rendered_image():
    picture = flat()
    assert exposed(picture) is picture


@pytest.mark.parametrize("times", [0.25, 0.5, 2, 3])
def test_values_are_proportional_to_exposure_gain_and_light(times):
    assert (exposed(flat(), exposure=EXPOSURE * times) == 80 * times).all()
    assert (exposed(flat(), DAY * times) == 80 * times).all()
    assert times < 1 or (exposed(flat(), gain=times) == 80 * times).all()
    assert times < 2 or (exposed(flat(200), exposure=times * EXPOSURE) == 255).all(), "it saturates"


def test_shot_noise_variance_is_proportional_to_the_signal():
    for value in (20, 80, 180):
        variance = exposed(flat(value), full_well=5000, read_noise=0).astype(float).var()
        assert variance == pytest.approx(value * 255 / 5000 + 1 / 12, rel=0.05)  # and that of rounding


def test_gain_amplifies_read_noise():
    for gain in (1, 4):
        deviation = exposed(flat(40), DAY / gain, full_well=5000, read_noise=30, gain=gain).astype(float).std()
        electrons = 40 / gain * 5000 / 255
        assert deviation == pytest.approx(gain * 255 / 5000 * np.sqrt(electrons + 900), rel=0.05)


def test_noise_is_that_of_the_seed():
    one, same, other = (exposed(flat(), seed=seed, full_well=3000) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


@pytest.mark.parametrize("lux", [100, 500, 3000, 10_000])
def test_auto_exposure_reaches_the_same_brightness_in_any_light(lux):
    assert exposed(flat(140), np.full(3, lux), auto_exposure=True).mean() == pytest.approx(110, rel=0.06)


@pytest.mark.parametrize(("lux", "gained"), [(1000, False), (20, True)])
def test_auto_exposure_uses_gain_only_at_the_longest_exposure(lux, gained):
    one = sensor(auto_exposure=True, longest_exposure=0.02)
    one.expose([flat(140)], np.full(3, lux))
    assert (one.gain > 1) == gained and (one.exposure == 0.02 if gained else one.exposure < 0.02)


def test_auto_exposure_follows_changing_light():
    one = sensor(auto_exposure=True)
    one.expose([flat(140)], DAY)
    dark = [one.expose([flat(140)], DAY / 6).mean() for _ in range(4)]
    assert dark[0] < 25 and dark[-1] == pytest.approx(110, rel=0.06)


def test_auto_exposure_does_not_saturate_a_small_bright_region():
    picture = flat(10)
    picture[:60, :80] = 220
    assert exposed(picture, auto_exposure=True)[10, 10].max() < 255


@pytest.mark.parametrize("temperature", [2700, 4000, 6500, 9000])
def test_auto_white_balance_keeps_grey_grey_and_red_red(temperature):
    picture = flat(150)
    picture[80:140, 80:140] = (26, 38, 255)
    level = REFERENCE / 2 * tint(temperature)
    seen = exposed(picture, level, white_balance="auto", full_well=10_000).astype(float)
    grey = seen[160:, 160:].reshape(-1, 3).mean(axis=0)
    assert np.ptp(grey) < 0.12 * grey.max()
    b, g, r = seen[90:130, 90:130].reshape(-1, 3).mean(axis=0)
    assert r > 3 * max(b, g)
    if temperature < 5000:
        plain = exposed(picture, level).astype(float)[160:, 160:].reshape(-1, 3).mean(axis=0)
        assert np.ptp(plain) > 0.3 * plain.max(), "without it grey is not grey"


def test_image_without_grey_has_no_balance():
    for color in ((30, 200, 20), (0, 0, 0)):
        assert grey_balance(np.full((64, 64, 3), color, np.float32)) is None


def test_sub_exposures_are_averaged():
    left, right = flat(0), flat(0)
    left[:, :100], right[:, 100:200] = 200, 200
    picture = sensor(sub_exposures=2).expose([left, right], DAY)
    assert (picture[:, :200] == 100).all() and (picture[:, 200:] == 0).all()


def test_tint_has_daylight_luminance_and_varies_with_temperature():
    tints = np.array([tint(temperature) for temperature in (2000, 3000, 5000, 6500, 10_000)])
    weights = np.array([0.0722, 0.7152, 0.2126])  # of luminance, IEC 61966-2-1
    np.testing.assert_allclose(tints @ weights, 1, atol=0.02)
    assert (np.diff(tints[:, 0]) > 0).all() and (np.diff(tints[:, 2]) < 0).all()
    np.testing.assert_allclose(tint(6500), 1)
