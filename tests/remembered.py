"""Segmentations of the same image by the same arguments, computed once for all tests of a process.

Many tests need the tissues of some head and are about what comes after. `segment_mri` is deterministic
(test_segmentation), so a second call may take the result of the first.
"""

from __future__ import annotations

import copy
import hashlib
import logging
import pickle
from collections import OrderedDict

from SlicerUSSim.Logic import Segmentation, segment_mri

_KEPT = 12  # results
_results: OrderedDict[bytes, tuple[Segmentation, list[float], list[logging.LogRecord]]] = OrderedDict()


class _Records(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.DEBUG)
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


def segment_once(mri, *, progress=None, device=None, keep_mask_at=None, **arguments) -> Segmentation:
    """As segment_mri; the second time a copy of its result, with the same progress and the same lines of the log.

    One that was cancelled or refused, reads or writes a kept mask, or is for a certain device is none to remember.
    """
    told = progress or (lambda share: None)
    if device is not None or (keep_mask_at is not None and keep_mask_at.exists()):
        return segment_mri(mri, progress=progress, device=device, keep_mask_at=keep_mask_at, **arguments)
    level = logging.getLogger("SlicerUSSim").getEffectiveLevel()  # which lines there are to remember
    key = hashlib.sha256(pickle.dumps((mri, sorted(arguments.items()), level))).digest()
    if key in _results:
        _results.move_to_end(key)
        result, shares, records = _results[key]
        for share in shares:
            told(share)
        for record in records:
            logger = logging.getLogger(record.name)
            if logger.isEnabledFor(record.levelno):
                logger.handle(record)
        return copy.deepcopy(result)
    shares, log = [], _Records()

    def report(share: float) -> None:
        shares.append(share)
        told(share)

    logger = logging.getLogger("SlicerUSSim")
    logger.addHandler(log)
    try:
        result = segment_mri(mri, progress=report, keep_mask_at=keep_mask_at, **arguments)
    finally:
        logger.removeHandler(log)
    if keep_mask_at is None or result.brain.method in ("given", "stripped", "none"):  # of those no mask is kept
        _results[key] = copy.deepcopy(result), shares, log.records
    while len(_results) > _KEPT:
        _results.popitem(last=False)
    return result
