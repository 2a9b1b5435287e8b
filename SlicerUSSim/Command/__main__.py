"""`python -m SlicerUSSim.Command` is the `ussim` command."""

import sys


def run() -> None:
    """The command; Ctrl-C while it is imported is one line, too."""
    try:
        from SlicerUSSim.Command.cli import main
    except KeyboardInterrupt:
        print("ussim: interrupted", file=sys.stderr)
        sys.exit(130)
    main()


if __name__ == "__main__":
    run()
