"""What keeps an OpenCL runtime from working: a limited address space, a cache that cannot be written, its full disk."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

#: Address space in bytes below which runtimes fail, or end the process: measured with PoCL 3.0 and Intel's of 2025
LEAST_ADDRESS_SPACE = {"Intel": 1_500_000_000, "": 1_000_000_000}
_LEAST_DISK = 4_000_000  # bytes of the programs of a simulator


def lack_of_address_space(platform: str = "") -> str | None:
    """What to say if the runtime of an OpenCL platform cannot work in this process's address space, else None."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    least = next(size for name, size in LEAST_ADDRESS_SPACE.items() if name in platform)
    if limit == resource.RLIM_INFINITY or limit >= least:
        return None
    return (
        f"the address space of this process is limited to {limit / 1e6:.0f} MB (ulimit -v), expected at least "
        f"{least / 1e6:.0f} MB"
    )


def lack_of_cache(folder: Path) -> str | None:
    """What to say if the folder in which PoCL keeps programs cannot be made or written, else None: it has no device."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return (
            f"PoCL keeps programs in {folder}, which cannot be written ({error.strerror}); set XDG_CACHE_HOME to "
            "another folder"
        )


def lack_of_disk(folders: list[Path]) -> str | None:
    """What to say if one of the folders that runtimes build programs in is on a full disk, else None."""
    for folder in [*folders, Path(tempfile.gettempdir())]:
        there = next((part for part in (folder, *folder.parents) if part.exists()), None)
        free = None if there is None else shutil.disk_usage(there).free
        if free is not None and free < _LEAST_DISK:
            return f"{folder} is on a full disk ({free / 1e6:.1f} MB left, expected {_LEAST_DISK / 1e6:.0f} MB)"
    return None


def lack_of_programs_disk(folder: Path) -> str | None:
    """What to say if PoCL's programs are neither in its folder nor would fit on the disk, else None.

    Its compiler ends the process where the disk is full.
    """
    there = next((part for part in (folder, *folder.parents) if part.exists()), None)
    if there is None or shutil.disk_usage(there).free >= _LEAST_DISK:
        return None
    held = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return None if held >= _LEAST_DISK else lack_of_disk([folder])
