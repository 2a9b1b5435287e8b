"""Installation of the packages that the module needs and Slicer's Python lacks, after the user has confirmed.

Packages that Slicer has are not changed: every installed distribution, at its version, is a constraint for pip, which
installs compatible versions of the missing packages, or fails.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

import slicer
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version
from slicer.i18n import tr as _

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.opencl.devices import Runtime, runtimes

_NAME = "SlicerUSSim"


def ensure_packages(requirements_file: Path) -> None:
    """Install the missing packages of a requirements file, after the user has confirmed.

    Raises SimulationError if the user declines, if pip fails, if Slicer has an incompatible version of a package, and
    if packages are missing in Slicer's testing mode, in which nothing is installed.
    """
    missing = _missing(requirements_file)
    if not missing:
        return
    for requirement in missing:
        version = _installed_version(requirement.name)
        require(
            version is None,
            f"{_NAME} needs {requirement}, but this Slicer has {version}, which the module does not change; to change "
            f'it, run slicer.util.pip_install("{requirement}") and restart Slicer',
        )
    _ask_and_install(missing)
    still = _missing(requirements_file)
    require(not still, _not_installed(", ".join(map(str, still))))


def are_installed(requirements_file: Path) -> bool:
    """Whether no package of a requirements file is missing."""
    return not _missing(requirements_file)


def runtimes_to_install() -> list[Runtime]:
    """The OpenCL runtimes for processors that pip can install on this computer and has not installed."""
    return [runtime for runtime in runtimes() if _installed_version(runtime.packages[0]) is None]


def install_runtime(runtime: Runtime) -> None:
    """Install an OpenCL runtime. Raises SimulationError if pip fails, and if Slicer must be restarted to use it."""
    _install([Requirement(name) for name in runtime.packages])
    require("pyopencl" not in sys.modules, f"{runtime.name} is installed; restart Slicer to use it")


def _ask_and_install(missing: list[Requirement]) -> None:
    try:
        from slicer.packaging import pip_ensure
    except ImportError:  # before Slicer 5.11
        names = ", ".join(map(str, missing))
        require(not slicer.app.testingEnabled(), _not_installed(f"{names}; nothing is installed in testing mode"))
        question = _("{name} needs these Python packages: {packages}. Install them now?")
        confirmed = slicer.util.confirmOkCancelDisplay(question.format(name=_NAME, packages=names))
        require(confirmed, _not_installed("the installation was declined"))
        _install(missing)
        return
    with _in_one_line(), _constraints_file() as constraints:
        pip_ensure(missing, constraints=constraints, requester=_NAME)  # installs nothing in testing mode, without error


def _install(missing: list[Requirement]) -> None:
    with _in_one_line(), _constraints_file() as constraints:
        slicer.util.pip_install([*map(str, missing), "--constraint", str(constraints)])


def _missing(requirements_file: Path) -> list[Requirement]:
    """The requirements that apply to this computer and are not met, without their environment markers."""
    lines = [line.strip() for line in requirements_file.read_text(encoding="utf-8").splitlines()]
    requirements = [Requirement(line) for line in lines if line and not line.startswith("#")]
    importlib.invalidate_caches()  # pip may have installed packages
    missing = []
    for requirement in requirements:
        version = _installed_version(requirement.name)
        fulfilled = version is not None and requirement.specifier.contains(version, prereleases=True)
        if not fulfilled and (requirement.marker is None or requirement.marker.evaluate()):
            requirement.marker = None
            missing.append(requirement)
    return missing


def _installed_version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


@contextmanager
def _constraints_file() -> Iterator[Path]:
    """A file of pip constraints that keep every distribution of this Python at its version."""
    versions: dict[str, str] = {}
    for distribution in metadata.distributions():
        name, version = distribution.metadata["Name"], distribution.metadata["Version"]
        if name and _is_version(version):
            versions.setdefault(canonicalize_name(name), version)  # the first is the one that Python imports
    with tempfile.TemporaryDirectory(prefix="ussim-") as folder:
        path = Path(folder) / "constraints.txt"
        path.write_text("".join(f"{name}=={versions[name]}\n" for name in sorted(versions)), encoding="utf-8")
        yield path


def _is_version(text: str | None) -> bool:
    """Whether pip accepts it as a version; a single invalid line makes pip reject the whole file."""
    try:
        return text is not None and bool(Version(text))
    except InvalidVersion:
        return False


@contextmanager
def _in_one_line() -> Iterator[None]:
    """Convert any exception of Slicer's installer to a SimulationError of one line."""
    try:
        yield
    except Exception as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise SimulationError(_not_installed(lines[-1])) from error


def _not_installed(reason: str) -> str:
    return f"{_NAME} needs Python packages that are not installed ({reason})"
