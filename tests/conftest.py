"""What every test relies on: one thread a library, reproducible examples, and slow tests only when asked for."""

from __future__ import annotations

import os

# Before numpy and its libraries load: sums in one order, and no fight for cores between parallel test processes.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import pytest
from hypothesis import HealthCheck, Phase, settings

# Without the phase that explains a failure: it can take minutes and says little about float arrays.
# A first example may compile numba code, so no deadline; derandomised, so that a failure shows again on any machine.
settings.register_profile(
    "project",
    deadline=None,
    derandomize=True,
    max_examples=40,
    database=None,
    phases=[Phase.explicit, Phase.generate, Phase.target, Phase.shrink],
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("project")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves the slow tests out of a bare `pytest`; `-m slow` or naming a test (`file::test`) runs them."""
    if config.option.markexpr or any("::" in arg for arg in config.args):
        return
    slow = [item for item in items if "slow" in item.keywords]
    if slow:
        items[:] = [item for item in items if "slow" not in item.keywords]
        config.hook.pytest_deselected(items=slow)
