"""The page of a diagnosis: complete, self-contained, safe with hostile names, and drawn by a browser."""

import copy
import json
import re
from html.parser import HTMLParser

import numpy as np
import plotly.graph_objects as go
import pytest
import xarray as xr
from plotly.offline import get_plotlyjs

from det2stoc_bayes.mismatch.finding import Finding
from det2stoc_bayes.report import diagnosis_page, replay
from det2stoc_bayes.report.page import asset

HEADINGS = {
    "mismatch": [
        "What was left out",
        "Recordings and predictions",
        "Explanations that were compared",
        "Parameters",
    ],
    "no_mismatch": ["What was tried", "Recordings and predictions", "Parameters", "Use the model"],
    "inconclusive": ["Candidates", "Recordings and predictions", "Explanations that were compared"],
}
ABSENT = {
    "mismatch": ["What was tried", "What to record next"],
    "no_mismatch": ["What was left out", "What to record next"],
    "inconclusive": ["What was tried", "What was left out"],
}
SAYS = {
    "mismatch": [
        "Mismatch found",
        "joint wrist",
        "0.310 ± 0.010",
        "97 %",
        "10²¹⁰",
        "83 % less",
        "uncertain",
        "Stribeck friction",
        "held-out recordings also chose between the best additions",
    ],
    "no_mismatch": ["No mismatch found", "43 explanations tried", "What could have been seen", "0.0042"],
    "inconclusive": [
        "Inconclusive",
        "payload mass",
        "55 %",
        "What to record next",
        "Swing the wrist fast",
        "6.3",
    ],
}


THREE = asset("three.min.js", "vendor")


def without_libraries(text: str) -> str:
    return text.replace(get_plotlyjs(), "").replace(THREE, "")


class Page(HTMLParser):
    """Tags, attributes and text of a page; fails on tags that do not match."""

    VOID = {"meta", "br", "link", "img", "input", "hr"}

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.text: list[str] = []
        self.figures: dict[str, str] = {}
        self.current: str | None = None
        self.feed(without_libraries(text))
        assert self.open == []

    def handle_starttag(self, tag, attrs) -> None:
        self.attributes += [(tag, name, value) for name, value in attrs]
        values = dict(attrs)
        self.current = (
            values["id"]
            if values.get("id") != "scene" and tag == "script" and values.get("type") == "application/json"
            else None
        )
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if self.current and self.open[-1] == "script":
            self.figures[self.current] = self.figures.get(self.current, "") + data
        elif self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)

    def words(self) -> str:
        return " ".join("".join(self.text).replace("\u00a0", " ").split())

    def ids(self) -> list[str]:
        return [value for _, name, value in self.attributes if name == "id"]


def test_the_fixture_is_a_valid_finding(finding) -> None:
    Finding(**finding)


@pytest.mark.parametrize("odds", [(0.55, 0.41), (0.9, 0.05), (0.998, 0.002)])
def test_what_is_ahead_of_its_rivals_and_not_named_is_in_doubt(open_question, odds) -> None:
    finding, fit = open_question
    candidates = [c | {"probability": p} for c, p in zip(finding["candidates"], odds, strict=True)]
    words = Page(diagnosis_page(finding | {"candidates": candidates}, fit, study_name="arm")).words()
    doubted = odds[0] > 0.8
    apart = "do not part", "2 candidates, best", "cannot tell which"
    assert {text in words for text in apart} == {not doubted}
    assert ("Nearest in the catalogue" in words, "in doubt" in words) == (doubted, doubted)


def test_what_is_open_beside_what_is_named_is_told(half_open) -> None:
    page = Page(half_open)
    words = page.words()
    told = [
        words.index(t) for t in ("Dry friction of", "What was left out", "Something else is missing", "payload mass")
    ]
    assert told == sorted(told) and "55 %" in words[told[-1] :]
    assert "What to record next" in words and ("a", "href", "#candidates") in page.attributes


def test_each_verdict_says_what_it_must(verdict, html) -> None:
    words = Page(html).words()
    assert [text for text in HEADINGS[verdict] + SAYS[verdict] if text not in words] == []
    assert [text for text in ABSENT[verdict] if text in words] == []


