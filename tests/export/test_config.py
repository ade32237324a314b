import json
from dataclasses import replace
from pathlib import Path

import pytest

from edgepose.errors import EdgeposeError
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.training import config as configs
from edgepose_export.training.config import config_from, config_values, read_config

CONFIGS = Path(configs.__file__).parent / "configs"


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_configs(path):
    config = read_config(path)
    assert config_from(config_values(config)) == config
    assert config_from(json.loads(json.dumps(config_values(config)))) == config


def test_paper_configs_are_the_papers():
    for kind in ("birnn", "rnn"):
        config = read_config(CONFIGS / f"dip-{kind}.toml")
        assert config.network == NetworkShape(kind, 512, "local-matrix", "predicted")
        assert (config.beta, config.input_dropout, config.learning_rate) == (0.0, 0.2, 1e-3)
        assert (config.schedule, config.averaging, config.augmentation.mirror) == ("exponential", 0.0, 0.0)


@pytest.mark.parametrize(
    ("name", "acceleration_loss", "dropout", "shape"),
    [
        ("dip-rnn-dropout", False, 0.2, NetworkShape("rnn")),
        ("dip-rnn-acc", True, 0.0, NetworkShape("rnn")),
        ("dip-birnn-dropout", False, 0.2, NetworkShape()),
        ("dip-birnn-acc", True, 0.0, NetworkShape()),
        ("dip-birnn-no-acc", False, 0.2, NetworkShape(acceleration=False)),
        ("dip-birnn-heading", True, 0.2, NetworkShape(normalisation="heading")),
        ("dip-birnn-sequence", True, 0.2, NetworkShape(normalisation="sequence")),
        ("dip-feed-forward", True, 0.2, NetworkShape("feed-forward")),
        ("dip-wavenet", True, 0.2, NetworkShape("wavenet", 128)),
    ],
)
def test_rows_of_the_papers_tables_differ_in_what_they_say(name, acceleration_loss, dropout, shape):
    whole, config = (read_config(CONFIGS / f"{n}.toml") for n in ("dip-birnn", name))
    assert (config.acceleration_loss, config.input_dropout, config.network) == (
        acceleration_loss,
        dropout,
        shape,
    )
    same = {"acceleration_loss": True, "input_dropout": 0.2, "network": whole.network}
    assert replace(config, **same) == whole
    assert (whole.warm_up, whole.patience, whole.steps) == (0, 10, 100_000)


def test_config_that_differs_from_another(tmp_path):
    (tmp_path / "whole.toml").write_text("steps = 7\nseed = 3\n[network]\nhidden = 8\nkind = 'rnn'\n")
    (tmp_path / "other.toml").write_text("base = 'whole'\nsteps = 9\n[network]\nhidden = 16\n")
    config = read_config(tmp_path / "other.toml")
    assert (config.steps, config.seed, config.network) == (9, 3, NetworkShape("rnn", 16))
    (tmp_path / "other.toml").write_text("base = 3\n")
    with pytest.raises(EdgeposeError, match=r"other\.toml: base is 3; it must be the name of a config"):
        read_config(tmp_path / "other.toml")
    (tmp_path / "other.toml").write_text("base = 'nosuch'\n")
    with pytest.raises(EdgeposeError, match=r"nosuch\.toml: No such file"):
        read_config(tmp_path / "other.toml")
    (tmp_path / "other.toml").write_text("base = 'other'\n")
    with pytest.raises(EdgeposeError, match=r"other\.toml: unknown field 'base'"):
        read_config(tmp_path / "other.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps = 'many'", "steps is 'many'; it must be a whole number"),
        ("steps = 1.5", "steps is 1.5; it must be a whole number"),
        ("steps = true", "steps is True; it must be a whole number"),
        ("steps = 0", "steps is 0; it must be from 1 to"),
        ("joined = 1", "joined is 1; it must be true or false"),
        ("learning_rate = -1", "learning_rate is -1; it must be"),
        ("learning_rate = nan", "learning_rate is nan; it must be"),
        ("input_dropout = 1.0", "input_dropout is 1.0; it must be from 0 to 0.99"),
        ("schedule = 'linear'", "schedule is 'linear'; it must be 'exponential' or 'cosine'"),
        ("schedule = []", "schedule is []; it must be a string"),
        ("speed = 1", "unknown field 'speed'"),
        ('streamed = 5\n[network]\nkind = "rnn"', 'streamed needs kind = "birnn"'),
        ("window = 5\nstreamed = 5", "streamed is 5; it must be less than window"),
        ("network = 3", r"network is 3; it must be a table [network]"),
        ("[network]\nkind = 'gru'", "kind is 'gru'; it must be 'birnn' or 'rnn'"),
        ("[network]\nhidden = 0", "hidden is 0; it must be from 1 to"),
        ("[network]\nlayers = 3", r"unknown field 'layers' in [network]"),
        ("[network]\nsmoothing = 1.0", "smoothing is 1.0; it must be from 0 to 0.99"),
        ("[network]\nkind = 'wavenet'\nsmoothing = 0.5", "smoothing needs kind"),
        ("[network]\nsmoothing = 0.5", 'smoothing needs targets = "global-6d"'),
        ("[network]\nmeasured = 'passed'", 'measured = "passed" needs targets = "global-6d"'),
        ("[network]\nacceleration = false", "cannot reconstruct them: set acceleration_loss = false"),
        ("[network]\nnormalisation = 'none'", "normalisation is 'none'; it must be 'root' or"),
        ("rests_share = 1.1", "rests_share is 1.1; it must be from 0 to 1"),
        ("seated_share = 0.7\nrests_share = 0.5", "0.7 and 0.5; their sum must not exceed 1"),
        ("[augmentation]\nmirror = 2", "mirror is 2; it must be from 0 to 1"),
        ("[augmentation]\nstature = 1.75", "stature is 1.75; it must be from 0 to 1"),
        ("[augmentation]\nproportions = 50", "proportions is 50; it must be from 0 to 5"),
        ("[augmentation]\nsilent = 1.5", "silent is 1.5; it must be from 0 to 1"),
        ("[augmentation]\nheading_deg = inf", "heading_deg is inf; it must be"),
        ("[augmentation\n", "line 1"),
    ],
)
def test_bad_configs_name_the_field(tmp_path, text, message):
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(EdgeposeError) as caught:
        read_config(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_config_that_cannot_be_read(tmp_path):
    with pytest.raises(EdgeposeError, match="nosuch: No such file"):
        read_config(Path("nosuch"))
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(EdgeposeError, match=r"x\.toml"):
        read_config(tmp_path / "x.toml")
