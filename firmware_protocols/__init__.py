"""Wire formats of body-worn IMUs, byte for byte."""
