"""The card of a dataset: what its frames are, checked before they are used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from crptpro.cards import read_json
from crptpro.data.episode_writer import read_journal
from crptpro.data.frame_stacks import size_problem
from crptpro.data.layout import CARD_FILE, COLLECTION_FILE, FORMAT, JOURNAL_FILE, PIXELS, VERSION, Layout
from crptpro.errors import DatasetError

_COUNTS = ("transitions", "frames", "episodes", "frame_stack", "action_repeat", "seed")


def read_card(path: str | Path) -> dict[str, Any]:
    """Read and check a dataset's card against its files, without reading the frames.

    Raises:
        DatasetError: naming what is missing, unfinished, truncated or foreign.
    """
    path = Path(path)
    if not path.is_dir():
        raise DatasetError(
            f"{path} is not a directory. A dataset is made by collect_random or `crptpro collect`."
        )
    if not (path / CARD_FILE).exists():
        raise DatasetError(_why_no_card(path))
    card = read_json(path / CARD_FILE, error=DatasetError)
    if card.get("format") != FORMAT:
        raise DatasetError(
            f"{path / CARD_FILE} is not the card of a frame dataset: its format is {card.get('format')!r}, "
            f"expected {FORMAT!r}."
        )
    if card.get("version") != VERSION:
        raise DatasetError(
            f"{path} has format version {card.get('version')}, this release reads version {VERSION}. "
            "Use the release that wrote it, or collect the dataset again."
        )
    missing = [name for name in (*_COUNTS, "layout", "domain", "task", "quality") if name not in card]
    wrong = [name for name in _COUNTS if not isinstance(card.get(name, 0), int)]
    try:
        layout = Layout.from_dict(card.get("layout", {}))
    except (KeyError, TypeError, ValueError, AttributeError):
        wrong.append("layout")
    if missing or wrong:
        raise DatasetError(
            f"{path / CARD_FILE} is damaged: {', '.join(missing + wrong)} missing or unusable."
        )
    if (pixels := card.get("pixels", PIXELS)) != PIXELS:  # cards of the first releases say nothing: the same
        raise DatasetError(
            f"The pixels of {path} are {pixels!r}, this release reads {PIXELS!r}. Collect the dataset again."
        )
    if card["frames"] != card["transitions"] + card["episodes"] or card["transitions"] < 1:
        raise DatasetError(
            f"{path / CARD_FILE} is damaged: {card['frames']} frames do not fit {card['transitions']} "
            f"transitions in {card['episodes']} episodes, which have one frame more than transitions each."
        )
    for file, expected in layout.sizes(card["transitions"], card["frames"]).items():
        file_path = path / file
        if not file_path.is_file():
            raise DatasetError(f"{file_path} is missing. Collect the dataset again.")
        if (size := file_path.stat().st_size) != expected:
            raise DatasetError(size_problem(file_path, size, expected))
    return card


def _why_no_card(path: Path) -> str:
    collection = path / COLLECTION_FILE
    if not collection.exists():
        kinds = sorted(child.parent.name for child in path.glob(f"*/{CARD_FILE}"))
        hint = f" Did you mean one of its datasets: {', '.join(kinds)}?" if kinds else ""
        return f"{path} has no {CARD_FILE}: it is not a dataset.{hint}"
    wanted = read_json(collection, error=DatasetError).get("request", {}).get("transitions", "?")
    done = sum(entry.transitions for entry in read_journal(path / JOURNAL_FILE))
    return (
        f"{path} is unfinished: {done} of {wanted} transitions are collected. "
        "Run the same collect command again to complete it."
    )
