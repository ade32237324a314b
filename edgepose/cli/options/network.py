"""Flags of `edgepose run` for the network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from edgepose.cli.options.gathered import gathered
from edgepose.inference.loading import RUNTIMES
from edgepose.inference.quantisation import CHOICES
from edgepose.pipeline.network import NetworkConfig


def network_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags of the network; the command gets them as `settings: NetworkConfig`."""
    flags = [
        click.option(
            "--model",
            default="birnn",
            show_default=True,
            help="Shipped model (see `edgepose models`) or path of an archive.",
        ),
        click.option(
            "--trust",
            is_flag=True,
            help="Load --model even if its checksum is unknown: you vouch for the code in it.",
        ),
        click.option(
            "--online",
            type=click.Choice(["stream", "window"]),
            default="stream",
            show_default=True,
            help="How a bidirectional model runs. stream: carry its forward state from frame to frame. "
            "window: compute a whole window for each frame, as in the paper, which is slower. A "
            "unidirectional model always carries its state.",
        ),
        click.option(
            "--past",
            type=click.IntRange(0, 600),
            help="Frames in a window before the present one.  [default: the model's]",
        ),
        click.option(
            "--future",
            type=click.IntRange(0, 120),
            help="Frames after the present one that a bidirectional model waits for; each adds 1/60 s of "
            "latency.  [default: the model's]",
        ),
        click.option(
            "--precision",
            type=click.Choice(CHOICES),
            default="auto",
            show_default=True,
            help="Number format of the model's weights; smaller ones run faster. auto: fp16 on x86-64 and on "
            "ARM processors with asimdfhm, otherwise f32 (Raspberry Pi). int8: the fastest on x86-64, slow "
            "elsewhere; its poses differ from f32 by about 0.2 deg.",
        ),
        click.option(
            "--runtime",
            type=click.Choice(RUNTIMES),
            default="auto",
            show_default=True,
            help="What runs the model. numpy: in f32, without torch, in a fifth of the memory; it runs no "
            "code of the archive, so no --trust is needed. auto: torch if it is installed, otherwise numpy.",
        ),
    ]
    return gathered(command, flags, "settings", NetworkConfig)
