"""The ``crptpro`` command: a thin, typed shell over the library's functions.

The settings of each training stage are the dataclass that its function takes.
"""

from __future__ import annotations

import ast
import contextlib
import itertools
import logging
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
import torch
import tyro
from tyro.conf import OmitSubcommandPrefixes, Positional, arg

from crptpro import training
from crptpro.artifact import require_replaceable
from crptpro.cli.reproduce import Reproduce
from crptpro.console import run_main
from crptpro.data import FrameDataset, collect_group
from crptpro.directory_lock import refusal_leaves_nothing
from crptpro.domains import GROUPS, PAPER_DOMAINS, TASKS, expand_groups, get_domain
from crptpro.envs import make_env
from crptpro.errors import CRPTproError, DatasetError
from crptpro.logging import RunLogger
from crptpro.modules import usable_device
from crptpro.modules.encoder import images_of
from crptpro.objectives import get_method
from crptpro.plugins import load_plugins
from crptpro.pretrained import FORMAT, load_pretrained, random_pretrained, require_saveable, save_pretrained
from crptpro.provenance import cpu_cores
from crptpro.seeding import seed_everything
from crptpro.training.evaluate import episode_seed, run_episode
from crptpro.values import Colors, Quality, as_path

logger = logging.getLogger(__name__)

DESCRIPTION = """Cross-domain random pre-training with prototypes for reinforcement learning from pixels.
Start with `crptpro doctor`, then collect, pretrain and downstream; each stage continues where it was killed.
Or `crptpro reproduce` a whole experiment of the paper.
With `--plugin FILE.py` (or a module) any command first runs your file: methods and domains that it registers can then
be named."""

NamedValues = Annotated[tuple[str, ...], arg(metavar="[NAME=VALUE ...]", help_behavior_hint="(default: the method's)")]


@dataclass(frozen=True)
class Logging:
    """Where metrics go besides the local CSV and JSONL records, which are always written."""

    wandb: Literal["off", "auto", "offline", "online"] = "off"
    """mirror to Weights & Biases (its variables apply, e.g. WANDB_TAGS); auto is online when logged in, else offline"""
    wandb_project: str | None = None
    """W&B project (None: $WANDB_PROJECT, or crptpro)"""
    tensorboard: bool = False
    """also write TensorBoard event files"""

    @contextlib.contextmanager
    def records(self, run_dir: Path) -> Iterator[RunLogger | None]:
        """Open the record of a run with its mirrors; without mirrors yields ``None``: the run then opens its own."""
        if self.wandb == "off" and self.wandb_project:
            raise CRPTproError("--logging.wandb-project needs --logging.wandb: auto, offline or online.")
        if self.wandb == "off" and not self.tensorboard:
            yield None
            return
        run_dir = as_path(run_dir, "out")
        asked = {"project": self.wandb_project, "mode": None if self.wandb == "auto" else self.wandb}
        wandb = None if self.wandb == "off" else {name: value for name, value in asked.items() if value}
        with refusal_leaves_nothing(run_dir), RunLogger(run_dir, wandb=wandb, tensorboard=self.tensorboard) as logger:
            yield logger


@dataclass(frozen=True)
class Doctor:
    """Check that this machine can run crptpro: render every domain, print versions, say what to fix."""

    domains: Annotated[tuple[str, ...], arg(help_behavior_hint="(default: the paper's eight)")] = ()
    """only these domains, tasks or groups"""

    def run(self) -> None:
        from crptpro.doctor import run_doctor

        report = run_doctor(domains=self.domains or None)
        print(report.text())
        if not report.ok:
            raise SystemExit(1)


@dataclass(frozen=True)
class Collect:
    """Collect one dataset per domain with a uniform random policy."""

    domains: Annotated[Positional[tuple[str, ...]], arg(metavar="DOMAIN [DOMAIN ...]", help_behavior_hint="(required)")]
    """domains, tasks, or group letters, e.g. `walker cartpole`, `A`, `gymnasium:HalfCheetah-v5`"""
    out: Path = Path("data")
    """parent directory: each domain gets a directory in it"""
    transitions: int = 100_000
    """transitions per domain (21 KB each); a finished dataset does not grow"""
    seed: int = 0
    """the same seed gives the same data whatever the number of workers"""
    workers: Annotated[int, arg(help_behavior_hint=lambda cores: f"(default: one per core, {cores} here)")] = field(
        default_factory=cpu_cores
    )
    """collecting processes"""
    quality: Quality = "exact"
    """render quality; fast uses smaller shadow maps on software GL"""
    colors: Colors = "normal"
    """colours of the environments; reversed_background are the unseen ones of the paper"""
    action_repeat: int | None = None
    """simulator steps per agent step (None: the domain's, 2)"""

    def run(self) -> None:
        settings = {k: v for k, v in vars(self).items() if k not in ("domains", "out")}
        for name, path in collect_group(expand_groups(self.domains), self.out, **settings).items():
            logger.info("%s: %s", name, path)


