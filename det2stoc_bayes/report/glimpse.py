"""One rollout of a diagnosis's fit.nc, short enough to be kept in a log."""

import os
from typing import Any

import numpy as np
import xarray as xr

from det2stoc_bayes.report import series

POINTS, DIGITS = 120, 5


def glimpse(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """The worst predicted column of the worst predicted recording, of held-out ones if there are any.

    `time`, and with None for what is missing `observed`, `before` and `after`. None without rollouts.
    """
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        found = tree["rollouts"].children if "rollouts" in tree.children else {}
        rollouts = {stem: node.to_dataset().load() for stem, node in found.items()}
    if not rollouts:
        return None
    stem = max(rollouts, key=lambda s: (rollouts[s].attrs.get("role") == "holdout", series.misfit(rollouts[s])))
    channel = series.channel_order(rollouts[stem])[0]
    one = rollouts[stem].sel(channel=channel)
    kept = np.unique(np.linspace(0, one.sizes["sample"] - 1, min(POINTS, one.sizes["sample"])).round().astype(int))
    told: dict[str, Any] = {"recording": str(stem), "channel": channel}
    for name in ("time", "observed", "before", "after"):
        if name in one:
            told[name] = [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in one[name].values[kept]]
    return told
