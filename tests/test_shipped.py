"""The shipped configs are found by name; where there are none, the error says what to do."""

from pathlib import Path

import pytest

from kjax.config import ConfigError, shipped
from kjax.config.shipped import described, find_config, shipped_config, shipped_names


def test_every_config_of_the_checkout_is_found_by_its_name(repository):
    files = sorted((repository / "configs").rglob("*.toml"))
    assert len(files) > 20
    for file in files:
        name = file.relative_to(repository / "configs").as_posix()
        assert shipped_config(name) == file


def test_a_name_that_is_none_gives_the_nearest():
    with pytest.raises(ConfigError, match=r"trot_velocty\.toml: .* did you mean trot_velocity"):
        shipped_config("trot_velocty.toml")


def test_an_installation_without_configs_says_so(monkeypatch):
    monkeypatch.setattr(shipped, "_FOLDER", None)
    with pytest.raises(ConfigError, match="was installed without its configs"):
        shipped_config("trot_velocity.toml")
    assert shipped_names() == []


def test_every_config_has_a_line_that_says_what_it_is():
    found = dict(described())
    assert list(found) == shipped_names()
    assert min(map(len, found.values())) > 20
    assert max(map(len, found.values())) <= 100
    assert found["trot_velocity"].startswith("The paper's main experiment")


def test_a_users_file_that_is_not_there_stays_his(tmp_path):
    assert find_config("trot_rough") == shipped_config("trot_rough.toml")
    assert find_config("nowhere.toml") == Path("nowhere.toml")
    with pytest.raises(ConfigError, match="did you mean trot_rough"):
        find_config("trot_rouhg")