@dataclass(frozen=True, kw_only=True)
class EncoderRun:
    """A stage that trains an encoder."""

    out: Path
    """run directory: records and checkpoints, and the encoder in OUT/encoder"""
    logging: Logging = field(default_factory=Logging)
    """Weights & Biases and TensorBoard"""

    def keep(self, result: Any, records: RunLogger | None) -> None:
        """Write the encoder, and copy it to the mirrors."""
        path = save_pretrained(result, self.out / "encoder")
        if records is not None:
            records.artifact(path, name=f"encoder_{self.out.name}", kind="encoder")
        logger.info("pretrained encoder: %s", path)


@dataclass(frozen=True, kw_only=True)
class Pretraining(EncoderRun):
    """Settings of `pretrain` for every method."""

    sources: Annotated[Positional[tuple[str, ...]], arg(metavar="SOURCE [SOURCE ...]", help_behavior_hint="")] = ()
    """dataset directories, e.g. data/walker data/cartpole; for methods that explore domains, tasks or group letters"""
    method: str = "crptpro"
    """crptpro, atc or random-encoder (on datasets), proto-rl-c, proto-rl-s, apt-c, apt-s or becl (exploring), a preset
    such as crptpro-fast, or one of your own with --plugin FILE.py; settings: see --method NAME --help"""
    loss: NamedValues = ()
    """options of the method's loss, e.g. num_prototypes=128 intr_loss_coef=0"""
    encoder: NamedValues = ()
    """options of the encoder, e.g. pixel_offset=0.5"""

    config: Any = None

    def run(self) -> None:
        method = get_method(self.method)
        train: Any = training.pretrain if method.exploration is None else training.pretrain_active
        images: dict[str, int] = {}
        if method.exploration is not None:
            for source in self.sources:
                if "/" in source and os.path.isdir(source):
                    raise CRPTproError(
                        f"{self.method} explores and reads no dataset: instead of {source} name a domain."
                    )
            sources: list[Any] = expand_groups(self.sources)
        else:
            sources = [as_path(source, "sources") for source in self.sources]
            if sources or method.loss_class is not None:
                image_size, frame_stack = image_format(sources)
                images = {"image_size": image_size, "in_channels": 3 * frame_stack}
        if method.loss_class is None:
            if self.loss:
                raise CRPTproError(f"{self.method} is not trained and has no loss; leave out --loss.")
            if self.config != type(self.config)(seed=self.config.seed) or self.logging != Logging():
                raise CRPTproError(f"{self.method} is not trained: of the settings only --seed and --encoder apply.")
            encoder_options = images | named_values("--encoder", self.encoder)
            untrained = random_pretrained(self.config.seed, method=self.method, datasets=sources, **encoder_options)
            logger.info("untrained encoder: %s", save_pretrained(untrained, self.out / "encoder"))
            return
        require_replaceable(self.out / "encoder", FORMAT)
        loss_options, encoder_options = named_values("--loss", self.loss), named_values("--encoder", self.encoder)
        seed_everything(self.config.seed)
        loss = method.build(method.build_encoder(**images | encoder_options), **loss_options)
        require_saveable(loss)
        with self.logging.records(self.out) as records:
            result = train(loss, sources, method=self.method, run_dir=self.out, config=self.config, records=records)
            self.keep(result, records)


@dataclass(frozen=True, kw_only=True)
class Pretrain(Pretraining):
    """Pre-train one encoder for several domains on their datasets, one update per domain in turn."""

    config: Annotated[training.PretrainConfig, arg(name="")] = field(default_factory=training.PretrainConfig)
    """all settings of the stage"""


@dataclass(frozen=True, kw_only=True)
class Explore(Pretraining):
    """Pre-train one encoder on what exploring agents see: one agent step per domain in turn."""

    config: Annotated[training.ExploreConfig, arg(name="")] = field(default_factory=training.ExploreConfig)
    """all settings of the stage"""


