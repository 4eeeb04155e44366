"""Is it said that psi_0 excludes the truth? Tried with the source's psi_0 and with one whose wind is too weak."""

from typing import Any

import numpy as np

from det2stoc_bayes.doubts import ALARM
from det2stoc_bayes.inference._amortized import Options, Population, iterate
from det2stoc_bayes.models import windy_slope
from det2stoc_bayes.reproduce.work import Work

PRIORS = {"psi_0": windy_slope.PRIOR, "psi_0 with wind from -1 to 1 m/s": windy_slope.CALM_PRIOR}


def alarms(work: Work) -> dict[str, Any]:
    """Each prior's probabilities that the population's mean is outside of it, by seed and psi; the alarms raised.

    One decoder a prior; every seed has its own recordings and its own encoder.
    """
    settings, out = work.settings, {}
    recorded = [
        work.recorded(number, work.scene.real_episodes[0]).transitions
        for number in range(settings.num_seeds if settings.num_alarm else 0)
    ]
    for name, prior in PRIORS.items() if settings.num_alarm else ():
        psi = prior.draw(work.random(7), settings.num_alarm)
        simulated = work.simulate(psi, "simulating for the alarm", 7).transitions
        each, believed = np.repeat(psi, windy_slope.NUM_STEPS, 0), Population.of(psi)
        options = Options.decoding(settings.decoder_steps)
        decoder, turns = None, []
        for number, real in enumerate(recorded):
            key = work.key("alarm", number)
            found = iterate(real, simulated, each, believed, key, options, work.progress, decoder)
            decoder = found.pretrained
            turns.append(found)
        out[name] = {
            "outside": [t.outside.mean(0).tolist() for t in turns],
            "alarm": [t.alarm for t in turns],
            "raised": sum(t.alarm > ALARM for t in turns),
        }
    return out
