from __future__ import annotations

import numpy as np
import pytest

from crptpro.experiments.bootstrap import COVERAGE, encoder_indices, run_indices


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_runs_are_drawn_uniformly_within_their_task() -> None:
    drawn = run_indices([3, 5], replicates=4000, rng=rng())
    assert [d.shape for d in drawn] == [(4000, 3), (4000, 5)]
    for indices, count in zip(drawn, (3, 5)):
        frequencies = np.bincount(indices.ravel(), minlength=count) / indices.size
        np.testing.assert_allclose(frequencies, 1 / count, atol=0.02)


def test_tasks_that_share_encoders_are_given_the_same_ones() -> None:
    encoders = [["a", "b", "c"], ["c", "a", "b"]]
    first, second = encoder_indices(encoders, replicates=500, rng=rng())
    names = np.array(encoders)
    counts = [[sorted(task[row].tolist()) for row in drawn] for task, drawn in zip(names, (first, second))]
    assert counts[0] == counts[1]
    assert len({tuple(c) for c in counts[0]}) == 10  # three encoders have ten different resamples


def test_tasks_without_a_common_encoder_are_drawn_independently() -> None:
    encoders = [["a", "b"], ["a", "b"], ["c", "d"]]
    first, second, third = encoder_indices(encoders, replicates=4000, rng=rng())
    assert (first == second).all()
    assert np.mean((first == third).all(axis=1)) == pytest.approx(1 / 4, abs=0.04)


def test_tasks_are_tied_together_through_a_third() -> None:
    # The first and the last share no encoder, but each shares one with the task between.
    encoders = [["a", "b"], ["b", "c"], ["c", "d"]]
    first, _, last = encoder_indices(encoders, replicates=200, rng=rng())
    assert (first == last).all()


def test_runs_of_a_drawn_encoder_are_redrawn_among_its_own() -> None:
    encoders = ["a", "a", "a", "b", "b", "b"]
    (drawn,) = encoder_indices([encoders], replicates=3000, rng=rng())
    names = np.array(encoders)[drawn]
    # Places one to three hold one encoder, four to six one, each a or b.
    assert (names[:, :3] == names[:, :1]).all()
    assert (names[:, 3:] == names[:, 3:4]).all()
    np.testing.assert_allclose(np.bincount(drawn.ravel()) / drawn.size, 1 / 6, atol=0.02)


def test_an_encoder_with_fewer_runs_is_drawn_as_often_as_another() -> None:
    (drawn,) = encoder_indices([["a", "a", "a", "b"]], replicates=6000, rng=rng())
    of_b = (drawn == 3).mean(axis=0)
    np.testing.assert_allclose(of_b, 0.5, atol=0.03)


def test_a_task_that_lacks_an_encoder_is_resampled_from_those_it_has() -> None:
    full, partial = encoder_indices([["a", "b", "c"], ["a", "c"]], replicates=500, rng=rng())
    assert full.max() == 2
    assert set(np.unique(partial)) == {0, 1}


def test_one_run_per_encoder_on_one_task_is_the_plain_bootstrap() -> None:
    scores = np.array([0.0, 1.0, 5.0, 9.0])
    (by_encoder,) = encoder_indices([list("abcd")], replicates=20_000, rng=rng())
    (by_run,) = run_indices([4], replicates=20_000, rng=rng())
    places = [5, 25, 50, 75, 95]
    one, other = (np.percentile(scores[i].mean(axis=1), places) for i in (by_encoder, by_run))
    np.testing.assert_allclose(one, other, atol=0.26)  # means come in steps of a quarter


def test_rows_of_the_same_runs_are_redrawn_alike() -> None:
    encoders, names = [["a", "a", "b"], ["a", "a", "b"], ["a", "a", "b"]], ["rst", "rst", "uvw"]
    first, again, other = encoder_indices(encoders, runs=names, replicates=500, rng=np.random.default_rng(0))
    assert (first == again).all()
    assert (first != other).any()  # other runs of the same encoders
    assert ((first == 2) == (other == 2)).all()


@pytest.mark.parametrize("count", COVERAGE)
def test_intervals_of_few_runs_hold_the_truth_as_seldom_as_the_report_says(count: int) -> None:
    generator = rng()
    samples = generator.normal(size=(6_000, count))
    drawn = generator.integers(0, count, size=(400, 6_000, count))
    means = np.take_along_axis(samples[None], drawn, axis=-1).mean(axis=-1)
    low, high = np.percentile(means, [2.5, 97.5], axis=0)
    assert np.mean((low <= 0) & (high >= 0)) == pytest.approx(COVERAGE[count], abs=0.02)
