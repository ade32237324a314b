"""`edgepose learn-prior`: what poses people take, from motion capture, for `edgepose solve`."""

from __future__ import annotations

from pathlib import Path

import click

from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.utils.output_targets import check_output

RATE = 6.0
"""Poses a second that are taken; neighbours say the same."""


@click.command(short_help="Learn from motion capture what poses people take.")
@click.argument("inputs", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="File to write, for `edgepose solve --prior`.",
)
@click.option(
    "--about",
    default="",
    help="What the data are and their licence, kept in the file.  [default: what the files say]",
)
@overwrite_option
def learn_prior(inputs: tuple[Path, ...], out: Path, about: str, overwrite: bool) -> None:
    """Learn mean, covariance and limits of poses from motion capture (.bvh, .amc, AMASS .npz; folders are
    searched), for `edgepose solve`.

    Takes that the split of this project holds out stay out, by their names.

    \b
    Example:
      edgepose learn-prior mocap/cmu-bvh --out prior.npz
    """
    import numpy as np

    from edgepose.rotations import matrix_to_rotvec
    from edgepose.sip.prior import learn_prior as learn
    from edgepose.sip.prior import save_prior
    from edgepose.skeleton import local_from_global
    from edgepose_export.cli.progress import progress
    from edgepose_export.cli.synthesize import LICENSES, motion_files
    from edgepose_export.mocap import pieces, read_motion
    from edgepose_export.training.splits import part_of

    check_output(out, "the prior", (".npz",), overwrite)
    files = [path for root in inputs for path in motion_files(root) if part_of(path.stem) == "train"]
    poses, sources = [np.empty((0, 24, 3))], set()
    for path in progress(files, "reading"):
        try:
            takes = pieces(read_motion(path))
        except EdgeposeError as error:
            say(f"left out: {error}")
            continue
        for take in takes:
            rows = take.rotations[:: max(1, round(take.rate / RATE))]
            poses.append(matrix_to_rotvec(local_from_global(rows)))
            sources.add(LICENSES[take.source])
    together = np.concatenate(poses).reshape(-1, 72)
    prior = learn(together, about or " and ".join(sorted(sources)))
    save_prior(out, prior, overwrite)
    say(f"wrote {out}: {len(together)} poses of {len(files)} files; {prior.about}")
