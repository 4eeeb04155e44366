"""The concealed physics, written as plain code on MuJoCo's arrays; independent of every other module."""

from det2stoc_bayes.blind.laws.actuator import ACTUATOR_LAWS
from det2stoc_bayes.blind.laws.base import Effect, Law, Scene
from det2stoc_bayes.blind.laws.body import BODY_LAWS
from det2stoc_bayes.blind.laws.contact import CONTACT_LAWS
from det2stoc_bayes.blind.laws.frame import FRAME_LAWS
from det2stoc_bayes.blind.laws.hard_stop import STOP_LAWS
from det2stoc_bayes.blind.laws.immersed import IMMERSED_LAWS
from det2stoc_bayes.blind.laws.joint import JOINT_LAWS
from det2stoc_bayes.blind.laws.mechanism import MECHANISM_LAWS
from det2stoc_bayes.blind.laws.sensor import SENSOR_LAWS
from det2stoc_bayes.blind.laws.strings import STRING_LAWS
from det2stoc_bayes.blind.laws.unlisted import UNLISTED_LAWS
from det2stoc_bayes.blind.laws.world import WORLD_LAWS

UNLISTED = "unlisted"  # what every law with `variables` is called in answers; asked for by it, any of them is drawn
INTEGRATION = "numerical_integration"  # what the believed model does wrong, not what reality does besides
LAWS: dict[str, Law] = {
    **JOINT_LAWS,
    **STOP_LAWS,
    **MECHANISM_LAWS,
    **BODY_LAWS,
    **IMMERSED_LAWS,
    **STRING_LAWS,
    **WORLD_LAWS,
    **FRAME_LAWS,
    **CONTACT_LAWS,
    **ACTUATOR_LAWS,
    **SENSOR_LAWS,
    INTEGRATION: Law("simulator", {"timestep": "s"}, lambda scene, element: 0.02, lambda m, drawn: {"timestep": m}),
    **UNLISTED_LAWS,
}
NAMES = (*LAWS, UNLISTED)

__all__ = ["INTEGRATION", "LAWS", "NAMES", "UNLISTED", "Effect", "Law", "Scene"]
