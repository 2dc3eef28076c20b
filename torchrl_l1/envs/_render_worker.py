"""Draws MuJoCo poses off screen; run as a script in its own process.

``python _render_worker.py INPUT.npz MODEL.mjb OUTPUT.npy``. MuJoCo chooses its OpenGL backend when
first imported, from the variable MUJOCO_GL, and a broken driver may crash the process: both require
a separate process. The script imports only MuJoCo and NumPy so that it starts fast.
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np


def render(model: mujoco.MjModel, qpos: np.ndarray, width: int, height: int) -> np.ndarray:
    """Draw one image for each pose.

    Args:
        model: the MuJoCo model; its camera "track" is used if it has one.
        qpos: poses ``(T, nq)``.
        width: pixels.
        height: pixels.

    Returns:
        RGB images ``(T, height, width, 3)``, uint8.
    """
    # The buffer that the XML requests may be smaller than the image.
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.distance *= 0.8  # MuJoCo's default leaves wide margins
    tracking = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    frames = np.empty((len(qpos), height, width, 3), dtype=np.uint8)
    with mujoco.Renderer(model, height, width) as renderer:
        for pose, frame in zip(qpos, frames, strict=True):
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera=camera if tracking < 0 else tracking)
            renderer.render(out=frame)
    return frames


if __name__ == "__main__":
    with np.load(sys.argv[1]) as arrays:
        poses, (columns, lines) = arrays["qpos"], arrays["size"].tolist()
    np.save(
        sys.argv[3], render(mujoco.MjModel.from_binary_path(sys.argv[2]), poses, columns, lines)
    )
