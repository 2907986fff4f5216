"""The difficulty that the paper tells of is there: legs hide what they must step on, and views gap."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def analysis():
    sys.path.insert(0, str(SCRIPTS))
    try:
        spec = importlib.util.spec_from_file_location("view_analysis", SCRIPTS / "view_analysis.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["view_analysis"] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPTS))
    return module


@pytest.fixture(scope="module")
def printed(analysis, tmp_path_factory):
    out = tmp_path_factory.mktemp("views")
    rows = {}
    for robot in ("sdm_b", "t12"):
        spec = analysis.load_spec(robot)
        size = analysis.size_of(spec)
        down = analysis.sight(spec, cell=0.1, size=size)
        lifted = [analysis.sight(spec, cell=0.1, size=size, lifted=leg) for leg in range(6)]
        rows |= {r["name"]: r for r in analysis.rows_of(spec, down, lifted)}
        rows[robot] = (down, lifted, analysis.draw(out, spec, down, lifted[0], analysis.rings(down)))
    return rows


def test_the_targets_of_the_views_are_met_but_for_one(printed):
    """T12's outward pairs stand apart by 1.7 m: they share a quarter of the horizon, and hardly any ground near their feet."""
    judged = [r for r in printed.values() if isinstance(r, dict) and r["target"]]
    assert len(judged) == 9
    assert [r["name"] for r in judged if not r["met"]] == ["t12 least overlap of neighbouring navcams on the ground within reach"]


def test_navcams_of_sdm_b_see_nothing_within_reach(printed):
    assert printed["sdm_b ground within reach seen by navcams"]["ours"] == pytest.approx(0.0, abs=0.5)


def test_a_lifted_leg_hides_less_of_its_next_step(printed):
    for leg in (1, 3, 5):
        down, up = (printed[f"sdm_b next step of leg {leg} seen, {how}"]["ours"] for how in ("legs down", "leg lifted"))
        assert up > down + 50.0


def test_what_is_seen_is_framed(printed):
    for robot in ("sdm_b", "t12"):
        down, lifted, _ = printed[robot]
        for view in (down, *lifted):
            assert not (view.seen & ~view.framed).any()


def test_the_view_of_sdm_b_repeats_every_third_of_a_turn(printed, analysis):
    """Three HazCams a third of a turn apart: the rings they see are alike in all thirds."""
    down = printed["sdm_b"][0]
    angle = np.arctan2(down.y[None, :], down.x[:, None])
    inside = down.radius() < 3.0
    thirds = [inside & (np.abs(np.angle(np.exp(1j * (angle - turn)))) < np.pi / 3) for turn in np.deg2rad([0, 120, 240])]
    shares = [down.by("hazcam")[third].mean() for third in thirds]
    assert np.ptp(shares) < 0.03  # of cells of 0.1 m, which do not turn with it


def test_figures_are_pictures(printed):
    for robot in ("sdm_b", "t12"):
        paths = printed[robot][2]
        assert len(paths) == 3
        assert all(p.read_bytes().startswith(b"\x89PNG") for p in paths)


def test_the_script_prints_one_json_object(analysis, tmp_path, capsys):
    assert analysis.main(["--robots", "sdm_b", "--cell", "0.2", "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"]


@pytest.mark.parametrize(("arguments", "message"), [(["--robots", "sdm_x"], "sdm_x"), (["--cell", "2"], "outside 0.01 to 0.25")])
def test_bad_usage_is_one_line_and_exit_status_2(analysis, capsys, arguments, message):
    assert analysis.main(arguments) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1
