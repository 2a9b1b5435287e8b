"""The API reference: what docs/reference.py makes of faces, docstrings and the command."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest

from SlicerUSSim.Command.cli import main

ROOT = Path(__file__).parents[1]


def module_of_docs(name: str):
    """The module docs/`name`.py."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


reference = module_of_docs("reference")


def test_the_pages_of_rooms_describe_the_names_of_their_faces_alone():
    for room in reference.rooms():
        page = reference.room_page(room)
        described = re.findall(r"^\.\. (?:autoclass|autofunction|py:data):: (\w+)$", page, re.MULTILINE)
        assert sorted(described) == sorted(reference.exports(room))
        if room != "mrml":  # which needs Slicer's libraries
            assert sorted(described) == dir(importlib.import_module(f"SlicerUSSim.Logic.{room}"))
        without_comment = re.findall(r"py:data:: (\w+)\n\n *\n", page)
        assert not without_comment, "needs a comment that begins with #:"
    assert ".. py:data:: PROBES\n\n   Preset probes by name" in reference.room_page("probe")


def test_every_room_and_every_name_of_the_package_is_on_the_first_page():
    page = reference.index_page()
    for room in reference.rooms():
        assert f"   {room} <{room}>" in page
    for name in dir(importlib.import_module("SlicerUSSim.Logic")):
        assert re.search(rf"^   ~\w+\.{name}$", page, re.MULTILINE), name


def test_a_class_shows_the_methods_of_a_base_that_is_not_public():
    page = reference.room_page("vtk")
    assert page.count(".. automethod:: SetDevice") == 2
    assert "RequestUpdateExtent" not in page  # which has no docstring


def test_the_page_of_the_command_has_every_command_and_option():
    page = reference.command_page(main)
    for name, command in main.commands.items():
        assert f"\nussim {name}\n" in page
        for option in command.params:
            assert option.param_type_name == "argument" or max(option.opts, key=len) in page, (name, option.opts)


def test_parameters_become_a_definition_list():
    lines = [
        "Label the tissues.", "",
        "Parameters", "----------",
        "mri : the image; with a `mask`", "    if it is not stripped.",
        "a, b : (rows, columns).", "",
        "Raises SimulationError for others.",
    ]  # fmt: skip
    assert reference.docstring_as_rest(lines) == [
        "Label the tissues.", "",
        "", ":Parameters:",
        "    ``mri``", "        the image; with a ``mask``", "        if it is not stripped.",
        "    ``a``, ``b``", "        (rows, columns).", "",
        "Raises SimulationError for others.",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("`depth` of it", "``depth`` of it"),
        ("``as it is``", "``as it is``"),
        ("`Volume`", ":py:obj:`Volume <base.Volume>`"),
        ("`Volume.read`", ":py:obj:`Volume.read <base.Volume.read>`"),
        ("Volume", "Volume"),  # an ordinary word, too
        ("a TissueTable.", "a :py:obj:`TissueTable <tissue.TissueTable>`."),
        ("echo ~ |r|", r"echo ~ \|r\|"),
        ("see docs/physics.md#3-rays.", "see :doc:`docs/physics.md </docs/physics>`."),
    ],
)
def test_names_and_pages_in_a_docstring(text, expected):
    known = {"Volume": "base.Volume", "TissueTable": "tissue.TissueTable"}
    assert reference.docstring_as_rest([text], known) == [expected]


def test_an_example_is_left_unchanged():
    lines = [">>> values[`0`] | 1", "'`TissueTable`'", "", "`depth`"]
    assert reference.docstring_as_rest(lines, {"TissueTable": "x"}) == [*lines[:3], "``depth``"]


def test_pages_are_written_and_stale_ones_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(reference, "room_page", lambda room: f"the page of {room}\n")
    (tmp_path / "attic.rst").write_text("Attic")
    reference.write_pages(tmp_path, main)
    assert {page.stem for page in tmp_path.iterdir()} == {"index", "command", *reference.rooms()}
    before = (tmp_path / "probe.rst").stat().st_mtime_ns
    reference.write_pages(tmp_path, main)
    assert (tmp_path / "probe.rst").stat().st_mtime_ns == before
