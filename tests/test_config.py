import pytest

from kjax.config import (
    ConfigError,
    DatasetConfig,
    FitStudyConfig,
    LmpcConfig,
    RunConfig,
    SrbConfig,
    fields,
    load_config,
    to_dict,
)


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
        ({"gait.name": "trto"}, ("gait.name", "got 'trto'", "did you mean 'trot'")),
        ({"lmpc.force_z_min": 200.0}, ("lmpc", "force_z_min", "200.0", "160.0")),
        ({"lmpc.model_dt": 0.0015}, ("lmpc.model_dt", "multiple", "0.0015")),
        ({"lmpc.control_dt": 0.0004}, ("lmpc.control_dt", "multiple", "0.0004")),
        ({"lmpc.command_slew": 0.0}, ("lmpc.command_slew", "greater than 0")),
        ({"command.times": [0.0, 1.0]}, ("command", "equally long", "2", "5")),
        ({"command.times": [0, 3, 2, 4, 5]}, ("command", "increase")),
        ({"lmpc.state_weights": [1.0, 2.0]}, ("lmpc.state_weights", "[1.0, 2.0]")),
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


def test_overrides_win_over_the_file(tmp_path):
    path = tmp_path / "walk.toml"
    path.write_text("duration = 3\n[lmpc]\nhorizon = 4\n")
    config = load_config(RunConfig, path, {"lmpc.horizon": 9})
    assert (config.duration, config.lmpc.horizon) == (3.0, 9)


def test_a_config_survives_the_way_through_plain_data():
    config = load_config(RunConfig, None, {"lmpc.force_z_max": float("inf"), "seed": 7})
    again = load_config(RunConfig, None, to_dict(config))
    assert again == config


def test_building_a_config_in_python_checks_it_too():
    with pytest.raises(ValueError, match="horizon"):
        LmpcConfig(horizon=0)
    with pytest.raises(ValueError, match="mass"):
        SrbConfig(mass=-3.0)
    with pytest.raises(ValueError, match="force_z"):
        DatasetConfig(force_z=(10.0, 0.0))


@pytest.mark.parametrize("cls", [RunConfig, FitStudyConfig])
def test_every_key_has_a_description_that_ends_with_its_unit(cls):
    for name, info, _ in fields(cls):
        assert info.description, name
        assert info.description.endswith("]."), (name, info.description)


@pytest.mark.parametrize("path", ["trot_velocity.toml", "trot_velocity_long.toml"], ids=lambda p: p)
def test_the_shipped_configs_load(path, repository):
    assert load_config(RunConfig, repository / "configs" / path).duration == 22.0
