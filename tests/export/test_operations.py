"""Operations that an archive takes for a frame: for one wearer they cost more than the products."""

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from edgepose.inference.quantisation import pack_weights
from edgepose_export.archive.torchscript import script
from edgepose_export.networks.shape import NetworkShape

MOST = {"rnn": 230, "birnn": 480}
FUTURE = {"rnn": 0, "birnn": 5}
LINEAR = 8
"""Operations of one linear layer: the product itself, and those that torch divides it into."""


def operations(module, future, method):
    """The operations of torch, with those that they call, for one frame of a stream that is under way."""
    orientation, acceleration = torch.eye(3).expand(1, 6, 3, 3).contiguous(), torch.zeros(1, 6, 3)
    step = getattr(module, method)
    with torch.inference_mode():
        state = module.start(1, future)
        for _ in range(future + 4):  # the first calls compile
            state = step(orientation, acceleration, state)[-1]
        with profile(activities=[ProfilerActivity.CPU]) as profiler:
            step(orientation, acceleration, state)
    return len(profiler.events())


@pytest.mark.parametrize("precision", ["f32", "fp16", "int8"])
@pytest.mark.parametrize("kind", ["rnn", "birnn"])
def test_operations_a_frame(parts, kind, precision):
    """A shipped network's shape, and the place costs no more than a linear layer."""
    shape = NetworkShape(kind, 8, "global-6d", "passed", "tilt", smoothing=0.6, place=True)
    module = script(*parts(shape))
    pack_weights(module, precision)
    count = operations(module, FUTURE[kind], "stream")
    assert 50 < count <= MOST[kind]
    assert count <= operations(module, FUTURE[kind], "stream_place") <= count + LINEAR
