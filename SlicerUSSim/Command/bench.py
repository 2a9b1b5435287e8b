"""`ussim bench`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from SlicerUSSim.Command.options import check_outputs, device_option
from SlicerUSSim.Command.progress import Steps
from SlicerUSSim.Logic.base.version import __version__


@click.command()
@click.option(
    "--json",
    "json_file",
    type=click.Path(path_type=Path),
    help="Write the results to this JSON file; -: print them instead of the table.",
)
@click.option(
    "--repeat", default=30, show_default=True, help="Calls per measurement; the best and the median are reported."
)
@click.option("--brief", is_flag=True, help="Only frame A and the segmentation, with few calls.")
@device_option
@click.pass_context
def bench(ctx: click.Context, json_file: Path | None, repeat: int, brief: bool, device: str | None) -> None:
    """Time per stage and per frame on every OpenCL device, compared with lower bounds for memory and arithmetic.

    The images are also compared with the numpy model and between devices; exit status 1 if they differ. Times do not
    affect the exit status.
    """
    from SlicerUSSim.Logic.base.own_outputs import write_own_json
    from SlicerUSSim.Logic.opencl.devices import devices_to_measure
    from SlicerUSSim.Logic.verification.benchmark.suite import run_benchmark
    from SlicerUSSim.Logic.verification.benchmark.tables import table_of

    prints_json = str(json_file) == "-"
    if json_file and not prints_json:
        check_outputs(json_file)
    devices = devices_to_measure(device)
    steps = len(devices) * (3 if brief else 6) + 1
    with Steps(steps) as step:
        result = run_benchmark(devices, repeat=min(repeat, 5) if brief else repeat, brief=brief, progress=step)
    result = {"version": __version__, **result}
    click.echo(json.dumps(result, indent=2) if prints_json else table_of(result))
    if json_file and not prints_json:
        write_own_json(json_file, result)
    ctx.exit(1 if result["wrong"] else 0)
