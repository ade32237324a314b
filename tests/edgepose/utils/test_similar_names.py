"""What is suggested for mistyped names, wherever a user types one."""

import pytest

from edgepose.calibration.body_frame import check_body_frame
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording
from edgepose.inference.archive import find_archive
from edgepose.sources.protocol_detection import checked_protocol, protocol_named
from edgepose.sources.sensor_map import read_map
from edgepose.utils.similar_names import choices

MAP = """
left_forearm = { port = "a" }
right_forearm = { port = "b" }
left_lower_leg = { port = "c" }
right_lower_leg = { port = "d" }
head = { port = "e" }
pelvis = { port = "f" }
"""


def test_similar_names_or_all_of_them():
    assert choices("xsns", ["native", "xsens", "xsens-can"]) == "did you mean 'xsens' or 'xsens-can'?"
    assert choices("zzz", ["native", "xsens"]) == "known are native, xsens"
    assert choices("native", ["native", "nativ"], "names are") == "names are native, nativ"


@pytest.mark.parametrize(
    ("use", "says"),
    [
        (
            lambda: checked_protocol("natve"),
            "unknown protocol 'natve'; did you mean 'native' or 'native-can'",
        ),
        (lambda: protocol_named("vectornv"), "'vectornv'; did you mean 'vectornav' or 'vectornav-ascii'"),
        (lambda: find_archive("brinn"), "brinn: no such model; did you mean 'birnn'"),
        (lambda: check_body_frame("pelvs:-z"), "pelvis:-z.; did you mean 'pelvis'"),
        (lambda: check_body_frame("pelvis:w"), "such as heading:90, pelvis:-z.$"),
        (lambda: check_body_frame("navel:z"), "pelvis:-z.; sensors are left_forearm, "),
    ],
)
def test_flags(use, says):
    with pytest.raises(EdgeposeError, match=says):
        use()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("left_forearm", "left_forarm", "unknown placement 'left_forarm'; did you mean 'left_forearm'"),
        ('head = { port = "e" }', 'head = { prot = "e" }', "unknown key 'prot'; did you mean 'port'"),
        ("\nleft_forearm", "\nports.a.protocl = 'xsens'\nleft_forearm", "'protocl'; did you mean 'protocol'"),
    ],
)
def test_maps(tmp_path, old, new, says):
    file = tmp_path / "map.toml"
    file.write_text(MAP.replace(old, new))
    with pytest.raises(EdgeposeError, match=says):
        read_map(file)


def test_sensors_of_a_recording(tmp_path):
    file = tmp_path / "walk.csv"
    file.write_text(
        "time_s,sensor,qw,qx,qy,qz,ax,ay,az,gx,gy,gz,mx,my,mz\n0.0,pelvs,1,0,0,0,0,0,9.81,0,0,0,,,\n"
    )
    with pytest.raises(EdgeposeError, match=r"an unknown sensor.*; did you mean 'pelvis'"):
        read_recording(file)
