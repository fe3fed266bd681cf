import json
import pwd
import subprocess
import sys
from argparse import Namespace

import jax
import numpy as np
import pytest

from kjax import cli, options
from kjax.config import ConfigError


def parse(*words):
    return options.parse_config(options.RunOptions, list(words), "test")


def refusal(capsys, *words):
    with pytest.raises(SystemExit) as caught:
        parse(*words)
    assert caught.value.code == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1, text
    return text


def test_any_key_can_be_overridden_by_its_dotted_name():
    config, _ = parse(
        "--lmpc.horizon", "9", "--gaits.bound.switch_rule=anywhere", "--lmpc.grf_z_min", "-0.05"
    )
    assert (config.lmpc.horizon, config.lmpc.grf_z_min) == (9, -0.05)
    assert config.gaits.bound.switch_rule == "anywhere"


def test_lists_are_written_as_in_toml():
    config, _ = parse("--command.times", "[0, 1]", "--command.v_x", "[-0.1, 0.2]")
    assert config.command.v_x == (-0.1, 0.2)
    config, _ = parse("--gaits.gallop.period", "0.4", "--gait.names", '["gallop"]')
    assert config.gaits["gallop"].period == 0.4
    config, _ = parse("--gait.names", '["trot", "bound"]', "--gait.times=[0, 2.5]")
    assert config.gait.names == ("trot", "bound")
    assert config.gait.times == (0.0, 2.5)


def test_an_unknown_option_is_one_line_with_the_nearest_name(capsys):
    assert "did you mean --lmpc.horizon?" in refusal(capsys, "--lmpc.horizn", "3")


def test_words_that_are_missing_or_of_the_wrong_type_are_one_line(capsys):
    assert "--lmpc.horizon: a value is missing" in refusal(capsys, "--lmpc.horizon")
    assert "--lmpc.horizon: a value is missing" in refusal(capsys, "--lmpc.horizon", "--seed", "1")
    assert "lmpc.horizon" in refusal(capsys, "--lmpc.horizon", "many")
    assert "--out" in refusal(capsys, "--out")
    assert "unknown option --viedo" in refusal(capsys, "--viedo")


def test_a_shipped_config_is_found_by_its_name_and_may_stand_behind_its_keys():
    assert parse("bound_rough")[0].gait.names == ("bound_multiphase",)
    config, args = parse("--lmpc.horizon", "10", "trot_velocity", "--duration=3")
    assert (config.lmpc.horizon, config.duration, args.config) == (10, 3.0, "trot_velocity")


def test_a_file_of_ones_own_comes_before_a_shipped_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "trot_velocity").write_text("duration = 1.5")
    assert parse("trot_velocity")[0].duration == 1.5


def test_a_bad_value_is_one_line(capsys):
    assert "greater than 0" in refusal(capsys, "--lmpc.horizon", "0")
    assert "no such file" in refusal(capsys, "configs/nowhere.toml")


def test_help_is_a_screen_and_leads_to_the_keys(capsys):
    with pytest.raises(SystemExit) as caught:
        parse("--help")
    assert caught.value.code in (0, None)
    text = capsys.readouterr().out
    assert len(text.splitlines()) <= 24
    assert "--help-config" in text
    assert "--out PATH" in text


def test_every_key_is_shown_with_type_unit_and_default(capsys):
    with pytest.raises(SystemExit) as caught:
        parse("--help-config")
    assert caught.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "--lmpc.control_dt FLOAT Time between two plans [s]. default: 0.005" in text
    assert "--gaits.trot.switch_rule {anywhere,first_flight,cycle_end} When it may be left" in text
    assert "--gait.names LIST" in text


