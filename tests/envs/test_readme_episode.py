"""The README's episode with an agent of one's own runs as it is printed."""

import re
from pathlib import Path


def test_the_episode_of_the_readme_runs_until_pictures_have_come():
    text = (Path(__file__).parents[2] / "README.md").read_text()
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.S) if "def agent" in block]
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    names = {}
    exec(code, names)
    assert names["observation"]["image_present"].any()
    names["env"].close()
