"""docs/yumi_pusher.png: an episode of YuMi Pusher at three times.

MUJOCO_GL=egl python benchmarks/yumi_picture.py (or osmesa)
"""

from pathlib import Path

import mujoco
import numpy as np
from matplotlib.image import imsave

from det2stoc_bayes.models import yumi_pusher
from det2stoc_bayes.models.yumi_pusher_policy import Pusher

OUT = Path(__file__).parents[1] / "docs" / "yumi_pusher.png"
SAMPLES = (0, 40, 100)
HEIGHT, WIDTH = 400, 420


def main() -> int:
    """Frames side by side."""
    random = np.random.default_rng(3)
    psi, start = np.array([yumi_pusher.REALITY.loc]), yumi_pusher.drawn_starts(random, 1)
    full = yumi_pusher.simulate(psi, start, lambda _: Pusher(random), random).full[0]
    spec = mujoco.MjSpec.from_file(str(yumi_pusher.MODEL))
    sky, flat = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_FLAT
    spec.add_texture(name="sky", type=sky, builtin=flat, rgb1=[0.95] * 3, rgb2=[0.95] * 3, width=8, height=48)
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.34, 0.0, 0.24), 1.5, 130.0, -28.0
    frames = []
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for k in SAMPLES:
            data.qpos[:] = full[k, : model.nq]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            frames.append(renderer.render())
    imsave(OUT, np.concatenate(frames, 1))
    print(OUT)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
