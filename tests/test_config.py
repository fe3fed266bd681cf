import dataclasses
from pathlib import Path

import pytest

from kjax.config import (
    ConfigError,
    DatasetConfig,
    FitStudyConfig,
    GaitConfig,
    Gaits,
    GaitScheduleConfig,
    LmpcConfig,
    Overlay,
    RunConfig,
    SrbConfig,
    SweepConfig,
    fields,
    load_config,
    to_dict,
)
from kjax.config.gaits import LIBRARY, gait_setting, reachable_gaits


def message(overrides, cls=RunConfig, path=None):
    with pytest.raises(ConfigError) as caught:
        load_config(cls, path, overrides)
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        ({"lmpc.horizn": 8}, ("lmpc.horizn", "unknown key", "8", "did you mean 'lmpc.horizon'")),
        ({"lmcp.horizon": 8}, ("lmcp", "unknown key", "did you mean 'lmpc'")),
        ({"lmpc.horizon": 0}, ("lmpc.horizon", "got 0", "greater than 0")),
        ({"lmpc.horizon": "six"}, ("lmpc.horizon", "got 'six'", "integer")),
        ({"lmpc.horizon": 2.5}, ("lmpc.horizon", "got 2.5", "integer")),
        ({"srb.mass": -1.0}, ("srb.mass", "got -1.0", "greater than 0")),
        ({"srb.mass": float("nan")}, ("srb.mass", "got nan", "finite")),
        ({"gait.names": ["trto"]}, ("gait.names", "got 'trto'", "did you mean 'trot'")),
        ({"gait.names": "trot"}, ("gait.names", "got 'trot'")),
        ({"gait.name": "trot"}, ("gait.name", "unknown key", "did you mean 'gait.names'")),
        ({"gait.names": ["trot", "bound"]}, ("gait", "equally long", "2", "1")),
        ({"gait.times": [0.0, 1.0]}, ("gait", "equally long", "1", "2")),
        ({"gait.names": [], "gait.times": []}, ("gait", "not empty", "0")),
        ({"gait.times": [0.5]}, ("gait", "start at 0", "0.5")),
        ({"gait.times": [-1.0]}, ("gait.times", "got -1.0", "greater than or equal to 0")),
        (
            {"gait.names": ["trot", "bound", "trot"], "gait.times": [0.0, 2.0, 2.0]},
            ("gait", "increase", "[0.0, 2.0, 2.0]"),
        ),
        (
            {"gait.names": ["trot", "bound", "trot"], "gait.times": [0.0, 2.0, 1.0]},
            ("gait", "increase", "[0.0, 2.0, 1.0]"),
        ),
        (
            {"gaits.bound.switch_rule": "first_flght"},
            ("gaits.bound.switch_rule", "did you mean 'first_flight'"),
        ),
        ({"gaits.trot.perod": 0.4}, ("gaits.trot.perod", "did you mean 'gaits.trot.period'")),
        ({"gaits.amble.dutty": 0.4}, ("gaits.amble.dutty", "did you mean 'gaits.amble.duty'")),
        ({"gaits.trot.offset": 0.5}, ("gaits.trot.offset: got 0.5, wanted a list of 4 numbers",)),
        ({"gaits.trot.Q": [1.0]}, ("gaits.trot.Q: got [1.0], wanted a list of 6 numbers",)),
        ({"lmpc.Q": [0.0] * 7}, ("lmpc.Q: got [0.0, ", "wanted a list of 6 numbers")),
        ({"command.v_x": 0.3}, ("command.v_x: got 0.3, wanted a list of numbers",)),
        ({"gait.names": "trot"}, ("gait.names: got 'trot', wanted a list of names",)),
        ({"gaits.trot.duty": [0.5, 0.5, 0.5, 1.2]}, ("gaits.trot.duty", "1.2", "or equal to 1")),
        ({"gaits.trot.offset": [0.0, 1.0, 0.0, 0.0]}, ("gaits.trot.offset", "1.0", "less than 1")),
        (
            {"gaits.trot.foothold_front": 0.2347},
            ("gaits.trot", "foothold_front and foothold_rear belong"),
        ),
        ({"gaits.trot.horizon": "multiphase"}, ("gaits.trot", "needs foothold_front")),
        (
            {
                "gaits.own.horizon": "multiphase",
                "gaits.own.foothold_front": 0.2347,
                "gaits.own.foothold_rear": 0.2347,
            },
            ("gaits.own", "needs Q"),
        ),
        ({"gaits.bound.transition_gait": "land"}, ("gaits.bound.transition_gait", "'landing'")),
        ({"gait.also": ["walkk"]}, ("gait.also", "'walkk'", "did you mean 'walk'")),
        ({"gaits.own.period": "a"}, ("gaits.own.period", "got 'a'")),
        # Keys of earlier versions
        ({"bound.height": 0.3}, ("bound.height", "is now gaits.bound.body_height")),
        ({"bound.front_stance": 0.1}, ("bound.front_stance", "period, offset and duty")),
        ({"bound.horizon": "multiphase"}, ("bound.horizon", "bound_multiphase")),
        (
            {"multiphase.force_x_max": 80.0},
            ("multiphase.force_x_max", "is now gaits.bound_multiphase.grf_x_max"),
        ),
        # Keys of earlier versions in SI units
        ({"lmpc.state_weights": [1.0] * 6}, ("lmpc.state_weights", "is now lmpc.Q", "1 / (L^2,")),
        ({"gaits.own.apex": 0.1}, ("gaits.own.apex", "is now gaits.own.swing_height", "of L (")),
        ({"lateral.roll_damping": 4.0}, ("is now lateral.roll_kd", "m g L sqrt(L / g)")),
        ({"leg.kp": 100.0}, ("leg.kp", "is now leg.swing_kp", "m g L / rad")),
        ({"gait.stance_time": 0.2}, ("gait.stance_time", "gaits.trot.period")),
        ({"gait.trot_flight": 0.05}, ("gait.trot_flight", "flying_trot")),
        ({"gait.switch_rule": "anywhere"}, ("gait.switch_rule", "gaits.bound.switch_rule")),
        ({"gait.landing_time": 0.1}, ("gait.landing_time", "transition_gait = 'landing'")),
        ({"gaits.bound.reference": "none"}, ("gaits.bound.reference", "got 'none'")),
        ({"gaits.bound.grf_z_min": 3.2}, ("bound", "grf_z_min", "3.2", "2.4")),
        ({"gaits.bound.grf_z_max": 0.08}, ("bound", "grf_z_min", "0.16", "0.08")),
        ({"gaits.bound.ramp_start": 0.0}, ("gaits.bound.ramp_start", "got 0.0", "greater than 0")),
        (
            {"gaits.bound.ramp_start": 1.5},
            ("gaits.bound.ramp_start", "got 1.5", "less than or equal to 1"),
        ),
        ({"gaits.bound.ramp_cycles": -1}, ("gaits.bound.ramp_cycles", "got -1")),
        ({"duration": 0.004}, ("duration", "0.004", "lmpc.control_dt 0.005")),
        ({"duration": 0.0}, ("duration", "got 0.0", "greater than 0")),
        ({"lmpc.grf_z_min": 1.6}, ("lmpc", "grf_z_min", "1.6", "1.28")),
        ({"lmpc.model_dt": 0.0015}, ("lmpc.model_dt", "multiple", "0.0015")),
        ({"lmpc.control_dt": 0.0004}, ("lmpc.control_dt", "multiple", "0.0004")),
        ({"lmpc.command_slew": 0.0}, ("lmpc.command_slew", "greater than 0")),
        ({"command.times": [0.0, 1.0]}, ("command", "equally long", "2", "5")),
        ({"command.times": [0, 3, 2, 4, 5]}, ("command", "increase")),
        ({"lmpc.Q": [1.0, 2.0]}, ("lmpc.Q", "[1.0, 2.0]")),
        ({"seed": True}, ("seed", "True", "integer")),
        ({"seed.x": 1}, ("seed",)),
    ],
)
def test_a_wrong_value_is_one_line_that_names_key_value_and_wish(overrides, parts):
    text = message(overrides)
    for part in parts:
        assert part in text, text


