"""An arm with seven joints and position servos."""

from det2stoc_bayes.blind.systems.base import System, normal, positive

LINKS = (
    # link, joint, axis, position in its parent, end, radius, mass, stiffness, damping of the servo
    ("link1", "j1", "0 0 1", "0 0 0.3", "0 0 0.3", 0.06, 4.0, 180.0, 22.0),
    ("link2", "j2", "0 1 0", "0 0 0.3", "0 0 0.25", 0.05, 3.0, 180.0, 22.0),
    ("link3", "j3", "0 0 1", "0 0 0.25", "0 0 0.2", 0.05, 2.0, 120.0, 14.0),
    ("link4", "j4", "0 1 0", "0 0 0.2", "0 0 0.25", 0.045, 2.0, 120.0, 14.0),
    ("link5", "j5", "0 0 1", "0 0 0.25", "0 0 0.15", 0.04, 1.2, 60.0, 6.0),
    ("link6", "j6", "0 1 0", "0 0 0.15", "0 0 0.1", 0.04, 0.9, 60.0, 6.0),
    ("link7", "j7", "0 0 1", "0 0 0.1", "0.08 0 0.06", 0.03, 0.6, 30.0, 3.0),
)


def _xml() -> str:
    """The links inside one another, then a servo on each joint."""
    opened, servos = "", "  </worldbody>\n  <actuator>\n"
    for depth, (link, joint, axis, place, end, radius, mass, stiffness, damping) in enumerate(LINKS):
        pad = "  " * (depth + 2)
        opened += f"""{pad}<body name="{link}" pos="{place}">
{pad}  <joint name="{joint}" type="hinge" axis="{axis}" damping="1.0" armature="0.15"/>
{pad}  <geom name="{link}_tube" type="capsule" fromto="0 0 0 {end}" size="{radius}" mass="{mass}"/>
"""
        servos += f'    <position name="servo{depth + 1}" joint="{joint}" kp="{stiffness:g}" kv="{damping:g}"/>\n'
    pad = "  " * (len(LINKS) + 1)
    opened += f'{pad}  <site name="mark" pos="0.08 0 0.06"/>\n'
    closed = "".join("  " * (depth + 2) + "</body>\n" for depth in reversed(range(len(LINKS))))
    return "  <worldbody>\n" + opened + closed + servos + "  </actuator>\n"


SYSTEM = System(
    name="servo_arm",
    title="arm with seven servos",
    body_xml=_xml(),
    psi=(
        normal("link2_mass", "body/link2/mass", 3.0, 0.4),
        normal("link4_mass", "body/link4/mass", 2.0, 0.3),
        normal("link7_mass", "body/link7/mass", 0.6, 0.12),
        normal("j2_damping", "joint/j2/damping", 1.0, 0.25),
        normal("j4_damping", "joint/j4/damping", 1.0, 0.25),
        positive("j6_damping", "joint/j6/damping", 0.0, 0.4),
        normal("j4_gain", "actuator/servo4/gainprm", 120.0, 6.0, 0),
    ),
    noise_sd={"qpos/*": 5e-4, "qvel/*": 1e-2},
    start_position=(0.8, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8),
    start_velocity=(0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5),
    reach=(2.5, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5),
    input_scale=(0.8, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8),
    sampling=(0.01, 0.02),
    known="body/link5/mass",
)
