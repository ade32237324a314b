"""`python -m edgepose`: the same as the `edgepose` command."""

from edgepose.cli import main

main()
