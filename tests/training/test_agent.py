"""The learner that steps the optimisers of an agent."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from crptpro.errors import CompileError
from crptpro.modules import SquashedGaussianActor, TwinCritic
from crptpro.objectives import RADSACLoss
from crptpro.training import SACLearner
from crptpro.training.compile import accelerate


def test_the_target_critic_moves_by_tau_with_every_second_update() -> None:
    torch.manual_seed(0)
    loss = RADSACLoss(SquashedGaussianActor(6, 2, hidden_dim=8), TwinCritic(6, 2, hidden_dim=8))
    learner = SACLearner(loss, learning_rate=0.1, critic_tau=0.3)
    end = torch.zeros(5, 1, dtype=torch.bool)
    after = {"features": torch.randn(5, 6), "reward": torch.randn(5, 1), "done": end, "terminated": end}
    td = TensorDict({"features": torch.randn(5, 6), "action": torch.rand(5, 2), "next": after}, [5])
    before = loss.target_qvalue_network_params.data.clone()
    learner.update(td, agent_update=1)
    assert (loss.target_qvalue_network_params.data == before).all()
    learner.update(td, agent_update=2)
    moved = before.apply(lambda target, source: target + 0.3 * (source - target), loss.qvalue_network_params.data)
    for name, value in moved.items(True, True):
        torch.testing.assert_close(loss.target_qvalue_network_params.data[name], value)


@pytest.mark.parametrize(("error", "raised"), [
    (RuntimeError("no compiler"), CompileError), (ValueError("a loss returns scalars"), ValueError),
    (torch.OutOfMemoryError("full"), torch.OutOfMemoryError),
])  # fmt: skip
def test_only_what_pytorch_cannot_run_is_called_a_failed_compilation(
    monkeypatch: pytest.MonkeyPatch, error: Exception, raised: type[Exception]
) -> None:
    def update(batch: TensorDict) -> TensorDict:
        raise error

    monkeypatch.setattr(torch, "compile", lambda function, **_: function)
    with pytest.raises(raised):
        accelerate(update, compile=True)(TensorDict())
