"""fingerprint: a hash that is equal only for equal values."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import numpy as np


def fingerprint(value: object) -> str:
    """SHA-256 of plain values, arrays, dataclasses (fields that are compared), and sequences and mappings of these.

    Types and shapes of arrays and lengths of sequences are included, so that different values with the same bytes have
    different hashes. Raises TypeError for other values.
    """
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()


def _feed(digest, value: object) -> None:
    if value is None or isinstance(value, str):
        _feed_bytes(digest, type(value).__name__, repr(value).encode())
    elif isinstance(value, bool | int | float | np.generic):
        whole = float(value).is_integer()  # 1 equals 1.0, but 2**53 does not equal 2**53 + 1
        _feed_bytes(digest, "number", repr(int(value) if whole else float(value)).encode())
    elif isinstance(value, np.ndarray) and not value.dtype.hasobject:
        _feed_bytes(digest, f"array {value.dtype.str} {value.shape}", np.ascontiguousarray(value).data)
    elif isinstance(value, Mapping):
        _feed(digest, [*value.items()])
    elif isinstance(value, list | tuple):
        _feed_bytes(digest, f"sequence of {len(value)}", b"")
        for item in value:
            _feed(digest, item)
    elif is_dataclass(value):
        compared = {field.name: getattr(value, field.name) for field in fields(value) if field.compare}
        _feed(digest, [type(value).__name__, compared])
    else:
        raise TypeError(f"no fingerprint of a {type(value).__name__}")


def _feed_bytes(digest, kind: str, content) -> None:
    digest.update(f"{kind}, {memoryview(content).nbytes} bytes:".encode())
    digest.update(content)
