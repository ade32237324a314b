"""Write the recordings of real people in tests/data/real from their original files.

python tools/make_real_recordings.py --walker FOLDER_OF_MT_MANAGER --sitter six-sites.npz

The walker wears 17 Xsens MTw Awinda, one .csv of MT Manager each. Six of them become `mtw-walk.npz`, the
others, on further segments, `mtw-walk-reference.npz`. The sitter wears six sensors; their recording has this
format already. Numbers are rounded, to less than the sensors' noise, so that the files stay small.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import Recording, SensorData
from edgepose.placements import PLACEMENTS, SITES

OUT = Path(__file__).parents[1] / "tests" / "data" / "real"

RATE = 60.0
"""Of the walker's sensors, Hz."""

END_S = 125.0
"""End of what is kept of the sitter's recording, which goes on in the same way, seconds."""

SEGMENTS = {
    "27": "left_forearm", "30": "right_forearm", "33": "left_lower_leg", "2e": "right_lower_leg",
    "29": "head", "2d": "pelvis", "2a": "chest", "25": "left_shoulder", "2f": "right_shoulder",
    "26": "left_upper_arm", "34": "right_upper_arm", "28": "left_hand", "23": "right_hand",
    "2c": "left_upper_leg", "2b": "right_upper_leg", "31": "left_foot", "24": "right_foot",
}  # fmt: skip
"""Segments of the walker's sensors, by the last two digits of their device ids."""

QUAT_STEP, ACC_STEP, GYR_STEP = 2.0**-15, 2.0**-7, 2.0**-10
"""Steps to which numbers are rounded: 0.003 deg, 0.008 m/s^2, 0.001 rad/s."""


def read_walker(folder: Path) -> dict[str, SensorData]:
    """Return the 17 sensors of a folder of MT Manager's, by segment; times start with the first packet."""
    sensors = {}
    for path in folder.glob("*.csv"):
        packet, *columns = np.loadtxt(path, comments=("//", "Packet"), delimiter=";", unpack=True)
        acc, gyr, _, quat = np.split(np.array(columns).T, [3, 6, 9], axis=1)
        sensors[SEGMENTS[path.stem[-2:]]] = SensorData((packet - packet[0]) / RATE, quat, acc, gyr)
    return {name: sensors[name] for name in SITES}


def rounded(data: SensorData, with_gyr: bool = True) -> SensorData:
    """Return a sensor's numbers rounded, with or without its gyroscope."""
    assert data.quat is not None
    assert data.acc is not None
    assert data.gyr is not None
    return data._replace(
        quat=np.round(data.quat / QUAT_STEP) * QUAT_STEP,
        acc=np.round(data.acc / ACC_STEP) * ACC_STEP,
        gyr=np.round(data.gyr / GYR_STEP) * GYR_STEP if with_gyr else None,
    )


@click.command()
@click.option("--walker", type=click.Path(path_type=Path, exists=True, file_okay=False), required=True)
@click.option("--sitter", type=click.Path(path_type=Path, exists=True, dir_okay=False), required=True)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=OUT, show_default=True)
def main(walker: Path, sitter: Path, out: Path) -> None:
    """Write the recordings."""
    out.mkdir(parents=True, exist_ok=True)
    walk = read_walker(walker)
    sitting = {
        site: SensorData(*(None if column is None else column[data.time_s < END_S] for column in data))
        for site, data in read_recording(sitter).sensors.items()
    }
    units = {"frame": "Z up", "units": "s, m/s^2, rad/s"}
    for name, sensors, placements, with_gyr in (
        ("mtw-walk", walk, PLACEMENTS, True),
        ("mtw-walk-reference", walk, [site for site in walk if site not in PLACEMENTS], True),
        # Its orientations were computed offline; with the gyroscope the file would be above 1 MB.
        ("six-sites", sitting, PLACEMENTS, False),
    ):
        path = out / f"{name}.npz"
        write_npz(path, Recording({site: rounded(sensors[site], with_gyr) for site in placements}, units))
        click.echo(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
