"""Compute the poses of a recording, the main job of edgepose, in a few lines.

python examples/poses_of_a_recording.py walk.npz calib.json poses.csv
"""

import sys

import edgepose

recording, calibration, poses = sys.argv[1:4]
pipeline = edgepose.Pipeline(edgepose.load_calibration(calibration), model="rnn")
with edgepose.open_source(file=recording) as source, edgepose.CsvSink(poses) as sink:
    for pose in pipeline.poses(source):
        sink.write(pose)
print(f"{pipeline.summary.poses} poses")
