"""Environments for agents that learn to move a probe, with the API of Gymnasium: pip install "SlicerUSSim[gym]"."""

from contextlib import suppress
from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .find_view import FindView as FindView

lazy_exports(globals())

with suppress(ImportError):  # which FindView reports, and says what to install
    import gymnasium

    _PLACE = "SlicerUSSim.gym.find_view:FindView"
    gymnasium.register("SlicerUSSim/FindView-v0", entry_point=_PLACE, max_episode_steps=100)
