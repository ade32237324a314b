"""Small networks and made-up sensor data that several test files need."""

import os
import signal
import sys
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from edgepose_export.archive.torchscript import Statistics, describe, new_network, save, script
from edgepose_export.networks.receptive_field import field_archive
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.networks.shape import NetworkShape

# Tests send Ctrl-C to programs that they start; a shell that starts the tests in the background leaves it
# ignored, and what they start inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Hundreds of commands import edgepose. Its modules are compiled once, even where the environment forbids to
# keep that; workers of pytest-xdist and everything that tests start inherit it.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The tests' networks are tiny: a second thread would only wait.
torch.set_num_threads(1)

WITH_STATE = [name for name, kind in NETWORKS.items() if kind.archive is not field_archive]


def pytest_collection_modifyitems(items):
    """Begin with the tests of tools, which take longest: no worker is left alone with them at the end."""
    items.sort(key=lambda item: item.path.parent.name != "tools")


SHAPES = [
    NetworkShape(kind, 8, targets, measured)
    for kind in WITH_STATE
    for targets, measured in (
        ("local-matrix", "predicted"),
        ("global-6d", "predicted"),
        ("global-6d", "passed"),
    )
] + [
    NetworkShape(kind, 8, "global-6d", "passed", smoothing=0.6)
    for kind in WITH_STATE
    if NETWORKS[kind].smoothed
]
DATA = {"summary": "Made-up motion", "licenses": ["Made-up motion, public domain"], "takes": 3, "hours": 0.5}


def tiny_network(shape):
    """A network whose recurrent weights are large enough for past and future to matter, and statistics."""
    torch.manual_seed(5)
    network = new_network(shape).eval()
    with torch.no_grad():
        for weights in network.parameters():
            weights.mul_(2.0)
    generator = torch.Generator().manual_seed(6)

    def numbers(size):
        return torch.rand(size, generator=generator)

    mean = numbers(shape.pose_outputs) * 0.2
    if shape.targets == "local-matrix":
        mean = mean + torch.eye(3).flatten().repeat(len(shape.joints))
    else:
        mean = mean + torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(len(shape.joints))
    return network, Statistics(
        numbers(shape.inputs) * 0.1,
        0.5 + numbers(shape.inputs),
        mean,
        0.1 + 0.3 * numbers(shape.pose_outputs),
    )


@cache
def tiny_module(shape):
    return script(*tiny_network(shape))


@pytest.fixture(scope="session")
def tiny():
    """The scripted module of a shape with 8 units; always the same weights."""
    return tiny_module


@pytest.fixture(scope="session", params=SHAPES, ids=lambda s: "-".join(map(str, s)))
def shape(request):
    return request.param


@pytest.fixture(scope="session")
def parts():
    """Network and statistics of a shape."""
    return tiny_network


@pytest.fixture(scope="session")
def write_archive():
    """Writes an archive of a shape, gives its path; keywords replace entries of its metadata."""

    def write(path, shape=SHAPES[2], **changes):
        checkpoint = {"step": 7, "data": DATA, "config": '{"steps": 7}'}
        about = describe(path.stem, tiny_network(shape)[0], checkpoint, 4, 2)
        save(tiny_module(shape), path, about | changes)
        return path

    return write


@pytest.fixture(scope="session")
def wearers():
    """Makes sensors (wearers, frames, 6, ...) that turn steadily: orientations and accelerations, float32."""

    def make(count, frames, seed=1):
        rng = np.random.default_rng(seed)
        start = Rotation.random(count * 6, random_state=rng).as_matrix().reshape(count, 1, 6, 3, 3)
        steps = rng.normal(scale=0.2, size=(count, frames, 6, 3)).cumsum(axis=1)
        turns = Rotation.from_rotvec(steps.reshape(-1, 3)).as_matrix().reshape(count, frames, 6, 3, 3)
        acceleration = rng.normal(scale=3.0, size=(count, frames, 6, 3))
        return torch.tensor(start @ turns).float(), torch.tensor(acceleration).float()

    return make
