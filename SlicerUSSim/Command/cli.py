"""The `ussim` command: its subcommands, one file each, and its error and warning messages.

Slow imports are inside the subcommands, so that --help is immediate.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import threading
import warnings
from typing import Any

import click

from SlicerUSSim.Command.dataset import dataset
from SlicerUSSim.Command.demo import demo
from SlicerUSSim.Command.interrupts import end_at_signals
from SlicerUSSim.Command.optimize import optimize
from SlicerUSSim.Command.options import about_key, device_option, rare_keys, untrusted_option, verbose_option
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Command.segment import segment
from SlicerUSSim.Command.serve import serve
from SlicerUSSim.Command.simulate import approach, simulate, sweep, volume
from SlicerUSSim.Command.virtual_ultrasound import device
from SlicerUSSim.Logic.base.errors import is_our_warning, user_message
from SlicerUSSim.Logic.base.version import __version__

#: Errors of a standard output that is a file on a full or broken disk, or closed
_NO_MORE = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EBADF}

_HELP = {"help_option_names": ["-h", "--help"]}


class _OneLineErrors(click.Command):
    """Reports errors caused by the user, and warnings, as one line on stderr; the exit status of errors is 2."""

    def main(self, *args: Any, **extra: Any) -> Any:
        warnings.showwarning = _show_warning
        try:
            return super().main(*args, **extra)
        except OSError as error:
            if error.filename is not None or error.errno not in _NO_MORE:
                raise
            with contextlib.suppress(OSError):  # both may go to the same full disk
                click.echo(f"ussim: standard output cannot be written ({os.strerror(error.errno)})", err=True)
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115, the rest of its buffer would be tried again at the end
            sys.exit(2)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("ussim: interrupted", err=True)
            ctx.exit(128 + signal.SIGINT)
        except Exception as error:
            message = about_key(error) if isinstance(error, click.NoSuchOption) else user_message(error)
            if message is None:
                raise
            click.echo(f"ussim: {message}", err=True)
            ctx.exit(2)


class ToolCommand(_OneLineErrors):
    """A command of a checkout, with the options of every subcommand of `ussim`."""

    def __init__(self, *args: Any, **extra: Any) -> None:
        super().__init__(*args, **extra, context_settings=_HELP)
        untrusted_option(verbose_option(self))


class _Commands(_OneLineErrors, click.Group):
    """The subcommands of `ussim`."""


@click.group(cls=_Commands, context_settings=_HELP)
@click.version_option(__version__, prog_name="ussim")
def main() -> None:
    """B-mode ultrasound simulated from a patient's MRI."""
    if threading.current_thread() is threading.main_thread():
        end_at_signals()


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Show warnings of this package as one line, and none of other libraries."""
    if is_our_warning(category):
        note(f"ussim: warning: {message}")


@click.command()
@device_option
def devices(device: str | None) -> None:
    """List the OpenCL devices, the one that is used with the reason, and how to install a faster one."""
    from SlicerUSSim.Logic.opencl.devices import choose_device, faster_hint, list_devices

    chosen, reason = choose_device(device)
    for info in list_devices():
        click.echo(f"{'*' if info == chosen else ' '} {info}, {info.memory_mb} MB")
    click.echo(f"used: {chosen.index}, {reason}")
    hint = faster_hint(chosen)
    if hint:
        click.echo(f"faster on this computer: {hint}")


@click.command()
@device_option
@click.pass_context
def check(ctx: click.Context, device: str | None) -> None:
    """Test that every OpenCL device computes correctly, in some seconds each.

    Compares small images with those of the release and speed of sound, attenuation and speckle with theory, and
    measures the time per frame. The exit status is 1 if a device computes wrongly or fails.
    """
    from SlicerUSSim.Logic.imaging.self_check import check_devices

    with Share("check") as progress:
        result = check_devices(device, progress)
    for line in result.lines:
        click.echo(line)
    ctx.exit(1 if result.wrong else 0)


commands = (approach, check, dataset, demo, device, devices, optimize, segment, serve, simulate, sweep, volume)
for command in commands:
    main.add_command(untrusted_option(verbose_option(command), hidden=True))
    if rare_keys(command):
        command.epilog = f"Further keys of --set: {', '.join(rare_keys(command))}."
untrusted_option(verbose_option(main))

if __name__ == "__main__":
    main()
