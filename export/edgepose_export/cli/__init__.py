"""Commands that make models; found by the entry-point group `edgepose.commands`."""
