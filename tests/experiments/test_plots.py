from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from matplotlib.image import imread
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from crptpro.experiments import plots
from crptpro.experiments.plots import (
    plot_embeddings,
    plot_learning_curves,
    plot_pretraining,
    plot_stacks,
    read_columns,
)


@pytest.fixture
def pretraining(tmp_path: Path) -> Path:
    path = tmp_path / "pretrain.csv"
    path.write_text(
        "updates,loss,comp,assignment_entropy,embedding_cosine,prototypes_in_use\n"
        "20,6.5,6.4,6.2,0.9,500\n40,6.3,6.2,,0.8,510\n60,6.1,6.0,6.0,0.7,511\n"
    )
    return path


@pytest.fixture
def evaluations(tmp_path: Path) -> Path:
    path = tmp_path / "eval.csv"
    path.write_text("env_steps,episode,episode_return\n0,0,10\n0,1,20\n100,0,30\n100,1,50\n200,0,60\n")
    return path


@pytest.fixture
def axes(monkeypatch: pytest.MonkeyPatch) -> list:
    """Every axis that is drawn on, for a look at what it shows."""
    drawn: list = []
    make = plots.make_figure

    def spy(*args: object, **options: object) -> object:
        figure, grid = make(*args, **options)
        drawn.extend(grid.flat)
        return figure, grid

    monkeypatch.setattr(plots, "make_figure", spy)
    return drawn


def dataset(brightness: int) -> ReplayBuffer:
    buffer = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=4)
    pixels = torch.full((10, 9, 8, 8), brightness, dtype=torch.uint8)
    buffer.extend(TensorDict({"pixels": pixels}, [10]))
    return buffer


def test_rows_with_an_empty_or_absent_cell_are_left_out(pretraining: Path) -> None:
    assert read_columns(pretraining, "updates", "assignment_entropy") == [(20.0, 6.2), (60.0, 6.0)]
    assert read_columns(pretraining, "updates", "comp") == [(20.0, 6.4), (40.0, 6.2), (60.0, 6.0)]
    assert read_columns(pretraining, "updates", "no_such_column") == []


@pytest.mark.parametrize("draw", [
    lambda folder, out: plot_pretraining(folder / "pretrain.csv", out),
    lambda folder, out: plot_learning_curves({"a run": folder / "eval.csv"}, out, baseline=(15.0, 3.0)),
    lambda folder, out: plot_stacks({"dark": dataset(10), "bright": dataset(200)}, out, stacks=2),
    lambda folder, out: plot_embeddings({"a": torch.randn(9, 4), "b": torch.randn(9, 4) + 3}, out),
])  # fmt: skip
def test_a_figure_is_written_where_it_was_asked_for(
    draw: Callable[[Path, Path], Path], tmp_path: Path, pretraining: Path, evaluations: Path
) -> None:
    out = tmp_path / "figure.png"
    assert draw(tmp_path, out) == out
    picture = imread(out)
    assert min(picture.shape[:2]) > 150
    assert picture.std() > 0.01


def test_pretraining_panels_show_the_record_and_what_nothing_learned_looks_like(
    pretraining: Path, tmp_path: Path, axes: list
) -> None:
    plot_pretraining(pretraining, tmp_path / "figure.png", num_prototypes=512)
    assert [axis.get_xlabel() for axis in axes] == ["updates"] * 4
    curve, reference = axes[0].lines[0], axes[0].lines[-1]
    assert curve.get_xydata().tolist() == [[20, 6.4], [40, 6.2], [60, 6.0]]
    assert reference.get_ydata()[0] == pytest.approx(6.238, abs=1e-3)
    assert all("[" in axis.get_ylabel() for axis in axes[:2])


def test_a_method_without_these_columns_gets_empty_panels_and_no_error(tmp_path: Path, axes: list) -> None:
    record = tmp_path / "own.csv"
    record.write_text("updates,loss_prediction\n10,0.4\n")
    plot_pretraining(record, tmp_path / "figure.png")
    assert [len(axis.lines) for axis in axes] == [1, 1, 1, 0]  # the references alone


def test_a_learning_curve_is_the_mean_over_episodes_with_one_deviation(
    evaluations: Path, tmp_path: Path, axes: list
) -> None:
    plot_learning_curves({"a run": evaluations}, tmp_path / "figure.png", title="walker_stand")
    (axis,) = axes
    assert axis.lines[0].get_xydata().tolist() == [[0, 15], [100, 40], [200, 60]]
    band = axis.collections[0].get_paths()[0].vertices
    at_100 = band[band[:, 0] == 100][:, 1]
    assert (at_100.min(), at_100.max()) == pytest.approx((40 - 200**0.5, 40 + 200**0.5))
    assert axis.get_title() == "walker_stand"
    assert axis.get_xlabel() == "env steps"
    assert axis.get_legend().get_texts()[0].get_text() == "a run (1-2 episodes per point)"


def test_stacks_are_drawn_a_domain_a_row_oldest_picture_first(tmp_path: Path, axes: list) -> None:
    rising = ReplayBuffer(storage=LazyTensorStorage(2), batch_size=2)
    brightness = torch.tensor([10, 60, 110], dtype=torch.uint8).repeat_interleave(3)
    rising.extend(TensorDict({"pixels": brightness.view(1, 9, 1, 1).expand(2, 9, 8, 8)}, [2]))
    plot_stacks({"rising": rising}, tmp_path / "figure.png", stacks=1)
    (axis,) = axes
    strip = axis.images[0].get_array()
    assert strip.shape == (8, 24, 3)
    assert strip[0, [0, 8, 16], 0].tolist() == [10, 60, 110]
    assert axis.get_ylabel() == "rising"


def test_drawing_stacks_leaves_the_datasets_stream_alone(tmp_path: Path) -> None:
    buffer, generator = dataset(10), torch.Generator().manual_seed(5)
    buffer.set_rng(generator)
    before = generator.get_state()
    plot_stacks({"dark": buffer}, tmp_path / "figure.png", stacks=2)
    assert torch.equal(generator.get_state(), before)
    buffer.sample()
    assert not torch.equal(generator.get_state(), before)


def test_every_domain_has_its_own_colour_and_name_in_the_scatter(tmp_path: Path, axes: list) -> None:
    embeddings = {"near": torch.randn(6, 4), "far": torch.randn(5, 4) + 9}
    plot_embeddings(embeddings, tmp_path / "figure.png")
    near, far = axes[0].collections
    assert (len(near.get_offsets()), len(far.get_offsets())) == (6, 5)
    assert near.get_facecolor().tolist() != far.get_facecolor().tolist()
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["near", "far"]
    # Nine units apart, the two are told apart by the first component.
    sides = [part.get_offsets()[:, 0] for part in (near, far)]
    assert sides[0].max() < sides[1].min() or sides[1].max() < sides[0].min()
