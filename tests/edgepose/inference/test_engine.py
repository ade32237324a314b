import platform

import numpy as np
import pytest
import torch

from edgepose.errors import ModelError
from edgepose.inference import quantisation
from edgepose.inference.engine import EngineInput, EngineOutput, MultiWearerEngine, StreamEngine, WindowEngine
from edgepose.inference.quantisation import pack_weights
from edgepose_export.archive.torchscript import script
from edgepose_export.networks.shape import NetworkShape

BIRNN = NetworkShape("birnn", 8, "global-6d", "passed")
RNN = BIRNN._replace(kind="rnn")
SMOOTH = [shape._replace(smoothing=0.6) for shape in (BIRNN, RNN)]


def run(engine, orientation, acceleration):
    """All outputs, and how many came after each frame; tags are the frames' numbers."""
    outputs, counts = [], []
    for t, (o, a) in enumerate(zip(orientation, acceleration, strict=True)):
        # Calibration gives float64.
        out = engine.push(t, o.numpy().astype(float), a.numpy().astype(float))
        counts.append(len(out))
        outputs += out
    last = engine.finish()
    return outputs + last, counts, len(last)


def check_frames(result, frames, future, past):
    outputs, counts, last = result
    assert [output.frame for output in outputs] == list(range(frames))
    assert counts == [int(t >= future) for t in range(frames)]
    assert last == min(future, frames)
    assert [output.warming_up for output in outputs] == [t < past for t in range(frames)]
    for output in outputs:
        assert isinstance(output, EngineOutput)
        assert output.rotations.shape == (24, 3, 3)
        assert output.std.shape == (24,)
        assert output.rotations.dtype == output.std.dtype == np.float32


@pytest.mark.parametrize(
    ("past", "future", "frames"),
    [(4, 2, 12), (0, 0, 6), (3, 0, 6), (0, 3, 6), (20, 5, 12), (2, 9, 6), (4, 2, 1), (1, 1, 0), (5, 6, 12)],
)
def test_window(tiny, wearers, past, future, frames):
    module = tiny(BIRNN)
    orientation, acceleration = (x[0] for x in wearers(1, max(frames, 1)))
    orientation, acceleration = orientation[:frames], acceleration[:frames]
    result = run(WindowEngine(module, past, future), orientation, acceleration)
    check_frames(result, frames, future, past)
    for t, output in enumerate(result[0]):
        window = slice(max(0, t - past), t + future + 1)
        with torch.no_grad():
            rotations, std = module(orientation[None, window], acceleration[None, window])
        index = t - window.start
        np.testing.assert_allclose(output.rotations, rotations[0, index], atol=2e-5)
        np.testing.assert_allclose(output.std, std[0, index], atol=2e-5)


@pytest.mark.parametrize("window", [(0, 0), (3, 2)])
def test_window_keeps_no_more_frames_than_it_needs(tiny, wearers, window):
    engine = WindowEngine(tiny(BIRNN), *window)
    run(engine, *(x[0] for x in wearers(1, 20)))
    assert engine._orientation.shape[1] == engine._acceleration.shape[1] == sum(window) + 1


@pytest.mark.parametrize(("future", "frames"), [(2, 12), (0, 12), (9, 6), (3, 3), (2, 1), (1, 0)])
def test_stream(tiny, wearers, future, frames):
    module = tiny(BIRNN)
    orientation, acceleration = (x[0, :frames] for x in wearers(1, 12))
    result = run(StreamEngine(module, 4, future), orientation, acceleration)
    check_frames(result, frames, future, 4)
    with torch.no_grad():
        state, poses = module.start(1, future), []
        for o, a in zip(orientation, acceleration, strict=True):
            rotations, _, state = module.stream(o[None], a[None], state)
            poses += rotations[0]
        poses += module.drain(state)[0][0]
    for output, pose in zip(result[0], poses, strict=True):
        np.testing.assert_allclose(output.rotations, pose, atol=2e-5)


def test_one_directional_stream_is_the_whole_sequence(tiny, wearers):
    orientation, acceleration = wearers(1, 12)
    result = run(StreamEngine(tiny(RNN), 0, 0), orientation[0], acceleration[0])
    check_frames(result, 12, 0, 0)
    with torch.no_grad():
        rotations, std = tiny(RNN)(orientation, acceleration)
    np.testing.assert_allclose([output.rotations for output in result[0]], rotations[0], atol=2e-5)
    np.testing.assert_allclose([output.std for output in result[0]], std[0], atol=2e-5)