def test_an_unwritable_folder_is_one_line(capsys, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    _, args = parse("--out", str(blocked / "run"))
    with pytest.raises(SystemExit) as caught:
        cli.output_folder(args, "x")
    assert caught.value.code == 2
    assert str(blocked) in capsys.readouterr().err


def test_json_has_no_nan_and_is_written_whole(tmp_path):
    path = tmp_path / "m.json"
    cli.save_json(path, {"a": np.float64(1.5), "b": float("nan"), "c": np.arange(2)})
    assert json.loads(path.read_text()) == {"a": 1.5, "b": None, "c": [0, 1]}
    assert list(tmp_path.iterdir()) == [path]


def test_a_saved_config_can_be_run_again(tmp_path):
    config, _ = parse("--lmpc.horizon", "9", "--seed", "3")
    path = tmp_path / "config.toml"
    cli.save_config(path, config)
    assert "git_revision" in path.read_text()
    assert parse(str(path))[0] == config


@pytest.fixture
def homeless(monkeypatch):
    """A container's user: no HOME, no entry in the list of users."""
    for name in ("HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)

    def unknown(number):
        raise KeyError(f"getpwuid(): uid not found: {number}")

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_without_a_home_folder_nothing_is_kept_and_a_line_says_so(homeless, capsys):
    cli.configure_jax()
    assert jax.config.jax_compilation_cache_dir is None
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "HOME is not set" in text
    assert "JAX_COMPILATION_CACHE_DIR" in text


def test_without_a_home_folder_a_given_cache_is_used(homeless, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cli.configure_jax()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "kjax" / "jax")
    assert capsys.readouterr().err == ""


def test_a_home_that_cannot_be_written_to_is_a_line_too(monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    assert cli.compilation_cache() is None
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert str(tmp_path / "file") in text


def test_the_core_imports_neither_mujoco_nor_matplotlib():
    code = (
        "import sys, kjax, kjax.robots.go1;"
        "extras = 'mujoco', 'matplotlib', 'optax', 'tqdm', 'xarray', 'tomli_w', 'cma';"
        "own = 'kjax.bench', 'kjax.studies', 'kjax.runs', 'kjax.sim', 'kjax.viz';"
        "print([m for m in (*extras, *own) if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--robot", "go3"], "robot: got 'go3', wanted one of a1, go1, go2"),
        (["--robot", "no_module:ROBOT"], "robot: 'no_module:ROBOT' cannot be loaded"),
        (["--koopman.model", "linar"], "koopman.model: got 'linar'"),
        (["--koopman.model", "residual"], "koopman.file: model = 'residual' needs a file"),
        (["--lmpc.grf_z_max", "0.1"], "lmpc.grf_z_max: in a cycle of trot"),
        (["--gaits.trot.period", "0.008"], "gaits.trot: offset and duty"),
        (["--lmpc.height", "0.3"], "--lmpc.height: is now lmpc.body_height, in units of L"),
        (["--gaits.bound.apex", "0.1"], "--gaits.bound.apex: is now gaits.bound.swing_height"),
        (["--lmpc.caution", "1.0"], "--lmpc.caution: is now lmpc.uncertainty_discount"),
    ],
)
def test_what_cannot_walk_is_one_line_before_anything_is_compiled(capsys, words, text):
    assert text in refusal(capsys, *words)


def test_an_option_out_of_range_is_one_line_and_one_that_was_not_given_passes(capsys):
    args = Namespace(seeds=0, held_out=0.0, threads=None, weight=float("nan"), updates=3)
    options.require(args, "threads", "updates", least=1)
    options.require(args, "threads", "updates", above=0)
    for name, limit, said in (
        ("seeds", {"least": 1}, "error: --seeds: got 0, wanted at least 1\n"),
        ("held_out", {"above": 0}, "error: --held-out: got 0.0, wanted more than 0\n"),
        ("weight", {"above": 0}, "error: --weight: got nan, wanted more than 0\n"),
    ):
        with pytest.raises(SystemExit) as caught:
            options.require(args, name, **limit)
        assert caught.value.code == 2
        assert capsys.readouterr().err == said


def test_a_script_ends_with_the_exit_code_of_its_main_and_without_a_traceback(capsys):
    def ends(main):
        with pytest.raises(SystemExit) as caught:
            cli.run(main, ["--quick"])
        return caught.value.code

    def throws(error):
        def main(argv):
            raise error

        return main

    assert ends(lambda argv: 7 if argv == ["--quick"] else 1) == 7
    assert ends(throws(KeyboardInterrupt())) == 130
    assert ends(throws(OSError(28, "No space left on device", "out/a.json"))) == 2
    assert ends(throws(ConfigError("lmpc: no"))) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[1:] == ["error: out/a.json: No space left on device", "error: lmpc: no"]
    assert "interrupted" in lines[0]
