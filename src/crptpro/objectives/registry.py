"""Methods by name: which loss, with which options, trained by which defaults."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from torch import nn
from torchrl.objectives import LossModule

from crptpro.errors import UnknownNameError
from crptpro.modules import PixelEncoder
from crptpro.objectives.exploration import ExplorationDefaults


@dataclass(frozen=True)
class MethodDefaults:
    """How a method is trained unless the caller says otherwise; the values here are CRPTpro's."""

    updates: int = 50_000
    """Encoder updates in total, over all domains."""

    batch_size: int = 512
    """Transitions per update."""

    lr: float = 1e-4
    """Adam learning rate (peak, if scheduled)."""

    betas: tuple[float, float] = (0.9, 0.999)
    """Adam moments."""

    eps: float = 1e-8
    """Adam epsilon."""

    weight_decay: float = 0.0
    """Adam weight decay."""

    encoder_tau: float | None = 0.05
    """EMA rate of the target networks, every update; None for a method without targets."""

    schedule: Literal["constant", "warmup_cosine"] = "constant"
    """Learning rate over the updates."""

    warmup_updates: int = 0
    """Length of the linear warm-up of the learning rate from 0; 0 for none."""

    grad_clip: float | None = None
    """Largest gradient norm; None for no clipping."""


@dataclass(frozen=True)
class Method:
    """A registered method or preset."""

    name: str
    """Registered name."""

    loss_class: type[LossModule]
    """The loss it trains."""

    defaults: MethodDefaults = MethodDefaults()
    """How it is trained."""

    loss_options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of ``loss_class`` that make up the preset."""

    is_preset: bool = False
    """A variant of another method: not listed among the methods, not the default of its class."""

    encoder_options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of :class:`~crptpro.modules.PixelEncoder` that the method wants."""

    replay_capacity: int = 40_000
    """Transitions that an agent keeps which is trained on its encoder later."""

    exploration: ExplorationDefaults | None = None
    """How it explores while it pre-trains; None for a method trained on random datasets."""

    is_builtin: bool = False
    """Comes with the library, whose revision says what it is."""

    def describe(self) -> dict[str, Any]:
        """Return all that was registered as plain values: what a record needs to tell two methods of one name apart.

        The code of the loss is not part of it, only its class's name.
        """
        return {
            "loss_class": f"{self.loss_class.__module__}.{self.loss_class.__qualname__}",
            "defaults": dataclasses.asdict(self.defaults),
            "loss_options": self.loss_options,
            "encoder_options": self.encoder_options,
            "replay_capacity": self.replay_capacity,
            "exploration": None if self.exploration is None else dataclasses.asdict(self.exploration),
        }

    def build_encoder(self, in_channels: int = 9, image_size: int = 84, **options: Any) -> PixelEncoder:
        """Build a fresh encoder of the kind that the method trains.

        Args:
            in_channels: colour channels times stacked frames.
            image_size: height and width in pixels.
            **options: of :class:`~crptpro.modules.PixelEncoder`, over the method's own.
        """
        return PixelEncoder(in_channels, image_size=image_size, **{**self.encoder_options, **options})

    def build(self, encoder: nn.Module, **options: Any) -> LossModule:
        """Build the loss on ``encoder``; ``options`` override the preset's own.

        The result remembers this method's name, so that :func:`method_defaults` returns this method's
        defaults.

        Raises:
            ValueError: an option that the loss does not have.
        """
        parameters = inspect.signature(self.loss_class.__init__).parameters.values()
        known = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY or p.name in options]
        unknown = sorted(set(options) - set(known))
        if unknown and not any(p.kind is p.VAR_KEYWORD for p in parameters):
            raise ValueError(
                f"The method {self.name!r} has no option {', '.join(unknown)}; it has {', '.join(known)}."
            )
        loss = self.loss_class(encoder, **{**self.loss_options, **options})
        loss.method_name = self.name
        return loss


_METHODS: dict[str, Method] = {}


def mark_builtin() -> None:
    """Call every method that is registered so far the library's own."""
    for name, method in _METHODS.items():
        _METHODS[name] = dataclasses.replace(method, is_builtin=True)


