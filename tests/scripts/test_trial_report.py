import importlib.util
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from athlete_twin.assets import robot_dir
from athlete_twin.geometry.se3 import SE3
from athlete_twin.link import LinkConfig
from athlete_twin.mock import MockAthlete
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.camera import Pinhole
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.sensors import onlooker
from athlete_twin.sensors.renderer import Renderer
from envs.trial import Trial, TrialSetup
from planner.decisions import RejectSome

ROOT = Path(__file__).resolve().parents[2]
SECOND = 1e-6
MILLIMETRE = 1e-3


def imported(*names):
    """Scripts import each other as neighbours; the path is put back, so that other tests find none of them."""
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        return [importlib.import_module(name) for name in names]
    finally:
        sys.path.remove(str(ROOT / "scripts"))


trial_report, trial_film, trial_recording, report_sag = imported("trial_report", "trial_film", "trial_recording", "report_sag")


def scripted_ground():
    place = ROOT / "tests" / "envs" / "conftest.py"
    spec = importlib.util.spec_from_file_location("scripted_ground", place)
    module = importlib.util.module_from_spec(spec)
    sys.modules["scripted_ground"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two steps of the mock, of which the operator rejected the first proposal."""
    out = tmp_path_factory.mktemp("trial")
    ground = scripted_ground()
    up, down = LinkConfig(delay=5.0, bandwidth=64e3), LinkConfig(delay=5.0, bandwidth=2e6)
    setup = TrialSetup(
        robot="sdm_b", scenario="calibration_yard", variant="integrated", seed=0, operator="<b>bob</b>", up=up, down=down,
        goal=(1.0, 0.0), cycles=9, time_limit=600.0,
    )  # fmt: skip
    spec = load_spec("sdm_b")
    Trial(
        setup=setup, spec=spec, robot=MockAthlete(spec), agent=ground.ScriptedAgent(steps=2),
        operator=RejectSome(rejected=frozenset({0})), grid=ground.flat_grid(), out=out,
    ).run()  # fmt: skip
    return out


@pytest.fixture(scope="module")
def recording(folder):
    return trial_recording.load_recording(folder)


@pytest.fixture(scope="module")
def page(folder):
    return trial_report.write_report(folder).read_text()


def test_report_is_one_file_without_outside_addresses(page):
    assert "http" not in page.replace("http-equiv", "")
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r'src="([^"]*)"', page))
    assert page.count("<img") >= 4


def test_report_names_outcome_and_every_proposal(page, recording):
    assert "the ground declared arrival" in page
    assert all(page.count(p.text) >= len(recording.proposals) for p in recording.proposals)
    assert "reject" in page


def test_names_from_outside_are_escaped(page):
    assert "<b>bob</b>" not in page and "&lt;b&gt;bob&lt;/b&gt;" in page


def test_what_was_not_measured_is_a_dash(page):
    assert re.search(r"part of the legs found</td><td class=\"n\">–", page)


def test_parts_of_the_bar_fill_it(page):
    bar = re.search(r'<div class="bar">(.*?)</div></div>', page).group(1)
    assert sum(float(w) for w in re.findall(r"width:([\d.]+)%", bar)) == pytest.approx(100.0, abs=0.01)


def test_recorded_spans_add_up_to_the_accounts(recording):
    for name in trial_recording.BINS:
        total = sum(end - begin for kind, begin, end in recording.spans if kind == name)
        assert total == pytest.approx(recording.figures[f"{name}_s"], abs=1e3 * SECOND)
    ends = [end for _, _, end in recording.spans]
    begins = [begin for _, begin, _ in recording.spans]
    assert begins[0] == 0.0 and np.allclose(begins[1:], ends[:-1], atol=SECOND)


def test_true_footfalls_are_numbered_like_the_approved_steps(recording):
    footfalls = recording.footfalls()
    assert [f.number for f in footfalls] == list(range(1, recording.figures["steps_taken"] + 1))
    asked = [p for p in recording.proposals if p.decision == "approve"]
    for footfall, proposal in zip(footfalls, asked, strict=True):
        assert footfall.leg == proposal.leg


def test_map_error_of_a_true_map_is_nothing(recording):
    error = recording.map_error()
    assert np.nanmax(np.abs(error.heights)) < MILLIMETRE


def test_storyboard_skips_the_waiting(recording):
    shots = trial_film.storyboard(recording, most_frames=20)
    moving = [s.state.t for s in shots if s.state.moves]
    assert len(moving) < 40 and moving == sorted(moving)
    waited = [sum(s.state.waited.values()) for s in shots if s.state.waited]
    assert max(waited) > 2 * recording.figures["link"]["delay_s"]


@pytest.mark.slow
@pytest.mark.ci
def test_film_has_the_frames_of_its_storyboard(folder, recording):
    import cv2

    film = cv2.VideoCapture(str(trial_film.write_film(folder, most_frames=6)))
    frames = 0
    while True:
        ok, frame = film.read()
        if not ok:
            break
        frames += 1
        assert frame.shape == (trial_film.SIZE[1], trial_film.SIZE[0], 3)
    assert frames == len(trial_film.storyboard(recording, most_frames=6))


def test_what_is_drawn_in_parts_is_what_is_drawn_at_once(recording):
    terrain = trial_film.bare_ground(recording)
    spec = recording.spec
    target = np.array([0.0, 0.0, 0.8])
    camera = onlooker.looking(onlooker.stand_point(terrain, spec, target), target)
    eye = Pinhole.from_fov(320, 180, onlooker.FIELD_OF_VIEW)
    posture, joints = onlooker.Posture(spec), regular_stance(spec)
    lifted = joints.copy()
    lifted[0, 1] -= 0.3
    canvas = onlooker.Canvas(terrain, spec, camera, eye)
    for q in (joints, lifted):
        links = posture.link_poses(SE3.from_translation(np.array([0.0, 0.0, 1.7])), q, np.zeros(0))
        canvas.show(links)
        whole = Renderer(terrain, visual_parts(spec)).render_view(camera, eye, links)
        difference = np.abs(canvas.picture.astype(int) - whole.astype(int))
        # Edges are refined by another rule; nothing else may differ by more than grain.
        assert difference.mean() < 2.0
        assert np.mean(difference.max(axis=2) > 40) < 0.02


def test_bent_docks_carry_decks_and_legs_along():
    spec = load_spec("t12")
    posture = onlooker.Posture(spec)
    joints, docks = regular_stance(spec), np.array([0.03, -0.02, 0.01, 0.04])
    links = posture.link_poses(SE3.identity(), joints, docks)
    text = (robot_dir("t12") / "robot.urdf").read_text().replace('<joint name="', '<joint name="joint_')
    model = pin.buildModelFromXML(text)
    q = pin.neutral(model)
    for name, angle in zip(("left_bend", "left_twist", "right_bend", "right_twist"), docks, strict=True):
        q[model.joints[model.getJointId(f"joint_dock_{name}")].idx_q] = angle
    for leg in range(6):
        for k, joint in enumerate(spec.joint_names):
            q[model.joints[model.getJointId(f"joint_leg{leg + 1}_{joint}")].idx_q] = joints[leg, k]
    placed = model.createData()
    pin.framesForwardKinematics(model, placed, q)
    for n in range(1, 7):
        expected = placed.oMf[model.getFrameId(f"wheel{n}", pin.FrameType.BODY)].translation
        assert np.allclose(links[f"wheel{n}"].translation, expected, atol=1e-9)
    assert np.allclose(
        Kinematics(spec).link_poses(joints)["wheel1"].translation,
        posture.link_poses(SE3.identity(), joints, np.zeros(0))["wheel1"].translation,
    )


@pytest.mark.parametrize("script", [trial_report, trial_film])
def test_folder_without_a_trial_is_one_line_and_status_two(script, tmp_path, capsys):
    assert script.main([str(tmp_path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "trial.json is missing" in lines[0]


def test_measured_sag_is_what_the_chassis_does_while_the_leg_is_in_the_air():
    """A chassis that drops 3 cm and tilts by 0.01 rad while leg 2 swings, and whatever it does later."""
    times = np.arange(0.0, 10.0, 0.5)
    in_air = (times >= 2.0) & (times < 6.0)
    heights = 1.7 - 0.03 * in_air - 0.5 * (times > 8.0)
    tilts = 0.01 * in_air
    poses = [SE3.from_rpy(0.0, tilt, 0.0, np.array([0.0, 0.0, z])) for tilt, z in zip(tilts, heights, strict=True)]
    steps = tuple(
        SimpleNamespace(kind=kind, decision=decision, t=t, decided=t + 0.5, leg=1)
        for kind, decision, t in (("step", "approve", 0.5), ("step", "reject", 9.0), ("survey", "approve", 9.4))
    )
    trial = SimpleNamespace(
        proposals=steps, spec=load_spec("sdm_b"), track=SimpleNamespace(t=times, world_from_hex=poses),
        states=SimpleNamespace(t=times, phases=[("stance", "swing" if up else "stance") for up in in_air]),
    )  # fmt: skip
    measured = report_sag.measured_sags(trial)
    assert measured[0] == pytest.approx(0.03)
    assert np.isnan(measured[1:]).all()


def _lifted_first(*, stood_from):
    """Leg 2 goes up at 2 s by a proposal of its own, 4 cm of sag; at 4 s its step is decided, it comes down at 8 s."""
    times = np.arange(0.0, 10.0, 0.5)
    in_air = (times >= 2.0) & (times < 8.0)
    proposals = tuple(
        SimpleNamespace(kind=kind, decision="approve", t=t, decided=t + 0.5, leg=1) for kind, t in (("shift", 1.0), ("step", 3.5))
    )
    phases = [("stance", "swing" if up or t < stood_from else "stance") for up, t in zip(in_air, times, strict=True)]
    poses = [SE3.from_rpy(0.0, 0.0, 0.0, np.array([0.0, 0.0, 1.7 - 0.04 * up])) for up in in_air]
    return SimpleNamespace(
        proposals=proposals, spec=load_spec("sdm_b"), track=SimpleNamespace(t=times, world_from_hex=poses),
        states=SimpleNamespace(t=times, phases=phases),
    )  # fmt: skip


def test_sag_of_a_leg_that_was_up_when_its_step_was_decided_counts_from_where_it_last_stood():
    measured = report_sag.measured_sags(_lifted_first(stood_from=0.0))
    assert np.isnan(measured[0]) and measured[1] == pytest.approx(0.04)


def test_sag_of_a_leg_that_never_stood_before_its_step_is_left_out():
    assert np.isnan(report_sag.measured_sags(_lifted_first(stood_from=5.0))).all()
