import matplotlib.image
import numpy as np
import pytest

from edgepose.analysis.figures import check_picture
from edgepose.analysis.metrics import Metric, sip_error
from edgepose.errors import EdgeposeError
from edgepose_export.evaluation import plots
from edgepose_export.evaluation.evaluate import Mode, run_archive, run_windows, window_errors
from edgepose_export.evaluation.paper_tables import TABLES, format_paper_table
from edgepose_export.evaluation.uncertainty import reliability
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.training.dataset import Take

BIRNN = {"kind": "birnn", "past": 20, "future": 5}
WAVENET = {"kind": "wavenet", "past": 62, "future": 0}
FEED_FORWARD = {"kind": "feed-forward", "past": 20, "future": 5}
RNN = {"kind": "rnn", "past": 0, "future": 0}


def row(angle, position, frames):
    return {
        "sip_error_deg": Metric(angle, angle / 2, frames),
        "position_error_cm": Metric(position, position / 2, frames),
    }


def test_how_models_run_for_each_table():
    assert [TABLES["2"].modes(about) for about in (BIRNN, RNN)] == [[Mode("offline")]] * 2
    assert TABLES["3"].modes(BIRNN) == [Mode("window", 20, 5), Mode("window", 50, 5)]
    assert TABLES["3"].modes(RNN) == [Mode("stream")]
    assert TABLES["4"].modes(WAVENET) == [Mode("stream", 0, 0)]
    assert TABLES["4"].modes(FEED_FORWARD) == [Mode("stream", 0, 5)]
    assert TABLES["5"].modes(BIRNN) == [Mode("offline")]
    assert [TABLES[name].positions for name in "2345"] == [True, True, False, False]


def test_table_has_the_papers_columns():
    tables = {
        "walks": {"first": row(15.85, 5.98, 100), "second model": row(8, 4, 100)},
        "runs": {"first": row(31.7, 12.07, 7), "second model": row(100, 3, 7)},
    }
    parts, head, *rows, note = format_paper_table(tables, True).splitlines()
    assert parts.split() == ["walks", "runs"]
    assert head.split("  ")[-1].strip() == "σ_pos, cm"
    assert [line.split() for line in rows] == [
        ["first", "15.85", "7.92", "5.98", "2.99", "31.70", "15.85", "12.07", "6.04"],
        ["second", "model", "8.00", "4.00", "4.00", "2.00", "100.00", "50.00", "3.00", "1.50"],
    ]
    # A part's name stands above its first column.
    assert parts.index("runs") <= head.index("μ_ang", head.index("μ_ang") + 1)
    assert "walks 100, runs 7" in note
    brief = format_paper_table(tables, False).splitlines()
    assert brief[2].split() == ["first", "15.85", "7.92", "31.70", "15.85"]
    assert "pos" not in brief[1]


# --- windows ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def take(wearers):
    orientation, acceleration = (x[0].numpy() for x in wearers(1, 40))
    return Take(
        "made up", orientation, acceleration, np.tile(np.eye(3, dtype=np.float32), (40, 24, 1, 1)), ""
    )


@pytest.mark.parametrize(("past", "future"), [(0, 0), (4, 2), (30, 3), (3, 30), (100, 100), (0, 50)])
def test_some_windows_are_those_of_all(tiny, take, past, future):
    module = tiny(NetworkShape("birnn", 8))
    every = run_archive(module, [take], Mode("window", past, future))[0]
    frames = np.array([0, 7, 20, 39])
    poses, std = run_windows(module, take, frames, past, future)
    np.testing.assert_allclose(poses.detach().numpy(), every[frames], atol=3e-5)
    assert std.shape == (4, 24)


def test_errors_of_windows(tiny, take):
    module = tiny(NetworkShape("birnn", 8))
    means, frames = window_errors(module, [take, take], [0, 50], [0, 2, 60], every=4)
    assert means.shape == (3, 2)
    assert frames == 20
    for row, column, mode in ((0, 0, Mode("window", 0, 0)), (1, 1, Mode("window", 50, 2))):
        poses = run_archive(module, [take], mode)[0][2::4]
        assert means[row, column] == pytest.approx(sip_error(poses, take.pose[2::4]).mean(), abs=1e-3)


# --- pictures -----------------------------------------------------------------------------------------------


def drawn(path):
    """A picture's size, if it is not empty."""
    image = matplotlib.image.imread(path)
    assert image.std() > 0.01
    return image.shape[1]


def test_pictures(tmp_path):
    rng = np.random.default_rng(0)
    errors = rng.uniform(1, 90, 500)
    plots.histogram(tmp_path / "a.png", {"walks": {"x": errors, "y": errors / 2}})
    plots.histogram(tmp_path / "b.png", {"walks": {"x": errors}, "runs": {"x": errors}})
    assert drawn(tmp_path / "b.png") > 1.5 * drawn(tmp_path / "a.png")
    plots.heat_map(tmp_path / "c.png", {"walks": rng.uniform(10, 20, (3, 2))}, [0, 5], [0, 1, 2])
    assert drawn(tmp_path / "c.png") == drawn(tmp_path / "a.png")
    result = reliability(rng.uniform(0.1, 0.2, 500), rng.uniform(0.05, 0.3, 500))
    plots.reliability_plot(tmp_path / "d.png", {"walks": {"x": result}, "runs": {"x": result}})
    assert drawn(tmp_path / "d.png") == drawn(tmp_path / "b.png")


def test_pictures_that_cannot_be_drawn(tmp_path, monkeypatch):
    with pytest.raises(EdgeposeError, match=r"x\.txt: pictures are written as \.png"):
        check_picture(tmp_path / "x.txt", "drawing")
    with pytest.raises(EdgeposeError, match="cannot be written: No such file"):
        plots.histogram(tmp_path / "none" / "x.png", {"walks": {"x": np.ones(3)}})
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(EdgeposeError, match=r"pip install 'edgepose\[plot\]'"):
        check_picture(tmp_path / "x.png", "drawing")
