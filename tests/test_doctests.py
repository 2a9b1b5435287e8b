"""The examples in docstrings run, and print what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import SlicerUSSim.Logic

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "SlicerUSSim" / "Logic").rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
FINDER = doctest.DocTestFinder()
#: Public names whose reference shows how to use them
SHOWN = {
    "ConvexProbe", "DisplaySettings", "Preset", "SimulationError", "SimulationSettings", "Tissue", "TissueTable",
    "TrackedSequence", "UltrasoundSimulator", "Volume", "optimize_appearance", "seed_of_pose", "segment_ct",
    "segment_mri", "similarity",
}  # fmt: skip


@pytest.mark.parametrize("module", MODULES)
def test_examples_give_what_they_say(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # examples write files
    examples = [test for test in FINDER.find(importlib.import_module(module)) if test.examples]
    assert examples, f"{module} has >>> outside of docstrings"
    for example in examples:
        example.globs = {}  # so that each shows its imports
        report: list[str] = []
        result = doctest.DocTestRunner(verbose=False).run(example, out=report.append)
        assert result.failed == 0, "".join(report)


def test_the_most_used_names_have_an_example():
    assert not {name for name in SHOWN if ">>> " not in (getattr(SlicerUSSim.Logic, name).__doc__ or "")}
