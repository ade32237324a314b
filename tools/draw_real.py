"""Draws docs/images/real-walker.png: a real walker's thighs and upper arms, measured and predicted.

python tools/draw_real.py
"""

from __future__ import annotations

from pathlib import Path

import click
import matplotlib
import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.inference.model import Model
from edgepose.placements import SITES
from edgepose.skeleton import global_rotations
from edgepose_export.evaluation.real_wearers import FOLDER, WALKER, read_walker
from edgepose_export.synthesis.virtual_imus import straight_pose

Array = NDArray[np.float64]

OUT = Path(__file__).parents[1] / "docs" / "images" / "real-walker.png"

MODELS = {"birnn": "#1f6fb4", "rnn": "#d98c3f"}
BONES = ("left_upper_leg", "right_upper_leg", "left_upper_arm", "right_upper_arm")


def forward_angle(name: str, bones: Array, facing: Array) -> Array:
    """Return how far forward (T,), deg, a hanging bone has swung.

    Args:
        name: of the bone's sensor.
        bones: (T, 3, 3) its orientations in the body frame.
        facing: (T,) heading of the pelvis, rad.
    """
    down = bones @ straight_pose()[SITES[name]].T @ [0.0, -1.0, 0.0]
    ahead = down[:, 0] * np.sin(facing) + down[:, 2] * np.cos(facing)
    return np.degrees(np.arctan2(ahead, -down[:, 1]))


@click.command()
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default=OUT, show_default=True)
def main(out: Path) -> None:
    """Draw the picture."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    wearer = read_walker(FOLDER)
    take = wearer.take
    facing = rot.yaw_of_matrix(take.orientation[:, -1])
    figure, axes = plt.subplots(len(BONES), sharex=True, figsize=(10, 8), constrained_layout=True)
    for ax, bone in zip(axes, BONES, strict=True):
        ax.plot(wearer.time_s, forward_angle(bone, wearer.truth[bone], facing), "k", lw=1.4, label="measured")
        ax.set(ylabel=f"{bone.replace('_', ' ')}, deg", xlim=(wearer.time_s[0], wearer.time_s[-1]))
        ax.spines[["top", "right"]].set_visible(False)
        for part, span in WALKER.parts.items():
            ax.axvspan(*span, color="0.5" if part.startswith("N-pose") else "0.9", alpha=0.3, lw=0)
    for name, colour in MODELS.items():
        poses = Model(name).poses(take.orientation, take.acceleration)
        world = global_rotations(poses)
        for ax, bone in zip(axes, BONES, strict=True):
            angle = forward_angle(bone, world[:, SITES[bone]], facing)
            ax.plot(wearer.time_s, angle, color=colour, lw=1, label=name)
    figure.suptitle(
        "Forward swing of a real walker's limbs: sensors on them, and poses from six other sensors"
    )
    lines = axes[0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower right", ncols=3, fontsize=9, frameon=False)
    axes[-1].set_xlabel("time, s (dark: N-pose; light: walking and turning)")
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    main()
