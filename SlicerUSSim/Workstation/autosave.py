"""Autosave: keeps the running session in a folder of the user, in a thread, so that no image waits for it.

In the event loop it looks every two seconds whether anything has changed, and takes references to what has; voxels are
not copied. What was written before is there until all of the new is (session_store.OwnSession).
"""

from __future__ import annotations

import io
import logging
import shutil
import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from PIL import Image
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.reading import write_values
from SlicerUSSim.Logic.mrml.landmark_nodes import Landmark
from SlicerUSSim.Logic.mrml.scene_record import (
    SceneRecord,
    SequenceRecord,
    nodes_version,
    record_nodes,
    recorded_values,
)
from SlicerUSSim.Logic.mrml.taken_sequence import (
    FrozenRecord,
    SimulatedRecord,
    record_frozen,
    record_taken,
    version_frozen,
    version_taken,
)
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.export import MOST_IMAGES, Cine, CineImage
from SlicerUSSim.Workstation.opener import Opener
from SlicerUSSim.Workstation.session_store import OwnSession

_log = logging.getLogger(__name__)

#: Seconds between two looks at what has changed
_EVERY_S = 2.0
#: Seconds after which it is tried again, when it could not be written
_AGAIN_AFTER_S = 60.0
#: Of the images of a cine loop, see streams._QUALITY
_QUALITY = 95


@dataclass(frozen=True, eq=False)
class _Taken:
    """What is to be written; what has not changed is None."""

    patient: str
    state: dict[str, Any]
    #: Without its sequence
    anatomy: SceneRecord | None
    sequence: SequenceRecord | None
    #: Images of Simulate sequence
    simulated: SimulatedRecord | None
    #: The image that stays where it was taken
    frozen: FrozenRecord | None
    fit: tuple | None
    #: Names of those of these four that there are not at all
    missing: tuple[str, ...]
    #: Images that are new, and whether they begin a loop
    cine: list[CineImage]
    is_new_loop: bool
    #: {name: where it is} of the files that a page has sent
    sent: dict[str, Path]


