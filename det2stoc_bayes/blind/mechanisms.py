"""The believed systems' mechanics as MJCF."""

HEADER = """<mujoco model="{title}">
  <option timestep="{timestep}" integrator="{integrator}" gravity="0 0 -9.81"/>
  <default>
    <geom contype="0" conaffinity="0"/>
  </default>
"""

CART_POLE = """  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="track" type="slide" axis="1 0 0" damping="1.5"/>
      <geom name="cart_box" type="box" size="0.1 0.06 0.04" mass="1.0"/>
      <body name="pole">
        <joint name="swing" type="hinge" axis="0 1 0" damping="0.02"/>
        <geom name="pole_rod" type="capsule" fromto="0 0 0 0 0 -0.6" size="0.02" mass="0.35"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="track"/>
  </actuator>
</mujoco>
"""

PENDULUM = """  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.06"/>
      <geom name="rod_tube" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.025" mass="1.0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="drive" joint="pivot"/>
  </actuator>
</mujoco>
"""

ARM = """  <worldbody>
    <body name="upper_arm" pos="0 0 1.2">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.5"/>
      <geom name="upper_tube" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1.5"/>
      <body name="forearm" pos="0 0 -0.4">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.25"/>
        <geom name="fore_tube" type="capsule" fromto="0 0 0 0 0 -0.35" size="0.025" mass="0.9"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder"/>
    <motor name="elbow_motor" joint="elbow"/>
  </actuator>
</mujoco>
"""

SLIDER = """  <worldbody>
    <body name="carriage" pos="0 0 0.5">
      <joint name="rail" type="slide" axis="1 0 0" stiffness="60" damping="2.0"/>
      <geom name="carriage_box" type="box" size="0.08 0.05 0.04" mass="2.0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="coil" joint="rail"/>
  </actuator>
</mujoco>
"""