@dataclass(frozen=True, kw_only=True)
class Finetune(EncoderRun):
    """Continue pre-training on one domain from a pretrained encoder.

    The paper's --updates: pendulum and manipulation 2,000, cartpole 3,000, cheetah 1,000, walker 500.
    """

    pretrained: Annotated[Positional[str], arg(metavar="ENCODER")]
    """directory of the pretrained encoder; those that ship are slim, and cannot be trained further"""
    dataset: Annotated[Positional[Path], arg(metavar="DATASET")]
    """dataset directory of the one domain"""
    config: Annotated[training.PretrainConfig, arg(name="")] = field(default_factory=training.PretrainConfig)
    """all settings of the stage"""

    def run(self) -> None:
        pretrained = load_pretrained(self.pretrained)
        require_replaceable(self.out / "encoder", FORMAT)
        with self.logging.records(self.out) as records:
            result = training.finetune(pretrained, self.dataset, run_dir=self.out, config=self.config, records=records)
            self.keep(result, records)


@dataclass(frozen=True)
class Downstream:
    """Learn a task with SAC on a frozen encoder and the prototype-kNN bonus, or with DrQ from scratch."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """task to learn, e.g. walker_run, reach_duplo, gymnasium:HalfCheetah-v5"""
    pretrained: Annotated[str, arg(metavar="ENCODER")]
    """directory of the pretrained encoder, the name of one that ships (group-a, all-domains), `random-encoder` for the
    untrained control, or `drq` to learn the encoder with the task"""
    out: Path
    """run directory: eval.csv, train.csv, checkpoints, and the agent in OUT/agent"""
    config: Annotated[training.DownstreamConfig, arg(name="")] = field(default_factory=training.DownstreamConfig)
    """all settings of the stage"""
    logging: Logging = field(default_factory=Logging)
    """Weights & Biases and TensorBoard"""

    def run(self) -> None:
        get_domain(self.task)  # an unknown name is refused before the run directory is made
        with self.logging.records(self.out) as records:
            result = training.train_downstream(
                self.task, self.pretrained, run_dir=self.out, config=self.config, records=records
            )
        logger.info("agent: %s", result.agent_path)


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a trained agent, or the uniform random policy, for whole episodes."""

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """directory of an agent (OUT/agent of a downstream run), or `random-policy`"""
    task: str | None = None
    """task to act in (None: the agent's own)"""
    episodes: int = 10
    """number of whole episodes"""
    seed: int = 0
    """seeds the episodes"""
    quality: Quality | None = None
    """render quality (None: the one the agent was trained with; exact for the random policy)"""
    colors: Colors | None = None
    """colours of the environment (None: those of the agent's training; normal for the random policy)"""
    action_repeat: int | None = None
    """simulator steps per agent step (None: what the agent was trained with; the domain's for the random policy)"""
    csv: Path | None = None
    """write one row per episode here"""
    video: Path | None = None
    """write the first episode as MP4 here (needs the `video` extra)"""

    def run(self) -> None:
        is_random = self.agent == "random-policy"
        if is_random and self.task is None:
            raise CRPTproError("The random policy has no task of its own; name one, e.g. --task walker_run.")
        csv, video = require_writable(self.csv, "--csv"), require_video(self.video)  # before an hour of episodes
        agent, card = (None, {}) if is_random else training.load_agent(self.agent)
        task = self.task or card["task"]
        domain = get_domain(task)
        domain = replace(domain, camera=card.get("camera", domain.camera))
        usual = {"quality": "exact", "colors": "normal", "action_repeat": None} | card
        names = ("quality", "colors", "action_repeat")
        given = {name: getattr(self, name) for name in names}
        settings: dict[str, Any] = {name: usual[name] if given[name] is None else given[name] for name in names}
        settings["render"] = not is_random or video is not None  # the random policy needs no pixels
        if agent is not None:
            settings |= images_of(agent.encoder)
        with contextlib.closing(make_env(domain, seed=self.seed, **settings)) as env:
            action_dim = env.action_spec.shape[-1]
            if agent is not None and agent.actor.config["action_dim"] != action_dim:
                raise CRPTproError(
                    f"The agent was trained for {agent.actor.config['action_dim']} actions ({card['task']}), {task} "
                    f"has {action_dim}; choose a task of the agent's own domain."
                )
            policy = agent or training.uniform_policy(env, seed=self.seed)
            episodes: list[Any] = []
            try:
                training.evaluate(policy, env, episodes=self.episodes, seed=self.seed, on_episode=episodes.append)
            finally:  # a later episode may have failed
                if csv is not None and episodes:
                    from crptpro.experiments import measure

                    rows = [{"task": task, "agent": self.agent, **vars(episode)} for episode in episodes]
                    measure.write_rows(csv, rows)
            scores = training.summarize(episodes)
            print(
                f"{task}: {scores['mean']:.1f} ± {scores['std']:.1f} "
                f"({scores['min']:.1f} to {scores['max']:.1f}) over {len(episodes)} episode{'s' * (len(episodes) > 1)}",
                flush=True,
            )
            if video is not None:
                frames: list[Any] = []
                policy = agent or training.uniform_policy(env, seed=self.seed)
                run_episode(policy, env, episode=0, seed=episode_seed(self.seed, 0), on_frame=frames.append)
                write_video(frames, video)


