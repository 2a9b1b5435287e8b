"""SessionStore: sessions kept in a folder of the user, so that what was done is there after a crash.

Each server has a folder of its own, which it holds locked while it runs; one that nobody holds is of a server that has
ended. Folders are for the user alone (0700, files 0600), and few, small and young; see docs/security.md.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import make_folder, read_json, written_whole
from SlicerUSSim.Logic.base.reading import read_values

#: Ended sessions that are kept, for how many days, and bytes of all of them
MOST_SESSIONS, MOST_DAYS, MOST_BYTES = 3, 7, 6 * 2**30
#: Bytes of one session, and of the disk that stay free
MOST_SESSION_BYTES, FREE_BYTES = 2 * 2**30, 2**30
#: Hours after which a token is not taken again
_TOKEN_HOURS = 24
_STATE, _ADDRESS, _LOCK = "state.json", "address.json", "lock"
#: Changes when sessions of before cannot be read any more
_FORMAT = 1
#: Bytes of the file with the state, of which most are tissues
_MOST_STATE_BYTES = 2**24


def sessions_folder() -> Path:
    """Where sessions of this user are kept."""
    home = Path.home()
    if sys.platform == "win32":
        root = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "SlicerUSSim"
    elif sys.platform == "darwin":
        root = home / "Library" / "Application Support" / "SlicerUSSim"
    else:
        own = os.environ.get("XDG_STATE_HOME", "")
        root = (Path(own) if os.path.isabs(own) else home / ".local" / "state") / "slicerussim"
    return root / "sessions"


@dataclass(frozen=True)
class KeptSession:
    """A session of a server that does not run any more."""

    folder: Path
    #: Name of the patient
    patient: str
    #: Time of the last autosave, local
    saved: datetime
    #: What OwnSession.write_state wrote
    content: dict[str, Any]

    def read(self, part: str) -> Any:
        """A part of it, as OwnSession.write wrote it; None without. Raises SimulationError for a damaged file."""
        name = self.content["files"].get(part)
        return None if name is None else self.read_file(str(name))

    def read_file(self, name: str) -> Any:
        """The values in one of its files. Raises SimulationError for a damaged or missing file."""
        require(Path(name).name == name, f"the session names {name!r}, expected a file of its folder")
        try:
            with (self.folder / name).open("rb") as file:
                return read_values(file)
        except OSError as error:
            raise SimulationError(f"the session's {name} cannot be read ({error.strerror})") from None
        except SimulationError as error:
            raise SimulationError(f"the session's {name} {error}") from None

    def copies(self, part: str, folder: Path) -> dict[str, Path]:
        """{name: copy in a folder} of a part that is {name: its file}. Raises SimulationError for a missing file."""
        found = {}
        for number, (name, file) in enumerate(dict(self.content["files"].get(part, {})).items()):
            require(Path(file).name == file, f"the session names {file!r}, expected a file of its folder")
            found[str(name)] = folder / str(number)
            try:
                shutil.copyfile(self.folder / file, found[str(name)])
            except OSError as error:
                raise SimulationError(f"the session's {file} cannot be read ({error.strerror})") from None
        return found

    def remove(self) -> None:
        """Remove it from the disk."""
        shutil.rmtree(self.folder, ignore_errors=True)


class OwnSession:
    """The session of this server. Its methods may be called in a thread, one at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = _locked(folder / _LOCK)

    def write(self, name: str, write: Callable[[BinaryIO], None]) -> None:
        """Write a file of the session, whole or not at all. Raises SimulationError if that cannot be done."""
        with written_whole(self.folder / name) as partial:
            descriptor = os.open(partial, os.O_CREAT | os.O_WRONLY | os.O_TRUNC | getattr(os, "O_BINARY", 0), 0o600)
            with open(descriptor, "wb") as file:
                write(file)

    def write_state(self, patient: str, files: dict[str, Any], state: dict[str, Any]) -> None:
        """Make what was written what would be restored: `files` are {part: its file}; others are removed then."""
        saved = datetime.now().astimezone().isoformat(timespec="seconds")
        values = {"format": _FORMAT, "patient": patient, "saved": saved, "files": files, **state}
        self.write(_STATE, partial(_write_json, values))
        kept = {_STATE, _ADDRESS, _LOCK}
        for entry in files.values():
            kept |= {entry} if isinstance(entry, str) else set(entry.values() if isinstance(entry, dict) else entry)
        for path in self.folder.iterdir():
            if path.is_file() and path.name not in kept:
                path.unlink(missing_ok=True)

    def clear(self) -> None:
        """Keep nothing of the patient any more."""
        for path in sorted(self.folder.iterdir(), key=lambda path: path.name != _STATE):  # which makes it one
            if path.is_file() and path.name not in (_ADDRESS, _LOCK):
                path.unlink(missing_ok=True)

    def keep_address(self, port: int, token: str) -> None:
        """Keep the token, with which a server that is started again at this port is reached by the same pages."""
        self.write(_ADDRESS, partial(_write_json, {"port": port, "token": token}))

    def end(self) -> None:
        """Called when the server ends as it should: its token is not used again."""
        with suppress(OSError):
            (self.folder / _ADDRESS).unlink(missing_ok=True)
        self._lock.close()  # before it is removed, which Windows asks for
        if not (self.folder / _STATE).exists():
            shutil.rmtree(self.folder, ignore_errors=True)

    def room(self) -> int:
        """Bytes that a session may have now."""
        return max(0, min(MOST_SESSION_BYTES, shutil.disk_usage(self.folder).free - FREE_BYTES))


