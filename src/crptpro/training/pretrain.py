"""Pre-training on datasets: one batch of one domain, one update of loss, encoder and targets, domain after domain."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, is_tensor_collection
from torch import Tensor, nn
from torchrl.data import RandomSampler, ReplayBuffer
from torchrl.objectives import LossModule, SoftUpdate

from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError, DatasetError
from crptpro.logging import RunLogger
from crptpro.modules import computing, resolve_precision, usable_device
from crptpro.modules.encoder import images_of
from crptpro.modules.precision import PRECISION_NAMES, Precision
from crptpro.objectives import Method, get_method, method_of
from crptpro.objectives.functional import prototype_metrics
from crptpro.pretrained import HEADS, Pretrained, class_name, load_pretrained, loss_options
from crptpro.provenance import provenance
from crptpro.seeding import seed_everything
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.compile import Update, accelerate
from crptpro.training.run import Generators, Run
from crptpro.transforms import RandomShift
from crptpro.values import check_numbers

SHIFT_PAD = 4
METHOD_FIELDS = ("updates", "batch_size", "learning_rate", "warmup_updates", "encoder_tau")


@dataclass(frozen=True)
class PretrainConfig:
    """How an encoder is pre-trained on datasets. ``None`` means the method's own value."""

    updates: int | None = None
    """encoder updates, over all domains (None: the method's; crptpro 50,000; fine-tuning 2,000)"""
    batch_size: int | None = None
    """transitions per update (None: the method's; crptpro 512)"""
    learning_rate: float | None = None
    """of Adam (None: the method's; crptpro 1e-4)"""
    warmup_updates: int | None = None
    """updates over which the learning rate rises linearly from 0 (None: the method's; atc 1,000)"""
    encoder_tau: float | None = None
    """EMA rate of the target networks, every update (None: the method's; crptpro 0.05)"""
    seed: int = 0
    """seeds sampling, shifts, and what the loss draws"""
    precision: Precision = "auto"
    """auto is bf16 where faster, fp32 for your own loss or network. Deviation: the released code uses fp32"""
    compile: bool = False
    """compile the loss with torch.compile; changes rounding only"""
    cuda_graph: bool = False
    """on a GPU, record the whole update as a CUDA graph and replay it"""
    device: str = "cpu"
    """device to train on; a GPU holds a copy of the datasets' frames"""
    log_interval: int = 100
    """updates between two rows of the record"""
    checkpoint_interval: int | None = None
    """updates between two checkpoints (None: about every five minutes)"""

    def __post_init__(self) -> None:
        check_numbers(self, minima={"warmup_updates": 0}, maxima={"encoder_tau": 1})

    def resolved(self, method: Method) -> Any:
        values = {name: getattr(method, name) for name in METHOD_FIELDS if getattr(self, name) is None}
        return dataclasses.replace(self, **values)


@dataclass(frozen=True)
class PretrainResult:
    """How a pre-training ended; :func:`~crptpro.pretrained.save_pretrained` writes its encoder."""

    loss: LossModule = field(repr=False)
    """the objective with its trained networks"""
    method: str
    """name of the method"""
    updates: int
    """encoder updates in total, over all domains and resumptions"""
    resumed_from: int
    """position that this call resumed from, in updates (env steps for an active method); 0 for a fresh run"""
    metrics: dict[str, Any]
    """the last row of the record"""
    collapse: dict[str, Any]
    """verdict of :class:`~crptpro.training.collapse.CollapseMonitor`"""
    training: dict[str, Any] = field(repr=False)
    """how it was trained, as plain values, for the artifact's card"""
    history: list[dict[str, Any]] = field(default_factory=list, repr=False)
    """the rows of the record, oldest first"""


