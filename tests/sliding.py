"""A puck that slides over a table: its model, and recordings of one whose friction is another."""

import mujoco
import numpy as np

XML = """<mujoco>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="5 5 0.1" friction="0.3 0.005 0.0001"/>
    <body name="puck" pos="0 0 {}">
      <freejoint name="glide"/>
      <geom name="disc" type="cylinder" size="0.05 0.02" mass="0.2" friction="0.3 0.005 0.0001"/>
    </body>
  </worldbody>
</mujoco>
"""
PSI = """[psi.friction]
target = "geom/*/friction"
index = [0]
prior = { TruncatedNormal = { loc = 0.3, scale = 0.1, low = 0.05, high = 0.6 } }
[noise]
"qpos/*" = 5e-4
"qvel/*" = 1e-2
"""
TRUTH = 0.22
SLIDING = [f"{c}/glide/{p}" for c, p in (("qpos", "x"), ("qpos", "y"), ("qvel", "vx"), ("qvel", "vy"))]
NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz"), ("vx", "vy", "vz", "wx", "wy", "wz")


def slides(height=0.02, count=4):
    """Recordings of a puck that is pushed, with noise."""
    model = mujoco.MjModel.from_xml_string(XML.format(height))
    model.geom_friction[:, 0] = TRUTH
    random, time, out = np.random.default_rng(1), np.arange(31) * 0.01, {}
    for k in range(count):
        data = mujoco.MjData(model)
        data.qvel[:2] = 1.2, 0.3 * k
        rows = []
        for _ in time:
            rows.append(np.concatenate([data.qpos, data.qvel]))
            mujoco.mj_step(model, data, 5)
        values = np.array(rows) + np.repeat([5e-4, 1e-2], [7, 6]) * random.standard_normal((len(time), 13))
        names = [f"qpos/glide/{n}" for n in NAMES[0]] + [f"qvel/glide/{n}" for n in NAMES[1]]
        out[f"r{k}"] = (time, dict(zip(names, values.T, strict=True)))
    return out
