"""The part of the page about sessions: the offer of the last one, and whether this one is kept."""

from __future__ import annotations

from trame.widgets import html, vuetify3 as v3

from SlicerUSSim.Workstation.state import NAMES

_KEEP_TIP = (
    "Patient, tissues, probe and settings are kept on the computer of the server, for its user alone, and are there "
    "after a crash; off: nothing is kept, and what was is removed"
)


def session_offer() -> None:
    """A bar with the question whether the last session is to be restored, and for session.js what it needs."""
    html.Span(hidden=True, id="proof-key", raw_attrs=[f':data-key="{NAMES.proof_key}"'])
    is_busy = f"{NAMES.messages.progress_title} !== ''"
    with html.Div(
        v_if=NAMES.offer, classes="ussim-bar ussim-offer", id="session-offer", raw_attrs=['role="status"']
    ):  # fmt: skip
        html.Span(f"{{{{ {NAMES.offer} }}}}", id="session-offer-text")
        v3.VBtn(
            "Restore", size="small", color="primary", click="trigger('restore_session')", id="restore-session",
            disabled=(is_busy,), title="It takes the place of the patient that is open now",
        )  # fmt: skip
        v3.VBtn(
            "Discard", size="small", variant="outlined", click="trigger('discard_session')", id="discard-session",
            disabled=(is_busy,), title="Remove it from the disk",
        )  # fmt: skip


def keep_session() -> None:
    """A tick box: whether this session is kept."""
    with html.Div(title=_KEEP_TIP):
        v3.VCheckbox(
            label="Keep this session for a crash (autosave)", v_model=(NAMES.keeps_session,), density="compact",
            hide_details=True, id="keeps-session", disabled=(f"!{NAMES.can_keep_session}",),
        )  # fmt: skip
