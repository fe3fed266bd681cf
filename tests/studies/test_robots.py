"""One config on many robots: what is asked scales, what counts as done, and what is told."""

import json

import numpy as np
import pytest

from kjax.commands import robot as command
from kjax.controllers.walkable import check_walkable
from kjax.robots import get_robot
from kjax.sim.resolve import batch_spec
from kjax.studies.robots import cases, report, study
from kjax.studies.robots.cases import CASES, GROUPS, Scale, case_configs, group_of, succeeded

TOY = "toy_robot:ROBOT"  # legs of 0.51 m, 25.4 kg
ONE = Scale(1.0, 1.0, 1.0)


def row(**changes):
    return {
        "fell": False, "crossed": True, "reached": [0.5, 0.0, 0.0], "tilt_max_deg": [1.0, 2.0],
        "errors": [0.01, 0.02, 0.03], "errors_of_cycles": [0.001, 0.002, 0.003],
        "tilt_p95_deg": [0.5, 0.9], "torque_saturation_fraction": 0.0,
    } | changes  # fmt: skip


def test_the_go1_is_the_unit():
    scale = cases.scale_of("go1")
    np.testing.assert_allclose(scale, 1.0, rtol=1e-4)


def test_what_is_asked_scales_with_the_robot():
    scale = cases.scale_of(TOY)
    assert scale.length == pytest.approx(0.51 / 0.426)
    assert scale.mass == pytest.approx(25.4 / 12.743)
    one, own = (case_configs(name, "trot", [0])[0] for name in ("go1", TOY))
    assert own.command.v_x[-1] / one.command.v_x[-1] == pytest.approx(np.sqrt(scale.length))
    one, own = (case_configs(name, "turn", [0])[0] for name in ("go1", TOY))
    assert one.command.yaw_rate[-1] / own.command.yaw_rate[-1] == pytest.approx(scale.speed)
    one, own = (case_configs(name, "field", [0])[0] for name in ("go1", TOY))
    for key in ("start", "end", "height_min", "height_max"):
        ratio = getattr(own.terrain, key) / getattr(one.terrain, key)
        assert ratio == pytest.approx(scale.length, rel=1e-3)
    one, own = (case_configs(name, "push", [1])[0] for name in ("go1", TOY))
    assert own.push.lateral / one.push.lateral == pytest.approx(scale.mass * scale.speed, rel=1e-3)


def test_pushes_come_from_four_sides_at_eight_phases():
    pushes = [one.push for one in case_configs("go1", "push", range(32))]
    sides = {(round(p.forward, 3), round(p.lateral, 3)) for p in pushes}
    assert sides == {(12.0, 0.0), (0.0, 12.0), (-12.0, 0.0), (0.0, -12.0)}
    times = {p.times[0] for p in pushes}
    np.testing.assert_allclose(sorted(times), 2.5 + 0.05 * np.arange(8))


def test_what_walks_side_by_side_has_one_program_and_can_be_walked():
    for group in GROUPS:
        configs = [case_configs("go1", name, [0])[0] for name in CASES if group_of(name) == group]
        assert configs
        assert len({batch_spec(one) for one in configs}) == 1
        assert len({one.duration for one in configs}) == 1
        assert len({len(one.push.times) for one in configs}) == 1
        for one in configs:
            check_walkable(one, get_robot("go1").params)


@pytest.mark.parametrize(
    ("name", "changes", "wanted"),
    [
        ("trot", {}, True),
        ("trot", {"fell": True}, False),
        ("trot", {"reached": None}, False),
        ("trot", {"reached": [0.4, 0.0, 0.0]}, False),
        ("trot", {"reached": [0.5, 0.1, 0.0]}, False),
        ("trot", {"reached": [0.5, 0.0, 0.2]}, False),
        ("trot", {"tilt_max_deg": [1.0, 20.0]}, False),
        ("bound", {"tilt_max_deg": [3.0, 20.0]}, True),
        ("bound", {"tilt_max_deg": [3.0, 40.0]}, False),
        ("turn", {"reached": [0.0, 0.0, 1.5]}, True),
        ("turn", {"reached": [0.0, 0.0, 1.2]}, False),
        ("stand", {"reached": [0.0, 0.0, 0.0]}, True),
        ("push", {"reached": [0.0, 0.4, 0.0], "tilt_max_deg": [20.0, 5.0]}, True),
        ("field", {"crossed": False}, False),
        ("field", {"reached": [0.0, 0.0, 0.0]}, True),
    ],
)
def test_what_counts_as_done(name, changes, wanted):
    assert succeeded(name, row(**changes), ONE) is wanted


def test_larger_robots_are_measured_in_their_own_speed():
    scale = Scale(4.0, 2.0, 8.0)
    assert succeeded("trot", row(reached=[1.0, 0.0, 0.0]), scale)
    assert not succeeded("trot", row(), scale)


