"""Scenarios, variants, drawings and recordings with bytes that nobody would write: an error that names field or file, no crash."""

import numpy as np
import pytest

from athlete_twin.assets import assets_root, read_toml
from athlete_twin.errors import AthleteError, ConfigError, RecordingError
from athlete_twin.link import downlink, uplink
from athlete_twin.model.spec import load_spec, spec_from_content
from athlete_twin.world.scenario import load_scenario
from envs.build import variant_content
from envs.events import events
from envs.origin import recorded_origin
from envs.recorder import Recorder
from envs.recording import read_recording, recorded_downlinks
from envs.rerun import ending_of
from planner.config import planner_config

FEW, MANY = 300, 10_000
"""files tried in the quick suite and in the slow one"""
NONSENSE = (
    "nan", "inf", "-inf", "1e308", "-1e308", "0", "-1", "9223372036854775807", "true", "''", "'x'", "[]", "[[]]", "[1, 'a']", "{}",
    "{a = 1}", "1979-05-27", "07:32:00", "'\\u0000'", "[nan, nan]", "[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]",
)  # fmt: skip


def spoiled_bytes(raw: bytes, rng: np.random.Generator) -> bytes:
    """Random bytes, or the file cut, with flipped bits, or with a piece of itself elsewhere."""
    way = int(rng.integers(5))
    if way == 0:
        return rng.bytes(int(rng.integers(200)))
    if way == 1:
        return raw[: int(rng.integers(len(raw)))]
    out = bytearray(raw)
    if way == 2:
        for _ in range(int(rng.integers(1, 9))):
            out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    elif way == 3:
        a, b, size = (int(n) for n in rng.integers(len(out), size=3))
        out[a : a + size % 64] = out[b : b + size % 64]
    else:
        at = int(rng.integers(len(out)))
        out[at : at + int(rng.integers(16))] = rng.bytes(int(rng.integers(16)))
    return bytes(out)


def spoiled_toml(raw: bytes, rng: np.random.Generator) -> bytes:
    """As bytes, or still TOML: a value of another type or size, a line gone, doubled, or moved into another table."""
    if rng.random() < 0.4:
        return spoiled_bytes(raw, rng)
    lines = raw.decode().split("\n")
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(lines)))
        key, equals, _ = lines[at].partition("=")
        way = int(rng.integers(4))
        if way < 2 and equals:
            lines[at] = f"{key}= {NONSENSE[int(rng.integers(len(NONSENSE)))]}"
        elif way == 2:
            del lines[at]
        else:
            lines.insert(int(rng.integers(len(lines) + 1)), lines[at])
        lines = lines or [""]
    return "\n".join(lines).encode()


def variant(path):
    found, content = variant_content(str(path))
    return planner_config(content, load_spec("sdm_b"), name=str(found))


def drawings(path):
    content = read_toml(path)
    try:
        return spec_from_content(content)
    except ConfigError as e:
        raise ConfigError(f"{path}: {e}") from e


KINDS = {
    "scenario": ("scenarios/*.toml", lambda path: load_scenario(str(path))),
    "variant": ("variants/*.toml", variant),
    "drawings": ("robots/*/spec.toml", drawings),
}


def fuzz_toml(kind, count, folder):
    """Share of spoiled files that are refused; each refusal names the file in one line, and nothing else is raised."""
    pattern, load = KINDS[kind]
    sources = [path.read_bytes() for path in sorted(assets_root().glob(pattern))]
    rng = np.random.default_rng([1, *kind.encode()])
    path = folder / "mine.toml"
    refused = 0
    for _ in range(count):
        path.write_bytes(spoiled_toml(sources[int(rng.integers(len(sources)))], rng))
        try:
            load(path)
        except AthleteError as e:
            refused += 1
            assert str(path) in str(e), e
            assert len(str(e).splitlines()) == 1, e
    return refused / count


