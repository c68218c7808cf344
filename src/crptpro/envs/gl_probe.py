"""Render one small scene with the backend that MUJOCO_GL names and describe it as JSON on standard output.

Run as a script in a process of its own, because a broken GL driver may hang or crash. It imports MuJoCo
alone, to stay below a second or two.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time

SCENE = """
<mujoco>
  <visual><quality shadowsize="512"/></visual>
  <asset><texture name="t" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="64" height="64"/>
    <material name="m" texture="t" texrepeat="4 4"/></asset>
  <worldbody>
    <light pos="0 0 3"/><geom type="plane" size="2 2 .1" material="m"/><geom type="sphere" size=".4" pos="0
    0 .4"/> <camera name="c" pos="0 -2 2" xyaxes="1 0 0 0 .7 .7"/>
  </worldbody>
</mujoco>
"""


def gl_strings() -> dict[str, str]:
    """Return vendor, renderer and version of the GL context that is current, and whether it is software."""
    from OpenGL import GL

    def ask(name: int) -> str:
        answer = GL.glGetString(name)
        return answer.decode(errors="replace") if answer else "unknown"

    renderer = ask(GL.GL_RENDERER)
    is_software = any(name in renderer.lower() for name in ("llvmpipe", "softpipe", "swrast", "software"))
    return {
        "gl_vendor": ask(GL.GL_VENDOR),
        "gl_renderer": renderer,
        "gl_version": ask(GL.GL_VERSION),
        "gl_kind": "software" if is_software else "hardware",
    }


def probe() -> dict[str, object]:
    """Render two frames; returns the GL strings, the seconds they took and whether the image has content."""
    start = time.perf_counter()
    import mujoco

    if not hasattr(mujoco, "Renderer"):  # MuJoCo hides why its backend cannot be imported
        importlib.import_module(f"mujoco.{os.environ['MUJOCO_GL']}")
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, 84, 84)
    renderer.update_scene(data, camera="c")
    first = renderer.render()
    first_frame_s = time.perf_counter() - start
    start = time.perf_counter()
    second = renderer.render()
    frame_s = time.perf_counter() - start
    answer: dict[str, object] = {
        **gl_strings(),
        "first_frame_s": round(first_frame_s, 3),
        "frame_ms": round(frame_s * 1e3, 2),
        "alive": bool(first.max() > first.min() and (first == second).all()),
    }
    renderer.close()
    return answer


if __name__ == "__main__":
    json.dump(probe(), sys.stdout)
