"""The artifact between pre-training and downstream learning: an encoder, its heads and a card."""

from __future__ import annotations

import copy
import hashlib
import inspect
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule

from crptpro.artifact import CARD_FILE, identity_of, read_artifact, write_artifact
from crptpro.data import FrameDataset
from crptpro.errors import PretrainedError, UnknownNameError
from crptpro.modules import PixelEncoder
from crptpro.modules.encoder import images_of
from crptpro.modules.registry import describe_network, rebuild_networks
from crptpro.objectives import get_method, method_names, method_of
from crptpro.provenance import provenance
from crptpro.seeding import derive_seed, kept_global_rng
from crptpro.values import as_int, as_path

FORMAT = "crptpro-pretrained"
VERSION = 1
HEADS = ("projector", "predictor", "prototypes")
TARGETS = ("target_encoder", "target_projector")
NETWORKS = ("encoder", *HEADS, *TARGETS, "actor")

SHIPPED = Path(__file__).parent / "encoders"
"""One artifact per directory; their names are what :func:`load_pretrained` takes."""

_LOG = logging.getLogger(__name__)


@dataclass
class Pretrained:
    """A pre-trained encoder and what was trained with it; networks are frozen and in evaluation mode.

    What the method does not have is ``None``.
    """

    encoder: PixelEncoder  #: images to features
    projector: nn.Module | None = None  #: features to latents
    predictor: nn.Module | None = None  #: latents to latents, online branch
    prototypes: nn.Module | None = None  #: unit vectors in the latent space
    target_encoder: nn.Module | None = None  #: moving average of the encoder
    target_projector: nn.Module | None = None  #: moving average of the projector
    queue: Tensor | None = None  #: candidate latents ``[Q, D]``
    actor: nn.Module | None = None  #: the exploring policy, for methods whose downstream runs start from it
    card: dict[str, Any] = field(default_factory=dict, repr=False)  #: how it was trained
    #: Remaining state of the loss (further heads, coefficients), for fine-tuning.
    rest: dict[str, Tensor] = field(default_factory=dict, repr=False)
    #: Checksum of the networks as they were read, which is what the card identifies.
    read_checksum: str | None = field(default=None, repr=False)

    @property
    def method(self) -> str:
        """Registered name of the method, or the class name of a loss that is not registered, or of the encoder."""
        return str(self.card.get("method", type(self.encoder).__name__))

    @property
    def label(self) -> str:
        """Name in records and reports: the method, with ``-finetune`` if it started from another artifact."""
        is_finetuned = bool((self.card.get("training") or {}).get("started_from"))
        return f"{self.method}-finetune" if is_finetuned else self.method

    def _networks(self) -> dict[str, nn.Module]:
        return {name: module for name in NETWORKS if (module := getattr(self, name)) is not None}

    def identity(self) -> str:
        """Return what identifies these weights: the method and a checksum; that of the card until they are changed."""
        checksum = self._checksum()
        if checksum == self.read_checksum and (named := identity_of(self.card)) is not None:
            return named
        return f"{self.method}:{checksum}"

    def _checksum(self) -> str:
        digest = hashlib.sha256()
        for key, value in nn.ModuleDict(self._networks()).state_dict().items():
            digest.update(key.encode())
            digest.update(value.cpu().reshape(-1).view(torch.uint8).numpy().tobytes())  # NumPy has no bfloat16
        return digest.hexdigest()

    def build_loss(self) -> LossModule:
        """Build the loss that this was trained with, as trainable copies of all networks, targets included.

        TorchRL's ``SoftUpdate`` begins by copying the online networks into the targets; :func:`finetune` keeps them.
        Raises a PretrainedError if its method is not registered or does not take these networks, or if saved slim.
        """
        if self.card.get("slim"):
            raise PretrainedError(
                "The artifact was saved slim: it does not hold the networks that training needs. Use the full one."
            )
        try:
            method: Any = get_method(self.method)
        except UnknownNameError as reason:
            raise PretrainedError(
                f"The artifact was trained with {self.method!r}, which is not a registered method. Call "
                "crptpro.objectives.register_method for its loss first (on the command line: --plugin FILE.py)."
            ) from reason
        if method.loss_class is None:
            raise PretrainedError(f"{self.method} was not trained by a loss: there is nothing to train further.")
        networks = copy.deepcopy(self._networks())
        heads = {name: networks[name] for name in HEADS if name in networks}
        for module in (networks["encoder"], *heads.values()):
            module.requires_grad_(True).train()
        try:
            options = self.card.get("loss", {}).get("config", {})
            loss: Any = method.loss_class(networks["encoder"], **heads, **options)
            loss.load_state_dict(self.rest, strict=False)
        except (TypeError, RuntimeError) as reason:
            name = method.loss_class.__name__
            raise PretrainedError(f"{name} cannot be rebuilt from the artifact: {reason}") from reason
        for target in networks.keys() & {*TARGETS}:
            for key, live in _target_state(loss, target).items():
                live.copy_(networks[target].state_dict()[key])
        loss.method_name = method.name
        return loss


