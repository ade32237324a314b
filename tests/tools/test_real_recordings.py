"""The tools for the recordings of real wearers: their conversion and their picture."""

import numpy as np
import pytest

from edgepose.placements import SITES
from edgepose.rotations import rotation_about_axis
from edgepose_export.synthesis.virtual_imus import straight_pose
from tools import make_real_recordings

draw_real = pytest.importorskip("tools.draw_real", exc_type=ImportError)


def test_tables_of_mt_manager_become_sensors_by_segment(tmp_path):
    head = "// Update Rate: 60.0Hz\nPacketCounter;" + ";".join("abcdefghijklm") + "\n"
    for number, serial in enumerate(make_real_recordings.SEGMENTS):
        row = [number, 9.8, 0, 0.1, 0.2, 0.3, 7, 8, 9, 1, 0, 0, 0]
        lines = (";".join(map(str, [packet, *row])) for packet in (500, 501, 503))
        (tmp_path / f"walk_00b45c{serial}.csv").write_text(head + "\n".join(lines))
    sensors = make_real_recordings.read_walker(tmp_path)
    assert list(sensors) == list(SITES)
    for number, segment in enumerate(make_real_recordings.SEGMENTS.values()):
        data = make_real_recordings.rounded(sensors[segment])
        np.testing.assert_allclose(data.time_s, [0, 1 / 60, 3 / 60])
        np.testing.assert_array_equal(data.quat, [[1, 0, 0, 0]] * 3)
        np.testing.assert_allclose(data.acc[0], [number, 9.8, 0], atol=0.004)
        np.testing.assert_allclose(data.gyr[0], [0.1, 0.2, 0.3], atol=0.0005)


@pytest.mark.parametrize("bone", draw_real.BONES)
def test_the_picture_shows_how_far_forward_a_limb_swings(bone):
    facing = np.radians([0.0, 90.0])
    swing = rotation_about_axis("x", np.radians(-30.0))
    bones = rotation_about_axis("y", facing) @ swing @ straight_pose()[SITES[bone]]
    np.testing.assert_allclose(draw_real.forward_angle(bone, bones, facing), 30.0)
    np.testing.assert_allclose(draw_real.forward_angle(bone, bones[:1], facing[1:]), 0.0, atol=1e-9)
