"""``crptpro evaluate``: whole episodes of a trained agent, or of chance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from crptpro.cli.request import require_writable
from crptpro.colors import Colors
from crptpro.errors import CRPTproError
from crptpro.quality import Quality


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a trained agent, or the uniform random policy, for whole episodes."""

    agent: Positional[str]
    """directory of an agent (OUT/agent of a downstream run), or `random-policy`"""
    task: str | None = None
    """task to act in (default: the agent's own)"""
    episodes: int = 10
    """whole episodes"""
    seed: int = 0
    """seeds the episodes"""
    quality: Quality | None = None
    """render quality (default: the one the agent was trained with; exact for the random policy)"""
    colors: Colors | None = None
    """colours of the world (default: those the agent was trained in; normal for the random policy)"""
    action_repeat: int | None = None
    """simulator steps per decision (default: what the agent was trained with; the domain's for the random policy)"""
    csv: Path | None = None
    """write one row per episode here"""
    video: Path | None = None
    """write the first episode as MP4 here (needs the `video` extra)"""

    def run(self) -> None:
        """Print mean and deviation, and write what was asked for."""
        from crptpro.envs import make_env
        from crptpro.experiments.row_files import write_rows
        from crptpro.training import evaluate, load_agent, summarize, uniform_policy
        from crptpro.training.video import can_encode, write_video

        is_random = self.agent == "random-policy"
        if is_random and self.task is None:
            raise CRPTproError(
                "The random policy has no task of its own; name one with --task, e.g. --task walker_run."
            )
        if self.csv is not None:
            require_writable(self.csv)  # before an hour of episodes
        if self.video is not None:
            require_writable(self.video, "--video")
            if not can_encode():
                raise CRPTproError("--video needs the `video` extra: pip install 'crptpro[video]'.")
        agent, card = (None, {}) if is_random else load_agent(self.agent)
        task = self.task or card["task"]
        trained_with = card.get("config", {})
        settings: dict[str, Any] = {"quality": self.quality or trained_with.get("quality", "exact")}
        settings["colors"] = self.colors or trained_with.get("colors", "normal")
        if agent is not None:
            settings["image_size"] = agent.encoder.image_size
            settings["frame_stack"] = agent.encoder.in_channels // 3
            settings["action_repeat"] = trained_with.get("action_repeat")
        if self.action_repeat is not None:
            settings["action_repeat"] = self.action_repeat
        # Chance does not look; without a video there is nothing to draw.
        settings["render"] = agent is not None or self.video is not None
        env = make_env(task, seed=self.seed, **settings)
        try:
            action_dim = env.action_spec.shape[-1]
            if agent is not None and agent.actor.action_dim != action_dim:
                raise CRPTproError(
                    f"The agent was trained for {agent.actor.action_dim} actions ({card['task']}), "
                    f"{task} has {action_dim}; choose a task of the agent's own domain."
                )
            episodes, videos = evaluate(
                agent or uniform_policy(env, seed=self.seed),
                env,
                episodes=self.episodes,
                seed=self.seed,
                record_episodes=int(self.video is not None),
            )
        finally:
            env.close()
        scores = summarize(episodes)
        print(
            f"{task}: {scores['mean']:.1f} ± {scores['std']:.1f} "
            f"({scores['min']:.1f} to {scores['max']:.1f}) over {len(episodes)} episodes"
        )
        if self.csv is not None:
            about = {"task": task, "agent": self.agent}
            columns = ("episode", "episode_return", "agent_steps", "seed")
            rows = ({**about, **{name: getattr(e, name) for name in columns}} for e in episodes)
            write_rows(self.csv, (*about, *columns), rows)
        if self.video is not None and write_video(videos[0], self.video) is None:
            raise CRPTproError(f"--video {self.video} was not written; the warning above says why.")
