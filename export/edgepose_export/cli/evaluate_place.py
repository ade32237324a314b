"""`edgepose evaluate --place`: accuracy of the path of a wearer, and pictures of paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose_export.cli.results import Results

if TYPE_CHECKING:
    from edgepose_export.cli.evaluate import EvaluatedModel
    from edgepose_export.evaluation.paths import Path

SHOWN = 6
"""Paths in the picture: the widest of each part."""


def evaluate_place(
    models: Sequence[EvaluatedModel],
    data: FilePath,
    parts: Sequence[str],
    picture: FilePath | None,
    overwrite: bool,
    results: Results,
) -> None:
    """Show tables of the errors of paths, and draw paths of the first model.

    Raises:
        EdgeposeError: no model estimates places, or no recording has true ones.
    """
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation.evaluate import takes_of
    from edgepose_export.evaluation.paths import BOTH, LEGEND, format_table, measured, summarise
    from edgepose_export.evaluation.plots import path_plot

    able = [model for model in models if "place" in model.metadata]
    if not able:
        raise EdgeposeError(
            f"{', '.join(model.name for model in models)}: estimates no contacts and no velocity; train it "
            "with place_loss"
        )
    drawn: dict[str, Sequence[Path]] = {}
    for model in able:
        for part in parts:
            takes = takes_of(data, part, labelled("measuring paths"))
            paths = list(measured(model.module, model.metadata, takes))
            if not paths:
                raise EdgeposeError(
                    f"{data}: no recording of {part} has contacts; make them again with edgepose synthesize"
                )
            errors = summarise(path.errors for path in paths)
            kinds = summarise({BOTH: path.kinds} for path in paths)
            results.add("tables", kind="place", title=f"{part}, {model.name}", rows=errors)
            results.add("tables", kind="place by motion", title=f"{part}, {model.name}", rows=kinds)
            results.show(f"\n{format_table(f'{part}, {model.name}: errors of the path', errors)}")
            if kinds:
                results.show(
                    f"\n{format_table(f'{part}, {model.name}: after 2 s, cm, by kind of motion', kinds)}"
                )
            if model is able[0]:
                drawn[part] = sorted(paths, key=_width, reverse=True)[:SHOWN]
    results.show(f"\n{LEGEND}")
    if picture:
        path_plot(picture, drawn, BOTH, overwrite)
        say(f"wrote {picture}")


def evaluate_real_place(
    names: Mapping[str, str],
    trust: bool,
    folder: FilePath,
    picture: FilePath | None,
    overwrite: bool,
    results: Results,
) -> None:
    """Show and draw the paths of the real wearers.

    Args:
        names: names or paths of models, by the name of their rows.
        trust: load archives with unknown checksums.
        folder: of the recordings.
        picture: to write; None for none.
        overwrite: whether an existing picture may be replaced.
        results: what was measured so far.
    """
    from edgepose.inference import archive
    from edgepose_export.evaluation import plots
    from edgepose_export.evaluation import real_paths as real

    infos = {row: archive.read_info(archive.find_archive(name)) for row, name in names.items()}
    models = {row: (archive.load(info, trust), info.metadata) for row, info in infos.items()}
    paths = real.real_paths(models, folder)
    if not paths:
        return
    walkers = {name: real.walker_row(walker) for name, (walker, _) in paths.items()}
    sitters = {name: real.sitter_row(sitter) for name, (_, sitter) in paths.items()}
    results.add("tables", kind="real place", title="walker", rows=walkers)
    results.add("tables", kind="real place", title="sitter", rows=sitters)
    results.show(f"\n{real.format_table('walker: out and back', walkers)}")
    results.show(f"\n{real.format_table('sitter: height of the pelvis', sitters)}")
    results.show(f"\n{real.LEGEND}")
    if picture:
        plots.real_path_plot(picture, paths, overwrite)
        say(f"wrote {picture}")


def _width(path: Path) -> float:
    """Return how far a path spreads, metres."""
    spread = path.true.max(axis=0) - path.true.min(axis=0)
    return float(spread[0] + spread[2])
