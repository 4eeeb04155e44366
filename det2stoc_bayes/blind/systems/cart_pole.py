"""A cart with a hanging pole."""

from det2stoc_bayes.blind.systems.base import System, normal, positive

XML = """  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="track" type="slide" axis="1 0 0" damping="1.5"/>
      <geom name="cart_box" type="box" size="0.1 0.06 0.04" mass="1.0"/>
      <body name="pole">
        <joint name="swing" type="hinge" axis="0 1 0" damping="0.02"/>
        <geom name="pole_rod" type="capsule" fromto="0 0 0 0 0 -0.6" size="0.02" mass="0.35"/>
        <site name="mark" pos="0 0 -0.6"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="track"/>
  </actuator>
"""

SYSTEM = System(
    name="cart_pole",
    title="cart with a hanging pole",
    body_xml=XML,
    psi=(
        normal("cart_mass", "body/cart/mass", 1.0, 0.15),
        positive("pole_damping", "joint/swing/damping", -3.9, 0.3),
        normal("push_gain", "actuator/push/gainprm", 1.0, 0.1, 0),
    ),
    noise_sd={"qpos/track": 1e-3, "qvel/track": 1e-2, "qpos/swing": 2e-3, "qvel/swing": 2e-2},
    start_position=(0.5, 1.2),
    start_velocity=(0.8, 2.0),
    reach=(3.0, 2.4),
    input_scale=(7.0,),
    sampling=(0.01, 0.015, 0.02),
    known="body/pole/mass",
)
