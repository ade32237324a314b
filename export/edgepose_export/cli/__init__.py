"""Commands that make models, registered in the entry-point group `edgepose.commands`."""
