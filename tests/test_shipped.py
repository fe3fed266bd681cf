"""The shipped configs are found by name; where there are none, the error says what to do."""

import pytest

from kjax.config import ConfigError, shipped
from kjax.config.shipped import shipped_config


def test_every_config_of_the_checkout_is_found_by_its_name(repository):
    files = sorted((repository / "configs").rglob("*.toml"))
    assert len(files) > 20
    for file in files:
        name = file.relative_to(repository / "configs").as_posix()
        assert shipped_config(name) == file


def test_a_name_that_is_none_gives_the_nearest():
    with pytest.raises(ConfigError, match=r"trot_velocty\.toml: .* did you mean trot_velocity"):
        shipped_config("trot_velocty.toml")


def test_a_wheel_without_configs_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(shipped, "_FOLDER", tmp_path / "configs")
    with pytest.raises(ConfigError, match=r"without its configs; clone .* pip install -e \."):
        shipped_config("trot_velocity.toml")