class SessionStore:
    """The sessions in one folder.

    Parameters
    ----------
    folder : see sessions_folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def begin(self) -> OwnSession:
        """A new session for this server. Raises SimulationError if the folder cannot be made for this user alone."""
        make_folder(self._folder)
        for folder in (self._folder.parent, self._folder):
            if os.name == "posix" and folder.stat().st_uid == os.getuid():
                folder.chmod(0o700)
        own = self._folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(4)}"
        try:
            own.mkdir(mode=0o700)
            return OwnSession(own)
        except OSError as error:
            raise SimulationError(f"{own}: cannot be created ({error.strerror})") from None

    def ended(self) -> list[KeptSession]:
        """Sessions of servers that do not run any more, the newest first; those beyond the limits are removed."""
        found = []
        for folder in self._ended_folders():
            session = _read(folder)
            if session is None:
                if not (folder / _ADDRESS).exists() or _age_hours(folder / _ADDRESS) > _TOKEN_HOURS:
                    shutil.rmtree(folder, ignore_errors=True)
            else:
                found.append(session)
        found.sort(key=lambda session: session.saved, reverse=True)
        kept, size = [], 0
        for session in found:
            size += sum(path.stat().st_size for path in session.folder.rglob("*") if path.is_file())
            age = datetime.now().astimezone() - session.saved
            if len(kept) < MOST_SESSIONS and age.days < MOST_DAYS and size <= MOST_BYTES:
                kept.append(session)
            else:
                session.remove()
        return kept

    def token_of(self, port: int) -> str | None:
        """The token of the last server at this port, if it was killed; it is taken once."""
        for folder in sorted(self._ended_folders(), reverse=True):
            path = folder / _ADDRESS
            try:
                values = read_json(path) if path.exists() and _age_hours(path) < _TOKEN_HOURS else None
            except (SimulationError, OSError):
                continue
            if isinstance(values, dict) and values.get("port") == port:
                path.unlink(missing_ok=True)
                token = values.get("token")
                return token if isinstance(token, str) and len(token) >= 32 else None
        return None

    def _ended_folders(self) -> list[Path]:
        """Folders of sessions that no server holds."""
        if not self._folder.is_dir():
            return []
        return [folder for folder in self._folder.iterdir() if folder.is_dir() and not _is_held(folder / _LOCK)]


def _read(folder: Path) -> KeptSession | None:
    """The session in a folder; None if there is none that can be restored."""
    try:
        content = read_json(folder / _STATE, _MOST_STATE_BYTES)
        require(isinstance(content, dict) and content.get("format") == _FORMAT, "another format")
        require(isinstance(content.get("files"), dict), "no files")
        return KeptSession(folder, str(content["patient"]), datetime.fromisoformat(content["saved"]), content)
    except (SimulationError, KeyError, ValueError, TypeError):
        return None


def _write_json(values: Any, file: BinaryIO) -> None:
    file.write(json.dumps(values).encode())


def _age_hours(path: Path) -> float:
    return (time.time() - path.stat().st_mtime) / 3600.0


def _locked(path: Path) -> BinaryIO:
    """A file that is locked until it is closed, or this process ends. Raises OSError if another process holds it."""
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
    file = open(descriptor, "r+b")  # noqa: SIM115 (it stays open)
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise
    return file


def _is_held(path: Path) -> bool:
    """Whether a process holds a lock."""
    if not path.exists():  # it is about to
        return _age_hours(path.parent) < 0.1
    try:
        _locked(path).close()
    except OSError:
        return True
    return False
