"""Bodies of a height, weight and words, and sensors on them."""

import numpy as np
import pytest

from edgepose.cli.options.body import BodyFlags
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS, SITES
from edgepose.sip.bodies import WORDS, scaled, sensor_points, shaped_body
from edgepose.skeleton import default_body


def length(body, *joints):
    return sum(np.linalg.norm(body.offsets[joint]) for joint in joints)


def stature(body):
    """Legs and trunk, which together make the height."""
    return length(body, 4, 7) - body.offsets[1, 1] + body.offsets[[3, 6, 9, 12, 15], 1].sum()


def test_without_a_description_it_is_the_default_body():
    for body, default in (
        (shaped_body(1.7, "female"), default_body(1.7, "female")),
        (shaped_body(), default_body()),
    ):
        np.testing.assert_array_equal(body.offsets, default.offsets)
        np.testing.assert_array_equal(body.sensors, default.sensors)


@pytest.mark.parametrize(
    ("word", "joints"),
    [
        ("long-legged", (4, 7)),
        ("long-armed", (18, 20)),
        ("long-necked", (15,)),
        ("broad-shouldered", (16,)),
        ("broad-hipped", (1,)),
    ],
)
def test_words_do_what_they_say(word, joints):
    plain, more = shaped_body(1.8), shaped_body(1.8, words=[word])
    assert 1.01 < length(more, *joints) / length(plain, *joints) < 1.15
    assert stature(more) == pytest.approx(stature(plain), abs=0.012)  # the wearer's height is known
    twice = shaped_body(1.8, words=[word, word])
    np.testing.assert_allclose(twice.offsets - more.offsets, more.offsets - plain.offsets, atol=1e-12)
    opposite = next(o for o, (name, sign) in WORDS.items() if name == word and sign < 0)
    back = shaped_body(1.8, words=[word, opposite])
    np.testing.assert_allclose(back.offsets, plain.offsets, atol=1e-12)


def test_both_sides_are_alike():
    body = shaped_body(1.66, "female", 80.0, ["long-armed", "broad-hipped", "slender"])
    mirror = np.array([-1.0, 1.0, 1.0])
    for left, right in ((1, 2), (4, 5), (7, 8), (13, 14), (16, 17), (18, 19), (20, 21)):
        np.testing.assert_allclose(body.offsets[left] * mirror, body.offsets[right], atol=1e-9)


def test_weight_moves_sensors_away_from_bones():
    light, heavy = shaped_body(1.8, "male", 60.0), shaped_body(1.8, "male", 110.0)
    back = PLACEMENTS.index("pelvis")
    assert heavy.sensors[back, 2] < light.sensors[back, 2] - 0.01
    assert np.abs(heavy.offsets - light.offsets).max() < 0.02  # bones hardly change


def test_scale():
    body = scaled(default_body(), 1.1)
    np.testing.assert_allclose(body.offsets, 1.1 * default_body().offsets)
    assert body.height_m == pytest.approx(1.925)


def test_all_sensors_lie_on_their_bones():
    body = default_body()
    points = sensor_points(body, list(SITES))
    assert points.bones.tolist() == list(SITES.values())
    np.testing.assert_array_equal(points.points[:6], body.sensors)
    thigh = list(SITES).index("left_upper_leg")
    np.testing.assert_allclose(points.points[thigh], body.offsets[4] / 2.0)
    assert np.linalg.norm(points.points, axis=1).max() < 0.35


def test_the_flags_of_a_body_with_measured_legs():
    flags = BodyFlags("smpl", 1.9, 0.95, "male", 95.0, ("long-legged",), 1.1)
    body = flags.build()
    assert body.leg_length_m == pytest.approx(1.1 * 0.95)
    plain = flags._replace(leg_length=None).build()
    assert stature(body) == pytest.approx(stature(plain), abs=1e-3)
    with pytest.raises(EdgeposeError, match=r"leg length 0.5 m does not fit a height of 1.9 m"):
        flags._replace(leg_length=0.5).build()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"words": ["tall"]}, "unknown word 'tall'"),
        ({"weight_kg": 180.0, "height_m": 1.7}, "180 kg at 1.7 m: give the wearer's weight in kilograms"),
        ({"weight_kg": float("nan")}, "nan kg"),
        ({"height_m": 175.0}, "give the wearer's height in metres"),
        ({"sex": "other"}, "unknown sex"),
    ],
)
def test_slips_are_told(words, message):
    with pytest.raises(EdgeposeError, match=message):
        shaped_body(**words)
