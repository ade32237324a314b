"""`edgepose calibrate`: find out how the sensors sit on the wearer."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from edgepose import calibration
from edgepose.calibration import Calibration
from edgepose.cli.calibration_job import CalibrationJob, calibration_of
from edgepose.cli.calibration_session import (
    ROUTINE_S,
    CalibrationPlan,
    Measured,
    measure_live,
    measure_recorded,
)
from edgepose.cli.calibration_verdict import DAMAGED, judge, next_command, table, values
from edgepose.cli.guide.guide import Guide, end_stage
from edgepose.cli.guide.phone_page import PhonePage, address_in_network
from edgepose.cli.options.body import HEIGHT
from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.gathered import gathered
from edgepose.cli.options.inputs import check_jobs, recordings_or_source
from edgepose.cli.options.json_result import json_option, show_json
from edgepose.cli.options.outputs import address, check_files, overwrite_option
from edgepose.cli.options.recording_time import RecordingTime, RecordingTimeType
from edgepose.cli.options.source import (
    filter_options,
    lacking_sensors,
    source_options,
    without_option,
)
from edgepose.cli.terminal import messages as terminal
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.orientation.stage import OrientationStage
from edgepose.placements import PLACEMENTS
from edgepose.sinks.output_files import check_output
from edgepose.sources.sensor_map import SensorMap, read_map
from edgepose.utils.similar_names import choices

PAGE_PORT = 8090
"""Port of the page without an address."""

_RESETS = ("live", "motion", "steps", "mounting")
"""Ways to reset headings that are no file."""

_LINES = "--port, --can, --listen, --connect or --ble"
