"""Runs `edgepose bench` on networks of any size with random weights, on which speed does not depend.

Give kinds and sizes as KIND:UNITS; the default is the paper's, `birnn:512` and `rnn:512`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import click
import torch

from edgepose_export.archive.torchscript import Statistics, describe, new_network, save, script
from edgepose_export.networks.shape import NetworkShape

UNTRAINED = {
    "step": 0,
    "data": {"summary": "nothing", "licenses": [], "takes": 0, "hours": 0.0},
    "config": "{}",
}


def write(folder: Path, kind: str, hidden: int) -> Path:
    """Write an archive with the structure of the shipped networks and random weights."""
    shape = NetworkShape(kind, hidden, "global-6d", "passed", "tilt")
    network = new_network(shape).eval()
    inputs, targets = torch.zeros(shape.inputs), torch.zeros(shape.pose_outputs)
    path = folder / f"{kind}-{hidden}.pt"
    about = describe(path.stem, network, UNTRAINED, 20, 5)
    save(script(network, Statistics(inputs, inputs + 1.0, targets, targets + 1.0)), path, about)
    return path


@click.command(help=__doc__)
@click.argument("sizes", nargs=-1, metavar="[KIND:UNITS]...")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")
def main(sizes: tuple[str, ...], as_json: bool) -> None:
    """Run the command line."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["--json"] if as_json else []
        for size in sizes or ("birnn:512", "rnn:512"):
            kind, _, hidden = size.partition(":")
            if kind not in ("birnn", "rnn") or not hidden.isdigit():
                raise click.BadParameter(f"{size} is not birnn:UNITS or rnn:UNITS")
            words += ["--model", str(write(Path(folder), kind, int(hidden)))]
        sys.exit(subprocess.run([sys.executable, "-m", "edgepose", "bench", "--trust", *words]).returncode)


if __name__ == "__main__":
    main()
