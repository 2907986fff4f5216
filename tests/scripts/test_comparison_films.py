"""The telling trials of a comparison are filmed once, and recordings go only when nobody needs them any more."""

import os
import sys
from types import SimpleNamespace

import pytest


@pytest.fixture
def films(script, monkeypatch, tmp_path):
    """The module with scripts that pretend, and a choice of the first and the last row."""
    script("trial_crews")
    module = script("comparison_films")
    for name in ("trial_film.py", "trial_report.py"):
        made = "film.webm" if "film" in name else "report.html"
        (tmp_path / name).write_text(
            "import sys\nfrom pathlib import Path\nfolder = Path(sys.argv[1])\n"
            "if folder.name == 'bad': sys.exit('no ground to draw')\n"
            f"with (folder / '{made}').open('a') as file: file.write(' '.join(sys.argv[2:]) + '.')\n"
        )
    monkeypatch.setattr(module, "SCRIPTS", tmp_path)
    chosen = SimpleNamespace(picked_trials=lambda rows: {("r", "v"): {"best": rows[0], "median": rows[0], "worst": rows[-1]}})
    chosen.__spec__ = SimpleNamespace()
    monkeypatch.setitem(sys.modules, "variant_rows", chosen)
    return module


def comparison(out, *names):
    for name in names:
        (out / "trials" / name).mkdir(parents=True)
        for file in ("trial.json", "trial.mcap"):
            (out / "trials" / name / file).write_text("{}")
    return [{"folder": f"trials/{name}"} for name in names]


def test_each_telling_trial_is_filmed_once_and_again_when_it_was_run_again(films, tmp_path):
    out = tmp_path / "out"
    rows = comparison(out, "a", "b", "c")
    for _ in range(2):
        assert films.film(out, rows, workers=2) == [rows[0], rows[2]]
    made = {p.relative_to(out / "trials"): p.read_text() for p in out.glob("trials/*/*") if p.suffix in (".webm", ".html")}
    assert {str(k): v for k, v in made.items()} == {
        f"{n}/{file}": text for n in "ac" for file, text in (("film.webm", f"--most-frames {films.FRAMES}."), ("report.html", "."))
    }
    os.utime(out / "trials/a/trial.json", (2e10, 2e10))
    films.film(out, rows, workers=2)
    assert (out / "trials/a/report.html").read_text() == ".." and (out / "trials/c/report.html").read_text() == "."


def test_one_that_cannot_be_filmed_is_told_and_the_rest_goes_on(films, tmp_path, capsys):
    out = tmp_path / "out"
    films.film(out, comparison(out, "bad", "good"), workers=1)
    told = capsys.readouterr().err
    assert f"trial_film.py {out / 'trials/bad'}: no ground to draw\n" in told and told.count("\n") == 2
    assert (out / "trials/good/film.webm").exists()


@pytest.mark.parametrize(("keep", "left"), [("all", "abc"), ("filmed", "ac"), ("none", "")])
def test_recordings_stay_as_asked(films, tmp_path, keep, left):
    out = tmp_path / "out"
    rows = comparison(out, "a", "b", "c")
    films.drop_recordings(out, rows, keep=keep, filmed=[rows[0], rows[2]])
    assert "".join(sorted(p.parent.name for p in out.glob("trials/*/trial.mcap"))) == left
    assert len(list(out.glob("trials/*/trial.json"))) == 3
    # Without a recording nothing can be filmed, and nothing is tried.
    films.film(out, rows, workers=1)
    assert not (out / "trials/b/film.webm").exists() and (out / "trials/a/film.webm").exists() == (keep != "none")