def test_nothing_is_loaded_and_the_file_is_small(html) -> None:
    own = without_libraries(html)
    assert html.count(get_plotlyjs()) == html.count(THREE) == 1 and len(html.encode()) < 8e6
    assert not re.search(r"https?:|//cdn|@import|url\(", own)
    loads = {"src", "href", "srcset", "action", "data"}
    assert all(value.startswith("#") for _, name, value in Page(html).attributes if name in loads)
    assert "default-src 'none'" in own


def test_ids_are_unique_and_links_and_figures_find_theirs(html) -> None:
    page = Page(html)
    ids = page.ids()
    assert len(ids) == len(set(ids))
    targets = [value for _, name, value in page.attributes if name in ("data-source", "aria-labelledby", "for")]
    targets += [value[1:] for _, name, value in page.attributes if name == "href"]
    assert set(targets) <= set(ids)
    figures = [value for _, name, value in page.attributes if name == "data-source"]
    assert figures and set(figures) == set(page.figures)


def test_figures_are_json_with_theme_colours_alone(html) -> None:
    styled = set(re.findall(r"(--[\w-]+):", html))
    for text in Page(html).figures.values():
        go.Figure(json.loads(text, parse_constant=pytest.fail))
        assert set(re.findall(r"var\((--[\w-]+)\)", text)) <= styled
        assert not re.search(r"#[0-9a-f]{6}|rgb\(", text)


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_hostile_names_stay_text(finding, fit) -> None:
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"
    finding["summary"] = finding["effects"][0]["statement"] = finding["where"]["when"][0]["condition"] = evil
    finding["effects"][0]["element"] = finding["where"]["elements"][0] = {
        "kind": "joint",
        "name": evil,
        "share": 1.0,
    }
    finding["versions"] = {evil: evil}
    nodes = {path: node.to_dataset() for path, node in fit.subtree_with_keys if node.has_data}
    rollout = nodes["rollouts/swing_00"]
    rollout = rollout.assign_coords(channel=[evil, *rollout["channel"].values[1:].tolist()])
    nodes["rollouts/<img src=x onerror=alert(1)>"] = rollout
    nodes["before/posterior"]["<img src=x onerror=alert(1)>"] = nodes["before/posterior"]["damping"]
    page = Page(html := diagnosis_page(finding, xr.DataTree.from_dict(nodes), study_name=evil))
    own = without_libraries(html)
    assert "<img" not in own and "<script>alert" not in own
    assert not any(tag == "img" for tag, _, _ in page.attributes)
    titles = [note["text"] for note in json.loads(page.figures["rollout-1-1"])["layout"]["annotations"]]
    titles += [n["text"] for n in json.loads(page.figures["rollout-2-1"])["layout"]["annotations"]]
    assert not any("<" in title for title in titles)


def test_missing_parts_leave_their_sections_out(finding) -> None:
    words = Page(diagnosis_page(finding, xr.DataTree(), study_name="arm", files=["patched.xml"])).words()
    assert "Recordings and predictions" not in words and "Parameters" not in words
    assert "import effects" not in words and "patched.xml" in words


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_rollouts_in_contact_are_said_to_start_anew_after_each(finding, fit) -> None:
    """Fitted recordings, too, start from the samples before there, and the page must not claim more."""
    there = {**finding, "contact": {"memory": {"before": 3, "after": 50}, "finer_integration": False}}
    smooth, told = (diagnosis_page(f, fit, study_name="arm") for f in (finding, there))
    assert "of fitted ones from their fitted states" in smooth
    assert "of fitted ones from their fitted states" not in told
    assert "contact makes longer predictions worthless" in told
    assert "each from the state that was estimated from the samples before" in told


