"""The public API: names, what their import costs, the examples as they are documented."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from importlib import resources
from pathlib import Path

import click
import numpy as np
import pytest

import edgepose
from edgepose.cli import cli
from edgepose.formats.poses.registry import read_poses
from edgepose.sinks.registry import SINKS, sink_factory
from tests.support import processes

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def test_every_name_is_there():
    for name in edgepose.__all__:
        assert getattr(edgepose, name) is not None
    assert set(edgepose.__all__) <= set(dir(edgepose))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        edgepose.nothing  # noqa: B018
    assert resources.files("edgepose").joinpath("py.typed").is_file()


def test_every_name_is_documented():
    page = (ROOT / "docs" / "python-api.md").read_text(encoding="utf-8")
    for name in edgepose.__all__:
        assert re.search(rf"`(edgepose\.)?{name}\b", page), name


def test_the_import_loads_neither_torch_nor_numpy():
    code = "import edgepose, sys, json; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True)
    assert not {"torch", "numpy", "click", "serial", "can"} & set(json.loads(done.stdout))


def test_errors_are_one_family():
    for name in ("ConfigError", "DeviceError", "FileFormatError", "CalibrationError", "ModelError"):
        assert issubclass(getattr(edgepose, name), edgepose.EdgeposeError)


def run_example(name: str, *words: object) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, words)]
    done = processes.run(command, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_example_of_a_recording_gives_the_poses_of_run(command, wearer, tmp_path):
    said = run_example("poses_of_a_recording.py", wearer.short, wearer.calibration, tmp_path / "a.csv")
    assert said == "180 poses\n"
    flags = ("--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn")
    assert command("run", *flags, "--csv", tmp_path / "b.csv").returncode == 0
    one, other = read_poses(tmp_path / "a.csv"), read_poses(tmp_path / "b.csv")
    np.testing.assert_allclose(one.rotations, other.rotations, atol=1e-5)
    np.testing.assert_array_equal(one.time_s, other.time_s)


def test_a_pipeline_takes_pairs_of_time_and_samples(wearer):
    pipeline = edgepose.Pipeline(edgepose.load_calibration(wearer.calibration), model="rnn")
    with edgepose.open_source(file=wearer.short) as source:
        poses = list(pipeline.poses((batch.now_s, batch.samples) for batch in source))
    assert [pose.index for pose in poses] == list(range(180))
    assert [pose.status for pose in poses].count("ok") == sum(not pose.warming_up for pose in poses)


@pytest.mark.parametrize("model", ["birnn", "rnn"])
def test_the_poses_before_the_error_of_a_source_are_given(wearer, model):
    def ends_in_an_error(source):
        for k, batch in enumerate(source):
            if k == 50:
                raise edgepose.DeviceError("the cable is out")
            yield batch

    pipeline = edgepose.Pipeline(edgepose.load_calibration(wearer.calibration), model)
    given = []

    def take(poses):
        for pose in poses:
            given.append(pose.index)

    with edgepose.open_source(file=wearer.short) as source:
        poses = pipeline.poses(ends_in_an_error(source))
        with pytest.raises(edgepose.DeviceError, match="cable"):
            take(poses)
    assert given == list(range(pipeline.summary.poses))
    assert given


def test_the_example_of_arrays():
    assert re.fullmatch(
        r"\(120, 24, 3, 3\), left knee bent by \d+\.\d deg\n", run_example("poses_of_arrays.py")
    )


def test_the_example_of_an_own_output(wearer):
    lines = run_example("own_sink.py", wearer.short, wearer.calibration).splitlines()
    assert len(lines) == 180
    assert all(re.fullmatch(r"[\d.]+ [+-]0\.\d{3} m", line) for line in lines)


def test_every_example_is_tried():
    tried = {"poses_of_a_recording.py", "poses_of_arrays.py", "own_sink.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == tried


@pytest.mark.parametrize(
    ("orientation", "acceleration", "says"),
    [
        (np.zeros((4, 6, 3, 3)), np.zeros((4, 5, 3)), "must be"),
        (np.zeros((4, 5, 3, 3)), np.zeros((4, 6, 3)), "must be"),
        (np.full((4, 6, 3, 3), np.nan), np.zeros((4, 6, 3)), "NaN"),
    ],
)
def test_arrays_that_are_none(orientation, acceleration, says):
    with pytest.raises(edgepose.ModelError, match=says):
        edgepose.load_model("rnn").poses(orientation, acceleration)


def test_no_frames():
    assert edgepose.load_model("rnn").poses(np.empty((0, 6, 3, 3)), np.empty((0, 6, 3))).shape == (
        0,
        24,
        3,
        3,
    )


def test_one_configuration_from_toml_and_from_python(tmp_path):
    (tmp_path / "anna.toml").write_text(
        'file = "walk.csv"\ncalibration = "c.json"\ncsv = "p.csv"\nheight = 1.8\nudp = "127.0.0.1:9000"\n'
        'overwrite = true\n[sinks]\nmine = "target"\n'
    )
    from_file = edgepose.WearerConfig.from_toml(tmp_path / "anna.toml")
    own = edgepose.WearerConfig(
        source=edgepose.SourceConfig(file=tmp_path / "walk.csv"),
        calibration=tmp_path / "c.json",
        outputs=edgepose.OutputConfig(
            csv=str(tmp_path / "p.csv"),
            height=1.8,
            udp=("127.0.0.1", 9000, "json"),
            overwrite=True,
            sinks={"mine": "target"},
        ),
        name="anna",
        path=tmp_path / "anna.toml",
    )
    assert from_file == own


def test_outputs_by_name():
    outputs = edgepose.OutputConfig(
        csv=Path("a.csv"), udp="[::1]:9000,format=binary", view=True, osc=None, sinks={"mine": "x"}
    )
    assert outputs.targets == (
        ("csv", ("a.csv", (("rotations", ""),))),
        ("udp", ("::1", 9000, "binary", "")),
        ("view", True),
        ("mine", "x"),
    )
    assert outputs.any
    assert outputs.files == [("--csv", "a.csv")]
    assert dataclasses.replace(outputs, overwrite=True).targets == outputs.targets
    assert (
        outputs == edgepose.OutputConfig(outputs.targets) != edgepose.OutputConfig(outputs.targets, std=True)
    )
    assert not edgepose.OutputConfig(view=False, csv=None).any


def test_several_outputs_of_a_kind():
    outputs = edgepose.OutputConfig(
        csv=["a.csv", "b.csv,rotations=quat"],
        udp=["127.0.0.1:1", ("127.0.0.1", 2, "json")],
        sinks={"m": ["x", "y"]},
    )
    assert outputs.targets == (
        *(("csv", ("a.csv", (("rotations", ""),))), ("csv", ("b.csv", (("rotations", "quat"),)))),
        *(("udp", ("127.0.0.1", port, "json", "")) for port in (1, 2)),
        *(("m", "x"), ("m", "y")),
    )
    assert outputs.files == [("--csv", "a.csv"), ("--csv", "b.csv")]


def test_every_output_has_a_flag_in_the_order_of_the_table():
    flags = [param.name for param in cli.get_command(click.Context(cli), "run").params]
    assert [name for name in flags if name in SINKS] == list(SINKS)
    for name, output in SINKS.items():
        assert name.isidentifier()
        assert callable(sink_factory(name))
        assert bool(output.suffix) == (output.metavar or "").startswith("FILE")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: edgepose.SourceConfig(), "give one source"),
        (lambda: edgepose.SourceConfig(port="a", file="b"), "give one source"),
        (lambda: edgepose.SourceConfig(port="a", baud=0), "not in the range"),
        (lambda: edgepose.OutputConfig(rotations="rodrigues"), "is not one of"),
        (lambda: edgepose.OutputConfig(cvs="a.csv"), "unknown output 'cvs'; outputs are csv, npz, "),
        (lambda: edgepose.OutputConfig(udp="127.0.0.1"), "udp: no port in '127.0.0.1'"),
        (lambda: edgepose.OutputConfig(csv=["a", "a"]), "csv is given twice with the same target"),
        (lambda: edgepose.OutputConfig(view=[True, True]), "view is given twice"),
        (lambda: edgepose.OutputConfig(sinks={"csv": "a"}), "csv is not an output of another package"),
        (lambda: edgepose.OutputConfig(csv="a", height=175), "height 175 m is not between"),
        (
            lambda: edgepose.OutputConfig(csv="a", height=1.75, leg_length=1.2),
            "leg length 1.2 m does not",
        ),
        (lambda: edgepose.OutputConfig(csv="a", leg_length=85), "leg length 85 m is not between 0.3 and 1.5"),
        (lambda: edgepose.OutputConfig(udp="pc:9", mocopi="PC:9"), "udp and mocopi send to PC:9 in two form"),
        (
            lambda: edgepose.OutputConfig(udp=["localhost:9", "127.0.0.1:9,format=binary"]),
            "udp and udp send to 127.0.0.1:9 in two forms, of which a receiver reads one; give each its own",
        ),
        (lambda: edgepose.OutputConfig(osc=["[::1]:9", "[0::1]:9"]), r"osc sends to \[0::1\]:9 twice"),
        (lambda: edgepose.OutputConfig(view="no"), "view: 'no' is neither True nor False"),
    ],
)
def test_configurations_that_mean_nothing(make, says):
    with pytest.raises(edgepose.ConfigError, match=says):
        make()
