"""Motion from CMU's ASF/AMC files."""

from __future__ import annotations

from pathlib import Path

from edgepose.errors import EdgeposeError

from .amc import read_amc
from .known_t_poses import cmu_t_pose, is_cmu
from .rest_pose import limb_directions, near_rest, standing
from .retargeting import Source
from .skeleton_roles import find_roles


def read_cmu_amc(path: Path) -> Source:
    """Read the motion in an AMC file of CMU's; it agrees with that of the same take in BVH.

    Raises:
        EdgeposeError: the file or its skeleton is broken, or not like CMU's.
    """
    tree = read_amc(path)
    if not is_cmu(tree.names):
        raise EdgeposeError(f"{path}: unknown skeleton; of ASF/AMC files only those of CMU are supported")
    try:
        roles = find_roles(tree.names, tree.parents)
        rest = standing(tree, roles, cmu_t_pose(tree.names))
    except EdgeposeError as error:
        raise EdgeposeError(f"{path}: {error}") from None
    if rest is None or not near_rest(limb_directions(rest, roles)):
        raise EdgeposeError(f"{path}: the limbs of the skeleton do not lie as in CMU's skeletons")
    return Source(tree, roles, rest, rest.up, 1.0, "cmu")
