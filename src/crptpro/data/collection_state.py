"""What a directory is being filled with: the request, the layout and the sessions, kept beside the frames."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from crptpro.cards import read_json, versions, write_json
from crptpro.data.layout import COLLECTION_FILE, FORMAT, VERSION, Layout
from crptpro.errors import DatasetError

logger = logging.getLogger(__name__)

#: What requests of earlier releases do not name, with what was the case then.
_CAME_LATER = {"colors": "normal"}

_TEMPORARY = f".{COLLECTION_FILE}."


class CollectionState:
    """The content of ``collection.json``.

    As long as no episode has been accepted the directory holds nothing but this file, and another request
    takes its place: a request that was refused or failed never blocks the corrected one.

    Args:
        path: The dataset's directory.
        request: What is asked for.

    Attributes:
        layout: Shapes of the rows, ``None`` until an episode has been accepted.
        sessions: Package versions and what rendered, of each process that collected here.
    """

    def __init__(self, path: Path, request: dict[str, Any]):
        self.path, self.request = path, request
        self.layout: Layout | None = None
        self.sessions: list[dict[str, Any]] = []
        self._is_noted = False

    def resume(self) -> None:
        """Read what is there, or begin; the caller holds the directory's lock.

        Raises:
            DatasetError: if episodes were collected for another request, or by another release.
        """
        for stale in self.path.glob(f"{_TEMPORARY}*"):  # of a process that was killed: it had the lock
            stale.unlink(missing_ok=True)
        if not (self.path / COLLECTION_FILE).exists():
            self.save()
            return
        state = read_json(self.path / COLLECTION_FILE, error=DatasetError)
        if (state.get("format"), state.get("version")) != (FORMAT, VERSION):
            raise DatasetError(
                f"{self.path / COLLECTION_FILE} belongs to another release or program. Choose another directory."
            )
        if state.get("layout") is None:
            self.save()
            return
        require_request(self.path, state.get("request", {}), self.request, "was begun")
        self.layout, self.sessions = Layout.from_dict(state["layout"]), state.get("sessions", [])

    def note_layout(self, layout: Layout) -> None:
        """Keep the shapes of the first episode; from now on the request is fixed."""
        self.layout = layout
        self.save()

    def note_environment(self, card: dict[str, Any]) -> None:
        """Note what renders the frames.

        Args:
            card: The environment's; ``backend`` and ``gl_renderer`` are compared where it has them.

        Raises:
            DatasetError: if earlier episodes were rendered by another backend or renderer.
        """
        for session in self.sessions:
            for name, label in (("backend", "render backend"), ("gl_renderer", "GL renderer")):
                before = session["render"].get(name)
                if before is not None and card.get(name, before) != before:
                    raise DatasetError(
                        f"{self.path} was begun with the {label} {before!r}, now it is {card[name]!r}: their "
                        f"pixels differ. {_continue_with(session['render'], name)}, or remove the directory to "
                        "begin anew."
                    )
        if self._is_noted:
            return
        self._is_noted = True
        if self.sessions and self.sessions[-1]["versions"] != versions():
            logger.warning("%s is continued with other package versions; its card lists both.", self.path)
        self.sessions.append({"versions": versions(), "render": card})
        self.save()

    def save(self) -> None:
        """Write the file, whole or not at all."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "request": self.request,
            "layout": self.layout.to_dict() if self.layout else None,
            "sessions": self.sessions,
        }
        write_json(self.path / COLLECTION_FILE, content)


def require_free(path: Path) -> None:
    """Make sure that a directory is missing, empty, or a collection; what a kill at its very start left is none.

    Raises:
        DatasetError: if it holds something else.
    """
    if not path.exists() or (path / COLLECTION_FILE).exists():
        return
    if any(item.name != ".lock" and not item.name.startswith(_TEMPORARY) for item in path.iterdir()):
        raise DatasetError(f"{path} is not empty and not a collection. Choose another directory or empty it.")


def require_request(path: Path, found: dict[str, Any], request: dict[str, Any], what: str) -> None:
    """Compare the request that a directory was filled for with the one that is made now.

    Raises:
        DatasetError: naming every setting that differs.
    """
    found = {**_CAME_LATER, **found}
    differing = [
        f"{name} {found.get(name)!r} there, {value!r} asked for"
        for name, value in request.items()
        if found.get(name) != value
    ]
    if differing:
        raise DatasetError(
            f"{path} {what} with other settings: {'; '.join(differing)}. "
            "Ask for the same, choose another directory, or remove this one to collect anew."
        )


def _continue_with(render: dict[str, Any], name: str) -> str:
    if name == "backend":
        return f"Continue with MUJOCO_GL={render[name]}"
    return f"Continue on a machine where {render.get('backend', 'GL')} is this renderer"
