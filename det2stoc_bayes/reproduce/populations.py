"""What each seed's recordings had drawn of psi, beside the populations that are inferred from them."""

from collections.abc import Sequence
from typing import Any

from det2stoc_bayes.reproduce.scene import Scene


def populations_table(scene: Scene, seeds: Sequence[dict[str, Any]], exact: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means and sds after the last iteration, by psi and seed; `exact`: of the seeds that have it."""
    rows = []
    for j, name in enumerate(scene.names):
        for seed in seeds:
            last = [m for m in seed["models"].values() if "population" in m][-1]
            held = [last["drawn"], last["population"], *(e["population"] for e in exact[seed["seed"] :][:1])]
            rows.append([name, str(seed["seed"]), *(value[which][j] for value in held for which in ("mean", "sd"))])
    kinds = ["drawn", "det2stoc", *(["exact"] if exact else [])]
    return {
        "title": "psi of the population that the recorded episodes come from, after the last iteration",
        "columns": ["psi", "seed>", *(heading for kind in kinds for heading in (f"{kind}>", "sd>"))],
        "rows": rows,
    }
