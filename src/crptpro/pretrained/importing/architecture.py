"""Our modules from tensors alone: sizes from their shapes, strides from what the head takes in."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from crptpro.errors import PretrainedError
from crptpro.modules import AnchorHead, PixelEncoder, Predictor, Projector, Prototypes, SkillHead
from crptpro.modules.encoder import KERNEL_SIZE
from crptpro.modules.initialisation import WeightInit

IMAGE_SIZE = 84
_MOST_CONVOLUTIONS = 8


def build_encoder(
    state: dict[str, Tensor],
    *,
    pixel_offset: float,
    init: WeightInit = "orthogonal",
    strides: tuple[int, ...] | None = None,
    feature_dim: int | None = None,
) -> PixelEncoder:
    """Build the encoder that a state dict under our names belongs to. All sources show it 84 x 84 pixels.

    Args:
        state: ``convs.<i>.weight`` and ``.bias``.
        pixel_offset: of the source.
        init: how the source draws weights.
        strides: of the convolutions, if known.
        feature_dim: input length of the first head, if there is one: what the strides have to fit.

    Raises:
        PretrainedError: no encoder of this library, or strides that are impossible, unknown or ambiguous.
    """
    kernels = [state[name] for name in state if name.endswith(".weight")]
    shapes = [tuple(kernel.shape) for kernel in kernels]
    if any(len(shape) != 4 or shape[2:] != (KERNEL_SIZE, KERNEL_SIZE) for shape in shapes):
        raise PretrainedError(f"its kernels are not all 3x3 but {', '.join(map(str, shapes[:8]))}.")
    if not 1 <= len(shapes) <= _MOST_CONVOLUTIONS or shapes[0][1] % 3:
        raise PretrainedError(
            f"its {len(shapes)} convolutions on {shapes[0][1] if shapes else 0} channels see no stack of RGB images."
        )
    channels = [shape[0] for shape in shapes]
    if strides is None:
        strides = infer_strides(channels, feature_dim)
    config = {
        "in_channels": shapes[0][1],
        "channels": channels,
        "strides": strides,
        "image_size": IMAGE_SIZE,
        "pixel_scale": 1 / 255,
        "pixel_offset": pixel_offset,
        "init": init,
    }
    encoder = fill(PixelEncoder, config, state, "encoder")
    if feature_dim is not None and encoder.feature_dim != feature_dim:
        raise PretrainedError(
            f"its head takes {feature_dim} features, its convolutions with strides {strides} "
            f"make {encoder.feature_dim} of {IMAGE_SIZE}x{IMAGE_SIZE} pixels."
        )
    return encoder


def infer_strides(channels: list[int], feature_dim: int | None) -> tuple[int, ...]:
    """Return the strides (1 or 2 each) with which 84 x 84 pixels become ``feature_dim`` features.

    Raises:
        PretrainedError: none do, or more than one choice does.

    Examples:
        >>> infer_strides([32, 32, 32, 32], 39_200)
        (2, 1, 1, 1)
        >>> infer_strides([32, 32, 32, 32], 1_568)
        (2, 2, 2, 1)
    """
    if feature_dim is None:
        raise PretrainedError("nothing in it tells the strides of its convolutions.")
    fitting = []
    for strides in itertools.product((1, 2), repeat=len(channels)):
        size = IMAGE_SIZE
        for stride in strides:
            size = (size - KERNEL_SIZE) // stride + 1
        if size > 0 and channels[-1] * size * size == feature_dim:
            fitting.append(strides)
    if len(fitting) == 1:
        return fitting[0]
    told = " or ".join(map(str, fitting)) if fitting else "none"
    raise PretrainedError(
        f"its head takes {feature_dim} features; the strides of its {len(channels)} convolutions that make so many "
        f"of {IMAGE_SIZE}x{IMAGE_SIZE} pixels: {told}."
    )


def build_head(role: str, state: dict[str, Tensor], init: WeightInit = "orthogonal") -> nn.Module:
    """Build one of our heads from a state dict under our names.

    Args:
        role: what it is to a loss.
        state: its tensors.
        init: how the source draws the projector's weights.

    Raises:
        PretrainedError: shapes that do not belong together.
    """
    sizes = {name: tuple(value.shape) for name, value in state.items()}
    if any(len(shape) != 2 for name, shape in sizes.items() if name.endswith("weight")):
        raise PretrainedError(f"its {role} does not consist of linear layers.")
    if "embed_input.weight" in sizes:
        hidden, features = sizes["embed_input.weight"]
        latent = sizes["embed_output.weight"][0]
        config: dict[str, Any] = {"feature_dim": features, "latent_dim": latent, "hidden_dim": hidden}
        return fill(SkillHead, config, state, role)
    if role == "projector":
        latent, features = sizes["linear.weight"]
        config = {"feature_dim": features, "latent_dim": latent, "init": init}
        return fill(Projector, config, state, role)
    if role == "prototypes":
        count, latent = sizes["weight"]
        return fill(Prototypes, {"num_prototypes": count, "latent_dim": latent}, state, role)
    hidden, latent = sizes["hidden.weight"]
    head: Any = {"predictor": Predictor, "anchor_head": AnchorHead}[role]
    return fill(head, {"latent_dim": latent, "hidden_dim": hidden}, state, role)


def fill(cls: Any, config: Mapping[str, Any], state: dict[str, Tensor], role: str) -> Any:
    """Build a module around the tensors of a state dict, without allocating others.

    Raises:
        PretrainedError: a tensor is missing, of another shape, not of real numbers, or not finite.
    """
    try:
        with torch.device("meta"):
            module = cls(**config)
    except (ValueError, RuntimeError) as reason:
        raise PretrainedError(f"its {role} cannot be built: {reason}") from None
    for name, empty in module.state_dict().items():
        if name not in state:
            raise PretrainedError(f"its {role} lacks what is called {name} here.")
        if state[name].shape != empty.shape:
            raise PretrainedError(
                f"{name} of its {role} has shape {tuple(state[name].shape)}, not {tuple(empty.shape)}."
            )
        # As it will be stored: a larger type may hold numbers that float32 does not.
        if not state[name].is_floating_point() or not bool(state[name].float().isfinite().all()):
            raise PretrainedError(f"{name} of its {role} is not made of finite real numbers.")
    module.load_state_dict({name: value.float() for name, value in state.items()}, assign=True)
    return module.requires_grad_(False).eval()
