import torch
from scipy.spatial.transform import Rotation

from edgepose_export.archive.torchscript import Statistics, build
from edgepose_export.networks.normalisation import network_inputs
from edgepose_export.networks.shape import NetworkShape, PoseNetwork

TILT = NetworkShape("rnn", 8, "global-6d", "passed", "tilt")


def frames(count):
    orientation = torch.tensor(Rotation.random(count * 6, random_state=3).as_matrix()).float()
    return orientation.reshape(count, 6, 3, 3), torch.randn(
        count, 6, 3, generator=torch.Generator().manual_seed(2)
    )


def about_vertical(degrees):
    return torch.tensor(Rotation.from_euler("y", degrees, degrees=True).as_matrix()).float()


def test_tilt_is_where_up_is_for_the_root_and_what_accelerates_it():
    orientation, acceleration = frames(5)
    x = network_inputs(orientation, acceleration, "tilt", True)
    assert x.shape == (5, TILT.inputs) == (5, 66)
    root = orientation[:, 5]
    torch.testing.assert_close(root @ x[:, 45:48, None], torch.tensor([0.0, 1, 0])[:, None].expand(5, 3, 1))
    torch.testing.assert_close((root @ x[:, 48:51, None])[..., 0], acceleration[:, 5])
    both = torch.cat([x[:, :45], x[:, 51:]], dim=-1)
    torch.testing.assert_close(both, network_inputs(orientation, acceleration, "root", True))


def test_tilt_without_accelerations():
    orientation, acceleration = frames(2)
    x = network_inputs(orientation, acceleration, "tilt", False)
    assert x.shape == (2, TILT._replace(acceleration=False).inputs) == (2, 48)


def test_the_heading_of_the_wearer_does_not_matter_but_the_tilt_does():
    orientation, acceleration = frames(4)
    turn = about_vertical(70)
    same = network_inputs(turn @ orientation, acceleration @ turn.T, "tilt", True)
    torch.testing.assert_close(
        same, network_inputs(orientation, acceleration, "tilt", True), rtol=0, atol=1e-5
    )
    lean = torch.tensor(Rotation.from_euler("x", 20, degrees=True).as_matrix()).float()
    other = network_inputs(lean @ orientation, acceleration @ lean.T, "tilt", True)
    assert (other - same)[:, 45:48].norm(dim=-1).max() > 0.1


def test_an_archive_of_66_inputs_streams_what_it_computes_offline():
    torch.manual_seed(0)
    statistics = Statistics(
        torch.zeros(66), torch.ones(66), torch.zeros(TILT.pose_outputs), torch.ones(TILT.pose_outputs)
    )
    module = build(PoseNetwork(TILT), statistics)
    orientation, acceleration = (part[None] for part in frames(6))
    with torch.inference_mode():
        offline, _ = module(orientation, acceleration)
        state = module.start(1, 0)
        for t in range(6):
            rotations, _, state = module.stream(orientation[:, t], acceleration[:, t], state)
            torch.testing.assert_close(rotations[:, 0], offline[:, t], rtol=0, atol=1e-5)
