"""Made-up rows of a comparison, for tests alone: no robot ever walked these."""

import json

import numpy as np

DEFAULTS = ("integrated", "drats_2010", "moses_lake_2008", "blind")
SHARES = {"integrated": 0.95, "drats_2010": 0.8, "moses_lake_2008": 0.6, "blind": 0.35}
SUITE = "5" * 64
PROVENANCE = {
    "version": "0.1.0", "git_sha": "c0ffee" * 6 + "abcd", "python": "3.11.2", "platform": "Linux", "cpu": "Some Processor",
    "packages": {"numpy": "2.4.6", "pybullet": "3.2.7"},
}  # fmt: skip
NULLS = (
    "progress_m", "goal_distance_m", "gait_cycles", "steps_taken", "mission_time_s", "motion_s", "link_s", "operator_s", "ground_s",
    "wall_time_s", "uplinks", "command_cycles", "downlink_bytes", "decisions", "rejections", "e_stops", "faults", "collisions",
    "min_support_margin_m", "min_cps_margin_m", "min_tip_over_energy_m", "peak_torque_fraction", "sag_error_m", "touchdown_error_m",
    "map_error_m", "localisation_error_m", "leg_mask", "stage_times_s", "trajectory_sha256",
)  # fmt: skip


def case_row(robot, scenario, seed, delay, variant, **changes):
    """A row that identifies itself and has measured nothing: an error unless the changes say otherwise."""
    case = f"{robot}-{scenario}-{seed}-{delay:g}"
    row = {
        "schema_version": 1, "robot": robot, "payload_kg": 0.0, "scenario": scenario, "variant": variant, "seed": seed,
        "link": {"delay_s": delay, "down": {"delay": delay, "outages": []}, "up": {"delay": delay, "outages": []}},
        "operator": "approve_all", "outcome": "error", "reason": "WorkerError: gone", **dict.fromkeys(NULLS),
        "cycles": 30, "time_limit_s": 14400.0, "capped": False,
        "suite_sha256": SUITE, "provenance": PROVENANCE, "delay_s": delay, "case": case, "folder": f"trials/{case}-{variant}",
    }  # fmt: skip
    return row | changes


def walked(robot, scenario, seed, delay, variant, *, share=None):
    """A trial as it might have gone; what the case gives is shared by all variants."""
    ground = np.random.default_rng([seed, len(robot), len(scenario), int(10 * delay)])
    luck, slow = ground.random(), ground.gamma(20.0, 1 / 20)
    mine = np.random.default_rng([seed, len(scenario), int(10 * delay), *variant.encode()])
    share = SHARES.get(variant, 0.7) if share is None else share
    reached = 0.6 * luck + 0.4 * mine.random() < share
    k = 1.0 if scenario == "rock_field" else 1.3
    steps = int(60 * (1.0 if reached else mine.uniform(0.1, 0.9)))
    slowness = slow * mine.gamma(400.0, 1 / 400) * (1.0 if variant == "integrated" else 1.06)
    motion, link, ground_s, operator = 22.0 * slowness * steps, 2 * delay * steps, 3.5 * k * steps, 4.0 * steps
    outcome = "goal_reached" if reached else str(mine.choice(["fault", "no_step", "tip_over", "time_limit"], p=[0.5, 0.3, 0.1, 0.1]))
    reasons = {
        "goal_reached": "arrived; 0.12 m from the goal", "fault": f"swing_contact: leg {mine.integers(1, 7)} struck something; no way on",
        "no_step": "no step found (reach: 12, rocks: 3)", "tip_over": "the chassis tilts by 31 deg",
        "time_limit": "14400 s are over; the ground waited for nothing",
    }  # fmt: skip
    progress = float(3.0 if reached else 3.0 * steps / 60 + mine.normal(0, 0.05))
    figures = {
        "outcome": outcome, "reason": reasons[outcome], "progress_m": progress, "goal_distance_m": 3.05 - progress,
        "gait_cycles": steps // 6, "steps_taken": steps, "mission_time_s": motion + link + ground_s + operator, "motion_s": motion,
        "link_s": link, "operator_s": operator, "ground_s": ground_s, "wall_time_s": float(2.0 * steps * mine.gamma(20.0, 1 / 20)),
        "uplinks": 2 * steps, "command_cycles": 2 * steps + (6 if variant != "integrated" else 0) + int(mine.integers(0, 5)),
        "downlink_bytes": 1_000_000 * steps, "decisions": steps, "rejections": 0, "e_stops": 0,
        "faults": int(mine.poisson(0.2 if reached else 2.0)), "collisions": int(mine.poisson(4.0 if variant == "blind" else 0.1)),
        "min_support_margin_m": float(mine.normal(0.31, 0.02)), "min_cps_margin_m": float(mine.normal(0.05, 0.03)),
        "min_tip_over_energy_m": float(mine.gamma(9.0, 0.01)), "peak_torque_fraction": float(min(mine.normal(0.7, 0.08), 1.0)),
        "sag_error_m": _mean(mine, 0.012 if variant == "integrated" else 0.03), "touchdown_error_m": _mean(mine, 0.02 * slow),
        "map_error_m": {"median": float(mine.gamma(9.0, 0.0013)), "rmse": 0.03, "p95": 0.06, "coverage": 0.9},
        "localisation_error_m": _mean(mine, 0.03), "leg_mask": {"recall": 0.97, "terrain_lost": 0.02, "lost_near_wheels": 0.1},
        "stage_times_s": {
            stage: {"median": float(mine.gamma(9.0, m / 9)), "p95": float(3 * m * mine.gamma(9.0, 1 / 9)), "count": steps}
            for stage, m in (("plan", 0.6), ("stereo", 0.3), ("footfall", 0.05))
        },
        "trajectory_sha256": "ab" * 32,
    }  # fmt: skip
    return case_row(robot, scenario, seed, delay, variant, **figures)


def comparison(*, robots=("sdm_b", "t12"), scenarios=("rock_field", "black_point"), seeds=10, delays=(5.0,), variants=DEFAULTS):
    """All of these against each other."""
    return [
        walked(robot, scenario, seed, delay, variant)
        for robot in robots for scenario in scenarios for seed in range(seeds) for delay in delays for variant in variants
    ]  # fmt: skip


def write(folder, rows, *, torn=""):
    """`results.jsonl` in a folder, with a last line that was torn."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + torn)
    return folder


def _mean(draws, size):
    mean = float(draws.gamma(9.0, size / 9))
    return {"mean": mean, "max": 3 * mean}
