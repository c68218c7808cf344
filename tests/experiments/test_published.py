from __future__ import annotations

import numpy as np
import pytest

from crptpro.domains import GROUPS, TASKS
from crptpro.experiments import published as paper
from crptpro.experiments.matrix import VARIANTS
from crptpro.objectives import method_names


@pytest.mark.parametrize(("place", "printed"), [
    (("crptpro", "A", "cheetah_run"), "611 ± 44"),
    (("becl", "B", "cartpole_swingup_sparse"), "529 ± 397"),
    (("drq", "A", "hopper_hop"), "283 ± 32"),  # its task's, whatever the group
    (("apt-c", "C", "pendulum_swingup"), "778 ± 106"),
    (("proto-rl-c", "C", "reach_duplo", "reversed_background"), "55 ± 52"),
    (("crptpro", "A", "walker_run", "reversed_background"), "None"),
    (("proto-rl-s", "A", "walker_run"), "None"),
])  # fmt: skip
def test_published_scores_are_found_by_their_place(place: tuple, printed: str) -> None:
    assert str(paper.published_score(*place)) == printed


def test_the_printed_means_and_claims_follow_from_the_printed_cells() -> None:
    for method in paper.METHODS:
        scores = [row.scores[method].mean for row in paper.SEEN]
        assert np.mean(scores) == pytest.approx(paper.SEEN_MEAN[method], abs=0.5)
        normalized = np.mean([score / paper.EXPERT_SCORES[row.task] for score, row in zip(scores, paper.SEEN)])
        # Rounded cells move the mean by a few thousandths at most, but for APT's, which its cells do not give.
        expected = 0.4195 if method == "apt-c" else paper.SEEN_NORMALIZED_MEAN[method]
        assert normalized == pytest.approx(expected, abs=2e-3)
    ratios = [means["crptpro"] / means["proto-rl-c"] for means in (paper.SEEN_MEAN, paper.SEEN_NORMALIZED_MEAN)]
    assert ratios == pytest.approx([1.238, 1.785], abs=5e-4)
    assert sum(row.scores["crptpro"].mean > row.scores["proto-rl-c"].mean for row in paper.SEEN) == 11
    assert paper.EFFICIENCY["crptpro"].hours[2] / paper.EFFICIENCY["proto-rl-c"].hours[2] == pytest.approx(
        0.545, abs=5e-4
    )
    assert 50_000 + sum(paper.FINETUNE_UPDATES.values()) == 58_500
    for spread, without in (
        ("crptpro", "crptpro without dispersion"),
        ("proto-rl-c with dispersion", "proto-rl-c"),
        ("proto-rl-s with dispersion", "proto-rl-s"),
    ):
        assert all(a < b for a, b in zip(paper.PROTOTYPE_METRICS[spread], paper.PROTOTYPE_METRICS[without]))


def test_rows_are_the_papers_groups_and_methods() -> None:
    assert [(row.group, TASKS[row.task]) for row in paper.SEEN] == [(g, d) for g in GROUPS for d in GROUPS[g]]
    for group in ("A", "C"):
        elsewhere = {row.task for row in paper.UNSEEN if row.group == group}
        assert elsewhere == {task for task, domain in TASKS.items() if domain not in GROUPS[group]}
    assert all(tuple(row.scores) == paper.METHODS for row in (*paper.UNSEEN, *paper.COLORS))
    assert {*paper.METHODS, *paper.EFFICIENCY} <= set(method_names())
    assert set(paper.PROTOTYPE_METRICS) <= {label for variants in VARIANTS.values() for label, _ in variants}
