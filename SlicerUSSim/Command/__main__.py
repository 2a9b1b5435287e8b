"""`python -m SlicerUSSim` is the `ussim` command."""

from SlicerUSSim.cli import main

main()
