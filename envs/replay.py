"""Plans a recorded trial again from its downlink and its operator's decisions alone: no robot, no truth, no link.

If the proposals are the recorded ones, the ground used nothing but what came down.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from athlete_twin.errors import RecordingError
from envs.recording import read_recording, recorded_downlinks
from envs.schemas import Json
from planner.decisions import Decision, GroundAgent, Proposal


@dataclass(frozen=True, eq=False, kw_only=True)
class Replayed:
    """One decision of the operator, with what the ground proposes when it is planned again."""

    proposal: Proposal
    shown: Json
    """what the operator was shown in the trial: content of `/operator/shown`"""
    uplink: Json | None
    """the sequence that went up then, content of `/uplink/command_sequence`; None after a rejection"""


def replay(path: Path, agent: GroundAgent) -> Iterator[Replayed]:
    """Plan again, proposal by proposal.

    Args:
        path: the recording.
        agent: a fresh ground with the trial's robot, variant, goal and seed.
    """
    downlinks = iter(recorded_downlinks(path))
    lines = list(read_recording(path))
    shown: dict[int, Json] = {r.content["index"]: r.content for r in lines if r.topic == "/operator/shown"}
    sent: dict[int, Json] = {
        r.content["sequence_id"]: r.content for r in lines if r.topic == "/uplink/command_sequence"
    }
    for line in lines:
        if line.topic.startswith("/downlink/") and not line.topic.endswith(("/left", "/right")):
            arrived, message = next(downlinks)
            agent.observe(message, arrived)
        elif line.topic == "/operator/decision":
            proposal = agent.next(line.t)
            if not isinstance(proposal, Proposal):
                raise RecordingError(
                    f"{path}: at {line.t:.1f} s the operator decided, planned again the ground says {proposal}"
                )
            before = shown[line.content["proposal"]]
            sequence = agent.decide(decision_of(line.content), line.t)
            uplink = sent.get(sequence.sequence_id) if sequence else None
            yield Replayed(proposal=proposal, shown=before, uplink=uplink)


def same_proposal(replayed: Replayed) -> bool:
    """Whether the operator would have been shown the same: legs, footfalls, margin, sag and words, to the last bit."""
    proposal, shown = replayed.proposal, replayed.shown
    figures = {"predicted_margin": proposal.predicted_margin, "predicted_sag": proposal.predicted_sag}
    return (
        proposal.index == shown["index"]
        and proposal.leg == shown["leg"]
        and proposal.text == shown["text"]
        and proposal.footfall_in_world.tolist() == shown["footfall_in_world"]
        and [[p.leg, p.footfall_in_world.tolist()] for p in proposal.together]
        == [[p["leg"], p["footfall_in_world"]] for p in shown.get("together", ())]
        and all((v if np.isfinite(v) else None) == shown[k] for k, v in figures.items())
    )


def decision_of(content: Json) -> Decision:
    """The decision that a recording holds, content of `/operator/decision`."""
    footfall = content["footfall_in_world"]
    return Decision(
        kind=content["kind"],
        reason=content["reason"],
        footfall_in_world=None if footfall is None else np.array(footfall, dtype=float),
        leg=content["leg"],
        cameras=tuple(content["cameras"]),
        duration=content["duration"],
    )
