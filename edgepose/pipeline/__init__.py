"""The chain from a source's samples to the outputs, for one wearer and for several."""
