"""The artifact between pre-training and downstream learning: an encoder, its heads and a card."""

from __future__ import annotations

import copy
import hashlib
import inspect
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule

from crptpro.artifact import CARD_FILE, identity_of, read_artifact, write_artifact
from crptpro.data import FrameDataset
from crptpro.errors import PretrainedError, UnknownNameError
from crptpro.modules import (
    DeterministicActor,
    PixelEncoder,
    Predictor,
    Projector,
    Prototypes,
    SkillHead,
    SquashedGaussianActor,
)
from crptpro.objectives import get_method, method_of
from crptpro.provenance import provenance
from crptpro.seeding import derive_seed
from crptpro.values import as_int, as_path

FORMAT = "crptpro-pretrained"
VERSION = 1
HEADS = ("projector", "predictor", "prototypes")
TARGETS = ("target_encoder", "target_projector")
NETWORKS = ("encoder", *HEADS, *TARGETS, "actor")

SHIPPED = Path(__file__).parent / "encoders"
"""One artifact per directory; their names are what :func:`load_pretrained` takes."""

_CLASSES: dict[str, type[nn.Module]] = {
    cls.__name__: cls
    for cls in (PixelEncoder, Projector, Predictor, Prototypes, SkillHead, SquashedGaussianActor, DeterministicActor)
}
_LOG = logging.getLogger(__name__)


@dataclass
class Pretrained:
    """A pre-trained encoder and what was trained with it; networks are frozen and in evaluation mode.

    Attributes:
        encoder: images to features.
        projector: features to latents; ``None`` if the method has none. Likewise the others.
        predictor: latents to latents, online branch.
        prototypes: unit vectors in the latent space.
        target_encoder: slow copy of the encoder.
        target_projector: slow copy of the projector.
        queue: candidate latents ``[Q, D]`` if the method keeps some.
        actor: the exploring policy, for methods whose downstream runs start from it.
        card: how it was made.
        rest: remaining state of the loss (further heads, coefficients), for fine-tuning.
    """

    encoder: PixelEncoder
    projector: nn.Module | None = None
    predictor: nn.Module | None = None
    prototypes: nn.Module | None = None
    target_encoder: nn.Module | None = None
    target_projector: nn.Module | None = None
    queue: Tensor | None = None
    actor: nn.Module | None = None
    card: dict[str, Any] = field(default_factory=dict)
    rest: dict[str, Tensor] = field(default_factory=dict, repr=False)

    @property
    def method(self) -> str:
        """Registered name of the method, or the class name of a loss that is not registered."""
        return str(self.card.get("method", "unknown"))

    @property
    def label(self) -> str:
        """Name in records and reports: the method, with ``-finetune`` if it started from another artifact."""
        is_finetuned = bool((self.card.get("training") or {}).get("started_from"))
        return f"{self.method}-finetune" if is_finetuned else self.method

    def identity(self) -> str:
        """Return what identifies these weights: the method and a checksum."""
        if (named := identity_of(self.card)) is not None:
            return named
        digest = hashlib.sha256()
        for name in NETWORKS:
            module = getattr(self, name)
            for key, value in ({} if module is None else module.state_dict()).items():
                digest.update(f"{name}.{key}".encode())
                digest.update(value.detach().cpu().contiguous().numpy().tobytes())
        return f"{self.method}:{digest.hexdigest()}"

    def require(self, *, image_size: int, frame_stack: int | None = None) -> Pretrained:
        """Check that the encoder takes images of this size, in pixels, and stack. Returns self.

        ``None``, and what an encoder's ``config`` does not say, is not checked.

        Raises:
            PretrainedError: naming everything that does not fit, and both values.
        """
        has = _pixel_facts(self.encoder)
        needed = {"image_size": image_size, "frame_stack": frame_stack}
        wrong = [
            f"it was trained with {name} {has[name]}, not {value}"
            for name, value in needed.items()
            if None not in (value, has[name]) and has[name] != value
        ]
        if wrong:
            raise PretrainedError(
                f"The pretrained encoder ({self.method}) does not fit: {'; '.join(wrong)}. "
                "Use an artifact made for this, or change the settings to match it."
            )
        return self

    def build_loss(self) -> LossModule:
        """Build the loss that this was trained with, as trainable copies of all networks, targets included.

        Raises:
            PretrainedError: its method is not registered, does not take these networks, or they were saved slim.
        """
        if self.card.get("slim") or "trimmed_from" in self.card:
            raise PretrainedError(
                "The artifact was saved slim: it lacks the networks that training reads. Take the one with all of them."
            )
        try:
            method: Any = get_method(self.method)
        except UnknownNameError as reason:
            raise PretrainedError(
                f"The artifact was trained with {self.method!r}, which is no registered method. Call "
                "crptpro.objectives.register_method for its loss first."
            ) from reason
        own = copy.deepcopy(self)
        networks = {role: module for role in HEADS if (module := getattr(own, role)) is not None}
        for module in (own.encoder, *networks.values()):
            module.requires_grad_(True).train()
        try:
            options = own.card.get("loss", {}).get("config", {})
            loss: Any = method.loss_class(own.encoder, **networks, **options)
            loss.load_state_dict(own.rest, strict=False)
        except (TypeError, RuntimeError) as reason:
            raise PretrainedError(
                f"{method.loss_class.__name__} cannot be rebuilt from the artifact: {reason}"
            ) from reason
        for target in TARGETS:
            if (module := getattr(own, target)) is not None:
                for key, live in _target_state(loss, target).items():
                    live.copy_(module.state_dict()[key])
        loss.method_name = method.name
        return loss


