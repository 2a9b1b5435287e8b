"""`python -m SlicerUSSim.Command` is the `ussim` command."""

from SlicerUSSim.Command.cli import main

main()