@pytest.mark.parametrize("engine", [WindowEngine, StreamEngine])
def test_warming_up_leaves_no_trace(tiny, wearers, engine):
    orientation, acceleration = (x[0] for x in wearers(1, 5))
    first, second = (run(engine(tiny(BIRNN), 3, 2), orientation, acceleration)[0] for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.rotations, b.rotations, atol=1e-6)
    # Outputs stay as they were given while the engine goes on.
    running = engine(tiny(BIRNN), 0, 0)
    kept = running.push(0, orientation[0].numpy(), acceleration[0].numpy())[0]
    copy = kept.rotations.copy()
    running.push(1, orientation[1].numpy(), acceleration[1].numpy())
    np.testing.assert_array_equal(kept.rotations, copy)


@pytest.mark.parametrize("shape", [BIRNN, RNN, *SMOOTH, BIRNN._replace(normalisation="sequence")], ids=str)
@pytest.mark.parametrize("frames", [0, 3, 4, 11, 13])
def test_frames_together_give_what_they_give_one_by_one(tiny, wearers, shape, frames):
    orientation, acceleration = (x[0, :frames] for x in wearers(1, 13))
    future = 2 if shape.kind == "birnn" else 0
    alone, _, _ = run(StreamEngine(tiny(shape), 3, future), orientation, acceleration)
    together, counts, _ = run(StreamEngine(tiny(shape), 3, future, 4), orientation, acceleration)
    assert counts == [(4 if t > 3 else 4 - future) if t % 4 == 3 else 0 for t in range(frames)]
    assert [output.frame for output in together] == list(range(frames))
    for a, b in zip(alone, together, strict=True):
        assert a.warming_up == b.warming_up
        np.testing.assert_allclose(a.rotations, b.rotations, atol=2e-5)
        np.testing.assert_allclose(a.std, b.std, atol=2e-5)


def test_frames_together_of_a_field(tiny, wearers):
    module = tiny(NetworkShape("feed-forward", 8, "global-6d", "passed"))
    orientation, acceleration = (x[0] for x in wearers(1, 9))
    one, several = (run(StreamEngine(module, 0, 5, n), orientation, acceleration)[0] for n in (1, 4))
    for a, b in zip(one, several, strict=True):
        np.testing.assert_allclose(a.rotations, b.rotations, atol=2e-5)


@pytest.mark.parametrize("precision", ["f32", "fp16", "int8"])
@pytest.mark.parametrize("kind", ["birnn", "rnn"])
def test_the_place_beside_the_same_poses(parts, wearers, kind, precision):
    """In every engine and precision, to the last bit; without the wish for it there is none."""
    module = script(*parts(BIRNN._replace(kind=kind, place=True)))
    if precision == "fp16" and not quantisation.has_fp16_products(platform.machine(), quantisation._hwcap()):
        with pytest.raises(ModelError, match="asimdfhm"):
            pack_weights(module, precision)
        return
    if precision != "f32":
        pack_weights(module, precision)
    orientation, acceleration = (x[0] for x in wearers(1, 11))
    future = 2 if kind == "birnn" else 0
    engines = {
        "stream": lambda place: StreamEngine(module, 3, future, place=place),
        "many": lambda place: StreamEngine(module, 3, future, 4, place=place),
        "wearers": lambda place: Alone(MultiWearerEngine(module, 3, future, 1, place=place)),
    }
    if kind == "birnn":
        engines["window"] = lambda place: WindowEngine(module, 3, future, place=place)
    places = {}
    for name, make in engines.items():
        with_place, without = (run(make(place), orientation, acceleration)[0] for place in (True, False))
        assert [output.frame for output in with_place] == list(range(11))
        for a, b in zip(with_place, without, strict=True):
            np.testing.assert_array_equal(a.rotations, b.rotations)
            np.testing.assert_array_equal(a.std, b.std)
            assert (a.place.shape, a.place.dtype, b.place) == ((10,), np.float32, None)
        places[name] = np.array([output.place for output in with_place])
    np.testing.assert_array_equal(places["wearers"], places["stream"])
    if precision != "int8":  # its scale is that of all that is computed at once
        tolerance = 2e-5 if precision == "f32" else 2e-3
        np.testing.assert_allclose(places["many"], places["stream"], atol=tolerance)
    assert places["stream"].std(axis=0).min() > 1e-4
    # They are those of their frames, not of later ones.
    with torch.no_grad():
        state, expected = module.start(1, future), []
        for o, a in zip(orientation, acceleration, strict=True):
            _, _, place, state = module.stream_place(o[None], a[None], state)
            expected += place[0]
        expected += module.drain_place(state)[2][0]
    np.testing.assert_array_equal(places["stream"], np.array(expected))


