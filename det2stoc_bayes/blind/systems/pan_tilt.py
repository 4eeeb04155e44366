"""A camera head with two position servos, its weight beside the tilt axis."""

from det2stoc_bayes.blind.systems.base import System, normal

XML = """  <worldbody>
    <body name="yoke" pos="0 0 1">
      <joint name="pan" type="hinge" axis="0 0 1" damping="0.1"/>
      <geom name="yoke_box" type="box" size="0.08 0.1 0.02" mass="0.8"/>
      <body name="camera" pos="0 0 0.1">
        <joint name="tilt" type="hinge" axis="0 1 0" damping="0.08"/>
        <geom name="camera_box" type="box" pos="0.06 0 0.02" size="0.1 0.05 0.05" mass="1.1"/>
        <site name="mark" pos="0.16 0 0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="pan_servo" joint="pan" kp="5" kv="0.3"/>
    <position name="tilt_servo" joint="tilt" kp="6" kv="0.25"/>
  </actuator>
"""

SYSTEM = System(
    name="pan_tilt",
    title="pan and tilt head",
    body_xml=XML,
    psi=(
        normal("camera_mass", "body/camera/mass", 1.1, 0.15),
        normal("pan_gain", "actuator/pan_servo/gainprm", 5.0, 0.3, 0),
        normal("tilt_damping", "joint/tilt/damping", 0.08, 0.02),
    ),
    noise_sd={"qpos/*": 1e-3, "qvel/*": 1e-2},
    start_position=(0.8, 0.6),
    start_velocity=(1.0, 1.0),
    reach=(3.0, 1.6),
    input_scale=(1.0, 0.8),
    sampling=(0.01, 0.02),
    timestep=0.002,
    known="joint/pan/damping",
)
