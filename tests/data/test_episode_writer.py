from __future__ import annotations

import errno
import os
import zlib

import numpy as np
import pytest
from toy_world import data_bytes, random_episode

from crptpro.data import EpisodeWriter, Layout
from crptpro.data.episode_writer import read_journal
from crptpro.data.layout import CARD_FILE, JOURNAL_FILE
from crptpro.errors import DatasetError, DiskSpaceError

EPISODES = [random_episode(length, seed=length) for length in (3, 1, 5)]
LAYOUT = EPISODES[0].layout


def write(path, episodes=EPISODES):
    with EpisodeWriter(path, LAYOUT) as writer:
        for episode in episodes:
            writer.append(episode)
    return data_bytes(path)


def test_rows_are_one_per_frame_and_one_per_transition(tmp_path):
    content = write(tmp_path)
    sizes = {name: len(value) for name, value in content.items()}
    assert sizes == LAYOUT.sizes(transitions=9, frames=12)
    assert content["frames/pixels.memmap"] == b"".join(episode.pixels.tobytes() for episode in EPISODES)
    row = np.frombuffer(content["transitions/row.memmap"], np.int64)
    assert row.tolist() == [0, 1, 2, 4, 6, 7, 8, 9, 10]  # transition i, plus one row per earlier episode


def test_journal_covers_every_appended_byte(tmp_path):
    write(tmp_path, EPISODES[:1])
    columns = LAYOUT.columns()
    checksum = 0
    for column in columns:
        checksum = zlib.crc32((tmp_path / column.file).read_bytes(), checksum)
    assert [entry.crc32 for entry in read_journal(tmp_path / JOURNAL_FILE)] == [checksum]


@pytest.mark.parametrize("torn", [1, 7])
def test_reopening_drops_what_a_kill_left_half_written(tmp_path, torn):
    expected = write(tmp_path / "whole")
    write(tmp_path / "torn", EPISODES[:2])
    for column in LAYOUT.columns()[:torn]:
        with open(tmp_path / "torn" / column.file, "ab") as file:
            file.write(b"x" * 17)
    with open(tmp_path / "torn" / JOURNAL_FILE, "ab") as file:
        file.write(b'{"episode": 2, "transi')
    with EpisodeWriter(tmp_path / "torn", LAYOUT) as writer:
        assert (writer.episodes, writer.transitions, writer.frames) == (2, 4, 6)
        writer.append(EPISODES[2])
    assert data_bytes(tmp_path / "torn") == expected


def test_reopening_collects_a_damaged_last_episode_again(tmp_path):
    expected = write(tmp_path)
    pixels = tmp_path / "frames/pixels.memmap"
    content = bytearray(pixels.read_bytes())
    content[-1] ^= 255
    pixels.write_bytes(content)
    with EpisodeWriter(tmp_path, LAYOUT) as writer:
        assert writer.episodes == 2
        writer.append(EPISODES[2])
    assert data_bytes(tmp_path) == expected


def test_full_disk_keeps_the_finished_episodes_and_says_so(tmp_path, monkeypatch):
    before = write(tmp_path, EPISODES[:2])
    real_write, calls = os.write, []

    def full(file, content):
        calls.append(file)
        if len(calls) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real_write(file, content)

    with EpisodeWriter(tmp_path, LAYOUT) as writer:
        monkeypatch.setattr(os, "write", full)
        with pytest.raises(DiskSpaceError, match="4 transitions \\(2 whole episodes\\), which are kept"):
            writer.append(EPISODES[2])
        assert data_bytes(tmp_path) == before
        monkeypatch.undo()
        writer.append(EPISODES[2])
        assert writer.transitions == 9


def test_an_episode_of_other_shapes_is_refused(tmp_path):
    with EpisodeWriter(tmp_path, LAYOUT) as writer, pytest.raises(DatasetError, match="'action_dim': 5"):
        writer.append(random_episode(2, action_dim=5))


def test_cutting_marks_the_last_transition_truncated():
    cut = EPISODES[2].cut(2)
    assert (len(cut), len(cut.pixels), cut.is_cut) == (2, 3, True)
    assert cut.truncated.tolist() == [False, True]
    assert EPISODES[2].truncated.tolist() == [False, False, False, False, True]
    assert EPISODES[2].cut(5) is EPISODES[2]
    with pytest.raises(ValueError, match="at least one transition"):
        EPISODES[2].cut(0)


def test_a_paper_dataset_fits_the_budget():
    layout = Layout(image_size=84, action_dim=12, state={"qpos": 40, "qvel": 40})
    assert layout.bytes(transitions=100_000, frames=100_200) <= 2.2e9


@pytest.mark.parametrize("other", [
    Layout(image_size=6, action_dim=3, state={"qpos": 4, "qvel": 3}),
    Layout(image_size=7, action_dim=2, state={"qpos": 4, "qvel": 3}),
    Layout(image_size=6, action_dim=2, state={"sensors": 7}),
    Layout(image_size=6, action_dim=2),
])  # fmt: skip
def test_a_dataset_opened_with_another_layout_is_refused_and_left_as_it_is(tmp_path, other):
    write(tmp_path)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    with pytest.raises(DatasetError, match=r"does not hold the rows of .*other shapes"):
        EpisodeWriter(tmp_path, other)
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


def test_a_finished_dataset_is_not_opened_for_writing(tmp_path):
    before = write(tmp_path)
    (tmp_path / CARD_FILE).write_text("{}")
    with pytest.raises(DatasetError, match="holds a finished dataset"):
        EpisodeWriter(tmp_path, LAYOUT)
    assert data_bytes(tmp_path) == before


def test_a_rewritten_journal_is_on_the_disk_before_it_takes_the_old_ones_place(tmp_path, monkeypatch):
    write(tmp_path)
    with open(tmp_path / JOURNAL_FILE, "ab") as file:
        file.write(b"torn")
    events = []
    real_fsync, real_replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (events.append("synced"), real_fsync(file)))
    monkeypatch.setattr(os, "replace", lambda *paths: (events.append("replaced"), real_replace(*paths)))
    EpisodeWriter(tmp_path, LAYOUT).close()
    assert events == ["synced", "replaced"]
    assert len(read_journal(tmp_path / JOURNAL_FILE)) == 3