def test_the_message_names_the_file_and_the_nearest_one(tmp_path):
    good = tmp_path / "walk.toml"
    good.write_text("[lmpc]\nhorizon = 'long'\n")
    assert str(good) in message({}, path=good)
    text = message({}, path=tmp_path / "wlak.toml")
    assert "no such file" in text
    assert "walk.toml" in text


def test_broken_toml_is_reported_with_its_place(tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text("duration = = 3\n")
    assert "line 1" in message({}, path=bad)


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path):
    path = tmp_path / "walk.toml"
    path.write_bytes("duration = 3.0 # größer\n".encode("utf-8-sig"))
    assert load_config(RunConfig, path).duration == 3.0


@pytest.mark.parametrize("content", [b"\xff\xfed\x00", "größe = 1".encode("latin-1"), b"\0" * 9])
def test_a_file_that_is_no_text_is_named(tmp_path, content):
    path = tmp_path / "walk.toml"
    path.write_bytes(content)
    assert f"{path}: not valid TOML" in message({}, path=path)
    assert f"{tmp_path}: cannot be read" in message({}, path=tmp_path)


RUN, SWEEP, FIT = "trot_velocity.toml", "sweeps/push_trot.toml", "koopman_fit.toml"


@pytest.mark.parametrize(
    ("cls", "name", "kind", "command"),
    [
        (SweepConfig, RUN, "a closed-loop run", "experiments/closed_loop.py"),
        (SweepConfig, FIT, "a fit study", "experiments/koopman_fit.py"),
        (RunConfig, SWEEP, "a sweep", "experiments/sweep.py"),
        (RunConfig, FIT, "a fit study", "experiments/koopman_fit.py"),
        (FitStudyConfig, RUN, "a closed-loop run", "experiments/closed_loop.py"),
        (FitStudyConfig, SWEEP, "a sweep", "experiments/sweep.py"),
    ],
)
def test_a_config_of_another_kind_is_named_with_what_takes_it(cls, name, kind, command, repository):
    path = repository / "configs" / name
    text = message({}, cls=cls, path=path)
    assert f"{path} is the file of {kind}, which {command} takes" in text
    assert "{" not in text
    assert len(text) < 300