class Alone:
    """An engine of several wearers, with one."""

    def __init__(self, engine):
        self.engine = engine

    def push(self, *body):
        return self.engine.push({0: EngineInput(*body)})[0]

    def finish(self):
        return self.engine.finish(0)


def together(engine, spans, orientation, acceleration):
    """Outputs of wearers whose frames go in together; each has spans of steps in which it takes part."""
    outputs = [[] for _ in spans]
    seen = [0] * len(spans)
    for step in range(max(stop for own in spans for _, stop in own)):
        bodies = {}
        for wearer, own in enumerate(spans):
            if any(start <= step < stop for start, stop in own):
                t = seen[wearer]
                bodies[wearer] = EngineInput(
                    t, orientation[wearer, t].numpy(), acceleration[wearer, t].numpy()
                )
                seen[wearer] += 1
        for wearer, due in engine.push(bodies).items():
            outputs[wearer] += due
    return [own + engine.finish(wearer) for wearer, own in enumerate(outputs)], seen


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(
    "shape",
    [
        BIRNN,
        RNN,
        *SMOOTH,
        BIRNN._replace(normalisation="sequence"),
        NetworkShape("feed-forward", 8, "global-6d", "passed"),
    ],
    ids=str,
)
def test_wearers_together_get_the_poses_that_each_gets_alone(tiny, wearers, shape, apart):
    """One from the start, one late, one that pauses, one that ends early, and one of a single frame."""
    spans = [[(0, 14)], [(5, 12)], [(0, 4), (9, 13)], [(0, 2)], [(3, 4)]]
    orientation, acceleration = wearers(len(spans), 14)
    future = 0 if shape.kind == "rnn" else 3
    module = tiny(shape)
    engine = MultiWearerEngine(module, 4, future, len(spans), apart)
    outputs, seen = together(engine, spans, orientation, acceleration)
    assert seen == [14, 7, 8, 2, 1]
    for wearer, own in enumerate(outputs):
        frames = slice(0, seen[wearer])
        alone, _, _ = run(
            StreamEngine(module, 4, future), orientation[wearer, frames], acceleration[wearer, frames]
        )
        assert [output.frame for output in own] == list(range(seen[wearer]))
        assert [output.warming_up for output in own] == [output.warming_up for output in alone]
        for a, b in zip(own, alone, strict=True):
            np.testing.assert_allclose(a.rotations, b.rotations, atol=1e-5)
            np.testing.assert_allclose(a.std, b.std, atol=1e-5)


def test_wearers_together_get_the_places_that_each_gets_alone(tiny, wearers):
    spans = [[(0, 9)], [(5, 9)], [(0, 2), (6, 9)]]
    module, (orientation, acceleration) = tiny(BIRNN._replace(place=True)), wearers(3, 9)
    outputs, seen = together(MultiWearerEngine(module, 4, 3, 3, place=True), spans, orientation, acceleration)
    for wearer, own in enumerate(outputs):
        frames = slice(0, seen[wearer])
        engine = StreamEngine(module, 4, 3, place=True)
        alone, _, _ = run(engine, orientation[wearer, frames], acceleration[wearer, frames])
        for a, b in zip(own, alone, strict=True):
            np.testing.assert_allclose(a.place, b.place, atol=1e-5)


def test_a_step_is_one_pass_of_the_network_for_all(tiny, wearers):
    """Wearers who begin later have passes of their own only until as many of their frames wait."""

    class Counting:
        def __init__(self, module):
            self.module, self.rows = module, []

        def stream(self, orientation, acceleration, state):
            self.rows.append(len(orientation))
            return self.module.stream(orientation, acceleration, state)

        def __getattr__(self, name):
            return getattr(self.module, name)

    module = Counting(tiny(BIRNN))
    engine = MultiWearerEngine(module, 0, 2, 3)
    module.rows.clear()
    together(engine, [[(0, 6)], [(1, 6)], [(1, 6)]], *wearers(3, 6))
    assert module.rows == [1, 1, 2, 1, 2, 3, 3, 3]
