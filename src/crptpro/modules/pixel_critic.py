"""A critic that reads images: the encoder and the twin heads on it, as one network."""

from __future__ import annotations

from torch import Tensor, nn

from crptpro.modules.actor_critic import TwinCritic
from crptpro.modules.encoder import PixelEncoder


class PixelCritic(nn.Module):
    """Twin Q-functions of pixels; a target network is a copy of all of it, convolutions included.

    Whoever acts may read the same encoder: that ties the convolutions, as in denisyarats/drq ``drq.py``.

    Args:
        encoder: images to features.
        head: features and actions to two values.

    Raises:
        ValueError: the head was built for features of another length.
    """

    def __init__(self, encoder: PixelEncoder, head: TwinCritic) -> None:
        super().__init__()
        if head.config["feature_dim"] != encoder.feature_dim:
            raise ValueError(
                f"The critic's head was built for {head.config['feature_dim']} features, the encoder gives "
                f"{encoder.feature_dim}; build it with feature_dim={encoder.feature_dim}."
            )
        self.encoder = encoder
        self.head = head

    def reset_parameters(self) -> None:
        """Re-initialise the encoder and the head."""
        self.encoder.reset_parameters()
        self.head.reset_parameters()

    def forward(self, pixels: Tensor, action: Tensor) -> Tensor:
        """Return both action values.

        Args:
            pixels: ``[*, C, H, W]``, values 0..255.
            action: ``[*, A]`` in [-1, 1].

        Returns:
            ``[*, 2]``.
        """
        return self.head(self.encoder(pixels), action)
