"""Where an effect shows in a study with contact: between which geoms, and in which region."""

import numpy as np
from jaxtyping import Bool

from det2stoc_bayes.engines import contacts
from det2stoc_bayes.mismatch.contact.fit import ContactFit
from det2stoc_bayes.mismatch.contact.followed import BLOCK
from det2stoc_bayes.mismatch.contact.pair import Pair
from det2stoc_bayes.mismatch.effects import Element
from det2stoc_bayes.mismatch.where import LEAST_CONTRAST, LEAST_SHARE, QUANTILES, Condition

MOST_STATES = 600


def elements_of(fit: ContactFit) -> list[Element]:
    """Contacts that simulations make while they follow the recordings."""
    model = fit.problem.simulator.model
    qpos = fit.followed.path(fit.z).qpos.reshape(-1, model.nq)
    qpos = qpos[np.isfinite(qpos).all(1)]
    pairs, there = contacts.touching(model, qpos[:: max(1, len(qpos) // MOST_STATES)])
    often = [p for p, share in zip(pairs, there.mean(0), strict=True) if share >= 2 / MOST_STATES]
    return contacts.contact_elements(model, often)


def touching_blocks(pair: Pair) -> tuple[list[str], Bool[np.ndarray, "blocks pairs"]]:
    """Names of contacts, and in which blocks (fitted, then held out) they are made."""
    model = pair.fit.problem.simulator.model
    states = []
    for fit in (pair.fit, pair.held):
        qpos = fit.followed.path(fit.z).qpos[:, 1:]
        room = fit.followed.blocks * BLOCK - qpos.shape[1]
        qpos = np.pad(np.where(np.isfinite(qpos), qpos, model.qpos0), ((0, 0), (0, room), (0, 0)), mode="edge")
        states.append(qpos.reshape(-1, BLOCK, model.nq)[:, ::2])
    every = np.concatenate(states)
    pairs, there = contacts.touching(model, every.reshape(-1, model.nq))
    names = [contacts.pair_name(model, p) for p in pairs]
    return names, there.reshape(*every.shape[:2], len(pairs)).any(1)


def shares(before: Pair, after: Pair) -> dict[str, float]:
    """Share of the squared error that goes in blocks in which each contact is made."""
    names, there = touching_blocks(after)
    gains = np.maximum(before.losses - after.losses, 0.0)
    total = max(float(gains.sum()), 1e-12)
    return {name: float(gains[there[:, k]].sum() / total) for k, name in enumerate(names)}


def conditions(before: Pair, after: Pair) -> list[Condition]:
    """The rule that holds most of what an effect gains in least of the time; empty if none is telling."""
    gains = np.maximum(before.losses - after.losses, 0.0)
    total = float(gains.sum())
    if not total > 0:
        return []
    best, contrast = [], LEAST_CONTRAST
    names, there = touching_blocks(after)
    for k, name in enumerate(names):
        share, time = float(gains[there[:, k]].sum() / total), float(there[:, k].mean())
        if share >= LEAST_SHARE and share - time > contrast:
            best, contrast = [Condition(f"contact {name}", share, f"contact {name}", 0.5)], share - time
    for variable, values in _columns(after).items():
        for shape, x in (("{} > {:.3g}", values), ("{} < {:.3g}", -values), ("abs({}) > {:.3g}", np.abs(values))):
            for q in QUANTILES:
                threshold = float(np.nanquantile(x, q))
                inside = x > threshold
                share, time = float(gains[inside].sum() / total), float(inside.mean())
                if share >= LEAST_SHARE and share - time > contrast:
                    contrast = share - time
                    shown = -threshold if "<" in shape else threshold
                    best = [_rule(shape.format(variable, shown), share, variable, shown)]
    return best


def _rule(text: str, share: float, variable: str, threshold: float) -> Condition:
    return Condition(text, share, variable, float(f"{threshold:.3g}"), below="<" in text)


def _columns(pair: Pair) -> dict[str, np.ndarray]:
    """Recorded values, a mean over every block."""
    problem = pair.fit.problem
    values = np.concatenate([_middle(pair.fit), _middle(pair.held)])
    return {
        c: values[:, j]
        for j, c in enumerate(problem.segments.columns)
        if not c.startswith("sensor/") and np.isfinite(values[:, j]).all() and not c.rpartition("/")[2].startswith("q")
    }


def _middle(fit: ContactFit) -> np.ndarray:
    values = fit.problem.segments.values[:, 1:]
    room = fit.followed.blocks * BLOCK - values.shape[1]
    blocks = np.pad(values, ((0, 0), (0, room), (0, 0)), mode="edge").reshape(-1, BLOCK, values.shape[2])
    there = np.isfinite(blocks)
    return np.where(there, blocks, 0.0).sum(1) / np.where(there.any(1), there.sum(1), np.nan)
