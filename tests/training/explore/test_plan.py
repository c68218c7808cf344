from __future__ import annotations

import pytest
from torchrl.objectives import LossModule

from crptpro.objectives import ExplorationDefaults, exploration_defaults, get_method
from crptpro.training import ActiveConfig
from crptpro.training.explore.plan import make_plan, resolve


def plan_of(method: str, domains: int, **settings: object):
    chosen = get_method(method)
    config = resolve(ActiveConfig(**settings), chosen.exploration, chosen.defaults)
    return make_plan(config, [2] * domains)


def test_the_papers_budgets() -> None:
    """200,000 env steps in total over a group, 500,000 in one domain, four per encoder update."""
    group, single, becl = plan_of("proto-rl-c", 3), plan_of("apt-s", 1), plan_of("becl", 3)
    assert group.agent_steps == 33_334
    assert group.env_steps == 200_004
    assert group.encoder_updates == 3 * (33_334 - 1_000) // 2
    assert single.env_steps == 500_000
    assert single.encoder_updates == (250_000 - 1_000) // 2
    assert becl.encoder_updates == 3 * 3 * (33_334 - 2_000) // 2
    assert plan_of("proto-rl-c", 3, steps_budget="per_domain").agent_steps == 100_000


@pytest.mark.parametrize("random_agent_steps", [0, 1, 7, 8])
@pytest.mark.parametrize(("interval", "each", "n_step"), [(1, 1, 1), (2, 3, 3), (5, 1, 1)])
def test_updates_are_counted_as_they_happen(
    random_agent_steps: int, interval: int, each: int, n_step: int
) -> None:
    plan = plan_of(
        "proto-rl-c",
        2,
        env_steps=80,
        random_agent_steps=random_agent_steps,
        encoder_update_interval=interval,
        encoder_updates_each=each,
        n_step=n_step,
    )
    happening = sum(plan.trains_encoder(step) for step in range(plan.agent_steps)) * each * 2
    assert plan.encoder_updates == happening
    first = min(step for step in range(plan.agent_steps) if plan.trains_agent(step))
    assert first >= max(random_agent_steps, n_step), "there must be something to learn from"


def test_domains_of_different_repeats_share_a_budget_by_turns() -> None:
    chosen = get_method("proto-rl-c")
    config = resolve(ActiveConfig(env_steps=100, random_agent_steps=1), chosen.exploration, chosen.defaults)
    plan = make_plan(config, [2, 4, 1])
    assert plan.agent_steps == 15
    assert plan.env_steps == 15 * 7
    assert [plan.env_steps_after(decisions) for decisions in range(5)] == [0, 2, 6, 7, 9]


def test_a_budget_per_domain_is_that_of_the_largest_repeat_and_all_domains_decide_equally_often() -> None:
    chosen = get_method("proto-rl-c")
    config = ActiveConfig(env_steps=100, random_agent_steps=1, steps_budget="per_domain")
    plan = make_plan(resolve(config, chosen.exploration, chosen.defaults), [2, 1])
    assert [plan.agent_steps * repeat for repeat in plan.repeats] == [100, 50]


def test_a_loss_built_by_hand_explores_like_the_method_of_its_class_and_an_unknown_one_generically() -> None:
    from active_world import make_loss

    for method in ("becl", "apt-c"):
        loss = make_loss(method)
        by_name = exploration_defaults(loss)
        assert by_name != ExplorationDefaults()
        loss.method_name = None
        assert exploration_defaults(loss) == by_name
    assert exploration_defaults(LossModule()) == ExplorationDefaults()
