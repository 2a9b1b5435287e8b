"""`ussim check`."""

from __future__ import annotations

import click

from SlicerUSSim.Command.options import device_option
from SlicerUSSim.Command.progress import Share


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
