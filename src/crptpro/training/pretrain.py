"""Pre-training on datasets: one batch of one domain, one update of loss, encoder and targets, domain after domain."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import RandomSampler, ReplayBuffer
from torchrl.objectives import LossModule, SoftUpdate
from tyro.conf import arg

from crptpro.data import FrameDataset
from crptpro.errors import DatasetError
from crptpro.logging import RunLogger
from crptpro.modules import computing, resolve_precision, usable_device
from crptpro.modules.precision import Precision
from crptpro.objectives import Method, get_method, method_of
from crptpro.objectives.functional import mean_pairwise_cosine, prototype_metrics
from crptpro.pretrained import Pretrained, load_pretrained, save_pretrained
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.compile import accelerate
from crptpro.training.run import Generators, Run
from crptpro.transforms import RandomShift
from crptpro.values import as_int, check_numbers

SHIFT_PAD = 4
COSINE_ROWS = 128


@dataclass(frozen=True)
class PretrainConfig:
    """How an encoder is pre-trained on datasets. ``None`` means the method's own value, which is the paper's."""

    updates: int | None = None
    """encoder updates, over all domains (default: the method's; crptpro 50,000; fine-tuning 2,000)"""
    batch_size: int | None = None
    """transitions per update (default: the method's; crptpro 512)"""
    learning_rate: float | None = None
    """of Adam (default: the method's; crptpro 1e-4)"""
    warmup_updates: int | None = None
    """updates over which the learning rate rises linearly from 0 (default: the method's; atc 1,000)"""
    encoder_tau: float | None = None
    """EMA rate of the target networks, every update (default: the method's; crptpro 0.05)"""
    seed: int = 0
    """seeds sampling, shifts, and what the loss draws"""
    snapshots: Annotated[tuple[int, ...], arg(help_behavior_hint="(default: none)")] = ()
    """updates after which the encoder is saved too, as RUN_DIR/encoder_at_<updates>"""
    precision: Precision = "auto"
    """arithmetic of convolutions and big matrix products; auto is bf16 where the hardware is faster in it. Deviation:
    the released code computes in fp32 throughout, which fp32 gives"""
    compile: bool = False
    """compile the loss with torch.compile; changes rounding only"""
    cuda_graph: bool = False
    """on a GPU, record the whole update as a CUDA graph and replay it"""
    device: str = "cpu"
    """where to train; a GPU holds a copy of the datasets' frames"""
    log_interval: int = 100
    """updates between two rows of the record"""
    checkpoint_interval: int | None = None
    """updates between two checkpoints (default: about every five minutes)"""

    def __post_init__(self) -> None:
        """Convert numbers to plain values.

        Raises:
            ValueError: naming the setting, its value and what is allowed.
        """
        counts = {
            "updates": 1, "batch_size": 1, "warmup_updates": 0, "log_interval": 1, "checkpoint_interval": 1,
        }  # fmt: skip
        check_numbers(self, counts=counts, rates={"learning_rate": None, "encoder_tau": 1})
        snapshots = tuple(as_int(done, "snapshots", minimum=1) for done in self.snapshots)
        object.__setattr__(self, "snapshots", snapshots)

    def resolved(self, method: Method) -> Any:
        """Return these settings with the method's values where they were left open."""
        own = ("updates", "batch_size", "learning_rate", "warmup_updates", "encoder_tau")
        values = {name: getattr(method, name) for name in own if getattr(self, name) is None}
        return dataclasses.replace(self, **values)


@dataclass(frozen=True)
class PretrainResult:
    """How a pre-training ended; :func:`~crptpro.pretrained.save_pretrained` writes its encoder.

    Attributes:
        loss: the objective with its trained networks.
        method: name of the method.
        updates: encoder updates in total, over all domains and resumptions.
        resumed_from: where this call continued, in updates (in env steps for an active method); 0 for a fresh run.
        metrics: the last row of the record.
        collapse: verdict of :class:`~crptpro.training.collapse.CollapseMonitor`.
        training: how it was trained, as plain values, for the artifact's card.
        history: the rows that this call wrote, oldest first.
    """

    loss: LossModule = field(repr=False)
    method: str
    updates: int
    resumed_from: int
    metrics: dict[str, Any]
    collapse: dict[str, Any]
    training: dict[str, Any] = field(repr=False)
    history: list[dict[str, Any]] = field(default_factory=list, repr=False)

    @property
    def is_dead(self) -> bool:
        """Whether training ended on a plateau longer than the monitor's patience."""
        return self.collapse["verdict"] == "dead"


def pretrain(
    loss: LossModule,
    datasets: Any,
    *,
    method: str | None = None,
    run_dir: str | Path | None = None,
    config: PretrainConfig | None = None,
    records: RunLogger | None = None,
    resume: bool = True,
    progress: bool = True,
    started_from: str | None = None,
    **overrides: Any,
) -> PretrainResult:
    """Train a self-supervised loss on the datasets of several domains (CRPTpro, algorithm 1).

    Update u (from 0) uses dataset u mod N only: one batch under random shifts, one Adam step, one EMA step of the
    targets. Any ``LossModule`` works that returns scalar ``loss_*`` terms for a batch with the entries of its
    ``in_keys``. It is trained in place.

    With ``run_dir`` the run can be killed at any moment: the same call with a newly built loss continues from the last
    checkpoint and, on a CPU, gives the weights of an uninterrupted run. A larger ``updates`` extends a finished run.

    Args:
        loss: the objective with its networks.
        datasets: one or several (a sequence, or a mapping of domain names): directories,
            :class:`~crptpro.data.FrameDataset`, or any TorchRL ``ReplayBuffer`` whose samples have the loss's keys.
        method: name of a registered method, whose numbers are the defaults; by default that of the loss's class.
        run_dir: record (``pretrain.csv``, ``metrics.jsonl``), checkpoints and snapshots; ``None`` writes nothing.
        config: every number.
        records: used instead of a record in ``run_dir``, e.g. one that mirrors to W&B.
        resume: continue what ``run_dir`` holds; ``False`` refuses a directory that holds a run.
        progress: show a bar, or lines in a log file.
        started_from: identity of the artifact that the loss's weights come from, where they do.
        **overrides: single settings of :class:`PretrainConfig`, e.g. ``updates=10_000``.

    Returns:
        The trained loss, its last metrics and the verdict on collapse.

    Raises:
        CheckpointError: ``run_dir`` holds a run of other settings (named), or another process is running in it.
        NonFiniteError: a loss or a weight is not finite; the last checkpoint is kept.
        DatasetError: a dataset is unusable, shows other images than the encoder takes, or lacks an entry.
        ValueError: naming an impossible setting.
    """
    recipe = method_of(loss) if method is None else get_method(method)
    settings = dataclasses.replace(config or PretrainConfig(), **overrides).resolved(recipe)
    device = usable_device(settings.device)
    loss.to(device).train()
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(Run(run_dir, unit="updates", streams=("pretrain",), records=records, config=settings,
                                      resume=resume, progress=progress))  # fmt: skip
        dtype = resolve_precision(run.saved_setting("precision", settings.precision), device)
        stack.enter_context(computing(loss, dtype))
        buffers, generators = stack.enter_context(
            open_datasets(datasets, loss, seed=settings.seed, device=device)
        )
        torch.manual_seed(settings.seed)
        optimizer, schedule, targets = make_optimizer(
            loss, recipe, learning_rate=settings.learning_rate, warmup_updates=settings.warmup_updates,
            encoder_tau=settings.encoder_tau, updates=settings.updates, cuda_graph=settings.cuda_graph,
        )  # fmt: skip
        monitor = CollapseMonitor.of(loss)
        run.require_same(
            {"started_from": started_from, **settings_of(loss, recipe, settings, buffers, dtype)}
        )
        run.keep(loss=loss, optimizer=optimizer, schedule=schedule, targets=targets, monitor=monitor,
                 generators=generators, **samplers_of(buffers))  # fmt: skip

        def update(batch: TensorDictBase) -> TensorDictBase:
            normalise_prototypes(loss)
            losses = loss(batch)
            optimizer.zero_grad(set_to_none=True)
            total_loss(losses).backward()
            if recipe.grad_clip is not None:
                nn.utils.clip_grad_norm_(loss.parameters(), recipe.grad_clip)
            optimizer.step()
            if targets is not None:
                targets.step()
            return losses.detach()

        fast_update = accelerate(update, compile=settings.compile, cuda_graph=settings.cuda_graph)
        domains = list(buffers)
        for done in run.until(settings.updates, checkpoint_interval=settings.checkpoint_interval):
            domain = domains[done % len(domains)]
            batch = (
                buffers[domain].sample(settings.batch_size).to(device)
            )  # its transform is the random shift
            losses = fast_update(batch)
            schedule.step()
            run.log(scalars(losses, domain))
            run.advance(1)
            if run.every(settings.log_interval):
                write_row(run, loss, monitor, batch, domain)
            if run.position in settings.snapshots and run_dir is not None:
                save_pretrained(loss, Path(run_dir) / f"encoder_at_{run.position}", slim=True)
        run.finish()
        if run.means["pretrain"].counts:  # after the checkpoint: a longer run takes this shorter row back
            write_row(run, loss, monitor, batch, domain)
        collapse, metrics = monitor.finish(run.position), run.last_row("pretrain")
        training = training_card(
            run, monitor, metrics=metrics, device=str(device), datasets=facts_of(buffers)
        )
        return PretrainResult(loss, recipe.name, run.position, run.resumed_from, metrics, collapse, training,
                              run.history["pretrain"])  # fmt: skip


def finetune(
    pretrained: Pretrained | str | Path,
    datasets: Any,
    *,
    run_dir: str | Path | None = None,
    config: PretrainConfig | None = None,
    **options: Any,
) -> PretrainResult:
    """Train a pretrained artifact further, e.g. on the random data of one more domain.

    The networks, the target networks and the prototypes go on from what was saved; Adam starts afresh.

    Args:
        pretrained: an artifact, its directory, or the name of one that ships.
        datasets: as of :func:`pretrain`.
        run_dir: as of :func:`pretrain`; the same call continues what was interrupted.
        config: as of :func:`pretrain`.
        **options: further arguments of :func:`pretrain`, or single settings.

    Returns:
        As of :func:`pretrain`; its card also says how the artifact was trained before.

    Raises:
        PretrainedError: the artifact cannot be read, or its loss cannot be built again.
        CheckpointError: ``run_dir`` holds a run from another artifact or with other settings.
    """
    if not isinstance(pretrained, Pretrained):
        pretrained = load_pretrained(pretrained)
    result = pretrain(
        pretrained.build_loss(), datasets, method=pretrained.method, run_dir=run_dir, config=config,
        started_from=pretrained.identity(), **options,
    )  # fmt: skip
    before = {"started_from": pretrained.identity(), "previous_training": pretrained.card.get("training")}
    return dataclasses.replace(result, training={**result.training, **before})


def settings_of(
    loss: LossModule,
    method: Method,
    config: Any,
    buffers: Mapping[str, ReplayBuffer],
    dtype: torch.dtype,
) -> dict[str, Any]:
    """Return everything that decides the numbers of a run."""
    return {
        "batch_size": config.batch_size,
        "learning_rate": config.learning_rate,
        "warmup_updates": config.warmup_updates,
        "encoder_tau": config.encoder_tau,
        "seed": config.seed,
        # A schedule is stretched over the run, so that a run with one cannot be extended.
        "updates": None if method.schedule == "constant" else config.updates,
        "schedule": method.schedule,
        "grad_clip": method.grad_clip,
        "precision": "bf16" if dtype == torch.bfloat16 else "fp32",
        "loss": describe_loss(loss),
        "datasets": identities_of(buffers),
    }


# --- what active pre-training shares ---------------------------------------------------------------------------------


def make_optimizer(
    loss: LossModule, method: Method, *, learning_rate: float, warmup_updates: int, encoder_tau: float | None,
    updates: int, cuda_graph: bool = False,
) -> tuple[torch.optim.Adam, torch.optim.lr_scheduler.LambdaLR, SoftUpdate | None]:  # fmt: skip
    """Return Adam, the learning-rate schedule over ``updates``, and the EMA of the target networks.

    Raises:
        ValueError: nothing to train.
    """
    parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
    if not parameters:
        raise ValueError(
            f"{type(loss).__name__} has no parameters that require a gradient; nothing to train."
        )
    rate = torch.tensor(learning_rate, device=parameters[0].device) if cuda_graph else learning_rate
    optimizer = torch.optim.Adam(parameters, lr=rate, fused=True, capturable=cuda_graph)

    def factor(update: int) -> float:
        if update < warmup_updates:
            return update / warmup_updates
        if method.schedule == "constant":
            return 1.0
        progress = (update - warmup_updates) / max(updates - warmup_updates, 1)
        return (1 + math.cos(math.pi * min(progress, 1.0))) / 2

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    names = [
        name for name, _ in loss.named_children() if name.startswith("target_") and name.endswith("_params")
    ]
    if not names or encoder_tau is None:
        return optimizer, schedule, None
    # SoftUpdate begins by copying the sources; fine-tuning goes on with the targets that were saved.
    kept = {name: loss._modules[name].data.clone() for name in names}
    targets = SoftUpdate(loss, tau=encoder_tau)
    for name, target in kept.items():
        getattr(loss, name).data.update_(target)
    return optimizer, schedule, targets


def normalise_prototypes(loss: LossModule) -> None:
    """Call the loss's ``before_update``, if it has one: prototypes are brought to unit length before each forward."""
    if callable(hook := getattr(loss, "before_update", None)):
        hook()


def total_loss(losses: TensorDictBase) -> Tensor:
    """Return the sum of the ``loss*`` terms.

    Raises:
        ValueError: there is none, or one is no scalar.
    """
    terms = {name: losses[name] for name in losses.keys() if name.startswith("loss")}  # noqa: SIM118
    if not terms:
        raise ValueError(
            f"The loss returned no `loss_*` entry, only {sorted(losses.keys())}; nothing to minimise."
        )
    for name, term in terms.items():
        if term.numel() != 1:
            raise ValueError(f"{name} has shape {tuple(term.shape)}; a loss returns scalars.")
    return torch.stack([term.reshape(()) for term in terms.values()]).sum()


def scalars(losses: TensorDictBase, domain: str) -> dict[str, Tensor]:
    """Return what a row shows of an update: every scalar, their sum, and loss and cosine by domain."""
    values = {name: value.reshape(()) for name, value in losses.items() if value.numel() == 1}
    total = total_loss(losses)
    values |= {"loss": total, f"loss/{domain}": total}
    if "embedding_cosine" in values:
        values[f"cosine/{domain}"] = values["embedding_cosine"]
    return values


def write_row(
    run: Run, loss: LossModule, monitor: CollapseMonitor, batch: TensorDictBase, domain: str
) -> None:
    """Write a row of the ``pretrain`` record with the prototypes' spread, and let the monitor judge it."""
    means = run.means["pretrain"].read()
    extra = prototype_row(loss, means)
    if "embedding_cosine" not in means and (cosine := measured_cosine(loss, batch)) is not None:
        extra[f"cosine/{domain}"] = cosine
    row = run.write("pretrain", extra=extra)
    cosines = {
        name.removeprefix("cosine/"): value for name, value in row.items() if name.startswith("cosine/")
    }
    monitor.observe(
        run.counters.get("updates", run.position), comp=row.get("comp", row.get("loss_comp")), cosine=cosines
    )
    run.show(loss=row["loss"])


@torch.no_grad()
def prototype_row(loss: LossModule, means: Mapping[str, float]) -> dict[str, float]:
    """Return the spread of a loss's prototypes; nothing for a loss without any."""
    weight = getattr(getattr(loss, "prototypes", None), "weight", None)
    if not isinstance(weight, Tensor):
        return {}
    count = len(weight)
    row = {"ln_num_prototypes": math.log(count)}
    if "assignment_entropy" in means and count > 1:
        row["assignment_entropy_frac"] = means["assignment_entropy"] / math.log(count)
    if count >= 4:
        measured = prototype_metrics(weight.detach(), offset=float(getattr(loss, "offset", 1.5)))
        row |= {name: float(value) for name, value in measured.items()}
    return row


@torch.no_grad()
def measured_cosine(loss: LossModule, batch: TensorDictBase) -> float | None:
    """Return the mean pairwise cosine of a batch's embeddings, for a loss that does not report it."""
    encoder, pixels = getattr(loss, "encoder", None), batch.get("pixels", None)
    if not isinstance(encoder, nn.Module) or pixels is None:
        return None
    embeddings = encoder(pixels[:COSINE_ROWS])
    if isinstance(projector := getattr(loss, "projector", None), nn.Module):
        embeddings = projector(embeddings)
    if not isinstance(embeddings, Tensor) or embeddings.ndim != 2:
        return None
    return float(mean_pairwise_cosine(F.normalize(embeddings.float(), dim=-1)))


def describe_loss(loss: LossModule) -> dict[str, Any]:
    """Return a loss's class, plain options, coefficients and tensor shapes: what a checkpoint must agree with."""
    described: dict[str, Any] = {"class": f"{type(loss).__module__}.{type(loss).__qualname__}"}
    for name, value in sorted(vars(loss).items()):
        if not name.startswith("_") and name != "training" and isinstance(value, (bool, int, float, str)):
            described[name] = value
    for name in sorted(getattr(loss, "_schedulable_buffers", ())):
        value = getattr(loss, name, None)
        if isinstance(value, Tensor) and value.numel() == 1:
            described[name] = value.item()
    for name, value in loss.state_dict().items():
        if isinstance(value, Tensor):
            described[f"shape of {name}"] = f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    return described


def training_card(run: Run, monitor: CollapseMonitor, **facts: Any) -> dict[str, Any]:
    """Return how an encoder was trained, as plain values, for the card of its artifact."""
    settings = {name: value for name, value in run.settings.items() if name not in ("loss", "datasets")}
    return {
        "updates": run.counters.get("updates", run.position),
        "seconds": round(run.seconds, 1),
        "settings": settings,
        "collapse": monitor.verdict(run.counters.get("updates", run.position)),
        "made_with": run.made_with,
        **facts,
    }


# --- datasets --------------------------------------------------------------------------------------------------------

CARD_FACTS = (
    "domain", "task", "transitions", "episodes", "frame_stack", "action_repeat", "image_size", "seed", "quality",
    "colors", "backend",
)  # fmt: skip


@contextlib.contextmanager
def open_datasets(
    datasets: Any, loss: LossModule, *, seed: int, device: torch.device
) -> Iterator[tuple[dict[str, ReplayBuffer], Generators]]:
    """Open datasets, name them, and attach the random shift that the loss wants to each for the time of a run.

    Args:
        datasets: as of :func:`pretrain`.
        loss: whose ``in_keys`` and ``views`` say which images are shifted.
        seed: of the run.
        device: directories are opened on it.

    Yields:
        The buffers by domain, and the generators that they and their shifts draw from.

    Raises:
        DatasetError: there is none, or one does not fit the loss.
    """
    if isinstance(datasets, Mapping):
        given: list[tuple[str | None, Any]] = list(datasets.items())
    elif isinstance(datasets, (str, Path)) or hasattr(datasets, "sample"):
        given = [(None, datasets)]
    else:
        given = [(None, dataset) for dataset in datasets]
    if not given:
        raise DatasetError("pretrain needs at least one dataset, got none.")
    buffers: dict[str, ReplayBuffer] = {}
    for index, (name, dataset) in enumerate(given):
        if isinstance(dataset, (str, Path)):
            dataset = FrameDataset.open(dataset, device=device)
        if not isinstance(dataset, ReplayBuffer):
            raise DatasetError(
                f"Dataset {index} is a {type(dataset).__name__}; give a directory, a FrameDataset or a ReplayBuffer."
            )
        name = name or (getattr(dataset, "card", None) or {}).get("domain") or f"dataset_{index}"
        name = name if name not in buffers else f"{name}_{index}"
        buffers[name] = dataset
    # TorchRL draws indices where the storage is, and its generator must be there, too.
    devices = {f"sample/{name}": getattr(buffer.storage, "device", None) for name, buffer in buffers.items()}
    devices = {name: device for name, device in devices.items() if isinstance(device, torch.device)}
    generators = Generators(seed, "shift", *(f"sample/{name}" for name in buffers), devices=devices)
    with contextlib.ExitStack() as stack:
        for name, buffer in buffers.items():
            buffer.set_rng(generators[f"sample/{name}"])
            shift = random_shift_for(loss, name, buffer, generators["shift"])
            buffer.append_transform(shift)
            stack.callback(buffer.transform.pop, -1)
        yield buffers, generators


def random_shift_for(
    loss: LossModule, name: str, buffer: ReplayBuffer, generator: torch.Generator
) -> RandomShift:
    """Return the shift of every image that a loss reads: each entry, and each second view of one, has its own."""
    sample = buffer.sample(1)
    views: Mapping[NestedKey, NestedKey] = getattr(loss, "views", {})
    wanted = list(dict.fromkeys(views.get(key, key) for key in loss.in_keys))
    held = set(sample.keys(True, True))
    for key in wanted:
        if key not in held:
            raise DatasetError(
                f"The loss reads {key!r}, which the dataset {name!r} lacks; it has {', '.join(sorted(map(str, held)))}."
            )
    images = [key for key in wanted if sample[key].ndim >= 4]
    encoder = getattr(loss, "encoder", None)
    size, channels = getattr(encoder, "image_size", None), getattr(encoder, "in_channels", None)
    for key in images if size and channels else ():
        if tuple(sample[key].shape[-3:]) != (channels, size, size):
            raise DatasetError(
                f"The dataset {name!r} shows {key!r} as {tuple(sample[key].shape[-3:])}; the encoder takes "
                f"{(channels, size, size)}. Collect with those, or build the encoder for the dataset."
            )
    seconds = [view for view, key in views.items() if key in images]
    return RandomShift(
        pad=SHIFT_PAD,
        in_keys=[*(views[view] for view in seconds), *images],
        out_keys=[*seconds, *images],
        generator=generator,
    )


def samplers_of(buffers: Mapping[str, ReplayBuffer]) -> dict[str, Any]:
    """Return the samplers that a checkpoint must hold: those with a state of their own."""
    return {
        f"sampler_{index}": buffer.sampler
        for index, buffer in enumerate(buffers.values())
        if type(buffer.sampler) is not RandomSampler and hasattr(buffer.sampler, "state_dict")
    }


def facts_of(buffers: Mapping[str, ReplayBuffer]) -> list[dict[str, Any]]:
    """Return what the card of an encoder says about its datasets."""
    facts = []
    for name, buffer in buffers.items():
        card = getattr(buffer, "card", None) or {}
        facts.append(
            {"domain": name, "transitions": len(buffer), **{k: card[k] for k in CARD_FACTS if k in card}}
        )
    return facts


def identities_of(buffers: Mapping[str, ReplayBuffer]) -> list[dict[str, Any]]:
    """Return what must agree for a run to be continued on these datasets."""
    cards = [
        json.dumps(getattr(buffer, "card", None) or {}, sort_keys=True, default=str)
        for buffer in buffers.values()
    ]
    digests = [hashlib.sha256(card.encode()).hexdigest()[:16] for card in cards]
    return [
        {"name": name, "transitions": len(buffer), "card": digest}
        for (name, buffer), digest in zip(buffers.items(), digests)
    ]
