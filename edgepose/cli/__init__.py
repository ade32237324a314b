"""The command line: one thin file a command, imported only when that command is used."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import traceback
from importlib.metadata import entry_points
from io import StringIO
from types import FrameType
from typing import NoReturn

import click

from edgepose import __version__
from edgepose.cli.terminal.messages import prepare, say
from edgepose.cli.terminal.stop_signal import endings
from edgepose.errors import as_edgepose_error

COMMANDS = (
    "bench",
    "calibrate",
    "check",
    "convert",
    "devices",
    "models",
    "record",
    "report",
    "run",
    "solve",
    "view",
)
"""Commands of the runtime; others are found through the entry-point group `edgepose.commands`."""


class LazyGroup(click.Group):
    """A group that imports a command's module when the command is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands, without importing any."""
        return sorted({*COMMANDS, *(point.name for point in entry_points(group="edgepose.commands"))})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name, or None."""
        if cmd_name in COMMANDS:
            command: click.Command = getattr(
                importlib.import_module(f"edgepose.cli.commands.{cmd_name}"), cmd_name
            )
            return command
        for point in entry_points(group="edgepose.commands", name=cmd_name):
            return point.load()
        return None


@click.group(
    cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.version_option(__version__, prog_name="edgepose")
@click.option("--debug", is_flag=True, help="Show the whole traceback of an error.")
def cli(debug: bool) -> None:
    """Six body-worn IMUs in, full-body SMPL poses out, in real time.

    \b
    A first session, sensors on a serial port:
      edgepose devices
      edgepose calibrate --port /dev/ttyUSB0 --out calib.json
      edgepose run --port /dev/ttyUSB0 --calibration calib.json --csv poses.csv --udp 127.0.0.1:9000
    """


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def main() -> NoReturn:
    """Entry point: errors become one line on stderr.

    Exit codes: 0 done, 1 the job failed, 2 wrong use, 130 interrupted.
    """
    prepare()
    # These end a run as Ctrl-C does: files complete, counts printed. Under nohup, SIGHUP ends nothing.
    for number in endings():
        if number != signal.SIGINT:
            signal.signal(number, _terminate)
    # torch warns of its own plans when it reads int8 weights; nobody at a terminal can change these.
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    debug = "--debug" in sys.argv[1:]
    try:
        sys.exit(cli.main(standalone_mode=False) or 0)
    except click.ClickException as error:
        text = StringIO()
        error.show(text)
        say(text.getvalue().rstrip())
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        say("edgepose: stopped")
        sys.exit(130)
    except BrokenPipeError:  # of standard output; what it held must not be tried again at the end
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(1)
    except Exception as error:
        say(traceback.format_exc().rstrip() if debug else f"edgepose: {as_edgepose_error(error)}")
        sys.exit(1)