@pytest.fixture
def walks(monkeypatch):
    """No physics: every fourth seed falls over the field, all else is done."""
    asked = []

    def run(cache, configs, **more):
        assert len({batch_spec(one) for one in configs}) == 1
        asked.append((configs[0].robot, len(configs)))
        out = []
        for one in configs:
            fell = one.terrain.kind == "paper" and one.seed % 4 == 3
            wanted = [one.command.v_x[-1], one.command.v_y[-1], one.command.yaw_rate[-1]]
            out.append(row(fell=fell, reached=None if fell else wanted))
        return out

    monkeypatch.setattr(study, "run_batch", run)
    return asked


def test_a_study_tells_each_robot_and_case(tmp_path, walks):
    out = ["--out", str(tmp_path), "--robots", "go1", TOY, "--seeds", "4"]
    assert study.main(out) == 0
    record = json.loads((tmp_path / "results.json").read_text())
    assert list(record["robots"]) == ["go1", TOY]
    own = record["robots"]["go1"]["cases"]
    assert list(own) == list(CASES)
    assert own["trot"]["success"]["count"] == 4
    assert own["field"]["failed_seeds"] == [3]
    assert own["field"]["falls"] == 1
    text = (tmp_path / "table.md").read_text()
    assert "| go1 | 12.7 | 0.43 | 4 of 4, 0.9 deg | 4 of 4, 0.010 m/s, 0.9 deg |" in text
    assert "4 of 4, 0.003 rad/s, 0.9 deg" in text
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    assert "the paper's field: 0" in report.title(record)


def test_a_robot_that_is_too_weak_for_a_gait_is_said_to_be(tmp_path, walks, monkeypatch):
    def refuse(config, params):
        if config.gait.names[0] == "bound_multiphase":
            raise ValueError("calf joints can press 1 N s, and 2 N s are needed")

    monkeypatch.setattr(study, "check_walkable", refuse)
    found = study.walk("go1", ("trot", "bound"), 2, None)
    assert found["cases"]["bound"] == {
        "refused": "calf joints can press 1 N s, and 2 N s are needed"
    }
    record = {"quick": True, "robots": {"go1": found}}
    assert "| refused |" in report.table(record)
    report.figure(record, tmp_path / "figure.png")


def test_robots_and_cases_that_are_none_end_the_study_in_a_line(tmp_path, capsys):
    for words in (["--robots", "nowhere.xml"], ["--cases", "swim"]):
        with pytest.raises(SystemExit):
            study.main(["--out", str(tmp_path), *words])
    said = capsys.readouterr().err
    assert "there is no file 'nowhere.xml'" in said
    assert "swim" in said


def test_check_says_what_failed(tmp_path, walks, capsys):
    words = ["check", TOY, "--out", str(tmp_path), "--cases", "trot", "field"]
    assert command.main(words) == 1
    said = capsys.readouterr().out
    assert "mass            25.400 kg" in said
    assert "ok     trot 0.5 m/s: 4 of 4 (v_x 0.010 m/s" in said
    assert "FAILED the paper's field: 3 of 4, 1 fell" in said
    assert "1 of 2 checks failed" in said
    assert command.main([*words[:-1]]) == 0
    assert "all checks passed" in capsys.readouterr().out


def test_tune_is_kjax_tune_of_a_robot(monkeypatch):
    called = []
    monkeypatch.setattr("kjax.commands.main.start_module", lambda *words: called.append(words) or 0)
    assert command.main(["tune", TOY, "--updates", "3"]) == 0
    module, name, words = called[0]
    assert (module, name) == ("kjax.studies.tune.study", "kjax robot tune")
    assert words[:3] == ["omni_trot", "--robot", TOY]
    assert words[-2:] == ["--updates", "3"]


def test_show_and_list(capsys):
    assert command.main(["show", "go1"]) == 0
    said = capsys.readouterr().out
    assert "thigh 0.2130 m, calf 0.2130 m, foot 23 mm" in said
    assert "FR_abduction, FR_thigh, FR_calf; sign 1, 1, 1" in said
    assert command.main(["list"]) == 0
    assert capsys.readouterr().out.splitlines()[:3] == ["a1", "go1", "go2"]
    assert command.main([]) == 0
    assert "kjax robot check ROBOT" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["swim"], "wanted show, check, tune or list"),
        (["tune"], "wanted a robot"),
        (["tune", "nowhere.xml"], "there is no file"),
        (["show"], "wanted one robot"),
        (["show", "a", "b"], "wanted one robot"),
        (["check"], "wanted a robot"),
        (["show", "nowhere.xml"], "there is no file"),
        (["check", "go1", "--cases", "swim"], "swim"),
    ],
)
def test_wrong_words_end_the_command_in_a_line(words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        command.main(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
