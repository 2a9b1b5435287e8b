"""`ussim devices`."""

from __future__ import annotations

import click

from SlicerUSSim.Command.options import device_option


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