def register_method(
    name: str,
    loss_class: type[LossModule],
    defaults: MethodDefaults | None = None,
    *,
    loss_options: dict[str, Any] | None = None,
    is_preset: bool = False,
    encoder_options: dict[str, Any] | None = None,
    replay_capacity: int = 40_000,
    exploration: ExplorationDefaults | None = None,
) -> Method:
    """Make a method available by name, on the command line too.

    Args:
        name: unique name; registering a name again with another class is refused.
        loss_class: built as ``loss_class(encoder, **loss_options)``.
        defaults: None for the generic defaults.
        loss_options: keyword arguments of the loss.
        is_preset: a variant of an already registered method.
        encoder_options: keyword arguments of :class:`~crptpro.modules.PixelEncoder`, such as
            ``{"pixel_offset": 0.5}``.
        replay_capacity: transitions that an agent keeps which is trained on its encoder later.
        exploration: how the method explores, for active pre-training; None if it learns from random datasets.

    Returns:
        The registered method.

    Raises:
        ValueError: the name is taken by another class.
    """
    taken = _METHODS.get(name)
    if taken is not None and taken.loss_class is not loss_class:
        raise ValueError(
            f"The method {name!r} is already registered for {taken.loss_class.__name__}; choose another."
        )
    method = Method(
        name,
        loss_class,
        defaults or MethodDefaults(),
        dict(loss_options or {}),
        is_preset,
        dict(encoder_options or {}),
        replay_capacity,
        exploration,
    )
    _METHODS[name] = method
    return method


def get_method(name: str, *, besides: Iterable[str] = ()) -> Method:
    """Look a method or preset up by name.

    Args:
        name: as it was registered.
        besides: further names that the caller takes, which the error may propose.

    Raises:
        UnknownNameError: with the nearest known names.

    Examples:
        >>> get_method("crptpro").defaults.updates
        50000
    """
    if name not in _METHODS:
        known = sorted({*_METHODS, *besides})
        nearest = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
        raise UnknownNameError(f"There is no method {name!r}. Did you mean {', '.join(nearest or known)}?")
    return _METHODS[name]


def methods(*, presets: bool = False) -> list[str]:
    """Names of the registered methods, sorted; with ``presets``, of their variants too."""
    return sorted(name for name, method in _METHODS.items() if presets or not method.is_preset)


def method_defaults(loss: LossModule | type[LossModule]) -> MethodDefaults:
    """Training defaults of a loss, its class, or the nearest registered base class.

    A loss built by name has that method's defaults. A user's own, unregistered loss gets the generic ones,
    with ``encoder_tau`` None if it has no target networks; one of a class that adds target networks to
    those of a method without any gets the generic rate for them.
    """
    named = _named(loss)
    if named is not None:
        return named.defaults
    loss_class = loss if isinstance(loss, type) else type(loss)
    generic = MethodDefaults()
    inherited = next((method.defaults for base in loss_class.__mro__ for method in _methods_of(base)), None)
    if isinstance(loss, type):
        return inherited or generic
    has_targets = any(name.startswith("target_") for name, _ in loss.named_children())
    if inherited is None:
        return generic if has_targets else replace(generic, encoder_tau=None)
    if has_targets and inherited.encoder_tau is None and not _methods_of(loss_class):
        return replace(inherited, encoder_tau=generic.encoder_tau)
    return inherited


def method_name_of(loss: LossModule) -> str:
    """Name a loss: the method that built it; built by hand, the first one of its very class, or else the class."""
    name = getattr(loss, "method_name", None)
    if name is not None:
        return name
    return next((method.name for method in _methods_of(type(loss))), type(loss).__name__)


def exploring_method(loss: LossModule | type[LossModule]) -> Method | None:
    """Return the method that active pre-training of a loss explores as, None for the generic way.

    The method that built it, if that explores; otherwise the first method of its class, or the nearest base class,
    that does.
    """
    named = _named(loss)
    if named is not None and named.exploration is not None:
        return named
    loss_class = loss if isinstance(loss, type) else type(loss)
    for base in loss_class.__mro__:
        for method in _methods_of(base):
            if method.exploration is not None:
                return method
    return None


def exploration_defaults(loss: LossModule) -> ExplorationDefaults:
    """How active pre-training of a loss explores: as :func:`exploring_method` does."""
    method = exploring_method(loss)
    found = None if method is None else method.exploration
    return ExplorationDefaults() if found is None else found


def _named(loss: LossModule | type[LossModule]) -> Method | None:
    """Return the method whose name a loss bears, unless it is of another class."""
    method = _METHODS.get(getattr(loss, "method_name", None) or "")
    loss_class = loss if isinstance(loss, type) else type(loss)
    return method if method is not None and issubclass(loss_class, method.loss_class) else None


def _methods_of(loss_class: type) -> list[Method]:
    """List the methods of a very class, without presets, in the order in which they were registered."""
    return [m for m in _METHODS.values() if m.loss_class is loss_class and not m.is_preset]