class Autosave:
    """Keeps one session.

    Parameters
    ----------
    session : where; None: nothing is kept.
    pose : (4, 4) of the probe, or None.
    landmarks : of the registration.
    """

    def __init__(
        self, session: OwnSession | None, panel: BrowserPanel, opener: Opener, cine: Cine,
        pose: Callable[[], np.ndarray | None], landmarks: Callable[[], Sequence[Landmark]],
    ) -> None:  # fmt: skip
        self._session, self._shared, self._logic = session, panel.shared, panel.logic
        self._presenter, self._told, self._in_loop = panel.presenter, panel.showError, panel.tasks.tell
        self._opener, self._cine, self._pose, self._landmarks = opener, cine, pose, landmarks
        self._is_told = False
        self._is_ended = False
        self._not_before = 0.0  # time, s
        self._writing: threading.Thread | None = None
        self._when_kept: list[Callable[[], None]] = []
        self._forget()

    def _forget(self) -> None:
        """Take all as new, as after the session was cleared."""
        self._seen: Hashable = None  # when it was written last
        self._anatomy_seen: Hashable = None
        self._sequence_seen: Any = None
        self._simulated_seen: Hashable = None
        self._frozen_seen: Hashable = None
        self._fit_seen: Any = None  # with the preset that Apply replaced; these objects themselves, not their ids
        self._cine_seen = (-1, 0)  # loop, and number of images
        self._number = 0  # of files
        self._files: dict[str, Any] = {}
        self._sent: dict[Path, str] = {}  # {file that a page has sent: its copy}
        self._chunks: list[tuple[str, int]] = []  # file and number of images

    @property
    def is_done(self) -> bool:
        """Whether what was there at the last look is on the disk."""
        return self._writing is None

    @property
    def has_kept(self) -> bool:
        """Whether there is anything that would be restored."""
        return bool(self._files)

    def begin(self) -> None:
        """Look for changes from now on."""
        get_event_loop().call_later(_EVERY_S, self._look_again)

    def end(self) -> None:
        """Look no more."""
        self._is_ended = True

    def _look_again(self) -> None:
        if not self._is_ended:
            try:
                self.look()
            finally:
                self.begin()

    def when_kept(self, function: Callable[[], None]) -> None:
        """Call a function in a thread once the present state is on the disk; soon if it is not kept."""
        self._when_kept.append(function)
        self._seen = None

    def look(self) -> None:
        """Write what has changed, unless something is being written."""
        if self._session is None or self._writing is not None or monotonic() < self._not_before:
            return
        parameters = self._logic.parameters
        has_patient = parameters.mri is not None or parameters.labels is not None
        if not (self._shared.now.keeps_session and has_patient):
            if self._files or self._when_kept:
                self._forget()
                self._start(self._session.clear)
            return
        page = self._page()
        pose, fit, sequence = self._pose(), self._presenter.fits.kept(), self._opener.opened_sequence
        anatomy = nodes_version(parameters)
        of_tissues = self._logic.areOfTissues()
        simulated, frozen = version_taken(parameters.image_sequence), version_frozen(parameters.output)
        is_new_fit = fit is not None and not _are_same(fit, self._fit_seen)
        is_new_sequence = sequence is not None and sequence is not self._sequence_seen
        cine = self._cine.loop, self._cine.added
        seen = (
            anatomy, tuple(self._opener.sent_files.files.items()), parameters.node.GetMTime(),
            None if pose is None else pose.tobytes(), fit is not None, sequence is not None, simulated, frozen, cine,
            repr(page), self._presenter.notes.lines, tuple(map(id, self._landmarks())), of_tissues,
        )  # fmt: skip
        if seen == self._seen and not is_new_fit and not is_new_sequence:
            return
        try:
            record = SceneRecord(record_nodes(parameters)) if anatomy != self._anatomy_seen else None
            made = record_taken(parameters.image_sequence) if simulated != self._simulated_seen else None
            image = record_frozen(parameters.output) if frozen != self._frozen_seen else None
        except SimulationError as error:
            self._tell(str(error))
            return
        labels, lesions = parameters.labels, parameters.lesions
        source, files = self._opener.known_source(labels), self._opener.lesion_files(lesions)
        state = {
            "pose": None if pose is None or labels is None else pose.tolist(),
            "values": recorded_values(parameters),
            "page": page,
            "notes": list(self._presenter.notes.lines),
            "curve": list(self._shared.now.fit.curve),
            "costs": self._shared.now.fit.costs,
            "source": None if source is None else source.to_dict(),
            "lesions": None if files is None else [list(entry) for entry in files],
            "of_tissues": list(of_tissues),  # apart from the images, which stay as they are when tissues change
            "landmarks": [mark.to_list() for mark in self._landmarks()],
        }
        is_new_loop = self._cine.loop != self._cine_seen[0]
        parts = {"sequence": sequence, "simulated": simulated, "frozen": frozen, "fit": fit}
        taken = _Taken(
            self._opener.patient(), state, record, sequence if is_new_sequence else None, made, image,
            (replace(fit[0], simulator=None), fit[1]) if fit is not None and is_new_fit else None,
            tuple(name for name, part in parts.items() if part is None),
            self._cine.since(0 if is_new_loop else self._cine_seen[1]), is_new_loop,
            dict(self._opener.sent_files.files),
        )  # fmt: skip
        self._seen, self._anatomy_seen, self._sequence_seen, self._fit_seen = seen, anatomy, sequence, fit
        self._simulated_seen, self._frozen_seen = simulated, frozen
        self._cine_seen = cine
        self._start(lambda: self._write(taken))

    def _page(self) -> dict[str, Any]:
        now = self._shared.now
        return {
            "planes": dict(now.views.planes), "blend": now.views.blend, "follow": now.views.follow,
            "show_tissues": now.views.show_tissues, "upright": now.upright,
            "comparison": now.sequence.comparison.value, "number": now.sequence.number,
        }  # fmt: skip

    # ---- in a thread -------------------------------------------------------------------------------------------

    def _start(self, work: Callable[[], None]) -> None:
        def run() -> None:
            line, then = "", list(self._when_kept)
            try:
                work()
                for function in then:
                    function()
                    self._when_kept.remove(function)
            except SimulationError as error:
                line = str(error)
            except Exception as error:
                _log.error("a mistake of the program", exc_info=error)
                line = f"{type(error).__name__}: {error}"
            self._in_loop(lambda: self._written(line))

        self._writing = threading.Thread(target=run, name="autosave", daemon=True)
        self._writing.start()

    def _written(self, line: str) -> None:
        self._writing = None
        if line:
            self._not_before = monotonic() + _AGAIN_AFTER_S
            self._forget()
            self._tell(line)

    def _tell(self, line: str) -> None:
        if not self._is_told:
            self._is_told = True
            self._told(f"this session is not kept: {line}")

    def _write(self, taken: _Taken) -> None:
        """Raises SimulationError if it does not fit, or cannot be written; nothing is kept then."""
        session = self._session
        assert session is not None
        size = self._bytes_of("anatomy") if taken.anatomy is None else taken.anatomy.size
        size += self._bytes_of("sequence") if taken.sequence is None else taken.sequence.sequence.images.nbytes
        size += (
            self._bytes_of("simulated")
            if taken.simulated is None
            else sum(image.nbytes for image in taken.simulated.images)
        )
        size += sum(path.stat().st_size for path in taken.sent.values() if path.exists())
        room = session.room()
        if size > room:
            session.clear()
            raise SimulationError(f"{taken.patient} has {size / 2**30:.1f} GB, expected at most {room / 2**30:.1f} GB")
        for part in ("anatomy", "sequence", "simulated", "frozen", "fit"):
            if getattr(taken, part) is not None:
                self._put(part, getattr(taken, part))
        # By their places: another patient may have a file of the same name
        sent = {name: self._sent.get(path) or self._copied(path) for name, path in taken.sent.items()}
        self._files["sent"] = {name: file for name, file in sent.items() if file is not None}
        for part in taken.missing:
            self._files.pop(part, None)
        if taken.is_new_loop:
            self._chunks = []
        if taken.cine:
            self._number += 1
            name = f"cine-{self._number}"
            images = [(seconds, _jpeg(image), about) for seconds, image, about in taken.cine]
            session.write(name, lambda file: write_values(file, images))
            self._chunks.append((name, len(images)))
        while self._chunks and sum(count for _, count in self._chunks[1:]) >= MOST_IMAGES:
            del self._chunks[0]
        self._files["cine"] = [name for name, _ in self._chunks]
        session.write_state(taken.patient, self._files, taken.state)

    def _bytes_of(self, part: str) -> int:
        """Bytes of a part that is on the disk."""
        assert self._session is not None
        path = self._session.folder / str(self._files.get(part, ""))
        return path.stat().st_size if path.is_file() else 0

    def _copied(self, path: Path) -> str | None:
        """The file of the session that is a copy of one that a page has sent; None if its patient was closed."""
        try:
            source = path.open("rb")
        except FileNotFoundError:
            return None
        self._number += 1
        name = f"sent-{self._number}"
        assert self._session is not None
        with source:
            self._session.write(name, lambda file: shutil.copyfileobj(source, file, 2**20))
        self._sent[path] = name
        return name

    def _put(self, part: str, values: Any) -> None:
        self._number += 1
        name = f"{part}-{self._number}"
        assert self._session is not None
        self._session.write(name, lambda file: write_values(file, values))
        self._files[part] = name


def _are_same(fit: tuple, other: Any) -> bool:
    """Whether two results of FitPresenter.kept are of the same objects."""
    return other is not None and all(one is another for one, another in zip(fit, other, strict=True))


def _jpeg(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
