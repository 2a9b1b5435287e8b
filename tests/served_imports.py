"""What a server of the workstation imports: once, in the process whose forks are the servers of tests (served.py)."""

from __future__ import annotations

from SlicerUSSim.Command.serve import _prepare_libraries

_prepare_libraries()  # before trame, as `ussim serve` does

import SimpleITK  # noqa: E402, F401

import SlicerUSSim.Command.cli  # noqa: E402
import SlicerUSSim.Workstation.workstation  # noqa: E402, F401