def pretrain(
    loss: LossModule,
    datasets: Any,
    *,
    method: str | None = None,
    run_dir: str | Path | None = None,
    config: PretrainConfig | None = None,
    records: RunLogger | None = None,
    progress: bool = True,
    started_from: str | None = None,
    **overrides: Any,
) -> PretrainResult:
    """Train a self-supervised loss on the datasets of several domains (CRPTpro, algorithm 1).

    Update u (from 0) uses dataset u mod N only: one batch under random shifts, one Adam step, one EMA step of the
    targets. With ``run_dir`` the run can be killed at any moment: the same call with a newly built loss continues from
    the last checkpoint and, on a CPU, gives the same weights. A larger ``updates`` extends a finished run.

    Args:
        loss: any ``LossModule`` that returns scalar ``loss_*`` terms for a batch of its ``in_keys``; trained in place.
        datasets: one or several (a sequence, or a mapping of domain names): directories,
            :class:`~crptpro.data.FrameDataset`, or any TorchRL ``ReplayBuffer`` whose samples have the loss's keys.
        method: name of a registered method, whose numbers are the defaults; by default that of the loss.
        run_dir: record (``pretrain.csv``, ``metrics.jsonl``) and checkpoints; ``None`` writes nothing.
        config: all settings.
        records: used instead of a record in ``run_dir``, e.g. one that mirrors to W&B.
        progress: show a bar, or lines in a log file.
        started_from: identity of the artifact that the loss's weights come from, if any.
        **overrides: single settings of :class:`PretrainConfig`, e.g. ``updates=10_000``.

    Raises:
        CRPTproError: ``method`` explores, or takes the encoder of another method.
        CheckpointError: ``run_dir`` holds a run of other settings (named), or another process is running in it.
        NonFiniteError: a loss or a weight is not finite; the last checkpoint is kept.
        DatasetError: a dataset is unusable, lacks an entry, or has images of another shape than the encoder takes.
        ValueError: a setting is impossible; the message names it.
    """
    recipe = method_of(loss) if method is None else get_method(method)
    if started_from is None and recipe.starts_from is not None:
        raise CRPTproError(
            f"{recipe.name} takes a trained encoder of {recipe.starts_from} and does not pre-train its own."
        )
    if started_from is None and recipe.exploration is not None:
        raise CRPTproError(
            f"{recipe.name} explores its domains and does not learn from datasets; use pretrain_active(), or build "
            f"{type(loss).__name__} without its method."
        )
    settings = dataclasses.replace(config or PretrainConfig(), **overrides).resolved(recipe)
    device = usable_device(settings.device)
    loss.to(device).train()
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(Run(run_dir, unit="updates", streams=("pretrain",), records=records, config=settings,
                                      progress=progress))  # fmt: skip
        dtype = training_dtype(run, loss, settings.precision, device)
        stack.enter_context(computing(loss, dtype))
        buffers, generators = stack.enter_context(
            _opened(datasets, loss, batch_size=settings.batch_size, seed=settings.seed, device=device)
        )
        seed_everything(settings.seed)
        recipe = dataclasses.replace(recipe, **{name: getattr(settings, name) for name in METHOD_FIELDS})
        optimizer, schedule, targets = make_optimizer(loss, recipe, cuda_graph=settings.cuda_graph)
        monitor = CollapseMonitor.of(loss)
        datasets_facts = [_facts(name, buffer) for name, buffer in buffers.items()]
        run.require_same({
            **{name: getattr(settings, name) for name in (*METHOD_FIELDS, "seed")},
            "device": device.type,  # the samplers draw from generators of the device
            # A schedule is stretched over the run, so that a run with one cannot be extended.
            "updates": None if recipe.schedule == "constant" else settings.updates,
            "schedule": recipe.schedule, "grad_clip": recipe.grad_clip, "precision": PRECISION_NAMES[dtype],
            "loss": describe_loss(loss), "started_from": started_from, "datasets": datasets_facts,
        })  # fmt: skip
        samplers = {f"sampler_{index}": buffer.sampler for index, buffer in enumerate(buffers.values())}
        run.keep(loss=loss, optimizer=optimizer, schedule=schedule, targets=targets, monitor=monitor,
                 generators=generators, **samplers)  # fmt: skip

        update = make_update(loss, optimizer, targets, grad_clip=recipe.grad_clip)
        update = accelerate(update, compile=settings.compile, cuda_graph=settings.cuda_graph, device=device)
        domains = list(buffers)
        for done in run.until(settings.updates, checkpoint_interval=settings.checkpoint_interval):
            domain = domains[done % len(domains)]
            # The buffer's transform is the random shift. Only what the loss reads is kept: a recorded or compiled
            # update needs batches of one shape, and actions differ from domain to domain.
            batch = buffers[domain].sample(settings.batch_size).select(*loss.in_keys).to(device)
            losses = update(batch)
            schedule.step()
            run.log(scalars(losses, domain))
            run.advance(1)
            if run.every(settings.log_interval):
                write_row(run, loss, monitor, run.position)
        run.finish()
        if run.means("pretrain"):  # after the checkpoint, so that a longer run replaces this shorter row
            write_row(run, loss, monitor, run.position)
        facts = {"device": str(device), "datasets": datasets_facts}
        return PretrainResult(**ending(run, loss, recipe, monitor, run.position, facts))


