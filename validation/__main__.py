"""Compare the simulator with theory on phantoms: python -m validation [--only TEXT] [--out DIR] [--device D].

Writes tables and figures. The exit status is 1 if a value is out of its limits.
"""

from __future__ import annotations

import logging
from pathlib import Path

import click

from SlicerUSSim.Command.cli import ToolCommand
from SlicerUSSim.Command.options import check_results, device_option, overwrite_option, results_of
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.files import write_json
from validation.run import chosen_checks, validate

_TABLES, _SUMMARY = "report.md", "report.json"


@click.command(cls=ToolCommand, help=__doc__)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default="ussim-validation",
    show_default=True,
    help="Folder for the report.",
)
@click.option(
    "--only",
    multiple=True,
    metavar="TEXT",
    help="Run only checks with this text in their names, as the report lists them; may be repeated.",
)
@device_option
@overwrite_option
@click.pass_context
def main(ctx: click.Context, out: Path, only: tuple[str, ...], device: str | None) -> None:
    checks = chosen_checks(only)
    check_results(out, (_TABLES, _SUMMARY, *(check.picture for check in checks)))
    with results_of(out) as folder:
        report = validate(folder, device, only, lambda name: note(f"{name} ..."))
        write_json(folder / _SUMMARY, report.to_dict())
    for finding in report.failed:
        row = finding.row
        click.echo(
            f"out of limits: {finding.check}, {row.quantity}, {finding.orientation}: {row.measured:.4g} {row.unit}, "
            f"predicted {row.predicted:.4g} ({row.limits})"
        )
    click.echo(report.summary())
    note(f"wrote {out / _TABLES}, {_SUMMARY} and {len(report.pictures)} pictures")
    ctx.exit(1 if report.failed else 0)


if __name__ == "__main__":
    logging.getLogger("SlicerUSSim.Logic.imaging.simulator").setLevel(logging.ERROR)  # phantoms may end in the image
    main(prog_name="python -m validation")
