"""Verdicts are computed from measurements, both ways."""

from handmade import make_measurement, target_of

from carts_core.lab.benchmark import targets
from carts_core.lab.benchmark.statistics import Measurements
from carts_core.lab.synthesis import DOMAINS


def test_nothing_measured_gives_no_verdict_anywhere() -> None:
    assert all(target.met is None and target.reached == "not measured" for target in targets(Measurements([])))


def test_the_speedup_compares_the_times_to_the_papers_dice() -> None:
    paper = make_measurement((0.5, 0.6, 0.7, 0.8), method="paper", seconds=10.0)
    fast = make_measurement((0.5, 0.9), seconds=2.0)
    assert target_of("times faster", paper, fast).reached == "10.0"
    assert target_of("times faster", paper, fast).met is True
    slow = make_measurement((0.5, 0.9), seconds=6.0)
    assert target_of("times faster", paper, slow).met is False
    never = make_measurement((0.5, 0.75), seconds=0.1)
    assert target_of("times faster", paper, never).reached == "0.0"


def test_the_worst_domain_decides_on_dice() -> None:
    good = [make_measurement((0.6, 0.99), domain=domain, error_deg=2.0) for domain in DOMAINS[1:]]
    fine = make_measurement((0.6, 0.981), domain="regular", error_deg=2.0)
    bad = make_measurement((0.6, 0.97), domain="regular", error_deg=2.0)
    assert target_of("synthetic, 2° off, each frame alone: mean Dice", fine, *good).met is True
    part = target_of("synthetic, 2° off, each frame alone: mean Dice", fine)
    assert part.met is None and part.reached == "0.981" and "domains measured: 1" in part.basis
    missed = target_of("synthetic, 2° off, each frame alone: mean Dice", bad)
    assert missed.met is False
    missed = target_of("synthetic, 2° off, each frame alone: mean Dice", bad, *good)
    assert missed.met is False and missed.reached == "0.970" and "regular" in missed.basis
