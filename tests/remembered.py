"""Segmentations of the same image by the same arguments, computed once for all tests of a process.

Many tests need the tissues of some head and are about what comes after. `segment_mri` is deterministic, so a second
call may take the result of the first.
"""

from __future__ import annotations

import copy
import hashlib
import inspect
import logging
import pickle
from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from SlicerUSSim.Logic import Segmentation

_KEPT = 12  # results
_LOGGER = "SlicerUSSim"


class _Records(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.DEBUG)
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


def once(segment: Callable[..., Segmentation]) -> Callable[..., Segmentation]:
    """`segment`, which is segment_mri: the second time with a copy of its result, the same progress and the same log.

    One that was cancelled or refused, reads or writes a kept mask, or is for a certain device is not remembered.
    """
    results: OrderedDict[bytes, tuple[Segmentation, list[float], list[logging.LogRecord]]] = OrderedDict()

    def segment_once(mri, settings=None, *, progress=None, device=None, keep_mask_at=None, **arguments):
        told = progress or (lambda share: None)
        if device is not None or (keep_mask_at is not None and keep_mask_at.exists()):
            return segment(mri, settings, progress=progress, device=device, keep_mask_at=keep_mask_at, **arguments)
        level = logging.getLogger(_LOGGER).getEffectiveLevel()  # which lines there are to remember
        given = inspect.signature(segment).bind(mri, settings, **arguments)
        given.apply_defaults()
        key = hashlib.sha256(pickle.dumps((sorted(given.arguments.items()), level))).digest()
        if key in results:
            results.move_to_end(key)
            result, shares, records = results[key]
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

        logger = logging.getLogger(_LOGGER)
        logger.addHandler(log)
        try:
            result = segment(mri, settings, progress=report, keep_mask_at=keep_mask_at, **arguments)
        finally:
            logger.removeHandler(log)
        if keep_mask_at is None or result.brain.method in ("given", "stripped", "none"):  # of those no mask is kept
            results[key] = copy.deepcopy(result), shares, log.records
            while len(results) > _KEPT:
                results.popitem(last=False)
        return result

    return segment_once


@cache
def _shared() -> Callable[..., Segmentation]:
    from SlicerUSSim.Logic import segment_mri  # not before: tests of the module import nothing of the package

    return once(segment_mri)


def segment_once(mri, settings=None, **options) -> Segmentation:
    """segment_mri, as tests that are not about segmentation call it."""
    return _shared()(mri, settings, **options)
