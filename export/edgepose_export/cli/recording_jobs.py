"""Conversion of motion files to recordings of virtual IMUs, for `edgepose synthesize`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.skeleton import Body
from edgepose.utils.durable_files import replace_file
from edgepose_export.training.sources import OWN, TakeInfo, take_info

if TYPE_CHECKING:
    from edgepose_export.mocap import Mapping, Motion
    from edgepose_export.mocap.zeroing import Zero

KINDS = (".bvh", ".amc", ".npz")


class Job(NamedTuple):
    """Settings of a conversion: the command's flags, and the folder that paths are relative to.

    `license_note` is the licence of motion that no rule knows, `zero` that of the file's actor, or None for
    that of the source.
    """

    out: Path
    root: Path
    rate: float
    body: Body
    hold_s: float
    mounting_seed: int | None
    seated_seed: int | None
    rests_seed: int | None
    license_note: str
    overwrite: bool
    t_pose: Path | None = None
    mapping: Mapping | None = None
    zero: Zero | None = None


def motion_files(root: Path) -> list[Path]:
    """Return the motion files below a folder, or the file itself; T-poses of others are no motion."""
    from edgepose_export.mocap.rest_search import is_t_pose_file

    if root.is_file():
        return [root]
    return sorted(
        path for path in root.rglob("*") if path.suffix.lower() in KINDS and not is_t_pose_file(path)
    )


def file_name(path: Path, job: Job) -> str:
    """Return the name of a motion file in the journal: its path below the folder of the motion."""
    return path.relative_to(job.root).as_posix()


def about_take(path: Path, job: Job) -> TakeInfo:
    """Return source, licence, actor and part of a motion file, by its path from the motion's folder on."""
    info = take_info((job.root.absolute().name / path.relative_to(job.root)).with_suffix(""))
    if info.source.name != OWN:
        return info
    return info._replace(source=info.source._replace(license=job.license_note))


def recording_path(path: Path, job: Job, part: str) -> Path:
    """Return the path of the recording made of a motion file, or of a part of it."""
    from edgepose_export.training.dataset import RESTS, SEATED

    kind = SEATED if job.seated_seed is not None else RESTS if job.rests_seed is not None else ""
    return job.out / path.relative_to(job.root).with_name(f"{path.stem}{part}{kind}.npz")


def convert(path: Path, job: Job) -> str | None:
    """Convert one file, cut into parts where the source jumps; return what was wrong with it, or None."""
    import numpy as np

    from edgepose_export.mocap import fault, pieces, read_motion, resample, scaled_to
    from edgepose_export.synthesis.virtual_imus import (
        random_mounting,
        recording_arrays,
        virtual_imus,
        with_hold,
    )

    info = about_take(path, job)
    try:
        mounting = None if job.mounting_seed is None else random_mounting(job.mounting_seed)
        whole = read_motion(path, job.t_pose, job.mapping)
        problem = fault(whole, job.rate)
        if problem:
            return f"{path}: {problem}"
        takes = pieces(whole)
        if not takes:
            return f"{path}: no part between two jumps is as long as a second"
        for i, take in enumerate(takes):
            motion = resample(scaled_to(take, job.body.leg_length_m), job.rate)
            directions = None
            if job.zero:
                motion, directions = job.zero.applied(motion), job.zero.back
            if job.seated_seed is not None:
                directions = None  # the legs are made on the body as it is zeroed
            motion = _with_made_parts(motion, job, [i, *path.stem.encode()])
            if job.hold_s:
                motion = with_hold(motion, job.hold_s)
            imus = virtual_imus(motion, job.body, mounting, directions)
            part = f".part{i + 1}" if len(takes) > 1 else ""
            target = recording_path(path, job, part)
            target.parent.mkdir(parents=True, exist_ok=True)
            arrays = recording_arrays(motion, imus, info.source.license, info.source.name, info.actor)
            arrays["zero"] = np.array(job.zero.evidence if job.zero else "source")
            replace_file(
                target,
                lambda file, arrays=arrays: np.savez(file, **arrays),
                "recording",
                overwrite=job.overwrite,
            )
    except EdgeposeError as error:
        return str(error)
    except OSError as error:
        return f"{path}: {error}"
    return None


def _with_made_parts(motion: Motion, job: Job, key: list[int]) -> Motion:
    """Return a motion with synthetic sitting or rests if the job asks for them.

    The key, numbers made of the take's name, is part of the seed, so that a take does not depend on the
    others in the call.
    """
    import numpy as np

    from edgepose_export.synthesis.floor import SHARE, on_the_floor
    from edgepose_export.synthesis.rests import with_rests
    from edgepose_export.synthesis.sitting import seated

    if job.seated_seed is not None:
        seed = [job.seated_seed, *key]
        make = on_the_floor if np.random.default_rng([1, *seed]).random() < SHARE else seated
        return make(motion, job.body, np.random.default_rng(seed))
    if job.rests_seed is not None:
        return with_rests(motion, job.body, np.random.default_rng([job.rests_seed, *key]))
    return motion
