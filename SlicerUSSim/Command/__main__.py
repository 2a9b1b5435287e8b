"""`python -m SlicerUSSim.Command` is the `ussim` command."""

import signal
import sys


def run() -> None:
    """The command. Ctrl-C while it is imported is one line after that; a second one ends the process at once."""
    pressed = []

    def press(number: int, _: object) -> None:
        pressed.append(number)
        signal.signal(number, signal.SIG_DFL)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, press)
    from SlicerUSSim.Command.cli import main
    from SlicerUSSim.Command.interrupts import end_at_once

    if pressed:
        print("ussim: interrupted", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    if signal.getsignal(signal.SIGINT) is press:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        main()
    except SystemExit as ended:
        if isinstance(ended.code, int) and ended.code > 128:  # by a signal, while threads compile and compute
            end_at_once(ended.code)
        raise


if __name__ == "__main__":
    run()