@pytest.mark.parametrize("kind", list(KINDS))
def test_spoiled_toml_is_refused_by_name_or_read(kind, tmp_path):
    assert 0.2 < fuzz_toml(kind, FEW, tmp_path) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
def test_ten_thousand_spoiled_toml_files_are_refused_by_name_or_read(kind, tmp_path):
    assert 0.2 < fuzz_toml(kind, MANY, tmp_path) < 1.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory, request):
    """A small recording with all kinds of records: a trial of the mock with commands, pictures, proposals and answers."""
    from envs.prepare import Wanted, prepared

    wanted = Wanted(
        robot="sdm_b", scenario="rock_field", variant="blind", seed=1, operator="cautious", up=uplink(1.0), down=downlink(1.0),
        time_limit=22.0, body="mock",
    )  # fmt: skip
    out = tmp_path_factory.mktemp("fuzzed")
    prepared(wanted, out).run()
    return (out / "trial.mcap").read_bytes()


READERS = (recorded_origin, recorded_downlinks, events, ending_of)


def fuzz_recording(raw, count, folder):
    """Shares of spoiled recordings that are refused, and that are read as a beginning of what was written."""
    rng = np.random.default_rng(11)
    path = folder / "mine.mcap"
    path.write_bytes(raw)
    whole = [line.data for line in read_recording(path)]
    refused = lost = 0
    for k in range(count):
        path.write_bytes(spoiled_bytes(raw, rng))
        try:
            READERS[k % len(READERS)](path)
        except RecordingError as e:
            refused += 1
            assert str(path) in str(e), e
        try:
            kept = [line.data for line in read_recording(path)]
        except RecordingError:
            continue
        # What is given out without a word is a beginning of what was written.
        assert kept == whole[: len(kept)]
        lost += len(kept) < len(whole)
    return refused / count, lost / count


@pytest.mark.slow
@pytest.mark.ci
def test_spoiled_recordings_are_refused_by_name_or_read_as_far_as_they_go(recording, tmp_path):
    refused, shortened = fuzz_recording(recording, 60, tmp_path)
    assert refused > 0.3 and shortened > 0.1


@pytest.mark.slow
def test_ten_thousand_spoiled_recordings_are_refused_by_name_or_read_as_far_as_they_go(recording, tmp_path):
    refused, shortened = fuzz_recording(recording, MANY, tmp_path)
    assert refused > 0.3 and shortened > 0.1


def test_a_recording_cut_at_any_place_gives_what_was_whole_there(tmp_path):
    path, part = tmp_path / "a.mcap", tmp_path / "b.mcap"
    sizes = []
    with Recorder(path) as recorder:
        for k in range(5):
            recorder.write("/truth/state", {"k": k}, float(k))
            sizes.append(path.stat().st_size)
    raw = path.read_bytes()
    for size in range(len(raw)):
        part.write_bytes(raw[:size])
        if size < 8:
            with pytest.raises(RecordingError, match="is no MCAP file"):
                list(read_recording(part))
            continue
        kept = [line.content["k"] for line in read_recording(part)]
        # A chunk is whole before the index behind it is.
        assert kept == list(range(len(kept)))
        assert len(kept) >= sum(size >= s for s in sizes)


@pytest.mark.slow
@pytest.mark.ci
def test_every_flipped_bit_of_a_small_recording_is_noticed_or_harmless(tmp_path):
    path, spoiled = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with Recorder(path, metadata={"seed": "0"}) as recorder:
        for k in range(3):
            recorder.write("/truth/state", {"k": k}, float(k))
    raw = path.read_bytes()
    noticed = 0
    for bit in range(8 * len(raw)):
        out = bytearray(raw)
        out[bit // 8] ^= 1 << bit % 8
        spoiled.write_bytes(bytes(out))
        try:
            kept = [line.content["k"] for line in read_recording(spoiled)]
        except RecordingError as e:
            assert str(spoiled) in str(e)
            noticed += 1
        else:
            assert kept == [0, 1, 2], bit
    assert noticed > 0