def random_pretrained(
    seed: int = 0, *, method: str = "random-encoder", datasets: Iterable[Any] = (), **encoder_config: Any
) -> Pretrained:
    """Return a control: an encoder frozen at initialisation, without heads and prototypes.

    Args:
        seed: of the initialisation; the global generator is left as it was.
        method: ``"random-encoder"``; ``"random-encoder-standardised"``, whose features have mean 0 and deviation 1 on
            ``datasets``; or ``"drq"``, which trains it.
        datasets: one or several directories or :class:`~crptpro.data.FrameDataset`, for the standardised control.
        **encoder_config: arguments of :class:`~crptpro.modules.PixelEncoder`.

    Examples:
        >>> random_pretrained(channels=(4,), strides=(2,), image_size=16).method
        'random-encoder'
    """
    untrained = [name for name in method_names(presets=True) if get_method(name).loss_class is None]
    if method not in untrained:
        raise UnknownNameError(f"`method` must be one of {', '.join(untrained)}, got {method!r}.")
    seed = as_int(seed, "seed", minimum=0)
    with kept_global_rng():
        torch.manual_seed(derive_seed(seed, "random_pretrained"))
        encoder = PixelEncoder(**encoder_config)
    encoder.requires_grad_(False).eval()
    card: dict[str, Any] = {"method": method, "training": None, "seed": seed}
    if method == "random-encoder-standardised":
        opened = _opened(datasets, images_of(encoder)["frame_stack"])
        encoder.standardise(*_feature_moments(encoder, opened, seed))
        shown = ("domain", "transitions", "seed", "quality", "colors")
        card["standardised_on"] = [{name: data.card[name] for name in shown if name in data.card} for data in opened]
    return Pretrained(encoder, card=card)


def _opened(datasets: Iterable[Any], frame_stack: int) -> list[FrameDataset]:
    several = [datasets] if isinstance(datasets, (str, Path, FrameDataset)) else datasets
    opened = [FrameDataset.open(d, frame_stack=frame_stack) if isinstance(d, (str, Path)) else d for d in several]
    if not opened:
        raise PretrainedError("random-encoder-standardised needs datasets to standardise its features on.")
    return opened