@dataclass(frozen=True)
class Probe:
    """Predict positions and velocities from frozen features by ridge regression, on held-out episodes."""

    encoder: Annotated[Positional[str], arg(metavar="ENCODER")]
    """directory of a pretrained encoder, the name of one that ships (group-a, all-domains), or `random-encoder`"""
    datasets: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DATASET [DATASET ...]", help_behavior_hint="(required)")
    ]
    """datasets, e.g. data/walker data/finger; each is probed alone, seen in pre-training or not"""
    samples: int = 2_000
    """observations per dataset; time and memory grow with their square"""
    seed: int = 0
    """which observations, which episodes are held out, and the random encoder's initialisation"""
    csv: Path | None = None
    """write every number here, each coordinate's R2 among them"""
    device: str = "cpu"
    """device of the encoder"""

    def run(self) -> None:
        from crptpro.experiments import measure

        if self.samples < 1:
            raise CRPTproError(f"--samples must be at least 1, got {self.samples}.")
        csv = require_writable(self.csv, "--csv")  # before minutes of probing
        usable_device(self.device)
        image_size, frame_stack = image_format(self.datasets)
        if self.encoder == "random-encoder":
            pretrained = random_pretrained(self.seed, image_size=image_size, in_channels=3 * frame_stack)
        else:
            pretrained = load_pretrained(self.encoder)
        for network in filter(None, (pretrained.encoder, pretrained.projector)):
            network.to(self.device)
        rows: list[dict[str, Any]] = []
        settings: dict[str, Any] = {"encoder": self.encoder, "samples": self.samples, "seed": self.seed}
        try:
            for path in self.datasets:
                rows += measure.probe_rows(pretrained, FrameDataset.open(path), **settings)
                if csv is not None:
                    measure.write_rows(csv, rows)
        finally:  # a later dataset may be refused, and writing may fail
            if rows:
                about = ["method", "domain", "seen", "colors", "embedding"]
                means = pd.DataFrame(row for row in rows if not row["coordinate"]).astype({"value": float})
                table = means.pivot_table("value", about, "measure", sort=False).round(4).reset_index()
                print(table.to_string(index=False))


@dataclass(frozen=True)
class Report:
    """Write tables beside the paper's, figures and jobs as an HTML page, and as Markdown."""

    directory: Annotated[Positional[Path], arg(metavar="DIRECTORY")]
    """directory of `crptpro reproduce`, or any with downstream runs in or below it"""
    out: Path | None = None
    """directory of the report (None: DIRECTORY/report)"""

    def run(self) -> None:
        from crptpro.experiments.report import build_report

        print(build_report(self.directory, out=self.out))


def require_video(path: Path | None) -> Path | None:
    """Return the path of a video; one that cannot be written is refused before any work. Creates nothing."""
    path = require_writable(path, "--video")
    if path is None:
        return None
    if path.suffix.lower() != ".mp4":
        raise CRPTproError(f"--video {path}: the name of an MP4 ends in .mp4.")
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as reason:
        raise CRPTproError(f"--video needs the `video` extra ({reason}): pip install 'crptpro[video]'.") from None
    return path


