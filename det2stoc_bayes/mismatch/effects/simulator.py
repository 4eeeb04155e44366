"""Effects of the simulator itself."""

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter


class NumericalIntegration(Effect):
    """The believed timestep is too coarse: a finer one moves otherwise. Its one value is searched, not inferred."""

    name, kind, law, law_text = "numerical_integration", "simulator", r"\Delta t \to 0", "timestep -> 0"
    noun = "A finer timestep"
    parameters = (EffectParameter("timestep", "s"),)