def finetune(pretrained: Pretrained | str | Path, datasets: Any, **options: Any) -> PretrainResult:
    """Train a pretrained artifact further, e.g. on the random data of one more domain.

    All networks start from what was saved, targets and prototypes included; Adam is reset. ``pretrained`` is an
    artifact or its directory; ``datasets`` and ``options`` are those of :func:`pretrain`. The result's card also says
    how the artifact was trained before.

    Raises:
        PretrainedError: the artifact cannot be read, or its loss cannot be rebuilt, as for a slim one.
    """
    if not isinstance(pretrained, Pretrained):
        pretrained = load_pretrained(pretrained)
    identity = pretrained.identity()
    config = options.get("config") or PretrainConfig()
    if (updates := options.get("updates", config.updates)) is None:
        updates = get_method("crptpro-finetune").updates
    options |= {"method": pretrained.method, "started_from": identity, "updates": updates}
    result = pretrain(pretrained.build_loss(), datasets, **options)
    before = {"started_from": identity, "previous_training": pretrained.card.get("training")}
    return dataclasses.replace(result, training={**result.training, **before})


# --- what active pre-training shares ---------------------------------------------------------------------------------


def training_dtype(run: Run, loss: LossModule, precision: Precision, device: torch.device) -> torch.dtype:
    """Return the dtype that a loss trains in; see :func:`~crptpro.modules.resolve_precision`."""
    networks = (getattr(loss, role, None) for role in ("encoder", *HEADS))
    return resolve_precision(run.saved_setting("precision", precision), device, loss, *networks)


def make_optimizer(
    loss: LossModule, method: Method, *, cuda_graph: bool = False
) -> tuple[torch.optim.Adam, torch.optim.lr_scheduler.LambdaLR, SoftUpdate | None]:
    """Return Adam, the learning-rate schedule over the method's updates, and the EMA of the target networks."""
    parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
    if not parameters:
        raise ValueError(f"{type(loss).__name__} has no parameters that require a gradient: nothing to train.")
    rate = torch.tensor(method.learning_rate, device=parameters[0].device)
    optimizer = torch.optim.Adam(
        parameters, lr=rate if cuda_graph else method.learning_rate, fused=True, capturable=cuda_graph
    )

    def keep_rate(optimizer: torch.optim.Optimizer) -> None:
        # A graph reads this tensor. A loaded one is on the CPU, and its value would be recorded as a constant.
        for group in optimizer.param_groups:
            group["lr"] = rate.copy_(group["lr"])
            group["capturable"] = True

    if cuda_graph:
        optimizer.register_load_state_dict_post_hook(keep_rate)

    def factor(update: int) -> float:
        warmup = method.warmup_updates
        if update < warmup:
            return update / warmup
        if method.schedule == "constant":
            return 1.0
        progress = (update - warmup) / max(method.updates - warmup, 1)
        return (1 + math.cos(math.pi * min(progress, 1.0))) / 2

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    names = [name for name, _ in loss.named_children() if name.startswith("target_") and name.endswith("_params")]
    if not names or method.encoder_tau is None:
        return optimizer, schedule, None
    # SoftUpdate begins by copying the sources; fine-tuning continues with the saved targets.
    kept = {name: loss._modules[name].data.clone() for name in names}
    targets = SoftUpdate(loss, tau=method.encoder_tau)
    for name, target in kept.items():
        getattr(loss, name).data.update_(target)
    return optimizer, schedule, targets


def make_update(
    loss: LossModule, optimizer: torch.optim.Adam, targets: SoftUpdate | None, *, grad_clip: float | None
) -> Update:
    """Return a function that does one update on a batch, without host synchronisation."""
    before_update = getattr(loss, "before_update", lambda: None)  # normalises the prototypes

    def update(batch: TensorDictBase) -> TensorDictBase:
        before_update()
        losses = loss(batch)
        optimizer.zero_grad(set_to_none=True)
        total_loss(losses).backward()
        if grad_clip is not None:
            nn.utils.clip_grad_norm_(loss.parameters(), grad_clip)
        optimizer.step()
        if targets is not None:
            targets.step()
        return losses.detach()

    return update


