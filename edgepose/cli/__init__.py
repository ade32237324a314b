"""The command line: one thin module per command, imported when that command is used."""

from __future__ import annotations

import errno
import importlib
import os
import signal
import sys
import traceback
import warnings
from importlib.metadata import entry_points
from io import StringIO
from pathlib import Path
from types import FrameType
from typing import NoReturn

import click

from edgepose import __version__
from edgepose.cli import exit_codes
from edgepose.cli.given_options import check_given
from edgepose.cli.terminal.messages import prepare, say
from edgepose.cli.terminal.stop_signal import stop_signals
from edgepose.errors import as_edgepose_error
from edgepose.utils.similar_names import similar_names

COMMANDS = Path(__file__).with_name("commands")
"""Folder with a module for each command of this package, of the same name.

Other packages add commands through the entry-point group `edgepose.commands`.
"""


def own_commands() -> list[str]:
    """Return the names of the commands of this package, without importing any."""
    return sorted(path.stem for path in COMMANDS.glob("[!_]*.py"))


def summary(name: str) -> str:
    """Return a command's line in the list of commands: the first line of its module, after the colon."""
    with (COMMANDS / f"{name}.py").open(encoding="utf-8") as file:
        text = file.readline().strip().strip('"').partition(": ")[2]
    return text[:1].upper() + text[1:]


class LazyGroup(click.Group):
    """A group of commands whose modules are imported on demand."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands without importing any."""
        return sorted({*own_commands(), *(point.name for point in entry_points(group="edgepose.commands"))})

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List all commands, without importing those of this package."""
        names, own = self.list_commands(ctx), own_commands()
        limit = formatter.width - 6 - max(map(len, names))
        rows = [(name, summary(name) if name in own else self._listed_as(ctx, name, limit)) for name in names]
        with formatter.section("Commands"):
            formatter.write_dl(rows)

    def _listed_as(self, ctx: click.Context, name: str, limit: int) -> str:
        command = self.get_command(ctx, name)
        return "" if command is None else command.get_short_help_str(limit)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a command; None if there is none of that name."""
        if cmd_name in own_commands():
            command: click.Command = getattr(
                importlib.import_module(f"edgepose.cli.commands.{cmd_name}"), cmd_name
            )
            return command
        for point in entry_points(group="edgepose.commands", name=cmd_name):
            return point.load()
        return None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command of the first argument, and check its arguments with `check_given`."""
        try:
            name, command, rest = super().resolve_command(ctx, args)
        except click.UsageError as error:
            similar = similar_names(args[0], self.list_commands(ctx))
            hint = f" Did you mean {similar}?" if similar else ""
            raise click.UsageError(error.message + hint, error.ctx) from None
        if command is not None and not ctx.resilient_parsing:
            inner = click.Context(command, info_name=name, parent=ctx, **command.context_settings)
            check_given(command, inner, rest)
        return name, command, rest


@click.group(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog=f"\b\nExit codes:\n{exit_codes.table()}",
)
@click.version_option(__version__, prog_name="edgepose")
@click.option("--debug", is_flag=True, help="Show the full traceback of an error.")
def cli(debug: bool) -> None:
    """Six body-worn IMUs in, full-body SMPL poses out, in real time.

    \b
    A first session, sensors on a serial port:
      edgepose devices
      edgepose calibrate --port /dev/ttyUSB0 --out calib.json
      edgepose run --port /dev/ttyUSB0 --calibration calib.json --csv poses.csv
    """


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def _drop_standard_output() -> None:
    """Drop what standard output has not taken: its buffer must not be flushed again at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def main() -> NoReturn:
    """Run the command line, and report an error as one line on stderr.

    `edgepose.cli.exit_codes` lists the exit codes.
    """
    prepare()
    # Like Ctrl-C, these signals end a run with complete files and a summary. Under nohup, SIGHUP is ignored.
    for number in stop_signals():
        if number != signal.SIGINT:
            signal.signal(number, _terminate)
    # numpy's products are small here: threads cost more than they save, most of all on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # When torch reads int8 weights it logs deprecation warnings, which a user cannot act on.
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    debug = "--debug" in sys.argv[1:]
    if not debug and not sys.warnoptions:
        # From numpy, with the path of a module; absurd numbers are reported by checks of the input.
        warnings.simplefilter("ignore", RuntimeWarning)
    try:
        sys.exit(cli.main(standalone_mode=False) or 0)
    except click.ClickException as error:
        text = StringIO()
        error.show(text)
        say(text.getvalue().rstrip())
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        say("edgepose: stopped")
        sys.exit(exit_codes.INTERRUPTED)
    except BrokenPipeError:  # stdout
        _drop_standard_output()
        sys.exit(exit_codes.FAILED)
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            _drop_standard_output()
        say(traceback.format_exc().rstrip() if debug else f"edgepose: {as_edgepose_error(error)}")
        sys.exit(exit_codes.FAILED)
    finally:
        # An interrupt while Python shuts down would only print a traceback.
        for number in stop_signals():
            signal.signal(number, signal.SIG_IGN)
