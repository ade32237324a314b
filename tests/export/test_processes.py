"""Two processes that torchrun starts train one network together."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.skeleton import default_body
from edgepose_export.mocap import read_motion, resample
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.config import TrainConfig
from edgepose_export.training.dataset import read_take, tape
from edgepose_export.training.distributed import ALONE, Processes
from edgepose_export.training.sources import SOURCES
from edgepose_export.training.trainer import Trainer, compute_statistics, read_checkpoint
from tests.support import processes
from tests.support.datagrams import free_address

DATA = Path(__file__).parents[1] / "data" / "mocap"
CONFIG = """
steps = 4
sequences = 4
window = 20
validate_every = 2
place_loss = 0.3
[network]
kind = "rnn"
hidden = 8
place = true
"""
# What each process does with the gradients of its half of a batch, against the gradients of the whole batch.
PROGRAM = """
import sys, torch
from pathlib import Path
from edgepose_export.archive.torchscript import new_network
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.training.distributed import joined

torch.set_num_threads(1)

def compare(processes):
    assert processes.size == 2
    torch.manual_seed(0)
    network, x = new_network(NetworkShape("rnn", 8)), torch.randn(4, 5, 60)
    both = processes.wrapped(network)
    mean, deviation = both(torch.stack(processes.share(list(x))))
    (mean.square().mean() + deviation.mean()).backward()
    gradients = [p.grad.clone() for p in network.parameters()]
    network.zero_grad()
    mean, deviation = network(x)
    (mean.square().mean() + deviation.mean()).backward()
    for p, gradient in zip(network.parameters(), gradients, strict=True):
        torch.testing.assert_close(gradient, p.grad, rtol=1e-4, atol=1e-6)
    total = processes.total(torch.tensor([processes.rank + 1.0, 0.5]))
    assert total.tolist() == [3.0, 1.0], total
    assert processes.gathered(f"process {processes.rank}") == ["process 0", "process 1"]
    (Path(sys.argv[1]) / f"done-{processes.rank}").write_text("yes")

with joined() as processes:
    compare(processes)
"""
TRAIN = """
import sys
from edgepose.cli import cli

cli.main(sys.argv[1:], standalone_mode=False)
"""
# A thread of gloo's that is busy while Python ends aborts the process.
NO_THREADS = """
from pathlib import Path

threads = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
assert threads and not [name for name in threads if "gloo" in name], threads
"""


def started_by_torchrun(*words):
    """Runs a program in two processes, to its end."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *words]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, env=environment, timeout=120
    )


def together(*words):
    """The same with the environment that torchrun makes, without a new Python for each process."""
    host, port = free_address().split(":")
    group = {"WORLD_SIZE": "2", "MASTER_ADDR": host, "MASTER_PORT": port, "TORCHELASTIC_RUN_ID": "test"}
    command = [sys.executable, *map(str, words)]
    started = [
        processes.Popen(
            command,
            env=os.environ | group | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    ended = [process.communicate(timeout=120) for process in started]
    return subprocess.CompletedProcess(
        command,
        max(abs(process.returncode) for process in started),
        *("".join(texts) for texts in zip(*ended, strict=True)),
    )


def test_gradients_are_those_of_the_whole_batch(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM + NO_THREADS)
    done = together(tmp_path / "program.py", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "done-0").exists()
    assert (tmp_path / "done-1").exists()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of four steps by two processes, from packed takes; what it said."""
    folder = tmp_path_factory.mktemp("together")
    (folder / "recordings").mkdir()
    (folder / "tiny.toml").write_text(CONFIG)
    motion = resample(read_motion(DATA / "dataset-2_walk_normal_001.bvh"))
    imus, source = virtual_imus(motion, default_body()), SOURCES[motion.source]
    arrays = recording_arrays(motion, imus, source.license, source.name)
    for i, name in enumerate(("01_01", "01_02", "05_01", "03_01")):
        rows = {key: value[: 119 - 10 * i] if value.ndim else value for key, value in arrays.items()}
        np.savez(folder / "recordings" / f"{name}.npz", **rows)
    done = started_by_torchrun(
        *("-m", "edgepose", *words(folder), "--out", folder / "run", "--cache", folder / "cache")
    )
    assert done.returncode == 0, done.stderr
    return folder, done.stderr


def words(folder):
    return (
        *("train", "--config", folder / "tiny.toml", "--threads", 1),
        *("--data", folder / "recordings"),
    )


def test_one_run_of_two_processes(run):
    folder, said = run
    assert said.count("training on 3 takes") == 1
    assert said.count("step 2 of 4") == said.count("step 4 of 4") == 1
    state = read_checkpoint(folder / "run" / "checkpoint.pt")
    assert state["step"] == 4
    assert state["data"]["takes"] == 3
    assert state["data"]["hours"] == pytest.approx((119 + 109 + 99) / 60 / 3600)
    assert len((folder / "run" / "log.jsonl").read_text().splitlines()) == 2
    # Each process packed its own share.
    shares = [
        json.loads(path.read_text())["names"] for path in sorted(folder.glob("cache/train/*/tape.json"))
    ]
    assert shares == [["01_01", "05_01"], ["01_02"]]
    # The statistics are those of all takes.
    takes = [read_take(folder / "recordings" / f"{name}.npz") for name in ("01_01", "01_02", "05_01")]
    alone = compute_statistics(tape(takes), NetworkShape("rnn", 8), ALONE)
    for name, numbers in alone._asdict().items():
        torch.testing.assert_close(state["statistics"][name], numbers)
    # The processes draw differently.
    assert state["generator"].shape[0] == 2
    assert not torch.equal(*state["generator"])


def test_trained_process_leaves_no_threads(run, tmp_path):
    folder, _ = run
    (tmp_path / "program.py").write_text(TRAIN + NO_THREADS)
    done = together(tmp_path / "program.py", *words(folder), "--out", tmp_path / "run", "--steps", 1)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "checkpoint.pt").exists()


def test_resumed_run_of_two_processes_is_the_uninterrupted_one(run, tmp_path):
    folder, _ = run
    half = tmp_path / "half"
    done = together("-m", "edgepose", *words(folder), "--out", half, "--steps", 2)
    assert done.returncode == 0, done.stderr
    done = together("-m", "edgepose", *words(folder), "--out", half, "--resume")
    assert done.returncode == 0, done.stderr
    assert "continuing at step 2" in done.stderr
    whole, resumed = (read_checkpoint(path / "checkpoint.pt") for path in (folder / "run", half))
    for key in ("network", "averaged"):
        for name, weights in whole[key].items():
            assert torch.equal(weights, resumed[key][name]), name
    assert torch.equal(whole["generator"], resumed["generator"])


def test_another_number_of_processes_goes_on_too(run, tmp_path):
    folder, _ = run
    shutil.copytree(folder / "run", tmp_path / "run")
    arguments = [*words(folder), "--out", tmp_path / "run", "--resume", "--steps", 6]
    done = CliRunner().invoke(cli, list(map(str, arguments)), catch_exceptions=False)
    assert done.exit_code == 0, done.output
    state = read_checkpoint(tmp_path / "run" / "checkpoint.pt")
    assert state["step"] == 6
    assert state["generator"].shape[0] == 1


def test_sequences_must_be_shared_equally(run):
    takes = tape([read_take(run[0] / "recordings" / "01_01.npz")])
    config = TrainConfig(sequences=4, window=20)
    with pytest.raises(EdgeposeError, match="sequences is 4; 3 processes cannot share it equally"):
        Trainer(config, takes, takes, {}, Processes(0, 3))
