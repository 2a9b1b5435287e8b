"""Where real data lie beside a checkout. Imports nothing of the project, for tests of what its start imports."""

from __future__ import annotations

from pathlib import Path

import pytest

#: Real sequences, if the checkout has them next to it.
SHARED = Path(__file__).parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="the real sequences of ../shared/data are not here")
