"""Numbers as the page prints them."""

import pytest

from det2stoc_bayes.report import numbers


@pytest.mark.parametrize(
    "mean, sd, text",
    [
        (0.31, 0.01, "0.310 ± 0.010"),
        (0.31234, 0.0096, "0.3123 ± 0.0096"),
        (1.9, 0.0999, "1.90 ± 0.10"),
        (8810.0, 220.0, "8,810 ± 220"),
        (-2.0, 0.5, "−2.00 ± 0.50"),
        (-0.0001, 0.5, "0.00 ± 0.50"),
        (1.23e-5, 4e-7, "(1.230 ± 0.040) × 10⁻⁵"),
        (3.0, None, "3.00"),
        (3.0, 0.0, "3.00"),
        (None, 0.1, "–"),
        (float("nan"), 0.1, "–"),
        ([1.0, None], [0.1, None], "(1.00 ± 0.10, –)"),
    ],
)
def test_two_digits_of_the_uncertainty(mean, sd, text) -> None:
    assert numbers.plus_minus(mean, sd) == text


@pytest.mark.parametrize(
    "value, text",
    [(0.0, "0.00"), (0.04211, "0.0421"), (12345.6, "12,346"), (3.14e-6, "3.14 × 10⁻⁶"), (None, "–")],
)
def test_significant_digits(value, text) -> None:
    assert numbers.number(value) == text


@pytest.mark.parametrize(
    "fraction, text",
    [(0.97, "97 %"), (0.9999, "> 99 %"), (1.0, "100 %"), (0.002, "< 1 %"), (0.0, "0 %"), (-0.03, "−3 %")],
)
def test_a_percentage_is_never_rounded_to_certainty(fraction, text) -> None:
    assert numbers.percent(fraction) == text


@pytest.mark.parametrize(
    "bounds, text",
    [
        ([0.29, 0.33], "[0.290, 0.330]"),
        ([[0, 1], [2, 3]], "[0.00, 1.00], [2.00, 3.00]"),
        (None, "–"),
        ([None, 1], "–"),
    ],
)
def test_intervals(bounds, text) -> None:
    assert numbers.interval(bounds) == text


def test_the_rest() -> None:
    assert numbers.bayes_factor(210.3) == "10²¹⁰"
    assert numbers.bayes_factor(1.5) == "32"
    assert [numbers.duration(s) for s in (41.0, 200.0, 3900.0)] == ["41 s", "3 min 20 s", "1 h 5 min"]
    assert numbers.tied("by 78 % to 0.3 ± 0.1 N m").replace("\u00a0", "_") == "by 78_% to 0.3_±_0.1_N_m"
