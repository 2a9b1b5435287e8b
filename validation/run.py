"""Runs the checks and reports their results."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from validation.checks import ORIENTATIONS, Check, Row


@dataclass(frozen=True)
class Finding:
    """A row with its check and orientation."""

    check: str
    orientation: str
    row: Row


@dataclass(frozen=True, eq=False)
class Report:
    """All rows of a validation."""

    findings: tuple[Finding, ...]
    device: str
    pictures: tuple[str, ...] = ()

    @property
    def failed(self) -> tuple[Finding, ...]:
        """The rows outside their limits."""
        return tuple(finding for finding in self.findings if not finding.row.passed)

    def to_dict(self) -> dict:
        """Plain values, one entry per row."""
        return {
            "device": self.device,
            "passed": not self.failed,
            "pictures": list(self.pictures),
            "rows": [
                {"check": f.check, "orientation": f.orientation, **asdict(f.row), "passed": f.row.passed}
                # NaN (the echo to measure was missing) is not allowed in JSON.
                | {"measured": float(f.row.measured) if np.isfinite(f.row.measured) else None}
                for f in self.findings
            ],
        }

    def to_markdown(self) -> str:
        """The tables as Markdown: a summary, then a section per check with its claim and its figure."""
        lines = ["# Validation", "", f"Device: {self.device}. {self.summary()}", ""]
        checks = {check.name: check for check in all_checks()}
        rows = {
            name: [f for f in self.findings if f.check == name]
            for name in dict.fromkeys(f.check for f in self.findings)
        }
        lines += ["| check | rows | passed | closest to its limit | fraction of limit |", "|---|---|---|---|---|"]
        for name, findings in rows.items():
            passed = sum(f.row.passed for f in findings)
            worst = max(findings, key=lambda f: f.row.strain)
            near = f"{worst.row.quantity}, {worst.orientation} | {100 * worst.row.strain:.0f} %"
            lines.append(f"| [{name}](#{_slug(name)}) | {len(findings)} | {passed} | {near} |")
        lines.append("")
        for name, findings in rows.items():
            lines += [f"## {name}", "", checks[name].claim, ""]
            if checks[name].picture in self.pictures:
                lines += [f"![{name}]({checks[name].picture})", ""]
            lines += ["| | orientation | predicted | measured | limit | |", "|---|---|---|---|---|---|"]
            for finding in findings:
                row, unit = finding.row, f" {finding.row.unit}" if finding.row.unit else ""
                values = f"{row.predicted:.4g}{unit} | {row.measured:.4g}{unit} | {row.limits}"
                verdict = "pass" if row.passed else "**FAIL**"
                lines.append(f"| {row.quantity} | {finding.orientation} | {values} | {verdict} |")
            lines.append("")
        return "\n".join(lines)

    def summary(self) -> str:
        """One sentence: how many rows passed."""
        return f"{len(self.findings) - len(self.failed)} of {len(self.findings)} rows passed."


def all_checks() -> tuple[Check, ...]:
    """Every check, in the order of the physics: rays, speckle, artefacts, space."""
    from validation import (
        aberration,
        apertures,
        artefacts,
        band,
        beams,
        continuity,
        curved_walls,
        flat_walls,
        floor,
        heads,
        rays,
        rough,
        speckle,
        sulci,
        transmit,
        walls,
    )

    groups = (
        rays,
        speckle,
        continuity,
        band,
        floor,
        artefacts,
        beams,
        apertures,
        curved_walls,
        transmit,
        walls,
        flat_walls,
        sulci,
        rough,
        aberration,
        heads,
    )
    return tuple(check for group in groups for check in group.CHECKS)


def validate(
    out: str | os.PathLike,
    device=None,
    only: Iterable[str] = (),
    progress: Callable[[str], None] = lambda name: None,
) -> Report:
    """Run the checks (all, or those whose names contain one of `only`) and write report.md, report.json and figures.

    Raises SimulationError without matplotlib, for a text in `only` that matches no check, and for a folder that cannot
    be created. A failed row does not raise: see Report.failed.
    """
    from SlicerUSSim.Logic.base.files import make_folder, write_json, written_whole
    from SlicerUSSim.Logic.imaging.figures import require_matplotlib
    from SlicerUSSim.Logic.opencl.device import Device

    require_matplotlib()
    checks = chosen_checks(only)
    folder = make_folder(out)
    opened = Device.get(device)
    findings, pictures = [], []
    for check in checks:
        for orientation in check.orientations:
            progress(f"{check.name}, {orientation}")
            outcome = check.measure(ORIENTATIONS[orientation], opened)
            findings += [Finding(check.name, orientation, row) for row in outcome.rows]
            if outcome.draw is not None and orientation == check.orientations[0]:
                outcome.draw(folder / check.picture)
                pictures.append(check.picture)
    report = Report(tuple(findings), str(opened.info), tuple(pictures))
    write_json(folder / "report.json", report.to_dict())
    with written_whole(folder / "report.md") as partial:
        partial.write_text(report.to_markdown(), encoding="utf-8")
    return report


def chosen_checks(only: Iterable[str]) -> tuple[Check, ...]:
    """The checks whose names contain one of the texts; all without texts. SimulationError for a text without match."""
    wanted, checks = tuple(only), all_checks()
    for text in wanted:
        require(
            any(text in check.name for check in checks),
            f"check is {text!r}, expected part of: {', '.join(check.name for check in checks)}",
        )
    return tuple(check for check in checks if not wanted or any(text in check.name for text in wanted))


def _slug(name: str) -> str:
    return name.replace(" ", "-")
