"""`ussim optimize`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.options import check_outputs, declared, gathered, out_option, overwrite_option
from SlicerUSSim.Command.patient_options import RARE, RARE_BESIDE, PatientOptions
from SlicerUSSim.Command.progress import Curve, note
from SlicerUSSim.Command.sequence_options import RARE_OF_SEQUENCE, SequenceOptions, TrackedExamination, open_tracked
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings

if TYPE_CHECKING:
    from SlicerUSSim.Logic.fitting import Fit

#: Default number of images to fit.
_MOST_IMAGES = 6


@dataclass(frozen=True)
class Results:
    """Files that a fit writes beside its result."""

    report: Path | None = declared(  # noqa: RUF009, a dataclasses.field like the others
        "--report", type=click.Path(path_type=Path), help="Self-contained HTML report: .html"
    )
    save_preset: Path | None = declared(  # noqa: RUF009
        "--save-preset", type=click.Path(path_type=Path), help="Preset with the fitted values: .json"
    )
    save_transform: Path | None = declared(  # noqa: RUF009
        "--save-transform", type=click.Path(path_type=Path), help="With --register: the refined map from the "
        "ultrasound's reference frame to the MRI, in the format of --to-mri: .json",
    )  # fmt: skip


@click.command()
@gathered(
    f"{RARE} {RARE_BESIDE} {RARE_OF_SEQUENCE} craniotomy look evaluations restarts speckle validate save_transform",
    patient=PatientOptions, recording=SequenceOptions, fit=FitSettings, results=Results,
)  # fmt: skip
@out_option("Result: .json")
@click.option(
    "--free", multiple=True, metavar="NAME[=LOW:HIGH]",
    help='Free parameters: "display", "tissues" (echogenicity and attenuation of each tissue that the images show), a '
    'tissue, a group of the display ("smoothing", "map", "sliders", "line gains"), or a parameter ("gain_db", "white '
    'matter.mu0"), optionally with bounds; may be repeated (default: display and tissues).',
)  # fmt: skip
@overwrite_option
def optimize(
    patient: PatientOptions, recording: SequenceOptions, fit: FitSettings, results: Results, out: Path,
    free: tuple[str, ...],
) -> None:  # fmt: skip
    """Fit display and tissue parameters to tracked real ultrasound."""
    from SlicerUSSim.Logic.base.files import write_json
    from SlicerUSSim.Logic.fitting.control_costs import neighbours_of
    from SlicerUSSim.Logic.fitting.held_out import predict
    from SlicerUSSim.Logic.fitting.tracked_fit import fit as fitted_to
    from SlicerUSSim.Logic.imaging.figures import require_matplotlib
    from SlicerUSSim.Logic.imaging.preset import Preset

    report, save_transform = results.report, results.save_transform
    places = (out, report, results.save_preset, save_transform, recording.field)
    check_outputs(*places)
    if save_transform:
        expected = f"results.save_transform is {save_transform}, expected a name ending in .json"
        require(save_transform.suffix.lower() == ".json", expected)
        require(fit.register, "results.save_transform needs --register")
    if report:
        require_matplotlib()
    names = dict(_free_parameter(text) for text in free) or dict.fromkeys(fit.free_names)
    tracked = open_tracked(patient, recording, most=_MOST_IMAGES, apart=fit.validate)
    simulator = tracked.examination.simulator
    with Curve("optimize") as curve:
        found = fitted_to(
            simulator, tracked.images, free=names, display=tracked.examination.display,
            register=fit.register, speckle=fit.speckle,
            max_evaluations=fit.of_search, restarts=fit.restarts, progress=curve,
        )  # fmt: skip
        if tracked.others is not None:
            near = [neighbours_of(tracked.sequence, images) for images in (tracked.others, tracked.images)]
            prediction = predict(
                found, simulator, tracked.others, free=names, display=tracked.examination.display,
                speckle=fit.speckle, neighbours=near[0], fitted_neighbours=near[1],
                max_evaluations=fit.of_search, restarts=fit.restarts, progress=curve,
            )  # fmt: skip
            found = replace(found, prediction=prediction)
    write_json(out, found.to_dict())
    if results.save_preset:
        result = found.appearance
        preset = Preset(found.tracked.probe, result.display, simulator.settings, result.tissues)
        preset.write(results.save_preset)
    if save_transform and found.registration:
        to_mri = found.registration.correction @ tracked.reference_to_ras
        write_json(save_transform, {"probe_to_ras": to_mri.tolist()})
    if report:
        _write_report(report, found, tracked, patient, recording)
    _tell(found)
    note("wrote " + ", ".join(str(place) for place in places if place))


def _free_parameter(text: str) -> tuple[str, tuple[float, float] | None]:
    """A name, or name=low:high."""
    name, equals, bounds = text.partition("=")
    if not equals:
        return name.strip(), None
    try:
        low, high = (float(end) for end in bounds.split(":"))
    except ValueError:
        raise SimulationError(
            f"--free is {text!r}, expected NAME or NAME=LOW:HIGH, as in white matter.mu0=0.1:0.8"
        ) from None
    return name.strip(), (low, high)


def _write_report(
    path: Path, found: Fit, tracked: TrackedExamination, patient: PatientOptions, recording: SequenceOptions
) -> None:
    """Write --report, with all inputs that are needed to repeat the fit."""
    from SlicerUSSim.Logic.fitting.report import write_report

    simulator = tracked.examination.simulator
    provenance = (
        f"SlicerUSSim {__version__}, {simulator.device.info}. MRI or labels: {patient.source}. Sequence: "
        f"{recording.sequence}, images {', '.join(map(str, tracked.images.numbers))}. Probe: {tracked.images.probe}. "
        f"Settings: {simulator.settings}."
    )
    write_report(
        path, found.appearance, found.tracked, found.before, found.after, simulator,
        subtitle=f"{Path(recording.sequence).name} on {Path(patient.source).name}", provenance=provenance,
        prediction=found.prediction, speckle=found.speckle,
        reference="twin" if tracked.sequence.is_simulated else "real",
    )  # fmt: skip


def _tell(found: Fit) -> None:
    """Print the result, one line for the cost and one for each parameter."""
    if found.registration:
        moved = found.registration
        click.echo(f"moved by {moved.shift_mm:.2f} mm and {moved.turn_deg:.2f} degrees")
    result = found.appearance
    click.echo(f"cost {result.cost_before:.4f} -> {result.cost_after:.4f} ({result.evaluations} evaluations)")
    if found.prediction is not None:
        for line in found.prediction.lines():
            click.echo(line)
    for parameter in result.parameters:
        spread = result.identifiability[parameter.name]
        note = "  at its bound" if parameter.name in result.at_bounds else ""
        if not note and spread.is_determined is False:
            note = f"  not determined: {spread.low:.3g} to {spread.high:.3g} fit as well"
        before, after = result.before[parameter.name], result.after[parameter.name]
        click.echo(f"{parameter.name:42s} {before:8.3f} -> {after:8.3f}{note}")
