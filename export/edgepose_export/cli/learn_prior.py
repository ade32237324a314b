"""`edgepose learn-prior`: a pose prior from motion capture, for `edgepose solve`."""

from __future__ import annotations

from pathlib import Path

import click

from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.sinks.output_files import check_output

RATE = 6.0
"""Poses per second that are used; neighbouring frames are nearly alike."""


@click.command(short_help="Learn a pose prior from motion capture.")
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
    help="Source and licence of the data, stored in the file  [default: taken from the files]",
)
@overwrite_option
def learn_prior(inputs: tuple[Path, ...], out: Path, about: str, overwrite: bool) -> None:
    """Learn a pose prior for `edgepose solve` from motion capture (.bvh, .amc, AMASS .npz, or folders).

    The prior holds mean, covariance and limits of poses. Takes of the held-out parts, which are recognised by
    their names, are left out.

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
    from edgepose_export.cli.recording_jobs import motion_files
    from edgepose_export.mocap import fault, pieces, read_motion
    from edgepose_export.training.sources import take_info

    check_output(out, "the prior", (".npz",), overwrite)
    found = (path for root in inputs for path in motion_files(root))
    known = {path: take_info(path.absolute().with_suffix("")) for path in found}
    files = [path for path, info in known.items() if info.part == "train"]
    poses, sources = [np.empty((0, 24, 3))], set()
    for path in progress(files, "reading", len(files)):
        try:
            motion = read_motion(path)
            problem = fault(motion)
            if problem:
                raise EdgeposeError(f"{path}: {problem}")
        except EdgeposeError as error:
            say(f"skipped: {error}")
            continue
        for take in pieces(motion):
            rows = take.rotations[:: max(1, round(take.rate / RATE))]
            poses.append(matrix_to_rotvec(local_from_global(rows)))
            sources.add(known[path].source.license)
    together = np.concatenate(poses).reshape(-1, 72)
    prior = learn(together, about or " and ".join(sorted(sources)))
    save_prior(out, prior, overwrite)
    say(f"wrote {out}: {len(together)} poses from {len(files)} files; {prior.about}")