def random_pretrained(
    seed: int = 0, *, method: str = "random-encoder", datasets: Iterable[Any] = (), **encoder_config: Any
) -> Pretrained:
    """Return a control: an encoder frozen at initialisation, without heads and prototypes.

    Args:
        seed: seeds the initialisation; the global generator is left as it was.
        method: ``"random-encoder"``; ``"random-encoder-standardised"``, whose features have mean 0 and deviation 1 on
            ``datasets``; or ``"drq"``, which trains it.
        datasets: directories or :class:`~crptpro.data.FrameDataset`, for the standardised one.
        **encoder_config: arguments of :class:`~crptpro.modules.PixelEncoder`.

    Raises:
        PretrainedError: no dataset to standardise on.

    Examples:
        >>> random_pretrained(channels=(4,), strides=(2,), image_size=16).method
        'random-encoder'
    """
    seed = as_int(seed, "seed", minimum=0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(seed, "random_pretrained"))
        encoder = PixelEncoder(**encoder_config)
    encoder.requires_grad_(False).eval()
    if method == "random-encoder-standardised":
        encoder.standardise(*_feature_moments(encoder, datasets, seed))
    return Pretrained(encoder, card={"method": method, "training": None, "seed": seed})


@torch.no_grad()
def _feature_moments(
    encoder: PixelEncoder, datasets: Iterable[Any], seed: int, *, samples: int = 2_048
) -> tuple[Tensor, Tensor]:
    """Return mean and deviation of every feature over random observations, as many of each dataset."""
    opened = [FrameDataset.open(d) if isinstance(d, (str, Path)) else d for d in datasets]
    if not opened:
        raise PretrainedError("random-encoder-standardised needs datasets to standardise its features on.")
    features = []
    for index, dataset in enumerate(opened):
        dataset.set_rng(torch.Generator().manual_seed(derive_seed(seed, "standardise", index)))
        pixels = dataset.sample(-(-samples // len(opened)))["pixels"]
        features += [encoder(chunk) for chunk in pixels.split(64)]
    deviation, mean = torch.std_mean(torch.cat(features), dim=0, correction=0)
    # A feature that never changes stays 0 after centring, whatever it is divided by.
    return mean, torch.where(deviation > 1e-6, deviation, torch.ones_like(deviation))


def save_pretrained(
    trained: Any, path: str | Path, *, slim: bool = False, dtype: Literal["bfloat16"] | None = None
) -> Path:
    """Write what was trained as a directory: ``weights.safetensors`` and ``card.json``.

    It is read back and rebuilt before it replaces anything.

    Args:
        trained: the result of a pre-training (``.loss``, ``.method``, ``.training``, and optionally ``.actor`` and
            ``.queue``); a loss with the pre-training contract (``.encoder``, and optionally ``.projector``,
            ``.predictor``, ``.prototypes``); or a loaded artifact.
        path: directory to write; an artifact there is replaced, as a whole.
        slim: leave out what only training reads: predictor, targets and further heads, and without prototypes the
            projector. Learning a task from it gives the same numbers; fine-tuning from it is refused.
        dtype: ``"bfloat16"`` stores the weights in half the size, rounded to 8 bits; they are loaded as float32.

    Returns:
        ``path``.

    Raises:
        PretrainedError: if there is no encoder that can be rebuilt, or ``path`` is another kind of directory.
        ValueError: if a network was built with something that is no plain value.
        DiskSpaceError: if the disk is full; an artifact there is kept.
    """
    if dtype not in (None, "bfloat16"):
        raise ValueError(f"`dtype` must be 'bfloat16' or None, got {dtype!r}.")
    path = as_path(path)
    source = _as_pretrained(trained)
    if slim:
        source = _slimmed(source)
    states: dict[str, Mapping[str, Tensor]] = {}
    described: dict[str, dict[str, Any]] = {}
    classes: dict[str, type[nn.Module]] = {}
    for role in NETWORKS:
        if (module := getattr(source, role)) is None:
            continue
        if not isinstance(config := getattr(module, "config", None), dict):
            message = f"The {role} is a {type(module).__name__} without a `.config` of its arguments"
            if role == "encoder":
                raise PretrainedError(f"{message}; use crptpro.modules.PixelEncoder or give yours one.")
            _LOG.warning("%s; it is not saved.", message)
            continue
        states[role] = module.state_dict()
        described[role] = {"class": type(module).__name__, "config": config}
        classes[type(module).__name__] = type(module)
    if source.queue is not None:
        states["queue"] = {"latents": source.queue}
    if source.rest:
        states["loss"] = source.rest
    card = {**source.card, "modules": described, "pixels": _pixel_facts(source.encoder), **provenance()}
    if dtype is not None:
        card.pop("slim_of", None)  # these are other numbers
        states = {
            name: {k: v.to(torch.bfloat16) if v.is_floating_point() else v for k, v in state.items()}
            for name, state in states.items()
        }
    check = partial(_rebuilt, path, classes={**_CLASSES, **classes})
    return write_artifact(path, states, card=card, format_name=FORMAT, version=VERSION, check=check)


def load_pretrained(path: str | Path, classes: Mapping[str, type[nn.Module]] | None = None) -> Pretrained:
    """Read and verify an artifact; needs nothing but its directory.

    Args:
        path: directory written by :func:`save_pretrained`, or the name of an encoder that ships with the package, see
            :func:`shipped_encoders`.
        classes: class name to class, for networks that are not this library's.

    Returns:
        The networks, bit-equal to those saved, frozen, on the CPU.

    Raises:
        PretrainedError: naming what is missing, truncated, tampered with, of another kind, or unknown.
    """
    path = as_path(path)
    if not path.exists() and path.name == str(path):  # a name, not a path
        if not (SHIPPED / path / CARD_FILE).exists():
            raise PretrainedError(
                f"{path} does not exist, and no encoder of this name ships with crptpro; those that do: "
                f"{', '.join(shipped_encoders()) or 'none'}."
            )
        path = SHIPPED / path
    if not (path / CARD_FILE).exists() and (path / "encoder" / CARD_FILE).exists():
        raise PretrainedError(f"{path} is not a pretrained artifact. Did you mean {path / 'encoder'}?")
    card, tensors = read_artifact(path, format_name=FORMAT, version=VERSION, error=PretrainedError)
    return _rebuilt(path, card, tensors, classes={**_CLASSES, **(classes or {})})


def shipped_encoders() -> list[str]:
    """Return the names of the encoders that ship with the package, in alphabetical order."""
    return sorted(card.parent.name for card in SHIPPED.glob(f"*/{CARD_FILE}"))


def _as_pretrained(trained: Any) -> Pretrained:
    if isinstance(trained, Pretrained):
        return trained
    result = None if isinstance(trained, nn.Module) else trained
    loss = trained if result is None else getattr(result, "loss", None)
    if not isinstance(loss, nn.Module):
        raise PretrainedError(
            f"A {type(trained).__name__} cannot be saved as a pretrained encoder: it is no loss, and no result of one."
        )
    encoder: Any = _unwrapped(getattr(loss, "encoder", None))
    if encoder is None:
        raise PretrainedError(f"{type(loss).__name__} has no `.encoder`; a pre-training loss exposes it.")
    heads = {role: _unwrapped(getattr(loss, role, None)) for role in HEADS}
    targets = {}
    for target, online in (("target_encoder", encoder), ("target_projector", heads["projector"])):
        if online is not None and (state := _target_state(loss, target)):
            targets[target] = copy.deepcopy(online)
            targets[target].load_state_dict(state)
    covered = tuple(f"{role}{suffix}" for role in ("encoder", *HEADS, *TARGETS) for suffix in (".", "_params."))
    rest = {
        key: value
        for key, value in loss.state_dict().items()
        if isinstance(value, Tensor) and key != "queue" and not key.startswith(covered)
    }
    card = {
        "method": method_of(loss).name if result is None else result.method,
        "loss": {"class": class_name(loss), "config": loss_options(loss)},
        "training": getattr(result, "training", None),
    }
    queue, actor = getattr(result, "queue", None), getattr(result, "actor", None)
    return Pretrained(encoder, **heads, **targets, queue=queue, actor=actor, card=card, rest=rest)


def _slimmed(source: Pretrained) -> Pretrained:
    left_out: dict[str, Any] = dict.fromkeys(("predictor", *TARGETS)) | {"rest": {}}
    if source.prototypes is None or source.projector is None:
        left_out |= {"projector": None, "prototypes": None, "queue": None}
    card: dict[str, Any] = {**source.card, "slim": True}
    if (identity := identity_of(source.card)) is not None:
        card["slim_of"] = identity
    return replace(source, **left_out, card=card)


def class_name(loss: nn.Module) -> str:
    """Return the class of a loss with its module, as cards and checkpoints name it."""
    return f"{type(loss).__module__}.{type(loss).__qualname__}"


def loss_options(loss: nn.Module) -> dict[str, Any]:
    """Return the plain options of a loss's constructor, read back from the attributes of the same names."""
    if isinstance(config := getattr(loss, "config", None), dict):
        return config
    options = {}
    for name in inspect.signature(type(loss).__init__).parameters:
        value = getattr(loss, name, inspect.Parameter.empty)
        if isinstance(value, Tensor) and value.ndim == 0:
            value = value.item()
        if value is None and name in HEADS:
            continue
        if value is None or isinstance(value, (bool, int, float, str)):
            options[name] = value
    return options


def _pixel_facts(encoder: nn.Module) -> dict[str, Any]:
    config = getattr(encoder, "config", {})
    channels = config.get("in_channels")
    return {
        "image_size": config.get("image_size"),
        "in_channels": channels,
        "frame_stack": None if channels is None else channels // 3,
        "pixel_scale": config.get("pixel_scale"),
        "pixel_offset": config.get("pixel_offset"),
    }


def _unwrapped(module: Any) -> nn.Module | None:
    """Return the network inside a ``TensorDictModule``, or the network itself; ``None`` for anything else."""
    while isinstance(module, TensorDictModule):
        module = module.module
    return module if isinstance(module, nn.Module) else None


def _target_state(loss: Any, target: str) -> dict[str, Tensor]:
    """Return the live tensors of a target network by state-dict name, however a loss holds it; empty if it has none."""
    if (module := _unwrapped(getattr(loss, target, None))) is not None:
        return {key: value.detach() for key, value in module.state_dict(keep_vars=True).items()}
    params = getattr(loss, "_modules", {}).get(f"{target}_params")
    if params is None:
        return {}
    is_wrapped = isinstance(getattr(loss, target.removeprefix("target_"), None), TensorDictModule)
    state = dict(params.data.flatten_keys(".").items())
    return {key.removeprefix("module."): value for key, value in state.items()} if is_wrapped else state


def _rebuilt(
    path: Path, card: dict[str, Any], tensors: dict[str, Tensor], *, classes: Mapping[str, type[nn.Module]]
) -> Pretrained:
    """Build the networks that a card describes around its tensors; nothing is drawn from the global generator."""
    described = card.get("modules")
    if not isinstance(described, dict) or "encoder" not in described:
        held = sorted({name.split(".", 1)[0] for name in tensors})
        raise PretrainedError(f"{path} holds {', '.join(held) or 'no weights'}, but no encoder.")
    parts: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        role, key = name.split(".", 1)
        parts.setdefault(role, {})[key] = value.float() if value.dtype == torch.bfloat16 else value
    modules: dict[str, Any] = {}
    for role, description in described.items():
        if role not in NETWORKS or not isinstance(description, dict):
            raise PretrainedError(f"The card of {path} describes an unknown {role!r}; it is damaged or too new.")
        name = str(description.get("class"))
        if name not in classes:
            raise PretrainedError(
                f"The {role} in {path} is a {name!r}, which this library does not have. "
                f"Pass load_pretrained(..., classes={{{name!r}: ...}})."
            )
        try:
            # Without memory and initial weights, which the tensors replace; other classes may compute with them.
            is_ours = classes[name] is _CLASSES.get(name)
            with torch.random.fork_rng(devices=[]), torch.device("meta" if is_ours else "cpu"):
                module = classes[name](**description.get("config", {}))
            module.load_state_dict(parts.pop(role, {}), assign=True)
        except (TypeError, ValueError) as reason:
            raise PretrainedError(f"The card of {path} does not describe a {name}: {reason}") from reason
        except RuntimeError as reason:
            raise PretrainedError(f"The {role} in {path} is not the {name} of its card: {reason}") from reason
        modules[role] = module.requires_grad_(False).eval()
    queue, rest = parts.pop("queue", {}).get("latents"), parts.pop("loss", {})
    if parts:
        raise PretrainedError(f"{path} holds weights its card does not describe: {', '.join(sorted(parts))}.")
    return Pretrained(**modules, queue=queue, card=card, rest=rest)
