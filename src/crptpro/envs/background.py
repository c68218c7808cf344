"""Which part of a MuJoCo model is its background, and its colours in reverse."""

from __future__ import annotations

from typing import Any

import numpy as np

from crptpro.errors import CRPTproError


def reverse_background(model: Any) -> None:
    """Reverse the order of the red, green and blue values of a model's background, in place.

    The paper tests unseen colours by reversing the RGB values of the background, without saying what that is. Here it
    is the skybox, and the planes and height fields that are fixed to the world (floor, walls, terrain): their textures,
    and the colours of the materials and geoms that tint them. A material or texture that something else wears too
    keeps its colours: everything that moves looks as before.

    Call it before the render context is made, which is when textures are copied to it, and once per compiled model:
    twice restores the colours.

    Args:
        model: ``mujoco.MjModel``, 3.2 or later.

    Raises:
        CRPTproError: if the model has no background to reverse.
    """
    import mujoco

    sheets = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    is_fixed = model.body_weldid[model.geom_bodyid] == 0
    is_background = is_fixed & np.isin(model.geom_type, [int(kind) for kind in sheets])
    materials = _exclusive(model.geom_matid, is_background)
    worn_by_others = np.setdiff1d(np.arange(model.nmat), materials)
    roles = [int(mujoco.mjtTextureRole.mjTEXROLE_RGB), int(mujoco.mjtTextureRole.mjTEXROLE_RGBA)]
    textures = np.setdiff1d(model.mat_texid[materials][:, roles], model.mat_texid[worn_by_others])
    skyboxes = np.flatnonzero(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX))
    textures = np.union1d(textures[textures >= 0], skyboxes)
    if not (textures.size or is_background.any()):
        raise CRPTproError(
            "This model has no background whose colours could be reversed: no skybox, and no plane or height field "
            "that is fixed to the world. colors='reversed_image' works everywhere."
        )
    for texture in textures:
        first, channels = model.tex_adr[texture], model.tex_nchannel[texture]
        if channels < 3:
            continue
        values = model.tex_data[
            first : first + model.tex_height[texture] * model.tex_width[texture] * channels
        ]
        texels = values.reshape(-1, channels)
        texels[:, :3] = texels[:, 2::-1].copy()
    model.mat_rgba[materials, :3] = model.mat_rgba[materials, 2::-1]
    model.geom_rgba[is_background, :3] = model.geom_rgba[is_background, 2::-1]


def _exclusive(used: np.ndarray, is_background: np.ndarray) -> np.ndarray:
    """Return the indices that the background uses and nothing else does."""
    found = np.setdiff1d(used[is_background], used[~is_background])
    return found[found >= 0]