def test_null_numbers_are_printed_as_missing(finding, fit) -> None:
    finding = copy.deepcopy(finding)
    finding["evidence"] = {"log10_bayes_factor": None, "noise_inflation": None}
    for key, value in finding["fit"].items():
        finding["fit"][key] = dict.fromkeys(value) if isinstance(value, dict) else None
    for element in finding["where"]["elements"]:
        element["share"] = None
    for effect in finding["effects"]:
        effect["explains"] = None
        effect["parameters"]["force"] |= {"mean": None, "sd": None, "interval": None}
    words = Page(diagnosis_page(finding, fit, study_name="arm")).words()
    assert "None" not in words and "nan" not in words.split()


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_equivalent_effects_vectors_and_names_are_shown(finding, fit) -> None:
    offset = {"mean": [0.1, 0.2, 0.3], "sd": [0.01] * 3, "interval": [[0, 1]] * 3, "unit": "m"}
    finding["effects"][0]["equivalent"] = [
        {
            "name": "com_offset",
            "element": {"kind": "body", "name": "hand"},
            "parameters": {"offset": offset, "source": "elbow", "curve": {"x": [0.0], "y": [1.0]}},
        }
    ]
    finding["psi"]["link_mass"]["prior_conflict"] = [0.2, None, 0.04]
    words = Page(diagnosis_page(finding, fit, study_name="arm")).words()
    assert "or equally com offset of body hand" in words and "or its equal" in words
    assert "(0.100 ± 0.010, 0.200 ± 0.010, 0.300 ± 0.010) m" in words
    assert "elbow" in words and "conflicts with its prior" in words


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_regions_and_points_of_effects_are_marked_in_space(finding, fit) -> None:
    names = {"before": "believed", "after": "corrected"}
    assert replay.scene(fit, names, finding)["marks"] == []
    vector = {"sd": [0.01] * 3, "interval": [[0, 1]] * 3, "unit": "m"}
    patch = {"ratio": {"mean": 0.5}, "point": {"mean": [0.1, 0.2, 0.0], **vector}}
    patch["normal"] = {"mean": [1.0, 0.0, 0.0], **vector}
    tether = {"anchor": {"mean": [0.0, 0.0, 1.0], **vector}}
    for effect, parameters in zip(2 * finding["effects"], (patch, tether), strict=False):
        finding["effects"] = [effect | {"parameters": parameters}]
        told = replay.scene(fit, names, finding)["marks"]
        assert [m["normal"] for m in told] == [[1.0, 0.0, 0.0] if "normal" in parameters else None]
    finding["where"]["when"] = []
    assert not replay.traced(replay.scene(fit, names, finding))


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_long_and_broken_recordings_fit_on_the_page(finding, fit) -> None:
    nodes = {path: node.to_dataset() for path, node in fit.subtree_with_keys if node.has_data}
    short = nodes["rollouts/swing_00"]
    long = xr.concat([short] * 60, "sample", data_vars="minimal")
    long = long.assign_coords(time=("sample", 0.01 * np.arange(long.sizes["sample"])))
    dead = short.copy(deep=True)
    dead["before"][:] = dead["residual_before"][:] = np.nan
    dead["observed"][:, 0] = dead["noise_sd"][0] = np.nan
    nodes |= {f"rollouts/long_{k}": long for k in range(20)} | {"rollouts/dead": dead}
    html = diagnosis_page(finding, xr.DataTree.from_dict(nodes), study_name="arm")
    assert len(html.encode()) < 9.2e6  # 8.9e6, of which the two libraries are 5.4e6
    Page(html)


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_the_page_can_be_made_again_from_the_file(finding, fit, html, tmp_path) -> None:
    fit.to_netcdf(tmp_path / "fit.nc")
    with xr.open_datatree(tmp_path / "fit.nc") as read:
        assert Page(diagnosis_page(finding, read, study_name="arm")).words() == Page(html).words()


@pytest.mark.parametrize("gain", [6.31, None])
def test_an_expected_gain_is_told_where_one_was_computed(open_question, gain):
    finding, fit = open_question
    told = finding | {"experiment": finding["experiment"] | {"expected_gain": gain}}
    words = Page(diagnosis_page(told, fit, study_name="arm")).words()
    assert "What to record next" in words and ("Expected gain" in words) == (gain is not None)