def total_loss(losses: TensorDictBase) -> Tensor:
    """Return the sum of the ``loss*`` terms, which must be scalars."""
    if not is_tensor_collection(losses):
        raise ValueError(f"The loss returned a {type(losses).__name__}; a TensorDict of `loss_*` entries is needed.")
    terms = {name: losses[name] for name in losses.keys() if name.startswith("loss")}  # noqa: SIM118
    if not terms:
        raise ValueError(f"The loss returned no `loss_*` entry, only {sorted(losses.keys())}: nothing to minimise.")
    for name, term in terms.items():
        if term.numel() != 1:
            raise ValueError(f"{name} has shape {tuple(term.shape)}; a loss returns scalars.")
    return torch.stack([term.reshape(()) for term in terms.values()]).sum()


def scalars(losses: TensorDictBase, domain: str) -> dict[str, Tensor]:
    """Return the scalars of an update for a row: every output, the total loss, and loss and cosine by domain."""
    values = {n: v.reshape(()) for n, v in losses.items() if isinstance(v, Tensor) and v.numel() == 1}
    values["loss"] = values[f"loss/{domain}"] = total_loss(losses)
    if "embedding_cosine" in values:
        values[f"cosine/{domain}"] = values["embedding_cosine"]
    return values


@torch.no_grad()
def write_row(run: Run, loss: LossModule, monitor: CollapseMonitor, updates: int) -> None:
    """Write a row of the ``pretrain`` record with the prototypes' spread, and pass it to the monitor."""
    means = run.means("pretrain")
    extra = {}
    weight = getattr(getattr(loss, "prototypes", None), "weight", None)
    if isinstance(weight, Tensor):
        extra["ln_num_prototypes"] = log_count = math.log(len(weight))
        if "assignment_entropy" in means and log_count:
            extra["assignment_entropy_frac"] = means["assignment_entropy"] / log_count
        if len(weight) >= 4:
            measured = prototype_metrics(weight.detach(), offset=float(getattr(loss, "offset", 1.5)))
            extra |= {name: float(value) for name, value in measured.items()}
    row = run.write("pretrain", extra=extra, updates=updates)
    cosines = {name.removeprefix("cosine/"): value for name, value in row.items() if name.startswith("cosine/")}
    monitor.observe(updates, comp=row.get("comp", row.get("loss_comp")), cosines=cosines)
    run.show(loss=row["loss"])


def describe_loss(loss: LossModule) -> dict[str, Any]:
    """Return a loss's class, options and tensor shapes, which must agree with those of a checkpoint."""
    shapes = {
        f"shape of {name}": f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
        for name, value in loss.state_dict().items()
        if isinstance(value, Tensor)
    }
    return {"class": class_name(loss), **loss_options(loss), **shapes}


def ending(
    run: Run, loss: LossModule, method: Method, monitor: CollapseMonitor, updates: int, facts: dict[str, Any]
) -> dict[str, Any]:
    """Return the fields of a :class:`PretrainResult`, and log how training ended."""
    collapse, rows = monitor.finish(), run.rows("pretrain")
    last = rows[-1] if rows else {}  # the record of a finished run may be gone
    metrics = {name: value for name, value in last.items() if name not in (run.unit, "updates", "unix_time_s")}
    training = {
        "updates": updates,
        "seconds": round(run.seconds, 1),
        "settings": {name: value for name, value in run.settings.items() if name not in ("loss", "datasets")},
        "collapse": collapse,
        "made_with": provenance(),
        "metrics": metrics,
        **facts,
    }
    return {
        "loss": loss, "method": method.name, "updates": updates, "resumed_from": run.resumed_from, "metrics": metrics,
        "collapse": collapse, "training": training, "history": rows,
    }  # fmt: skip


