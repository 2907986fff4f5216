"""The validation compares what it measured with what was published, and says so when they differ."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
ROW_KEYS = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}


@pytest.fixture(scope="module")
def script():
    sys.path.insert(0, str(SCRIPTS))
    try:
        yield importlib.import_module
    finally:
        sys.path.remove(str(SCRIPTS))


@pytest.fixture(scope="module")
def rows_module(script):
    return script("validate_rows")


def by_name(rows: list) -> dict:
    return {row.name: row for row in rows}


@pytest.fixture(scope="module")
def measured(script, rows_module):
    """SDM-B on equal tyres, without what takes long."""
    runs = script("validate_runs")
    stances = {lifted: runs.stand("sdm_b", lifted) for lifted in ((), (0,), (4,), (1, 4), (0, 3))}
    drawn = runs.stand_on_drawn_tyres("sdm_b", 1, (stances[()], stances[(0,)], stances[(0, 3)]))
    slides = {
        angle: runs.Slide(angle=np.deg2rad(angle), height=1.2, downhill=np.full(6, slide), torque=0.5)
        for angle, slide in ((14, 0.049), (18, 0.060), (20, 0.048))
    }
    return rows_module.Measured(
        spec=runs.load_spec("sdm_b"),
        sizes=(2.2, 3.42),
        stances=stances,
        sets=({rest.lifted: rest for rest in drawn},),
        reference={lifted: stances[lifted] for lifted in ((), (0,), (0, 3))},
        lifts={"empty": (0.115, 0.2), "loaded": (0.14, 0.05), "raised": (0.14, 0.2)},
        slides=slides,
    )


@pytest.mark.slow
def test_loads_of_equal_tyres_sum_to_the_weight_and_meet_the_published_shares(rows_module, measured):
    for rest in measured.stances.values():
        assert rest.loads.sum() == pytest.approx(1.0, abs=2e-3)
        assert not rest.loads[list(rest.lifted)].any()
    rows = by_name(rows_module.rows_of(measured))
    row = rows["sdm_b wheel load, leg 1 lifted, neighbours"]
    assert row.published == pytest.approx(0.2778, abs=1e-4)
    assert row.met == (abs(row.ours - row.published) <= 0.01)


@pytest.mark.slow
def test_spread_of_tyres_follows_the_figure_and_passes_no_verdict(rows_module, measured):
    names = [row.name for row in rows_module.rows_of(measured)]
    first = names.index("sdm_b wheel load, none lifted, any wheel")
    assert names[first + 1].endswith("1 sets of tyres")
    row = by_name(rows_module.rows_of(measured))[names[first + 1]]
    assert row.low == row.ours == row.high
    assert row.ours > 1 / 6  # the heaviest of six unequal wheels carries more than its share
    assert row.met is None


@pytest.mark.slow
def test_a_miss_is_a_miss(rows_module, measured):
    rows = by_name(rows_module.rows_of(measured))
    assert rows["sdm_b lift that breaks contact, 850 kg"].met is False  # 11.5 cm of 12 to 13
    assert rows["sdm_b lift that breaks contact, 300 kg aboard"].met is False
    assert rows["sdm_b clearance of 20 cm + 15 cm raise, 300 kg aboard"].met is True
    assert rows["sdm_b largest slide of a step on 14 deg"].met is True
    assert rows["sdm_b largest slide of a step on 18 deg"].met is True
    assert rows["sdm_b largest slide of a step on 20 deg"].met is False  # less than on 14 deg


@pytest.mark.slow
def test_zero_interaction_gives_the_papers_pair_of_torques(rows_module, measured):
    rows = by_name(rows_module.rows_of(measured))
    for name, published in (("leg 1 lifted", 50.28), ("legs 1, 4 lifted", 43.43)):
        row = rows[f"sdm_b peak torque, {name}, zero interaction"]
        assert row.published == published
        assert row.ours == pytest.approx(published, abs=2.0)


@pytest.mark.slow
def test_springs_softer_than_the_best_ones_predict_too_much_sag(script, measured):
    sag = script("validate_sag")
    rests = list(measured.stances.values())
    best = sag.best_fit("sdm_b", rests)
    softer = sag.fit_with("sdm_b", rests, 0.7 * best.stiffness)
    assert softer.mean > best.mean
    assert np.mean(softer.errors) < -best.mean


@pytest.mark.slow
def test_the_search_ends_at_the_stiffest_tyre_that_was_measured_and_the_note_says_when_it_did(script, rows_module, measured):
    """The true tyre is F = 16 kN/m d + 110 kN/m2 d2, robot facts 2.6: the more it carries the stiffer, F / d."""
    sag = script("validate_sag")
    rests = list(measured.stances.values())
    heaviest = max(float(rest.loads.max()) for rest in rests) * measured.spec.mass * 9.81
    drop = (-16e3 + np.sqrt(16e3**2 + 4.0 * 110e3 * heaviest)) / (2.0 * 110e3)
    assert sag.stiffest_tyre("sdm_b", rests) == pytest.approx(heaviest / drop, rel=0.02)
    best = sag.best_fit("sdm_b", rests)
    assert best.stiffness < best.bound == sag.stiffest_tyre("sdm_b", rests) and not best.at_bound
    name = "sdm_b foot springs: mean error, best constant"
    assert "search ends" not in by_name(rows_module.rows_of(measured))[name].note
    ended = sag.SagFit(stiffness=best.bound - 10.0, bound=best.bound, errors=best.errors)
    assert ended.at_bound


@pytest.mark.slow
def test_rows_have_the_keys_of_every_benchmark(rows_module, measured):
    for row in rows_module.rows_of(measured) + rows_module.elsewhere():
        content = json.loads(json.dumps(row.as_json()))
        assert content.keys() >= ROW_KEYS
        assert isinstance(content["target"], str)


@pytest.mark.slow
def test_figures_are_drawn(script, measured, tmp_path):
    paths = script("validate_figures").draw(tmp_path, [measured])
    assert {path.name for path in paths} == {"corner_heights.png", "wheel_loads.png", "torque.png", "slope.png"}
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_bad_usage_is_one_clear_line(script, capsys, tmp_path):
    twin = script("validate_twin")
    assert twin.main(["--robots", "t13", "--out", str(tmp_path)]) == 2
    assert "robot 't13' is not known" in capsys.readouterr().err
    assert twin.main(["--workers", "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
