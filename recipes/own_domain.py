"""Your own environment and your own loss: Gymnasium's HalfCheetah, and a loss defined in this file.

    python recipes/own_domain.py                  # about five minutes on two CPU cores

The library knows neither: a Gymnasium id names the environment, and `NextLatentLoss` is a plain TorchRL LossModule. It
satisfies the contract of a pre-training loss: it takes an encoder, reads `pixels` and ("next", "pixels"), and returns
`loss_*` terms. Collection, pre-training, the artifact and the downstream stage therefore work unchanged. Without
prototypes there is no exploration bonus, as the log of the downstream stage says.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import nn
from torchrl.objectives import LossModule

from crptpro.console import parse, run_main
from crptpro.data import collect_random
from crptpro.modules import PixelEncoder, Predictor, Projector
from crptpro.objectives import register_method
from crptpro.pretrained import save_pretrained
from crptpro.seeding import seed_everything
from crptpro.training import DownstreamConfig, PretrainConfig, pretrain, train_downstream


class NextLatentLoss(LossModule):
    """Predict the target network's next latent from the present one (BYOL over one time step, arXiv 2006.07733)."""

    in_keys = ("pixels", ("next", "pixels"))
    out_keys = ("loss_prediction", "embedding_cosine")
    encoder_network: nn.Module
    encoder_network_params: TensorDictParams
    target_encoder_network_params: TensorDictParams

    def __init__(self, encoder: PixelEncoder) -> None:
        super().__init__()
        projector = Projector(encoder.feature_dim, 128)
        # The training loop updates the target parameters.
        self.convert_to_functional(nn.Sequential(encoder, projector), "encoder_network", create_target_params=True)
        self.predictor = Predictor(128, 256)
        self.__dict__.update(encoder=encoder, projector=projector)  # save_pretrained stores these

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return ``loss_prediction``, 2 - 2 cos, and the mean pairwise cosine, 1 if everything collapsed."""
        with self.encoder_network_params.to_module(self.encoder_network, preserve_module_state=False):
            latent = self.encoder_network(tensordict["pixels"])
        with (
            torch.no_grad(),
            self.target_encoder_network_params.to_module(self.encoder_network, preserve_module_state=False),
        ):
            target = self.encoder_network(tensordict["next", "pixels"])
        prediction = F.normalize(self.predictor(latent), dim=-1)
        loss = (2 - 2 * (prediction * F.normalize(target, dim=-1)).sum(-1)).mean()
        cosine = F.normalize(latent.detach(), dim=-1).mean(0).square().sum()
        return TensorDict({"loss_prediction": loss, "embedding_cosine": cosine}, batch_size=[])


register_method("next-latent", NextLatentLoss, updates=300, batch_size=128, learning_rate=3e-4, encoder_tau=0.05)


@dataclass
class Config:
    """A small run; increase the numbers for a real one."""

    task: str = "gymnasium:HalfCheetah-v5"
    """any Gymnasium id that renders RGB and has continuous actions"""
    out: Path = Path("runs/own_domain")
    """everything is written below this directory"""
    seed: int = 0
    """seeds every stage"""
    transitions: int = 1_000
    """random transitions"""
    workers: int = 2
    """collecting processes"""
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    """pre-training (default: as registered above)"""
    downstream: DownstreamConfig = field(
        default_factory=lambda: DownstreamConfig(
            env_steps=4_000,
            batch_size=128,
            learning_rate=1e-3,
            replay_capacity=5_000,
            random_agent_steps=500,
            eval_interval_env_steps=2_000,
            eval_episodes=2,
        )
    )
    """SAC on the frozen encoder"""


def main(config: Config) -> None:
    """Collect, pre-train, learn."""
    seed, out = config.seed, config.out
    dataset = collect_random(
        config.task, out / "data", transitions=config.transitions, seed=seed, workers=config.workers
    )
    seed_everything(seed)
    loss = NextLatentLoss(PixelEncoder())
    result = pretrain(loss, dataset, run_dir=out / "pretrain", config=replace(config.pretrain, seed=seed))
    encoder = save_pretrained(result, out / "encoder")
    train_downstream(config.task, encoder, run_dir=out / "downstream", config=replace(config.downstream, seed=seed))


if __name__ == "__main__":
    run_main(lambda: main(parse(Config, __doc__)))
