"""Recipes: all that makes a model from raw motion, as TOML files; see docs/research/training.md."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.utils.similar_names import choices
from edgepose.utils.text_files import read_toml
from edgepose_export.training.config import CONFIGS, TrainConfig, config_values, read_config
from edgepose_export.training.sources import OWN, SOURCES, TakeInfo

RECIPES = Path(__file__).parent / "recipes"
"""Folder with the recipes of the shipped models."""

STREAMED_COST = 3
"""Time of a training step on streamed sequences, in steps on whole ones."""


def option_words(options: dict[str, Any]) -> list[str]:
    """Return options as words of a command line; true is a flag that is set, false one that is not."""
    words = []
    for name, value in options.items():
        if value is not False:
            words += [f"--{name}"] if value is True else [f"--{name}", str(value)]
    return words


class Recordings(NamedTuple):
    """Recordings to make from motion, in a folder of their own.

    Attributes:
        folder: the folder's name.
        takes: regular expression that is searched in the paths of takes.
        train: whether only takes for training are used, or those of all parts.
        every: use every `every`-th of these takes,
        first: from this one on; 0 is the first.
        options: options of `edgepose synthesize` by name without dashes.
    """

    folder: str
    takes: str = ""
    train: bool = False
    every: int = 1
    first: int = 0
    options: dict[str, Any] = {}  # noqa: RUF012 - never changed

    def words(self) -> list[str]:
        """Return the options as words of a command line."""
        return option_words(self.options)

    def chosen(self, takes: dict[Path, tuple[str, TakeInfo]]) -> list[Path]:
        """Return the files that the recordings are made of, among takes with known names and parts."""
        fitting = [
            (name, path)
            for path, (name, info) in takes.items()
            if re.search(self.takes, name) and (info.part == "train" or not self.train)
        ]
        return [path for _, path in sorted(fitting)[self.first :: self.every]]


class Stage(NamedTuple):
    """One training run; each but the first starts from the weights of the one before."""

    name: str
    config: TrainConfig

    @property
    def work(self) -> float:
        """Relative duration of the stage."""
        config = self.config
        return config.steps * config.sequences * config.window * (STREAMED_COST if config.streamed else 1)


@dataclass(frozen=True)
class Recipe:
    """A recipe, checked.

    Attributes:
        name: name of the recipe and the model.
        sources: names of the sources of motion that are used.
        recordings: recordings to make.
        stages: training runs.
        average: names of the stages whose weights are averaged, the most important first.
        export: options of `edgepose export` by name without dashes.
    """

    name: str
    sources: tuple[str, ...]
    recordings: tuple[Recordings, ...]
    stages: tuple[Stage, ...]
    average: tuple[str, ...]
    export: dict[str, Any]

    @property
    def sha256(self) -> str:
        """Checksum of everything that the recipe says, including the configs that it builds on."""
        parts = [
            self.sources,
            self.recordings,
            [(stage.name, config_values(stage.config)) for stage in self.stages],
            self.average,
            self.export,
        ]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def recipe_path(name: str) -> Path:
    """Return the file of a shipped recipe, or of one at a path.

    Raises:
        EdgeposeError: there is neither.
    """
    shipped = sorted(path.stem for path in RECIPES.glob("*.toml"))
    if name in shipped:
        return RECIPES / f"{name}.toml"
    if Path(name).is_file():
        return Path(name)
    raise EdgeposeError(
        f"{name}: no such recipe; {choices(name, shipped, 'give the path of a TOML file, or one of')}"
    )


def read_recipe(path: Path) -> Recipe:
    """Read a recipe.

    A file with `base = "NAME"` contains only the entries that differ from NAME.toml in the same folder.

    Raises:
        EdgeposeError: the file is not TOML, an entry is missing or unknown or has a wrong value, or a config
            cannot be read.
    """
    values = read_toml(path)
    if isinstance(values.get("base"), str):
        values = read_toml(path.with_name(f"{values.pop('base')}.toml")) | values
    try:
        _check(values, {"sources": (str, list), "recordings": list, "stage": list, "export": dict})
        stages = tuple(_stage(table, path) for table in values["stage"])
        names = [stage.name for stage in stages]
        export = dict(values.get("export", {}))
        average = tuple(export.pop("average", names[-1:]))
        if not stages or len(set(names)) < len(names):
            raise ValueError("there must be a [[stage]], and no two of the same name")
        if not average or set(average) - set(names):
            raise ValueError(f"average must list stages ({', '.join(names)})")
        recordings = tuple(map(_recordings, values["recordings"]))
        if not recordings or len({one.folder for one in recordings}) < len(recordings):
            raise ValueError("there must be [[recordings]], and no two of the same folder")
        return Recipe(path.stem, _sources(values["sources"]), recordings, stages, average, export)
    except (ValueError, TypeError) as error:
        raise EdgeposeError(f"{path}: {error}") from error


def _check(table: dict[str, Any], kinds: dict[str, Any], optional: tuple[str, ...] = ("export",)) -> None:
    """Raise ValueError if an entry of a table is unknown, missing or of a wrong kind."""
    for name, value in table.items():
        if name not in kinds:
            raise ValueError(f"unknown entry {name!r}; {choices(name, kinds)}")
        if not isinstance(value, kinds[name]) or (isinstance(value, bool) and kinds[name] is int):
            raise ValueError(f"{name} is {value!r}, which is of a wrong kind")
    for name in kinds:
        if name not in table and name not in optional:
            raise ValueError(f"{name} is missing")


def _sources(names: str | list[Any]) -> tuple[str, ...]:
    if names == "free":
        return tuple(name for name, source in SOURCES.items() if source.free)
    if names == "all":
        return (*SOURCES, OWN)
    known = (*SOURCES, OWN)
    for name in [names] if isinstance(names, str) else names:
        if name not in known:
            listed = ", ".join(known)
            raise ValueError(f'unknown source {name!r} in sources: "free", "all", or a list of {listed}')
    return tuple(names)


def _recordings(table: Any) -> Recordings:
    if not isinstance(table, dict):
        raise ValueError("recordings must be tables [[recordings]]")
    kinds = {"folder": str, "takes": str, "train": bool, "every": int, "first": int, "options": dict}
    _check(table, kinds, optional=("takes", "train", "every", "first", "options"))
    result = Recordings(**table)
    if not re.fullmatch(r"\w[\w.-]*", result.folder):
        raise ValueError(f"folder is {result.folder!r}; it must be a plain name")
    if result.every < 1 or not 0 <= result.first < result.every:
        raise ValueError(f"every is {result.every}, first is {result.first}; first must be 0 to every - 1")
    try:
        re.compile(result.takes)
    except re.error as error:
        raise ValueError(f"takes is no regular expression: {error}") from error
    return result


def _stage(table: Any, path: Path) -> Stage:
    if not isinstance(table, dict):
        raise ValueError("stages must be tables [[stage]]")
    _check(table, {"name": str, "config": str, "settings": dict}, optional=("settings",))
    if not re.fullmatch(r"\w[\w.-]*", table["name"]):
        raise ValueError(f"name is {table['name']!r}; it must be a plain name")
    shipped = CONFIGS / f"{table['config']}.toml"
    config = shipped if shipped.is_file() else path.parent / table["config"]
    return Stage(table["name"], read_config(config, table.get("settings", {})))
