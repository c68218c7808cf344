"""Where pieces lie on disk, and which of them are there."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from crptpro.artifact import WEIGHTS_FILE
from crptpro.cards import read_json, write_json
from crptpro.data.layout import PIXELS_FILE
from crptpro.errors import RecordError
from crptpro.experiments.measurements import RedrawnPiece
from crptpro.experiments.pieces import (
    DatasetPiece,
    EncoderPiece,
    ExploredPiece,
    Piece,
    PretrainedPiece,
    piece_from_json,
)
from crptpro.training.explore.replays import DIRECTORY as REPLAYS

PIECES, DESCRIPTION, CLOCK, DONE, LOG = "pieces", "piece.json", "clock.json", "done.json", "log.txt"


@dataclass(frozen=True)
class Store:
    """The directory in which pieces are kept and found again.

    Args:
        root: pieces lie below ``root/pieces``.
    """

    root: Path

    def path(self, piece: Piece) -> Path:
        """Directory of a piece, made or not."""
        return self.root / PIECES / piece.key

    def log(self, piece: Piece) -> Path:
        """What the jobs that made a piece said."""
        return self.path(piece) / LOG

    def is_recorded(self, piece: Piece) -> bool:
        """Whether a piece has been finished; what it was made for may have been removed since, its records stay."""
        return (self.path(piece) / DONE).is_file()

    def is_done(self, piece: Piece, *, for_piece: Piece | None = None) -> bool:
        """Whether a piece is finished and what others read of it is there, or what a certain other piece reads."""
        if for_piece is not None and for_piece.reads_replays and isinstance(piece, ExploredPiece):
            domains = [self.path(piece) / REPLAYS / domain for domain in piece.domains]
            if not all(directory.is_dir() for directory in domains):
                return False
        return self.is_recorded(piece) and all(path.is_file() for path in self.outputs(piece))

    def outputs(self, piece: Piece) -> list[Path]:
        """Files that others read of a piece besides its records: gigabytes that may be removed when they have."""
        # Not the directories: cards lie in them, which belong to the records.
        file = PIXELS_FILE if isinstance(piece, DatasetPiece) else WEIGHTS_FILE
        return [directory / file for directory in self._output_directories(piece)]

    def forget(self, piece: Piece) -> None:
        """Remove the mark that a piece is finished, and what is left of its outputs."""
        (self.path(piece) / DONE).unlink(missing_ok=True)
        for directory in self._output_directories(piece):
            shutil.rmtree(directory, ignore_errors=True)

    def _output_directories(self, piece: Piece) -> list[Path]:
        if isinstance(piece, DatasetPiece):
            return [self.dataset(piece)]
        if isinstance(piece, RedrawnPiece):
            return [self.redrawn(piece)]
        if not isinstance(piece, EncoderPiece):
            return []
        snapshots = piece.snapshots if isinstance(piece, PretrainedPiece) else ()
        return [self.encoder(piece, at_updates) for at_updates in (None, *snapshots)]

    def seconds(self, piece: Piece) -> float:
        """Wall clock of all attempts at a finished piece."""
        return float(read_json(self.path(piece) / DONE, error=RecordError)["seconds"])

    def dataset(self, piece: DatasetPiece) -> Path:
        """Directory of a dataset."""
        from crptpro.data.incoming import dataset_path

        return dataset_path(self.path(piece), piece.domain)

    def redrawn(self, piece: RedrawnPiece) -> Path:
        """Directory of the pictures of a dataset in other colours."""
        return self.path(piece) / "frames"

    def encoder(self, piece: EncoderPiece, at_updates: int | None = None) -> Path:
        """Directory of an encoder's artifact, or of one of its snapshots."""
        from crptpro.pretrained import snapshot_path

        if at_updates is None:
            return self.path(piece) / "encoder"
        return snapshot_path(self.path(piece), at_updates)

    def describe(self, piece: Piece) -> Path:
        """Write a piece's description into its directory, where a job finds it."""
        path = self.path(piece) / DESCRIPTION
        if not path.exists():
            write_json(path, piece.to_json())
        return path

    def described(self, key: str) -> Piece:
        """Read a piece by its key.

        Raises:
            RecordError: if there is none.
        """
        return piece_from_json(read_json(self.root / PIECES / key / DESCRIPTION, error=RecordError))
