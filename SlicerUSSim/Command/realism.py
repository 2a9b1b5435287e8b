"""`ussim realism`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.options import check_outputs, gathered
from SlicerUSSim.Command.patient_options import PatientOptions
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Command.sequence_options import SequenceOptions, open_tracked

if TYPE_CHECKING:
    from SlicerUSSim.Logic.fitting import Realism

#: Default number of images
_MOST_IMAGES = 6


@click.command()
@gathered(patient=PatientOptions, recording=SequenceOptions)
@click.option("--json", "out", type=click.Path(path_type=Path), help="All numbers: .json")
@click.option("--picture", type=click.Path(path_type=Path), help="Real and simulated images and controls: .png")
def realism(patient: PatientOptions, recording: SequenceOptions, out: Path | None, picture: Path | None) -> None:
    """Measure how much simulated images are like tracked real ones: costs, speckle, grey levels, sheets.

    Beside them are controls: real neighbours of the images, one uniform tissue at the gain that gives it the real
    images' mean grey level, its speckle on their local mean, and the real images blurred by 2 pixels. See
    docs/realism.md.
    """
    from SlicerUSSim.Logic.base.own_outputs import write_own_json
    from SlicerUSSim.Logic.fitting.realism import draw_sources, measure_realism, neighbours_of
    from SlicerUSSim.Logic.fitting.tracked_fit import simulated

    check_outputs(out, picture, recording.field)
    tracked = open_tracked(patient, recording, most=_MOST_IMAGES)
    simulator, display, real = tracked.examination.simulator, tracked.examination.display, tracked.images
    images = simulated(simulator, real, simulator.medium.tissues, display)
    found = measure_realism(
        real, {"simulated": images}, simulator, neighbours=neighbours_of(tracked.sequence, real), display=display
    )
    if out:
        write_own_json(out, found.to_dict())
    if picture:
        draw_sources(picture, found)
    _tell(found)
    written = [place for place in (out, picture, recording.field) if place]
    if written:
        note("wrote " + ", ".join(map(str, written)))


def _tell(found: Realism) -> None:
    """Print all tables."""
    for title, heads, rows in found.tables():
        click.echo(f"\n{title}")
        widths = [max(len(row[n]) for row in [heads, *rows]) for n in range(len(heads))]
        for row in [heads, *rows]:
            click.echo(
                "  ".join([row[0].ljust(widths[0]), *(t.rjust(w) for t, w in zip(row[1:], widths[1:], strict=True))])
            )