@contextlib.contextmanager
def _opened(
    datasets: Any, loss: LossModule, *, batch_size: int, seed: int, device: torch.device
) -> Iterator[tuple[dict[str, ReplayBuffer], Generators]]:
    """Yield buffers by domain, with the random shift that the loss needs, and the generators that they draw from."""
    if isinstance(datasets, (str, Path)) or hasattr(datasets, "sample"):
        datasets = [datasets]
    given = list(datasets.items() if isinstance(datasets, Mapping) else ((None, dataset) for dataset in datasets))
    if not given:
        raise DatasetError("pretrain needs at least one dataset, got none.")
    buffers: dict[str, ReplayBuffer] = {}
    for index, (name, dataset) in enumerate(given):
        if isinstance(dataset, (str, Path)):
            frame_stack = images_of(getattr(loss, "encoder", None))["frame_stack"]
            dataset = FrameDataset.open(dataset, frame_stack=frame_stack, device=device)
        if not isinstance(dataset, ReplayBuffer):
            raise DatasetError(
                f"Dataset {index} is a {type(dataset).__name__}; give a directory, a FrameDataset or a ReplayBuffer."
            )
        if any(dataset is other for other in buffers.values()):
            raise DatasetError(f"Dataset {index} is given twice as one object; open its directory again for each.")
        name = name or getattr(dataset, "card", {}).get("domain") or f"dataset_{index}"
        if not name.isprintable() or {",", '"'} & set(name):
            raise DatasetError(f"The dataset {name!r} cannot name columns of a record; rename it.")
        while name in buffers:
            name += f"_{index}"
        buffers[name] = dataset
    # TorchRL draws indices on the storage's device, so its generator must be on it, too.
    devices = {f"sample/{name}": getattr(buffer.storage, "device", None) for name, buffer in buffers.items()}
    generators = Generators(seed, "shift", *devices, devices=devices)
    with contextlib.ExitStack() as stack:
        for name, buffer in buffers.items():
            if getattr(buffer, "_prefetch", False):
                raise DatasetError(f"The dataset {name!r} prefetches: its threads would reorder the run's batches.")
            stack.callback(buffer.set_rng, buffer._rng)
            buffer.set_rng(generators[f"sample/{name}"])
            shift = _shift_for(loss, name, buffer, generators["shift"], batch_size)
            own = [each for each in buffer.transform.modules() if isinstance(each, RandomShift)]
            if any(key in shift.out_keys for each in own for key in each.out_keys):
                raise DatasetError(f"The dataset {name!r} shifts its images, as pretrain does: remove its RandomShift.")
            buffer.append_transform(shift)
            stack.callback(buffer.transform.pop, -1)
        yield buffers, generators


def _shift_for(
    loss: LossModule, name: str, buffer: ReplayBuffer, generator: torch.Generator, batch_size: int
) -> RandomShift:
    """Return the shift of every image that a loss reads: each entry, and each second view of one, has its own.

    Images have the shape that the encoder declares, or else four or more dimensions; other entries are not shifted.
    """
    # Other samplers may not draw single rows.
    sample = buffer.sample(1 if type(buffer.sampler) is RandomSampler else batch_size)
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
    config = getattr(encoder, "config", None)
    declared = config if isinstance(config, Mapping) else {}
    size, channels = (getattr(encoder, fact, declared.get(fact)) for fact in ("image_size", "in_channels"))
    if images and size and channels:
        first, expected = images[0], (channels, size, size)
        images = [key for key in images if tuple(sample[key].shape[-3:]) == expected]
        if not images:
            found = tuple(sample[first].shape[-3:])
            remedy = "Collect with those, or build the encoder for the dataset."
            if found == (3, size, size):
                remedy = "A FrameReplay that is extended by single frames (replay.extend(buffer[:])) samples stacks."
            raise DatasetError(
                f"Dataset {name!r} has {first!r} of shape {found}; the encoder takes {expected}. {remedy}"
            )
    second_views = [view for view, key in views.items() if key in images]
    read = [*(views[view] for view in second_views), *images]
    return RandomShift(pad=SHIFT_PAD, in_keys=read, out_keys=[*second_views, *images], generator=generator)


def _facts(name: str, buffer: ReplayBuffer) -> dict[str, Any]:
    """Return a dataset's entries in the card of an encoder, which must agree for a run to be resumed."""
    card = getattr(buffer, "card", {})
    shown = ("domain", "task", "transitions", "episodes", "action_repeat", "image_size", "seed", "quality", "colors")
    return {"domain": name, "transitions": len(buffer), **{k: card[k] for k in shown if k in card}}
