"""`edgepose bench`: the speed of every step, with models of a few units."""

import json
import sys

import pytest

from edgepose_export.networks.shape import NetworkShape
from tests.support import processes

RNN = NetworkShape("rnn", 8, "global-6d", "passed", "tilt")


def bench(*words):
    command = [sys.executable, "-m", "edgepose", "bench", *map(str, words)]
    return processes.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_every_step_and_way_is_measured(tmp_path, write_archive):
    path = write_archive(tmp_path / "small.pt", RNN._replace(kind="birnn"))
    done = bench("--model", path, "--trust", "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr == "measuring small\n"
    (model,) = json.loads(done.stdout)["models"]
    assert {"decode", "frames", "calibration", "network", "place", "CSV"} < set(model["steps_us"])
    assert all(cost > 0 for cost in model["steps_us"].values())
    ways = [(way["mode"], way["precision"]) for way in model["ways"]]
    assert ways == [
        ("reference", "f32"),
        *[
            (mode, precision)
            for mode in ("stream", "window")
            for precision in ("f32", "fp16", "int8", "f32, numpy")
        ],
    ]
    assert model["ways"][0]["times"] == 1.0
    for way in model["ways"]:
        assert 0 < way["p50_us"] <= way["p99_us"] <= way["max_us"]
    assert 595 <= model["full_speed"]["frames"] <= 605
    assert 0 < model["full_speed"]["p50_ms"] <= model["full_speed"]["p99_ms"] <= model["full_speed"]["max_ms"]
    live = model["live"]
    assert live["us"] > 0
    assert live["waits"] > 0
    assert live["p50_ms"] <= live["p99_ms"]
    assert 200 < live["poses"] < 320  # a busy machine is late at both ends
    assert set(model["start"]) == {"torch", "numpy"}
    assert model["start"]["torch"]["imports_s"] > 0
    assert 20 < model["start"]["numpy"]["memory_mb"] < model["start"]["torch"]["memory_mb"] < 2000


def test_tables(tmp_path, write_archive):
    path = write_archive(tmp_path / "small.pt", RNN)
    before = {
        "name": "small",
        "steps_us": {"decode": 1e9, "gone": 1.0},
        "ways": [],
        "start": {},
        "live": None,
    }
    (tmp_path / "before.json").write_text(json.dumps({"models": [before]}))
    done = bench("--model", path, "--trust", "--against", tmp_path / "before.json")
    assert done.returncode == 0, done.stderr
    assert "| small | torch.nn.LSTM, defaults | f32 |" in done.stdout
    assert "| small | stream | int8 |" in done.stdout
    assert "| small | stream | f32, numpy |" in done.stdout
    assert "\n| small, numpy |" in done.stdout
    assert "window" not in done.stdout
    # Every table's rows have as many cells as its head.
    tables = [table.splitlines() for table in done.stdout.strip().split("\n\n")[1:]]
    assert len(tables) == 6
    assert len(tables[-1]) == 3
    assert tables[-1][2].startswith("| small, us a frame, decode | 1e+09 | ")
    assert tables[-1][2].endswith(" | 0.00 |")
    for rows in tables:
        assert len({row.count("|") for row in rows}) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--model", "none.pt"), "no such model"),
        (("--model", "small.pt"), "is not known"),
        (("--model", "small.pt", "--against", "none.json"), "none.json: cannot read it: No such file"),
        (
            ("--model", "small.pt", "--against", __file__),
            "not what edgepose bench --json prints",
        ),
    ],
)
def test_models_that_cannot_run(tmp_path, write_archive, words, said):
    write_archive(tmp_path / "small.pt", RNN)
    words = [tmp_path / word if word.endswith("small.pt") else word for word in words]
    done = bench(*words)
    assert done.returncode == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr
