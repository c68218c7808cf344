"""From a task's name to a TorchRL environment that emits stacks of uint8 frames."""

from __future__ import annotations

import logging
from typing import Any

from torchrl.envs import CatFrames, EnvBase

from crptpro.colors import COLORS, Colors
from crptpro.domains import GYMNASIUM_PREFIX, LONGEST_EPISODE_AGENT_STEPS, Domain, get_domain
from crptpro.envs.dm_stack import FAST_SHADOW_SIZE, DmControlSimulator, SceneCamera, load_dm_env
from crptpro.envs.episode_limit import EpisodeLimit
from crptpro.envs.gymnasium_env import GymnasiumSimulator
from crptpro.envs.own_env import fixed_action_repeat, make_own_env, repeats_actions, with_transform
from crptpro.envs.pixel_env import PixelEnv
from crptpro.envs.rendering import backend_card, first_frame_watchdog, select_backend
from crptpro.errors import CRPTproError
from crptpro.quality import QUALITIES, Quality
from crptpro.seeding import require_seed

logger = logging.getLogger(__name__)


def make_env(
    task: str | Domain,
    *,
    seed: int,
    image_size: int = 84,
    action_repeat: int | None = None,
    frame_stack: int = 3,
    camera: int | str | None = None,
    quality: Quality = "exact",
    colors: Colors = "normal",
    physics_state: bool = False,
    render: bool = True,
) -> EnvBase:
    """Build an unbatched CPU environment that renders once per agent step.

    Output keys: ``pixels`` uint8 ``[3 * frame_stack, H, W]``, oldest to newest (a reset repeats its first
    frame); ``action`` float32 ``[A]`` in [-1, 1]; ``("next", "reward")`` float32 ``[1]``, summed over the
    repeated env steps; ``done``, ``terminated``, ``truncated`` (time limits truncate; where a world has none,
    1000 agent steps do). Consecutive frames are ``action_repeat`` env steps apart. ``env.set_seed(s)``
    re-seeds the simulator without resetting, and the next ``reset`` starts the episode that belongs to ``s``.
    ``env.card()`` says what shaped the pixels (not in worlds of your own).
    ``env.close()`` frees the render context.

    Args:
        task: Any name that :func:`crptpro.domains.get_domain` knows, or a :class:`~crptpro.domains.Domain`.
        seed: Seed of the simulator's first episode.
        image_size: H = W, pixels.
        action_repeat: Env steps per agent step; ``None`` takes the domain's (2).
        frame_stack: Frames per observation; 1 gives the single frame ``[3, H, W]``.
        camera: Camera index or name; ``None`` takes the domain's.
        quality: ``"exact"`` renders the model as it is; ``"fast"`` uses smaller shadow maps, up to twice as
            fast on software GL, with fewer than 1 % of the pixels changed (quadruped_escape: 8 %).
        colors: ``"reversed_background"`` reverses the order of the RGB values of skybox and floor, the paper's unseen
            colours (dm_control only); ``"reversed_image"`` that of whole images.
        physics_state: Also emit ``qpos`` and ``qvel``, float64, where the world has a MuJoCo state.
        render: ``False`` leaves every image black, for policies that do not look: rewards and episodes are the
            same, ten times sooner. Environments of your own draw all the same.

    Raises:
        UnknownNameError: for a task nobody knows.
        RenderingError: if no GL backend renders.
        CRPTproError: for options or an own environment that cannot be used.
    """
    domain = get_domain(task)
    action_repeat = resolve_action_repeat(domain, action_repeat)
    require_seed(seed)
    _check_options(
        quality, colors, image_size=image_size, action_repeat=action_repeat, frame_stack=frame_stack
    )
    settings: dict[str, Any] = {
        "image_size": image_size, "action_repeat": action_repeat, "quality": quality, "colors": colors,
        "camera": domain.camera if camera is None else camera, "physics_state": physics_state,
    }  # fmt: skip
    env: EnvBase
    if colors == "reversed_background" and domain.source not in ("suite", "manipulation"):
        raise CRPTproError(
            f"What the background of {domain.name!r} is, is known for dm_control's worlds alone; "
            "colors='reversed_image' reverses the colours of whole images in any world."
        )
    if domain.source == "own":
        env = make_own_env(domain, seed=seed, **settings)
    elif domain.source == "gymnasium":
        env = _make_gymnasium_env(domain, render=render, **settings)
    else:
        env = _make_dm_env(domain, render=render, **settings)
    if colors == "reversed_image":
        # Imported late: transforms stand on networks, which no environment needs.
        from crptpro.transforms.color_swap import ColorSwap

        env = with_transform(env, ColorSwap(in_keys=["pixels"]))
    if domain.episode_env_steps is None:
        env = with_transform(env, EpisodeLimit(LONGEST_EPISODE_AGENT_STEPS))
    env.set_seed(seed)
    if frame_stack == 1:
        return env
    return with_transform(env, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))