@torch.no_grad()
def _feature_moments(encoder: PixelEncoder, datasets: Sequence[FrameDataset], seed: int) -> tuple[Tensor, Tensor]:
    """Return mean and deviation of every feature over 2048 random observations, equally many of each dataset."""
    features = []
    for index, dataset in enumerate(datasets):
        generator = torch.Generator("cpu").manual_seed(derive_seed(seed, "standardise", index))
        drawn = torch.randint(len(dataset), (-(-2048 // len(datasets)),), generator=generator, device="cpu")
        pixels = dataset.storage.get(drawn)["pixels"]  # without the transforms of samples
        features += [encoder(chunk) for chunk in pixels.split(64)]
    deviation, mean = torch.std_mean(torch.cat(features), dim=0, correction=0)
    # A feature that never changes stays 0 after centring, whatever it is divided by.
    return mean, torch.where(deviation > 1e-6, deviation, torch.ones_like(deviation))


def save_pretrained(trained: Any, path: str | Path, *, slim: bool = False) -> Path:
    """Write a trained encoder as a directory: ``weights.safetensors`` and ``card.json``.

    It is read back and rebuilt before it replaces anything.

    Args:
        trained: the result of a pre-training (``.loss``, ``.method``, ``.training``, and optionally ``.actor`` and
            ``.queue``); a loss with the pre-training contract (``.encoder``, and optionally ``.projector``,
            ``.predictor``, ``.prototypes``); or a loaded artifact.
        path: directory to write and to return; an artifact there is replaced, as a whole.
        slim: leave out what only training reads: predictor, targets and further heads, and without prototypes the
            projector. Learning a task from it gives the same numbers; fine-tuning from it is refused.

    Raises:
        CRPTproError: no encoder that can be rebuilt (a ``PretrainedError``), or ``path`` holds something else.
        ValueError: a network was built with something that cannot be stored as JSON.
        DiskSpaceError: the disk is full; an artifact there is kept.
    """
    path = as_path(path)
    source = _as_pretrained(trained)
    card = {"method": source.method, **source.card}
    if "weights_sha256" in card and (slim or "slim_of" in card):
        card["slim_of"] = source.identity()
    if slim:
        card["slim"] = True
        left_out: dict[str, Any] = dict.fromkeys(("predictor", *TARGETS)) | {"rest": {}}
        if source.prototypes is None or source.projector is None:
            left_out |= dict.fromkeys(("projector", "prototypes", "queue"))
        source = replace(source, **left_out)
    described = _describe(source)
    states: dict[str, Mapping[str, Tensor]] = {role: getattr(source, role).state_dict() for role in described}
    if source.queue is not None:
        states["queue"] = {"latents": source.queue}
    if source.rest:
        states["loss"] = source.rest
    card |= {"modules": described, "pixels": _pixel_facts(source.encoder), **provenance()}
    check = partial(_rebuilt, path)
    return write_artifact(path, states, card=card, format_name=FORMAT, version=VERSION, check=check)


def load_pretrained(path: str | Path) -> Pretrained:
    """Read and verify an artifact; its networks are bit-equal to those saved, frozen, on the CPU.

    ``path`` is a directory written by :func:`save_pretrained`, or one of :func:`shipped_encoders`. Networks of your own
    class need :func:`~crptpro.modules.register_network`.

    Raises:
        PretrainedError: something is missing, truncated, tampered with, of another kind, or unknown.
    """
    path = as_path(path)
    if path.name == str(path) and not path.exists():  # a name, not a path
        if not (SHIPPED / path / CARD_FILE).exists():
            raise PretrainedError(
                f"{path} does not exist, and no encoder of this name ships with crptpro; those that do: "
                f"{', '.join(shipped_encoders()) or 'none'}."
            )
        path = SHIPPED / path
    card, tensors = read_artifact(path, format_name=FORMAT, version=VERSION, error=PretrainedError)
    return _rebuilt(path, card, tensors)


def domains_seen(card: Mapping[str, Any]) -> set[str]:
    """Return the domains that an encoder, and the encoder it started from, were trained or standardised on."""
    training: Any = card.get("training")
    seen = {str(dataset.get("domain")) for dataset in card.get("standardised_on") or ()}
    while isinstance(training, Mapping):
        seen |= {str(dataset.get("domain")) for dataset in training.get("datasets") or ()}
        training = training.get("previous_training")
    return seen


def shipped_encoders() -> list[str]:
    """Return the names of the encoders that ship with the package, in alphabetical order."""
    return sorted(card.parent.name for card in SHIPPED.glob(f"*/{CARD_FILE}"))


def require_saveable(trained: Any) -> None:
    """Raise before training what :func:`save_pretrained` would raise after it about networks of your own."""
    source = _as_pretrained(trained)
    described = _describe(source)
    tensors = {f"{role}.{k}": v for role in described for k, v in getattr(source, role).state_dict().items()}
    rebuild_networks("the artifact", {"modules": described}, tensors, roles=NETWORKS, error=PretrainedError)


def _describe(source: Pretrained) -> dict[str, dict[str, Any]]:
    """Return class and arguments of every network that can be rebuilt; the encoder must be one of them."""
    described = {}
    for role, network in source._networks().items():
        if (description := describe_network(network)) is not None:
            described[role] = description
            continue
        message = f"The {role} is a {type(network).__name__} without a `.config` of its arguments"
        if role == "encoder":
            raise PretrainedError(f"{message}; use crptpro.modules.PixelEncoder or give yours one.")
        _LOG.warning("%s; it is not saved.", message)
    return described


def _as_pretrained(trained: Any) -> Pretrained:
    if isinstance(trained, Pretrained):
        return trained
    result = None if isinstance(trained, nn.Module) else trained
    loss = trained if result is None else getattr(result, "loss", None)
    if not isinstance(loss, nn.Module):
        raise PretrainedError(
            f"A {type(trained).__name__} cannot be saved as an encoder: it is neither a loss nor a pre-training result."
        )
    encoder: Any = _unwrapped(getattr(loss, "encoder", None))
    if encoder is None:
        raise PretrainedError(
            f"{type(loss).__name__} has no `.encoder`, which a pre-training loss exposes. An encoder alone: "
            "Pretrained(encoder)."
        )
    trained_here = {parameter.data_ptr() for parameter in loss.parameters()}
    own = {parameter.data_ptr() for parameter in encoder.parameters() if parameter.requires_grad}
    if own and trained_here and trained_here.isdisjoint(own):
        raise PretrainedError(
            f"The `.encoder` of this {type(loss).__name__} has none of its parameters, so it was not trained with it: "
            "a deep copy of a LossModule may be so. Save the original."
        )
    heads: dict[str, Any] = {role: _unwrapped(getattr(loss, role, None)) for role in HEADS}
    targets = {}
    for target, online in zip(TARGETS, (encoder, heads["projector"])):
        if online is not None and (state := _target_state(loss, target)):
            targets[target] = copy.deepcopy(online)
            targets[target].load_state_dict(state)
    covered = re.compile(rf"queue$|({'|'.join(('encoder', *HEADS, *TARGETS))})(_params)?\.")
    rest = {k: v for k, v in loss.state_dict().items() if isinstance(v, Tensor) and not covered.match(k)}
    card = {
        "method": method_of(loss).name if result is None else result.method,
        "loss": {"class": class_name(loss), "config": loss_options(loss)},
        "training": getattr(result, "training", None),
    }
    queue, actor = getattr(result, "queue", None), getattr(result, "actor", None)
    return Pretrained(encoder, **heads, **targets, queue=queue, actor=actor, card=card, rest=rest)


def class_name(loss: nn.Module) -> str:
    """Return the class of a loss with its module, as cards and checkpoints name it."""
    return f"{type(loss).__module__}.{type(loss).__qualname__}"


def loss_options(loss: nn.Module) -> dict[str, Any]:
    """Return the plain options of a loss's constructor: its ``config``, or the attributes of the same names."""
    if isinstance(config := getattr(loss, "config", None), dict):
        return config
    options, unknown = {}, []
    for name, parameter in inspect.signature(type(loss).__init__).parameters.items():
        value = getattr(loss, name, parameter.empty)
        if isinstance(value, Tensor) and value.ndim == 0:
            value = value.item()
        if isinstance(value, int | float | str) or (value is None and name not in HEADS):
            options[name] = value
        elif parameter.default is not parameter.empty and name not in HEADS and value is not parameter.default:
            unknown.append(name)
    if unknown and not type(loss).__init__.__module__.startswith("crptpro."):  # ours only build heads from theirs
        _LOG.warning(
            "%s of %s: not recorded, so fine-tuning takes the default. Keep each option as an attribute of its name, a "
            "number or text, or all of them in a dict `config`.", ", ".join(unknown), type(loss).__name__,
        )  # fmt: skip
    return options


def _pixel_facts(encoder: nn.Module) -> dict[str, Any]:
    config = getattr(encoder, "config", {})
    return {name: config.get(name) for name in ("in_channels", "pixel_scale", "pixel_offset")} | images_of(encoder)


def _unwrapped(module: Any) -> nn.Module | None:
    """Return the network inside a ``TensorDictModule``, or the network itself; ``None`` for anything else."""
    while isinstance(module, TensorDictModule):
        module = module.module
    return module if isinstance(module, nn.Module) else None


def _target_state(loss: Any, target: str) -> dict[str, Tensor]:
    """Return the live tensors of a target network by state-dict name, however a loss holds it; empty if it has none."""
    is_wrapped = isinstance(getattr(loss, target.removeprefix("target_"), None), TensorDictModule)
    prefix = re.compile(rf"{target}(_params)?\." + (r"module\." if is_wrapped else ""))
    return {prefix.sub("", key, 1): value for key, value in loss.state_dict().items() if prefix.match(key)}


def _rebuilt(path: Path, card: dict[str, Any], tensors: dict[str, Tensor]) -> Pretrained:
    networks, parts = rebuild_networks(path, card, tensors, roles=NETWORKS, error=PretrainedError)
    queue, rest = parts.pop("queue", {}).get("latents"), parts.pop("loss", {})
    if parts:
        raise PretrainedError(f"{path} holds weights its card does not describe: {', '.join(sorted(parts))}.")
    found = Pretrained(**networks, queue=queue, card=card, rest=rest)
    found.read_checksum = found._checksum()
    return found