def write_video(frames: Sequence[torch.Tensor], path: Path) -> None:
    """Write RGB images, uint8 ``[3, H, W]``, as an MP4 at 25 images per second."""
    import imageio.v2 as imageio

    # Nearest-neighbour upscaling makes 84 pixels visible on a screen; the codec needs even sizes.
    large = torch.stack(list(frames)).repeat_interleave(4, -1).repeat_interleave(4, -2)
    aside = path.with_name(f".{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        images = list(large.permute(0, 2, 3, 1).numpy())
        imageio.mimwrite(aside, images, format="FFMPEG", fps=25, macro_block_size=4)
        aside.replace(path)
    except (OSError, RuntimeError, ValueError) as reason:
        raise CRPTproError(f"--video {path} was not written: {reason}") from reason
    finally:
        aside.unlink(missing_ok=True)


def named_values(option: str, words: Sequence[str]) -> dict[str, Any]:
    """Read settings given as ``NAME=VALUE``.

    Examples:
        >>> named_values("--loss", ["num_prototypes=16", "intr_loss_coef=5e-3", "kind=mean"])
        {'num_prototypes': 16, 'intr_loss_coef': 0.005, 'kind': 'mean'}
    """
    found = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not name.isidentifier() or not equals:
            raise CRPTproError(f"{option} {word}: write NAME=VALUE, e.g. num_prototypes=128.")
        try:
            found[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            found[name] = value
    return found


def image_format(datasets: Sequence[Path]) -> tuple[int, int]:
    """Open every dataset and return the image size and frames per stack, which all must share."""
    if not datasets:
        raise DatasetError("Name at least one dataset directory, e.g. data/walker (made by `crptpro collect`).")
    formats = {}
    for path in datasets:
        if not path.exists() and str(path) in (*GROUPS, *PAPER_DOMAINS, *TASKS):
            raise DatasetError(
                f"{path} is not a directory. This method learns from datasets: `crptpro collect {path}` makes one, "
                "by default in data/."
            )
        dataset = FrameDataset.open(path)
        formats[path] = (dataset.image_size, dataset.frame_stack)
    if len(set(formats.values())) > 1:
        listed = ", ".join(f"{path} has {size} px, {stack} frames" for path, (size, stack) in formats.items())
        raise DatasetError(f"One encoder needs images of one size and stack: {listed}.")
    return next(iter(formats.values()))


def require_writable(path: Path | None, option: str) -> Path | None:
    """Return a path with ``~`` expanded; one that cannot be written is refused before any work. Creates nothing."""
    if path is None:
        return None
    path = as_path(path, option)
    if path.exists() and not path.is_file():  # the finished file would replace it, /dev/stdout for example
        raise CRPTproError(f"{option} {path} is not a regular file; name one.")
    parent = next(parent for parent in path.absolute().parents if parent.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise CRPTproError(f"{option} {path} cannot be written: {parent} is a file, or you may not write to it.")
    return path


def pretrain_command(arguments: Sequence[str]) -> type[Pretrain] | type[Explore]:
    """Return the settings class of ``pretrain`` for the method that the command line names."""
    words = " ".join(arguments).replace("=", " ").split()
    names = [after for word, after in itertools.pairwise(words) if word == "--method"]
    explores = names and "pretrain" in arguments and get_method(names[-1]).exploration is not None
    return Explore if explores else Pretrain


def main() -> None:
    """Run the ``crptpro`` command."""

    def run() -> None:
        arguments = load_plugins(sys.argv[1:])
        for before, word in itertools.pairwise(["crptpro", *arguments]):
            if not word or re.fullmatch("--[^=]*=", word):
                raise CRPTproError(f"An argument is empty: {word or before}. For the working directory write a dot.")
        if arguments == ["--version"]:
            print(f"crptpro {version('crptpro')}")
            return
        if arguments[:1] == ["measure"]:  # for jobs of `reproduce`
            from crptpro.experiments import measure

            measure.main(arguments[1:], pretrain_command)
            return
        commands: dict[str, Any] = {
            "doctor": Doctor, "collect": Collect, "pretrain": pretrain_command(arguments), "finetune": Finetune,
            "downstream": Downstream, "evaluate": Evaluate, "probe": Probe, "reproduce": Reproduce, "report": Report,
        }  # fmt: skip
        tyro.extras.subcommand_cli_from_dict(
            commands, prog="crptpro", description=DESCRIPTION, args=arguments, config=(OmitSubcommandPrefixes,)
        ).run()

    run_main(run)