def test_a_mistake_in_a_file_of_the_right_kind_is_still_the_key_s(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text('base = "walk.toml"\nseedz = 4\n[axes.a]\nvalues = [1]\n')
    assert "seedz: unknown key (got 4); did you mean 'seeds'?" in message({}, SweepConfig, path)
    path.write_text("[axes.a]\nvalues = [1]\n")
    assert "base: missing, it has no default" in message({}, SweepConfig, path)
    path.write_text("[project]\nname = 'x'\n[tool.ruff]\nline = 3\n")
    assert "project: unknown key (got {'name': 'x'})" in message({}, RunConfig, path)
    path.write_text("[project]\n" + "".join(f"key_{i} = 'long'\n" for i in range(40)))
    assert "project: unknown key (got a section of 40 keys)" in message({}, RunConfig, path)
    path.write_text(f"duration = [{'1, ' * 200}1]\n")
    assert len(message({}, RunConfig, path)) < len(str(path)) + 150


def test_overrides_win_over_the_file(tmp_path):
    path = tmp_path / "walk.toml"
    path.write_text("duration = 3\n[lmpc]\nhorizon = 4\n")
    config = load_config(RunConfig, path, {"lmpc.horizon": 9})
    assert (config.duration, config.lmpc.horizon) == (3.0, 9)


def test_a_config_survives_the_way_through_plain_data():
    config = load_config(RunConfig, None, {"lmpc.grf_z_max": float("inf"), "seed": 7})
    again = load_config(RunConfig, None, to_dict(config))
    assert again == config


def test_building_a_config_in_python_checks_it_too():
    with pytest.raises(ValueError, match="horizon"):
        LmpcConfig(horizon=0)
    with pytest.raises(ValueError, match="mass"):
        SrbConfig(mass=-3.0)
    with pytest.raises(ValueError, match="force_z"):
        DatasetConfig(force_z=(10.0, 0.0))
    with pytest.raises(ValueError, match="grf_z_min must not exceed grf_z_max"):
        RunConfig(gaits=Gaits({"trot": GaitConfig(grf_z_min=0.3, grf_z_max=0.2)}))
    with pytest.raises(ValueError, match="times must increase"):
        GaitScheduleConfig(names=("trot", "bound", "trot"), times=(0.0, 1.0, 1.0))


def test_a_gait_of_a_config_changes_the_librarys_or_is_its_own():
    keys = {
        "gaits.bound.swing_height": 0.24,
        "gaits.gallop.offset": [0.0, 0.1, 0.5, 0.6],
        "seed": 3,
    }
    config = load_config(RunConfig, None, keys)
    assert config.gaits.bound == dataclasses.replace(LIBRARY["bound"], swing_height=0.24)
    assert config.gaits["gallop"] == GaitConfig(offset=(0.0, 0.1, 0.5, 0.6))
    assert config.gaits.trot == LIBRARY["trot"]
    assert set(config.gaits) == {*LIBRARY, "gallop"}
    with pytest.raises(AttributeError):
        _ = config.gaits.canter
    # As plain data: what is not the library's, and what is walked, in full.
    data = to_dict(config)
    assert set(data["gaits"]) == {"trot", "bound", "gallop"}
    assert load_config(RunConfig, None, data) == config
    assert hash(load_config(RunConfig, None, data)) == hash(config)
    assert dataclasses.replace(config, seed=4).gaits is config.gaits
    assert config != load_config(RunConfig, None, keys | {"gaits.bound.swing_height": 0.2582})


def test_what_a_gait_does_not_give_is_the_lmpcs_or_the_legs():
    keys = {"lmpc.body_height": 0.6, "leg.swing_height": 0.2, "gaits.pace.body_height": 0.61}
    config = load_config(RunConfig, None, keys)
    found = {name: gait_setting(config, name, "body_height") for name in ("trot", "pace", "bound")}
    assert found == {"trot": 0.6, "pace": 0.61, "bound": 0.6338}
    assert gait_setting(config, "pronk", "swing_height") == 0.2
    seen = Overlay(config, {"gaits.pace.body_height": 0.7, "lmpc.body_height": 0.5})
    heights = [gait_setting(seen, name, "body_height") for name in ("trot", "pace", "bound")]
    assert heights == [0.5, 0.7, 0.6338]


def test_gaits_follow_one_another_at_their_times():
    config = load_config(
        RunConfig, None, {"gait.names": ["trot", "bound", "stand"], "gait.times": [0, 1.5, 4]}
    )
    assert config.gait.names == ("trot", "bound", "stand")
    assert config.gait.times == (0.0, 1.5, 4.0)


def test_the_bound_s_force_limits_may_be_switched_off():
    infinite = {"grf_x_max": float("inf"), "grf_z_max": float("inf")}
    config = load_config(RunConfig, None, {f"gaits.bound.{key}": v for key, v in infinite.items()})
    assert config.gaits.bound.grf_x_max == config.gaits.bound.grf_z_max == float("inf")


@pytest.mark.parametrize("cls", [RunConfig, FitStudyConfig])
def test_every_key_has_a_description_that_ends_with_its_unit(cls):
    for name, info, _ in fields(cls):
        assert info.description, name
        assert info.description.endswith("]."), (name, info.description)


CONFIGS = sorted(path.name for path in (Path(__file__).parents[1] / "configs").glob("*.toml"))


@pytest.mark.parametrize("name", CONFIGS)
def test_the_shipped_configs_load(name, repository):
    cls = FitStudyConfig if name == "koopman_fit.toml" else RunConfig
    config = load_config(cls, repository / "configs" / name)
    if name in ("trot_velocity.toml", "trot_velocity_long.toml"):
        assert config.duration == 22.0


def test_what_a_gait_is_left_through_is_compiled_in_however_far_it_goes():
    keys = {"gaits.bound.transition_gait": "landing", "gaits.landing.transition_gait": "walk"}
    gaits = load_config(RunConfig, None, keys).gaits
    assert reachable_gaits(gaits, ["bound", "trot"]) == ["bound", "trot", "landing", "walk"]


def test_names_of_earlier_versions_say_what_has_become_of_them():
    with pytest.raises(ImportError, match=r"BoundConfig has gone: use GaitConfig, .*LIBRARY"):
        from kjax.config import BoundConfig  # noqa: F401
    with pytest.raises(ImportError, match=r"kjax\.gait\.trot has gone: .*gaits\.LIBRARY"):
        from kjax.gait import trot  # noqa: F401
    with pytest.raises(ImportError, match="cannot import name 'gallop'"):
        from kjax.gait import gallop  # noqa: F401
