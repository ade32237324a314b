"""Flags that say whose body it is."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.skeleton import MAX_HEIGHT, MIN_HEIGHT

if TYPE_CHECKING:
    from edgepose.skeleton import Body


class BodyFlags(NamedTuple):
    """The wearer's body: one field a flag; those that are None or empty were not given."""

    body: str
    height: float | None
    sex: str | None
    weight: float | None
    words: tuple[str, ...]
    scale: float

    @property
    def hinges(self) -> bool:
        """Whether the skeleton has hinges as one rigged by hand, instead of SMPL's joints."""
        return self.body == "hinges"

    def build(self) -> Body:
        """The body.

        Raises:
            EdgeposeError: no wearer is like that, or the model file is none.
        """
        from edgepose.sip.bodies import scaled, shaped_body

        if self.body in ("smpl", "hinges"):
            body = shaped_body(self.height or 1.75, self.sex or "neutral", self.weight, self.words)
        else:
            from edgepose.formats.smpl_model import read_smpl

            body = read_smpl(self.body)
        return scaled(body, self.scale)


def _words(ctx: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in value.split(",") if word.strip())


def body_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the flags that say whose body it is; the command gets them as `body: BodyFlags`."""
    flags = [
        click.option(
            "--body",
            default="smpl",
            show_default=True,
            metavar="smpl|hinges|FILE",
            help="smpl: SMPL's joints with the average lengths for --height. hinges: a skeleton as rigged by "
            "hand (SIP-M). FILE: your own SMPL model (.npz or .pkl); a .pkl's code is not run.",
        ),
        click.option(
            "--height",
            type=click.FloatRange(MIN_HEIGHT, MAX_HEIGHT),
            help="Height of the wearer, metres.  [default: 1.75]",
        ),
        click.option(
            "--sex",
            type=click.Choice(["neutral", "male", "female"]),
            help="Of the wearer.  [default: neutral]",
        ),
        click.option(
            "--weight", type=float, help="Weight of the wearer, kg.  [default: the average for --height]"
        ),
        click.option(
            "--words",
            callback=_words,
            default="",
            metavar="WORD[,WORD...]",
            help="Shape of the wearer: long-, short-legged, -armed, -necked; broad-, narrow-shouldered, "
            "-hipped; muscular, slender.",
        ),
        click.option(
            "--scale",
            type=click.FloatRange(0.5, 2.0),
            default=1.0,
            show_default=True,
            help="All lengths of the body times this (1.1: SIP-110).",
        ),
    ]

    @functools.wraps(command)
    def with_body(**words: Any) -> Any:
        body = BodyFlags(*(words.pop(name) for name in BodyFlags._fields))
        if body.body not in ("smpl", "hinges") and (body.height or body.sex or body.weight or body.words):
            raise click.UsageError(
                "a body from a file has its own shape: leave out --height, --sex, --weight and --words"
            )
        return command(body=body, **words)

    for flag in reversed(flags):
        with_body = flag(with_body)
    return with_body
