"""edgepose: six body-worn IMUs in, SMPL poses out."""

__version__ = "0.1.0"
