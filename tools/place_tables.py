"""Write the tables and pictures of docs/research/place.md.

python tools/place_tables.py --data RECORDINGS [--data MORE] [--model birnn --model rnn] [--trust]

RECORDINGS are folders that `edgepose synthesize` wrote, with the held-out parts. A table stands between two
comments, `table NAME: made by tools/place_tables.py` and `end of table`.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from edgepose.analysis.metrics import Metric
from edgepose.inference import archive
from edgepose_export.evaluation import plots
from edgepose_export.evaluation.evaluate import takes_of
from edgepose_export.evaluation.paths import BOTH, KINDS, measured, summarise
from edgepose_export.evaluation.paths import Path as Walked
from edgepose_export.evaluation.real_paths import Models, cells, real_paths, sitter_row, walker_row
from edgepose_export.evaluation.real_wearers import FOLDER
from edgepose_export.training.dataset import parts_of
from edgepose_export.training.sources import GROUPS, HELD_OUT

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "research" / "place.md"
IMAGES = ROOT / "docs" / "images"

COLUMNS = ("1 m", "3 m", "5 m", "7 m", "2 s", "5 s", "10 s", "height", "at end", "slide")
DRAWN = ("cmu-walk-run", "bandai-styles", "basketball")
"""Parts in the picture of paths."""

_BLOCK = re.compile(
    r"(<!-- table (\w+): made by tools/place_tables\.py -->\n).*?(<!-- end of table -->)", re.DOTALL
)

Table = dict[str, dict[str, Metric]]


def rows_of(part: str, model: str, table: Table, names: Sequence[str]) -> list[list[str]]:
    """Return the rows of a part in a page's table."""
    return [
        [part, model, name, *(_cell(table[name].get(column)) for column in COLUMNS)]
        for name in names
        if name in table
    ]


def _cell(metric: Metric | None) -> str:
    return f"{metric.mean:.1f}" if metric and metric.frames else "-"


def page_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows, the first of them the head, as a table of a page."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]) + "\n"


def with_tables(text: str, tables: Mapping[str, str]) -> str:
    """Return a page with its tables."""
    return _BLOCK.sub(lambda block: block[1] + tables.get(block[2], "") + block[3], text)


def real_table(models: Models) -> dict[str, str]:
    """Return the tables of the real wearers, and draw them."""
    paths = real_paths(models, FOLDER)
    plots.real_path_plot(IMAGES / "real-paths.png", paths)
    tables = {}
    for key, row_of, index in (("walker", walker_row, 0), ("sitter", sitter_row, 1)):
        head, *rows = cells({f"`{name}`": row_of(pair[index]) for name, pair in paths.items()})
        tables[key] = page_table([["model", *head[1:]], *rows])
    return tables


def main() -> None:
    """Run the models, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, action="append", required=True)
    parser.add_argument("--model", action="append")
    parser.add_argument("--trust", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    infos = [archive.read_info(archive.find_archive(name)) for name in given.model or ("birnn", "rnn")]
    models = {info.path.stem: (archive.load(info, given.trust), info.metadata) for info in infos}
    tables = real_table(models)
    folders = {part: folder for folder in given.data for part in set(parts_of(folder).values())}
    accuracy = [["part", "model", "row", *COLUMNS]]
    kinds = [["model", *KINDS]]
    drawn: dict[str, list[Walked]] = {}
    for model, (module, metadata) in models.items():
        paths = {
            part: list(measured(module, metadata, takes_of(folders[part], part)))
            for part in HELD_OUT
            if part in folders
        }
        paths["sports"] = [path for part in GROUPS["sports"] for path in paths.get(part, [])]
        for part, walked in paths.items():
            table = summarise(path.errors for path in walked)
            accuracy += rows_of(part, f"`{model}`", table, list(table))
        everything = [path for part in HELD_OUT for path in paths.get(part, [])]
        means = summarise({BOTH: path.kinds} for path in everything)[BOTH]
        found = [means.get(kind) for kind in KINDS]
        kinds.append([f"`{model}`", *(f"{m.mean:.1f} ({m.frames})" if m else "-" for m in found)])
        drawn = drawn or {
            part: sorted(paths[part], key=lambda path: -len(path.true))[:4] for part in DRAWN if part in paths
        }
    plots.path_plot(IMAGES / "paths.png", drawn, BOTH)
    tables |= {"accuracy": page_table(accuracy), "kinds": page_table(kinds)}
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8"), tables), encoding="utf-8")


if __name__ == "__main__":
    main()
