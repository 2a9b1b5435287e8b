"""`ussim approach`."""

from __future__ import annotations

from pathlib import Path

import click

from SlicerUSSim.Command.options import check_outputs, gathered, out_option, overwrite_option
from SlicerUSSim.Command.patient_options import RARE, PatientOptions, open_examination, target_of
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.declaration import parameters_of
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.placement.approach import NO_ADVICE, ApproachWeights

_WEIGHTS = " ".join(entry.name for entry in parameters_of(ApproachWeights))


@click.command()
@gathered(f"{RARE} seed {_WEIGHTS}", patient=PatientOptions, approach=ApproachWeights)
@click.option(
    "--target", metavar="TISSUE|R,A,S", help="What is to be seen: a tissue, or a point in mm (default: the largest "
    "lesion).",
)  # fmt: skip
@out_option("Report: .html")
@overwrite_option
def approach(patient: PatientOptions, approach: ApproachWeights, target: str | None, out: Path) -> None:
    """Plan from where a probe sees a lesion best: candidates with ways, openings and images. No medical advice."""
    from SlicerUSSim.Logic.imaging.approach_images import simulated_approach, write_approach_report
    from SlicerUSSim.Logic.placement.approach import plan_approach

    require(out.suffix.lower() == ".html", f"--out is {str(out)!r}, expected a file .html")
    check_outputs(out)
    what = target_of(target)
    require(patient.craniotomy == "none", f"--craniotomy is {patient.craniotomy}, expected none: the plan opens a head")
    examination = open_examination(patient)
    simulator, probe = examination.simulator, examination.probe
    labels, names = simulator.medium.labels, simulator.medium.tissues.names_by_label()
    plan = plan_approach(labels, names, probe, what, weights=approach)
    plan = simulated_approach(
        plan, labels, simulator.medium.tissues, probe, simulator.settings, examination.display,
        device=simulator.device, texture=simulator.texture, sheets=simulator.medium.sheets,
    )  # fmt: skip
    weights = {entry.name: getattr(approach, entry.name) for entry in parameters_of(ApproachWeights)}
    write_approach_report(out, plan, labels, names, probe, subtitle=patient.source, weights=weights)
    for line in (plan.target.text, *(candidate.text for candidate in plan.candidates), NO_ADVICE):
        click.echo(line)
    note(f"wrote {out} ({len(plan.candidates)} candidates of {plan.compared} ways)")
