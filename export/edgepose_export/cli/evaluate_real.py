"""`edgepose evaluate --real`: accuracy of models on recordings of two real wearers."""

from __future__ import annotations

from pathlib import Path

import click
from click.core import ParameterSource

from edgepose_export.cli.results import Results

_REAL = {"names", "trust", "data", "real", "paths", "overwrite", "as_json"}
"""Parameters that apply to --real."""


def evaluate_real(
    names: tuple[str, ...],
    trust: bool,
    folder: Path | None,
    paths: Path | None,
    overwrite: bool,
    results: Results,
) -> None:
    """Measure models on real wearers."""
    context = click.get_current_context()
    for parameter in context.command.params:
        name = parameter.name or ""
        if name not in _REAL and context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--real runs models as `edgepose run` does: omit {parameter.opts[0]}")
    from edgepose.analysis.figures import check_picture
    from edgepose.inference.model import Model
    from edgepose_export.cli.evaluate_place import evaluate_real_place
    from edgepose_export.cli.progress import labelled
    from edgepose_export.evaluation import real_wearers

    real_wearers.check_folder(folder or real_wearers.FOLDER)
    if paths:
        check_picture(paths, "drawing", overwrite)
    stems = [Path(name).stem for name in names]
    rows = dict(zip(stems if len(set(stems)) == len(names) else names, names, strict=True))
    models = {row: Model(name, trust=trust) for row, name in rows.items()}
    for title, table in real_wearers.measure_models(models, folder, labelled("measuring")).items():
        results.show(f"\n{real_wearers.format_table(title, table)}")
        results.add("tables", kind="real", title=title, rows=table)
    results.show(f"\n{real_wearers.LEGEND}")
    evaluate_real_place(rows, trust, folder or real_wearers.FOLDER, paths, overwrite, results)
