"""The page of an experiment on a scene: log likelihoods beside the source's, recovered psi, the source's figures."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from det2stoc_bayes.report import canvas, numbers, page
from det2stoc_bayes.report.canvas import Spec
from det2stoc_bayes.report.episode_figures import episode_figure, population_rows

METRICS = {
    "matched": "Matched Gaussian", "mixture": "Mixture of z", "one_latent": "One z", "energy": "Energy score",
    "pit_distance": "PIT distance", "rollout_energy": "Rollouts: energy", "rollout_pit_distance": "Rollouts: PIT",
}  # fmt: skip
SHADES = ("var(--muted)", canvas.BEFORE, canvas.OBSERVED, canvas.AFTER, "var(--text)")
CELL, COLUMNS = 120, 3  # of the grid of densities
SIDES = {"side": (1, 2), "above": (1, 0)}  # coordinates to the right and up


def scene_page(result: Mapping[str, Any]) -> str:
    """The report as html text, from results.json's content."""
    rows, settings = result["rows"], result["settings"]
    main = [r for r in rows if not r["variant"]]
    ours = max((r for r in main if r["name"].startswith("det2stoc")), key=lambda r: r["metrics"]["matched"][0])
    rival = max((r for r in main if r["name"].startswith("baseline")), key=lambda r: r["metrics"]["matched"][0])
    ahead = ours["metrics"]["matched"][0] - rival["metrics"]["matched"][0]
    scene = result["scene"]
    largest = [r["name"] for r in rows if r["name"].startswith("baseline")][-1]
    shown = ["simulator", _iterations(result["seeds"][0]["models"])[-1], largest]
    return page.render(
        "scene.html.j2",
        title=f"{scene['title']}: det2stoc against a CVAE",
        verdict="mismatch",  # whose page has two colours
        badge_kind="no_mismatch" if ahead > 0 else "mismatch",
        badge="det2stoc ahead" if ahead > 0 else "baseline ahead",
        ours=ours,
        rival=rival,
        ahead=numbers.number(ahead),
        result=result,
        settings=settings,
        headings=list(METRICS.values()),
        models=[_model(r) for r in rows],
        oracles=_oracles(result),
        likelihood=page.embedded(likelihood_figure(main, result["oracles"], scene["oracles"])),
        blocks=_blocks(result),
        recovered=[row for j in range(len(scene["names"])) for row in _recovered(result, j)],
        populations=population_rows(result["populations"]),
        episodes=[
            (name, page.embedded(episode_figure(result["seeds"], result["exact"], j, unit)))
            for j, (name, unit) in enumerate(zip(scene["names"], scene["units"], strict=True))
            if result["exact"]
        ],
        alarms=[_alarm(name, found) for name, found in result["alarms"].items()],
        posterior_height=canvas.ROW * settings["num_iterations"],
        posteriors=[
            (name, page.embedded(posterior_figure(result["seeds"][0]["models"], result["truth"], j, unit)))
            for j, (name, unit) in enumerate(zip(scene["names"], scene["units"], strict=True))
        ],
        poses=[(side, page.embedded(pose_figure(result["figures"]["poses"], side))) for side in SIDES],
        sweeps=[
            {"name": s["name"], "figure": page.embedded(sweep_figure(s)), "legend": _legend(s)}
            for s in result["figures"]["sweeps"]
        ],
        densities=[
            (d["step"], page.embedded(density_figure(d, shown, scene["shown"]))) for d in result["figures"]["densities"]
        ],
        samples=[p["sample"] for p in result["figures"]["poses"]],
        shown=shown,
        density_height=CELL * -(-len(scene["shown"]) // COLUMNS),
        number=numbers.number,
    )


def _iterations(models: Mapping[str, Any]) -> list[str]:
    """Those of the models that know psi."""
    return [name for name, model in models.items() if "population" in model]


def _model(row: Mapping[str, Any]) -> dict[str, Any]:
    source = numbers.plus_minus(*row["source"]) if row["source"] else numbers.MISSING
    values = [_spread(row["metrics"][m]) for m in METRICS]
    return {"name": row["name"], "real": row["real"], "source": source, "values": values}


def _oracles(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Where psi comes from, and the log likelihood."""
    told = result["scene"]["oracles"].items()
    return [
        (text, numbers.number(result["oracles"][key], 4)) for key, text in told if result["oracles"][key] is not None
    ]


def _blocks(result: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Models and oracles: matched log densities of the state's blocks."""
    names = result["scene"]["blocks"]
    if not names:
        return []
    out = [(r["name"], [_spread(r["metrics"][name]) for name in names]) for r in result["rows"]]
    for key, text in result["scene"]["oracles"].items():
        found = result["oracles"]["blocks"][key]
        out.append((f"oracle: psi from {text}", [numbers.number(found[name], 4) for name in names]))
    return out


def _spread(pair: Sequence[float | None]) -> str:
    """Mean and sd over seeds, where there are several."""
    return numbers.number(pair[0], 4) if pair[1] is None else numbers.plus_minus(*pair)


def _alarm(name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """A prior, in how many seeds it was said to exclude the truth, and the mean probabilities of that."""
    shares = [numbers.number(p) for p in (np.mean(found["alarm"]), *np.mean(found["outside"], axis=0))]
    return {"prior": name, "raised": f"{found['raised']} of {len(found['alarm'])}", "shares": shares}


def _legend(sweep: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Colour and text of each value."""
    unit = "" if sweep["unit"] == "1" else f" {sweep['unit']}"
    return [(c, f"{numbers.number(v)}{unit}") for c, v in zip(SHADES, sweep["values"], strict=True)]


def _recovered(result: Mapping[str, Any], j: int) -> list[dict[str, str]]:
    """A psi in every iteration: what was drawn, the population's posterior, the source's figure, KL of its latent."""
    out = []
    for name in _iterations(result["seeds"][0]["models"]):
        of = [s["models"][name] for s in result["seeds"]]

        def mean(*keys: str, of=of) -> float:
            found = of
            for key in keys:
                found = [o[key] for o in found]
            return float(np.mean([f[j] for f in found]))

        out.append(
            {
                "psi": result["scene"]["names"][j],
                "model": name,
                "drawn": numbers.plus_minus(mean("drawn", "mean"), mean("drawn", "sd")),
                "population": numbers.plus_minus(mean("population", "mean"), mean("population", "sd")),
                "pooled": numbers.plus_minus(mean("pooled", "mean"), mean("pooled", "sd")),
                "divergence": numbers.number(mean("divergences")),
            }
        )
    return out


def likelihood_figure(
    rows: Sequence[Mapping[str, Any]], oracles: Mapping[str, Any], sources: Mapping[str, str]
) -> Spec:
    """Log likelihood of the test set against the number of recorded transitions."""
    traces = []
    for kind, colour in (("baseline", canvas.BEFORE), ("det2stoc", canvas.AFTER)):
        mine = [r for r in rows if r["name"].startswith(kind)]
        x, y = np.array([r["real"] for r in mine], float), np.array([r["metrics"]["matched"] for r in mine], float)
        bars = {"type": "data", "array": np.nan_to_num(y[:, 1]).tolist(), "color": colour}
        traces.append(
            canvas.line(x, y[:, 0], kind, colour, mode="lines+markers", error_y=bars, text=[r["name"] for r in mine],
                        hovertemplate="%{text}: %{y:.4~g}<extra></extra>")
        )  # fmt: skip
    reals = [r["real"] for r in rows]
    span = np.array([min(reals) / 1.2, 1.2 * max(reals)])
    for key, text in sources.items():
        if oracles[key] is None:
            continue
        name = f"oracle: psi from {text}"
        level = np.full(2, oracles[key])
        traces.append(canvas.line(span, level, name, canvas.OBSERVED, line={"dash": "dot"}, hovertemplate="%{y:.4~g}"))
    axes = {"xaxis": canvas.axis("recorded transitions", type="log"), "yaxis": canvas.axis("nat a transition")}
    return {"data": traces, "layout": canvas.layout(320, **axes, hovermode="closest")}


def posterior_figure(models: Mapping[str, Any], truth: Mapping[str, Any], j: int, unit: str) -> Spec:
    """Histograms of q's samples over the recordings, by iteration, beside the population that was drawn from."""
    names = _iterations(models)
    every = [np.array(models[n]["pooled_draws"][j]) for n in names]
    mean, sd = truth["mean"][j], truth["sd"][j]
    low, high = (f([mean - 4 * sd, mean + 4 * sd, *np.quantile(np.concatenate(every), q)]) for f, q in
                 ((min, [0.01]), (max, [0.99])))  # fmt: skip
    x = np.linspace(low, high, 201)
    traces, axes = [], []
    for row, draws in enumerate(every):
        heights, edges = np.histogram(draws, np.linspace(low, high, 61), density=True)
        bars = {"type": "bar", "x": canvas.array((edges[:-1] + edges[1:]) / 2), "y": canvas.array(heights)}
        style = {"marker": {"color": canvas.soft(canvas.AFTER)}, "yaxis": canvas.y_name(row), "hoverinfo": "skip"}
        traces.append(bars | style | {"name": names[row]})
        truth_line = {"y_axis": canvas.y_name(row), "line": {"dash": "dot"}}
        traces.append(canvas.line(x, norm.pdf(x, mean, sd), "truth", canvas.OBSERVED, **truth_line))
        axes.append({"rangemode": "tozero"})
    title = "" if unit == "1" else f"[{unit}]"
    return {"data": traces, "layout": canvas.panels(names, title, axes) | {"bargap": 0.0}}


def pose_figure(poses: Sequence[Mapping[str, Any]], side: str) -> Spec:
    """Recordings laid over each other at some samples; the hidden block inside the box."""
    right, up = SIDES[side]
    traces = []
    for pose, colour in zip(poses, (canvas.OBSERVED, canvas.BEFORE, canvas.AFTER), strict=True):
        for part, width, dash in (("box", 1.0, "solid"), ("block", 0.7, "dot")):
            x, y = [], []
            for outline in pose[part]:
                for edge in outline:
                    x += [point[right] for point in edge] + [None]
                    y += [point[up] for point in edge] + [None]
            trace = {"type": "scatter", "mode": "lines", "x": x, "y": y, "hoverinfo": "skip", "opacity": 0.5}
            traces.append(trace | {"line": {"color": colour, "width": width, "dash": dash}})
    titles = ["x [m]", "y [m]", "z [m]"]
    axes = {"xaxis": canvas.axis(titles[right]), "yaxis": canvas.axis(titles[up], scaleanchor="x")}
    return {"data": traces, "layout": canvas.layout(380, **axes)}


def sweep_figure(sweep: Mapping[str, Any]) -> Spec:
    """The box's place over time for several values of one psi."""
    traces, names = [], ["x [m]", "y [m]", "z [m]"]
    for value, path, colour in zip(sweep["values"], sweep["position"], SHADES, strict=True):
        path = np.asarray(path)
        time = 0.04 * np.arange(len(path))
        for row in range(3):
            hover = "%{y:.3~g}"
            traces.append(
                canvas.line(time, path[:, row], f"{value:.3g}", colour, y_axis=canvas.y_name(row), hovertemplate=hover)
            )
    return {"data": traces, "layout": canvas.panels(names, "time [s]", [{}, {}, {}])}


def density_figure(found: Mapping[str, Any], shown: Sequence[str], state: Sequence[str]) -> Spec:
    """p(s' - s | s) in each of the dimensions, with KL(simulator || model)."""
    rows = -(-len(state) // COLUMNS)
    spec = canvas.layout(CELL * rows, annotations=[])
    traces = []
    for i, name in enumerate(state):
        row, column = divmod(i, COLUMNS)
        x_name, y_name = (f"{axis}{i + 1}" if i else axis for axis in "xy")
        left, top = column / COLUMNS, 1 - row / rows
        room = {"domain": [left, left + 0.92 / COLUMNS], "anchor": y_name, "nticks": 3}
        spec["xaxis" + x_name[1:]] = canvas.axis(**room, tickfont={"size": 9})
        own = {"domain": [top - 0.55 / rows, top - 0.15 / rows], "anchor": x_name, "showticklabels": False}
        spec["yaxis" + y_name[1:]] = canvas.axis(**own, rangemode="tozero")
        edges = np.asarray(found["edges"][i])
        middle = (edges[:-1] + edges[1:]) / 2
        for which, colour in zip(shown, (canvas.OBSERVED, canvas.AFTER, canvas.BEFORE), strict=True):
            height = np.asarray(found["heights"][which][i])
            traces.append(canvas.line(middle, height, which, colour, width=1.2, y_axis=y_name, xaxis=x_name))
        apart = " / ".join(numbers.number(found["divergence"][which][i], 2) for which in shown[1:])
        place = {"x": left, "y": top - 0.14 / rows, "xref": "paper", "yref": "paper", "showarrow": False}
        style = {"xanchor": "left", "yanchor": "bottom", "font": {"size": 11, "color": "var(--text)"}}
        spec["annotations"].append({"text": f"{name}: KL {apart}"} | place | style)
    return {"data": traces, "layout": spec}
