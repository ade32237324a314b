"""Draws the pictures of the README: sensor placements, calibration poses, and a run as an animation.

    python tools/draw_readme.py                 # all three, into docs/images
    python tools/draw_readme.py --only places --only calibration-poses --out .

`run.gif` shows the output of `edgepose synthesize`, `calibrate` and `run` for the clip of tools/demo.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.analysis.figures import INK, PREDICTION, REFERENCE, FlatBody, draw_body, flatten, save_picture
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.placements import BONES, PLACEMENTS
from edgepose.skeleton import default_body, forward_kinematics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
CLIP = ROOT / "tools" / "data" / "09_12.bvh"
MODEL = "rnn"

Array = NDArray[np.float64]

DPI = 160
SENSOR = "#E69F00"
GROUND = "#DDDDDD"
FRONT = 0.0

DESCRIPTIONS = {
    "left_forearm": "back of the forearm,\njust above the wrist",
    "right_forearm": "back of the forearm,\njust above the wrist",
    "left_lower_leg": "front of the shin,\nbelow the knee",
    "right_lower_leg": "front of the shin,\nbelow the knee",
    "head": "back of the head",
    "pelvis": "lower back, over the spine",
}
BEHIND = ("head", "pelvis")

HOLD_S = 6.0
FILM_FROM_S, FILM_S, FILM_FPS = 10.0, 4.0, 15
FILM_PIXELS, FILM_METRES = (640, 440), 3.1
"""Width and height of the animation in pixels, and its width in metres."""


def arms_down(degrees: float) -> Array:
    """Return the T-pose (24, 3, 3) with both arms lowered at the shoulders."""
    pose = np.tile(np.eye(3), (24, 1, 1))
    pose[16] = rot.rotation_about_axis("z", -np.deg2rad(degrees))
    pose[17] = rot.rotation_about_axis("z", np.deg2rad(degrees))
    return pose


def canvas(width_m: float, height_m: float, width_in: float, dpi: float = DPI) -> tuple[Figure, Any, float]:
    """Return an empty figure, its axes in metres with the ground at y = 0, and the points per metre."""
    from matplotlib.figure import Figure

    scale = width_in / width_m
    figure = Figure(figsize=(width_in, height_m * scale), dpi=dpi, facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(-width_m / 2, width_m / 2)
    return figure, axes, 72.0 * scale


def placements() -> Figure:
    """Draw the six sensor placements on a wearer who faces the reader."""
    figure, axes, scale = canvas(2.9, 2.06, 7.5)
    axes.set_ylim(-0.17, 1.89)
    body = default_body()
    pose = arms_down(50.0)
    flat = flatten(pose[None], body.offsets, FRONT)[0]
    axes.plot([-0.75, 0.75], [0, 0], color=GROUND, linewidth=1.2, zorder=0)
    draw_body(axes, flat, np.zeros(2), PREDICTION, scale)
    rotations, joints = forward_kinematics(pose, np.where(np.arange(24)[:, None] == 0, 0.0, body.offsets))
    sensors = body.sensors.copy()
    sensors[:2, 0] *= 0.85  # so that the mark leaves the wrist visible
    spots = joints[list(BONES)] + np.einsum("nij,nj->ni", rotations[list(BONES)], sensors)
    bends = flat.points[[4, 5, 18, 19, 20, 21]]
    axes.plot(*bends.T, "o", color="white", markersize=4.5, zorder=28)
    labels = {
        "left_forearm": (0.86, 1.22), "right_forearm": (-0.86, 1.22), "left_lower_leg": (0.5, 0.45),
        "right_lower_leg": (-0.5, 0.45), "head": (0.5, 1.72), "pelvis": (0.5, 0.8),
    }  # fmt: skip
    for name, spot in zip(PLACEMENTS, spots, strict=True):
        at = spot[:2] + flat.points[0]  # both have the pelvis as origin
        mark(axes, at, np.array(labels[name]), name)
    text = "The wearer faces you; left limbs are light. Dashed: behind. White dots: elbows, wrists, knees."
    axes.text(0.0, -0.09, text, ha="center", va="center", fontsize=9, color=INK)
    return figure


def mark(axes: Any, at: Array, label: Array, name: str) -> None:
    """Draw a sensor, and its name at the end of a line."""
    from matplotlib.patches import FancyBboxPatch

    half = np.array([0.045, 0.036])
    behind = name in BEHIND
    box = FancyBboxPatch(
        tuple(at - half), *(2 * half), boxstyle="round,pad=0,rounding_size=0.012",
        facecolor="none" if behind else SENSOR, edgecolor=SENSOR if behind else "white",
        linewidth=2.2 if behind else 1.6, linestyle=(0, (2.0, 1.0)) if behind else "-", zorder=30,
    )  # fmt: skip
    side = 1.0 if label[0] > at[0] else -1.0
    start = at + np.array([side * half[0], 0.0])
    axes.plot(
        *np.stack([start, label - np.array([side * 0.025, 0.0])]).T, color=INK, linewidth=1.0, zorder=29
    )
    axes.add_patch(box)
    align = "left" if side > 0 else "right"
    axes.text(*label, name, ha=align, va="center", fontsize=11, color=INK, weight="bold", family="monospace")
    axes.text(label[0], label[1] - 0.05, DESCRIPTIONS[name], ha=align, va="top", fontsize=9, color=INK)


def calibration_poses() -> Figure:
    """Draw both poses that `edgepose calibrate` supports."""
    figure, axes, scale = canvas(3.4, 2.39, 7.5)
    axes.set_ylim(-0.3, 2.09)
    offsets = default_body().offsets
    # Hanging arms are drawn slightly spread, so that the hands are not hidden by the thighs.
    columns = (
        (
            -0.95, 86.0, "Straight pose (N-pose)", "--pose straight, the default",
            "arms hanging, palms to the thighs",
        ),
        (0.65, 0.0, "T-pose", "--pose t-pose", "arms out to the sides, palms down"),
    )  # fmt: skip
    for centre, down, title, flag, text in columns:
        flat = flatten(arms_down(down)[None], offsets, FRONT)[0]
        axes.plot([centre - 0.55, centre + 0.55], [0, 0], color=GROUND, linewidth=1.2, zorder=0)
        draw_body(axes, flat, np.array([centre, 0.0]), PREDICTION, scale)
        axes.text(centre, 1.99, title, ha="center", va="center", fontsize=13, color=INK, weight="bold")
        axes.text(centre, 1.89, flag, ha="center", va="center", fontsize=9, color=INK, family="monospace")
        axes.text(centre, -0.09, text, ha="center", va="center", fontsize=10, color=INK)
    text = "Feet parallel, looking ahead. The wearer faces you; left limbs are light."
    axes.text(0.0, -0.22, text, ha="center", va="center", fontsize=9, color=INK)
    return figure


# --- the animation ------------------------------------------------------------------------------------------


def poses_of_the_clip(folder: Path) -> tuple[Array, Array]:
    """Return predicted and true local poses (K, 24, 3, 3), one per frame of the animation."""

    def edgepose(*words: object) -> None:
        subprocess.run([sys.executable, "-m", "edgepose", *map(str, words)], check=True, cwd=ROOT)

    recording, calibration, csv = folder / "09_12.npz", folder / "calibration.json", folder / "poses.csv"
    edgepose("synthesize", CLIP, "--out", folder, "--hold", HOLD_S, "--rate", 100, "--mounting", 7)
    hold = ("--from", 1, "--hold", 3, "--body-frame", "heading:0")
    edgepose("calibrate", "--file", recording, *hold, "--out", calibration)
    edgepose("run", "--file", recording, "--calibration", calibration, "--model", MODEL, "--csv", csv)

    _, time_s, predicted = read_poses(csv)[:3]
    with np.load(recording) as data:
        true_s, true = data["t"], rot.rotvec_to_matrix(data["poses"].reshape(-1, 24, 3))
    wanted = HOLD_S + FILM_FROM_S + np.arange(round(FILM_S * FILM_FPS)) / FILM_FPS
    return predicted[nearest(time_s, wanted)], true[nearest(true_s, wanted)]


def nearest(times: Array, wanted: Array) -> NDArray[np.intp]:
    """Return the index of the time nearest to each wanted one."""
    return np.abs(times[None, :] - wanted[:, None]).argmin(axis=1)


def film_frame(predicted: FlatBody, true: FlatBody, second: float) -> NDArray[np.uint8]:
    """Draw one frame of the animation, (rows, columns, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    dpi = 100
    width, height = FILM_PIXELS
    height_m = FILM_METRES * height / width
    figure, axes, scale = canvas(FILM_METRES, height_m, width / dpi, dpi)
    axes.set_ylim(-0.12, height_m - 0.12)
    columns = (
        (-0.7, predicted, PREDICTION, f"predicted from six IMUs ({MODEL})"),
        (0.7, true, REFERENCE, "true motion"),
    )
    for centre, body, colours, title in columns:
        axes.plot([centre - 0.55, centre + 0.55], [0, 0], color=GROUND, linewidth=1.2, zorder=0)
        draw_body(axes, body, np.array([centre, 0.0]), colours, scale)
        axes.text(centre, height_m - 0.21, title, ha="center", va="center", fontsize=10, color=INK)
    axes.text(0.0, -0.06, f"{second:.1f} s", ha="center", va="center", fontsize=9, color=INK)
    agg = FigureCanvasAgg(figure)
    agg.draw()
    pixels: NDArray[np.uint8] = np.asarray(agg.buffer_rgba())[..., :3].copy()
    return pixels


def film_colours() -> list[int]:
    """Return red, green and blue of every colour in the animation, and of its blends with white."""
    from matplotlib.colors import to_rgb

    pure = np.array([to_rgb(c) for c in (*PREDICTION.values(), *REFERENCE.values(), INK, GROUND)])
    share = np.linspace(0.0, 1.0, 9)[1:, None, None]
    shades = (1.0 - share * (1.0 - pure)).reshape(-1, 3)
    shades = shades[shades.min(axis=1) < 0.94]  # Pillow would confuse nearly white colours with white
    colours = np.concatenate([np.ones((1, 3)), shades]) * 255.0
    levels: list[int] = colours.round().astype(int).ravel().tolist()
    return levels


def film(path: Path) -> None:
    """Write the GIF; all frames share one palette, which avoids flicker."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        predicted, true = poses_of_the_clip(Path(folder))
    offsets = default_body().offsets
    bodies = zip(flatten(predicted, offsets), flatten(true, offsets), strict=True)
    pictures = [Image.fromarray(film_frame(*pair, i / FILM_FPS)) for i, pair in enumerate(bodies)]
    palette = Image.new("P", (1, 1))
    palette.putpalette(film_colours())
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    # GIF counts hundredths of a second, so durations are rounded such that errors do not add up.
    ends = np.round(np.arange(len(frames) + 1) * 100 / FILM_FPS) * 10
    durations = np.diff(ends).astype(int).tolist()
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)


def still(draw: Callable[[], Figure]) -> Callable[[Path], None]:
    """Return a function that writes a picture."""
    return lambda path: save_picture(draw(), path, overwrite=True, dpi=DPI)


PICTURES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "places": ("places.png", still(placements)),
    "calibration-poses": ("calibration-poses.png", still(calibration_poses)),
    "run": ("run.gif", film),
}


@click.command(help=__doc__.split("\n")[0])
@click.option(
    "--only",
    type=click.Choice(list(PICTURES)),
    multiple=True,
    help="Draw only this picture; may be repeated.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=ROOT / "docs" / "images",
    help="Folder for the pictures  [default: docs/images of the repository]",
)
def main(only: tuple[str, ...], out: Path) -> None:
    """Run the command line."""
    out.mkdir(parents=True, exist_ok=True)
    try:
        for name in only or PICTURES:
            file, write = PICTURES[name]
            write(out / file)
            click.echo(f"wrote {out / file}")
    except EdgeposeError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
