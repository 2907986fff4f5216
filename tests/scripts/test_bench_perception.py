"""The perception benchmark: its parts, one shape of rows, bad usage."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
KEYS = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(SCRIPTS))
    try:
        spec = importlib.util.spec_from_file_location("bench_perception", SCRIPTS / "bench_perception.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["bench_perception"] = module
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(SCRIPTS))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robots", "sdm_x"], "sdm_x"),
        (["--scenes", "0"], "--scenes must be at least 1"),
        (["--parts", "ears"], "part 'ears' is not one of stereo, masks, maps, speed"),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(bench, capsys, arguments, message):
    assert bench.main(arguments) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1


@pytest.mark.slow
def test_rows_of_the_speed_have_the_benchmarks_shape(bench, capsys):
    assert bench.main(["--robots", "sdm_b", "--parts", "speed", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"] and all(set(r) == KEYS for r in printed["rows"])
