"""`ussim validate`."""

from __future__ import annotations

from pathlib import Path

import click

from SlicerUSSim.Command.options import device_option
from SlicerUSSim.Command.own_folder import require_own_results, results_of
from SlicerUSSim.Command.progress import Steps, note

_TABLES, _SUMMARY = "report.md", "report.json"


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default="ussim-validation",
    show_default=True,
    help="Folder for the report.",
)
@click.option(
    "--only", multiple=True, metavar="TEXT", help="Run only checks with this text in their names; may be repeated."
)
@device_option
@click.pass_context
def validate(ctx: click.Context, out: Path, only: tuple[str, ...], device: str | None) -> None:
    """Compare the simulator with theory on phantoms, in tables and figures; exit status 1 for values out of limits."""
    from SlicerUSSim.Logic.verification.validation import chosen_checks, validate as run

    checks = chosen_checks(only)
    require_own_results(out, (_TABLES, *(check.picture for check in checks)), _SUMMARY)
    count = sum(len(check.orientations) for check in checks)
    with results_of(out, _SUMMARY) as (folder, summary), Steps(count) as step:
        report = run(folder, device, only, step)
        summary |= report.to_dict()
    for finding in report.failed:
        row = finding.row
        click.echo(
            f"out of limits: {finding.check}, {row.quantity}, {finding.orientation}: {row.measured:.4g} {row.unit}, "
            f"predicted {row.predicted:.4g} ({row.limits})"
        )
    click.echo(report.summary())
    note(f"wrote {out / 'report.md'}, report.json and {len(report.pictures)} pictures")
    ctx.exit(1 if report.failed else 0)