def resolve_action_repeat(task: str | Domain, action_repeat: int | None = None) -> int:
    """Return the env steps of one agent step: as asked, or the domain's.

    A world of your own whose ``make`` takes no ``action_repeat`` has 1, or what a ``partial`` of it binds; asked for
    another number, it warns.

    Raises:
        CRPTproError: asked for less than one.
    """
    if action_repeat is not None:
        _require_count("action_repeat", action_repeat)
    domain = get_domain(task)
    if domain.source == "own" and not repeats_actions(domain):
        fixed = fixed_action_repeat(domain)
        if action_repeat not in (None, fixed):
            logger.warning(
                "The make of domain %r takes no action_repeat: a decision is %d env step(s), not %d.",
                domain.name, fixed, action_repeat,
            )  # fmt: skip
        return fixed
    return domain.action_repeat if action_repeat is None else action_repeat


def episode_length(task: str | Domain, *, action_repeat: int | None = None) -> int | None:
    """Return the agent steps of a full episode (500; manipulation 125), ``None`` if unknown or unlimited."""
    domain = get_domain(task)
    repeat = resolve_action_repeat(domain, action_repeat)
    return None if domain.episode_env_steps is None else -(-domain.episode_env_steps // repeat)


def needs_gl(task: str | Domain) -> bool:
    """Tell whether MuJoCo draws the frames, so that a GL backend must be chosen and proven first.

    dm_control's worlds need one, and Gymnasium's where MuJoCo or its robotics package simulates. Other Gymnasium
    worlds (``gymnasium:Pendulum-v1``) and your own draw by themselves; a dataset of theirs names no backend.
    """
    domain = get_domain(task)
    if domain.source != "gymnasium":
        return domain.source != "own"
    import gymnasium

    made_by = str(gymnasium.spec(domain.task[len(GYMNASIUM_PREFIX) :]).entry_point).lower()
    return any(name in made_by for name in ("mujoco", "dm_control", "gymnasium_robotics"))


def _check_options(quality: str, colors: str, **counts: int) -> None:
    for name, value in counts.items():
        _require_count(name, value)
    if quality not in QUALITIES:
        raise CRPTproError(f"quality must be {' or '.join(map(repr, QUALITIES))}, got {quality!r}.")
    if colors not in COLORS:
        raise CRPTproError(f"colors must be {', '.join(map(repr, COLORS))}, got {colors!r}.")


def _require_count(name: str, value: int) -> None:
    if value < 1:
        raise CRPTproError(f"{name} must be at least 1, got {value}.")


def _make_dm_env(
    domain: Domain,
    *,
    image_size: int,
    action_repeat: int,
    camera: int | str,
    quality: Quality,
    colors: Colors,
    physics_state: bool,
    render: bool,
) -> PixelEnv:
    select_backend()
    shadow_size = FAST_SHADOW_SIZE[domain.source] if quality == "fast" else None
    with first_frame_watchdog():  # composer renders once when it is built
        env = load_dm_env(domain)
    description = {
        "task": domain.task, "image_size": image_size, "camera": camera, **backend_card(), "quality": quality,
        "colors": colors,
    }  # fmt: skip
    scene_camera = SceneCamera(
        image_size, camera, shadow_size, reverses_background=colors == "reversed_background"
    )
    scene_camera.prepare(env.physics)
    simulator = DmControlSimulator(env, scene_camera, action_repeat=action_repeat, description=description)
    return PixelEnv(simulator, image_size=image_size, physics_state=physics_state, render=render)


def _make_gymnasium_env(
    domain: Domain,
    *,
    image_size: int,
    action_repeat: int,
    camera: int | str | None,
    quality: Quality,
    colors: Colors,
    physics_state: bool,
    render: bool,
) -> PixelEnv:
    gl_card: dict[str, Any] = {"backend": "none"}
    if needs_gl(domain):
        select_backend()
        gl_card = backend_card()
    simulator = GymnasiumSimulator(
        domain.task[len(GYMNASIUM_PREFIX) :],
        image_size=image_size,
        action_repeat=action_repeat,
        camera=camera,
        shadow_size=FAST_SHADOW_SIZE["suite"] if quality == "fast" else None,
        description={
            "task": domain.task, "image_size": image_size, "camera": camera, **gl_card, "quality": quality,
            "colors": colors,
        },
    )  # fmt: skip
    return PixelEnv(simulator, image_size=image_size, physics_state=physics_state, render=render)
