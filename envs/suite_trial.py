"""One case with one variant, run in a process of its own that the runner of a comparison starts.

    python -m envs.suite_trial FOLDER

`FOLDER/asked.json` says what is asked; `trial.json` is there when, and only when, it was done. A process of its own because a trial
may take its process with it (Bullet, memory), because libraries keep state between trials, and because it can be ended at any moment.
It ends by itself when its standard input does, which the runner holds: whatever happens to the runner, nobody is left to write.
Where code, scenario or variant are not those that were asked for it does not begin, and its exit status is `CHANGED`.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import sys
import threading
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from athlete_twin.assets import robot_names
from athlete_twin.errors import AthleteError
from athlete_twin.link import downlink, uplink
from athlete_twin.world.scenario import load_scenario
from envs.mask_score import MaskScore
from envs.origin import code_sha256, file_hashes
from envs.provenance import provenance
from envs.scoring import mean_max
from envs.suite import OPERATOR, Case, scenario_sha256
from envs.trial import SCHEMA_VERSION, TrialResult
from envs.variants import OutsidePlanner, variant_named

ASKED, TRIAL, LOG, RECORDING = "asked.json", "trial.json", "log.txt", "trial.mcap"
CHANGED = 75
"""exit status of a trial that was not begun, as not that which was asked for is there"""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """One trial of a comparison, with everything that a result must agree in to be its result."""

    case: Case
    variant: str
    body: str
    """"twin", or "mock" without physics on flat ground"""
    suite_sha256: str
    code_sha256: str
    """of `this_code`"""
    scenario_sha256: str
    variant_sha256: str
    """of what the variant is; empty where it lies in no file"""

    @property
    def folder(self) -> str:
        """Name of the trial's folder."""
        name = Path(self.variant).stem if self.variant.endswith(".toml") else self.variant
        safe = re.sub(r"[^A-Za-z0-9_.]", "_", name)
        # Two paths may end alike, and two names may look alike once made safe.
        mark = "" if safe == self.variant else f"_{hashlib.sha256(self.variant.encode()).hexdigest()[:6]}"
        return f"{self.case.id}-{safe}{mark}"

    @property
    def key(self) -> tuple[str, str]:
        """Case and variant: what a row is known by."""
        return self.case.id, self.variant

    def content(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    def text(self) -> str:
        """Text of `asked.json`."""
        return json.dumps(self.content(), indent=2) + "\n"


def asked_of(content: dict[str, Any]) -> Asked:
    """What `asked.json` says."""
    return Asked(**content | {"case": Case(**content["case"])})


@cache
def this_code() -> str:
    """Hash of the code as it was when this process first asked."""
    return code_now()


def code_now() -> str:
    """Hash over sources, the robots' files, the interpreter's and the libraries' versions: what else moves a trajectory.

    Not over the commit: one that changes none of these changes no trial.
    """
    now = provenance()
    files = {name: file_hashes(name, None) for name in robot_names()}
    content = {"code": code_sha256(), "files": files} | {k: now[k] for k in ("version", "python", "packages")}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def variant_sha256(variant: str) -> str:
    """Hash of what a variant is: its content with its base's, or a planner's source; empty where that lies in no file."""
    found = variant_named(variant)
    if isinstance(found, OutsidePlanner):
        return found.sha256
    return hashlib.sha256(json.dumps(found.content, sort_keys=True, default=str).encode()).hexdigest()


def changed_from(asked: Asked) -> str:
    """What is not here as it was asked for, in words; empty where all is."""
    if code_now() != asked.code_sha256:
        return "the code, the drawings or the libraries"
    scenario = asked.case.scenario
    try:
        if scenario_sha256(scenario, load_scenario(scenario)) != asked.scenario_sha256:
            return f"scenario {scenario}"
        if variant_sha256(asked.variant) != asked.variant_sha256:
            return f"variant {asked.variant}"
    except AthleteError as e:  # they could be read where they were asked for
        return " ".join(f"a file that can no longer be used ({e})".split())
    return ""


def row_of(asked: Asked, folder: Path, *, status: int) -> dict[str, Any]:
    """The row of a trial whose process has ended: its result, or why there is none."""
    result = result_in(folder)
    if result is None:
        result = _no_result(asked, reason_of(status, folder / LOG))
    # The name that was given is the one that is compared.
    result |= {"variant": asked.variant, "suite_sha256": asked.suite_sha256}
    more = {"code_sha256": asked.code_sha256, "variant_sha256": asked.variant_sha256, "body": asked.body}
    result["provenance"] = result["provenance"] | more
    case = asked.case
    ends = {"cycles": case.cycles, "time_limit_s": case.time_limit, "capped": case.capped}
    return result | {"case": case.id, "delay_s": case.delay} | ends


def result_in(folder: Path) -> dict[str, Any] | None:
    """What a trial's folder holds as its result; None where it is missing, or torn as by a power cut."""
    try:
        result: dict[str, Any] = json.loads((folder / TRIAL).read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    return result


def reason_of(status: int, log: Path) -> str:
    """Why a process left no result, in one line."""
    lines = log.read_text(errors="replace").split("\n") if log.is_file() else []
    said = next((" ".join(line.split()) for line in reversed(lines) if line.strip()), "")
    if status < 0:
        name = signal.Signals(-status).name if -status in set(signal.Signals) else f"signal {-status}"
        hint = "; memory may have run out" if name == "SIGKILL" else ""
        return f"its process was ended by {name}{hint}"
    # The class of an error without its module.
    return re.sub(r"^(\w+\.)+(?=\w+(:|$))", "", said) or f"its process ended with status {status} and said nothing"


def main(arguments: list[str]) -> int:
    """Runs the trial that a folder asks for; exit status 0 when it ran to an outcome, whatever it was."""
    threading.Thread(target=_end_with_runner, daemon=True).start()
    folder = Path(arguments[0])
    asked = asked_of(json.loads((folder / ASKED).read_text()))
    changed = changed_from(asked)
    if changed:
        sys.stderr.write(f"{changed}\n")
        return CHANGED
    from envs.prepare import Wanted, prepared

    case = asked.case
    wanted = Wanted(
        robot=case.robot, scenario=case.scenario, variant=asked.variant, seed=case.seed, operator=OPERATOR, up=uplink(case.delay),
        down=downlink(case.delay), cycles=case.cycles, time_limit=case.time_limit, body=asked.body,
    )  # fmt: skip
    trial = prepared(wanted, folder)
    trial.suite_sha256 = asked.suite_sha256
    try:
        trial.run()
    finally:
        trial.robot.close()
    return 0


def _end_with_runner() -> None:
    # Not by `sys.stdin`, whose lock this thread would hold when the interpreter ends.
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGKILL)


def _no_result(asked: Asked, reason: str) -> dict[str, Any]:
    """Every key of a result, with null for what was not measured."""
    case = asked.case
    nothing = mean_max([])
    known: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION, "robot": case.robot, "payload_kg": 0.0, "scenario": case.scenario, "seed": case.seed,
        "link": {"delay_s": case.delay, "down": asdict(downlink(case.delay)), "up": asdict(uplink(case.delay))},
        "operator": OPERATOR, "outcome": "error", "reason": reason, "sag_error_m": nothing, "touchdown_error_m": nothing,
        "localisation_error_m": nothing, "map_error_m": dict.fromkeys(("median", "rmse", "p95", "coverage")),
        "leg_mask": MaskScore().summary(), "stage_times_s": {}, "provenance": provenance(),
    }  # fmt: skip
    return dict.fromkeys(f.name for f in fields(TrialResult)) | known


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
