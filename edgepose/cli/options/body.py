"""Flags for the wearer's body."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.gathered import add_flags
from edgepose.skeleton import (
    DEFAULT_HEIGHT,
    MAX_HEIGHT,
    MAX_LEG_LENGTH,
    MIN_HEIGHT,
    MIN_LEG_LENGTH,
    with_leg_length,
)

if TYPE_CHECKING:
    from edgepose.skeleton import Body

HEIGHT = FloatRange(MIN_HEIGHT, MAX_HEIGHT, unit="metres")
"""Type of the flag --height."""

leg_length_option = click.option(
    "--leg-length",
    type=FloatRange(MIN_LEG_LENGTH, MAX_LEG_LENGTH, unit="metres"),
    help="Length of the wearer's thigh and shank, metres: standing, from the bony point at the side of the "
    "hip, where the leg turns, straight down to the ankle bone.  [default: the average for --height]",
)
"""The flag --leg-length."""


class BodyFlags(NamedTuple):
    """Values of the body flags; None or empty if a flag was not given."""

    body: str
    height: float | None
    leg_length: float | None
    sex: str | None
    weight: float | None
    words: tuple[str, ...]
    scale: float

    @property
    def hinges(self) -> bool:
        """Whether to use a hand-rigged skeleton with hinges instead of SMPL's joints."""
        return self.body == "hinges"

    def build(self, known_height_m: float | None = None) -> Body:
        """Return the body; `known_height_m` is used if no height was given.

        Raises:
            EdgeposeError: no body has these measures, or the file is not an SMPL model.
        """
        from edgepose.sip.bodies import scaled, shaped_body

        if self.body in ("smpl", "hinges"):
            height_m = self.height or known_height_m or DEFAULT_HEIGHT
            body = shaped_body(height_m, self.sex or "neutral", self.weight, self.words)
            if self.leg_length is not None:
                body = with_leg_length(body, self.leg_length)
        else:
            from edgepose.formats.smpl_model import read_smpl

            body = read_smpl(self.body)
        return scaled(body, self.scale)


def _words(ctx: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in value.split(",") if word.strip())


def body_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags of the wearer's body; the command gets them as `body: BodyFlags`."""
    flags = [
        click.option(
            "--body",
            default="smpl",
            show_default=True,
            metavar="smpl|hinges|FILE",
            help="smpl: SMPL's joints with average bone lengths for --height. hinges: a hand-rigged skeleton "
            "(SIP-M). FILE: your own SMPL model (.npz or .pkl); code in a .pkl is not run.",
        ),
        click.option(
            "--height",
            type=HEIGHT,
            help=f"The wearer's height, metres.  [default: the calibration's, or {DEFAULT_HEIGHT}]",
        ),
        leg_length_option,
        click.option(
            "--sex",
            type=click.Choice(["neutral", "male", "female"]),
            help="The wearer's sex.  [default: neutral]",
        ),
        click.option(
            "--weight", type=float, help="The wearer's weight, kg.  [default: the average for --height]"
        ),
        click.option(
            "--words",
            callback=_words,
            default="",
            metavar="WORD[,WORD...]",
            help="The wearer's shape: long- or short-legged, -armed, -necked; broad- or narrow-shouldered, "
            "-hipped; muscular; slender.",
        ),
        click.option(
            "--scale",
            type=FloatRange(0.5, 2.0),
            default=1.0,
            show_default=True,
            help="Factor on all lengths of the body (1.1: SIP-110).",
        ),
    ]

    @functools.wraps(command)
    def with_body(**values: Any) -> Any:
        body = BodyFlags(*(values.pop(name) for name in BodyFlags._fields))
        shape = body.height, body.leg_length, body.sex, body.weight, body.words
        if body.body not in ("smpl", "hinges") and any(value not in (None, ()) for value in shape):
            raise click.UsageError(
                "a body from a file has its own shape: leave out --height, --leg-length, --sex, --weight and "
                "--words"
            )
        return command(body=body, **values)

    return add_flags(with_body, flags)
