"""The command ``kjax``: its verbs are there, start what they name, and fail in a line."""

import importlib
import sys
import tomllib
from types import SimpleNamespace

import pytest

from kjax import __version__
from kjax.commands import doctor, main, study
from kjax.commands.main import main as kjax
from kjax.options import called

MODULES = [name for name, _ in main.VERBS.values()]


def test_the_console_script_is_this_one(repository):
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"kjax": "kjax.commands.main:start"}


@pytest.mark.parametrize("verb", main.VERBS)
def test_each_verb_has_help_that_fits_on_a_screen(call, capsys, verb):
    assert call(kjax, verb, "--help") == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"usage: kjax {verb}")
    assert len(out.splitlines()) <= 50
    assert err == ""
    assert verb in main.usage()


def test_a_verb_gets_the_words_after_it_and_its_exit_code_is_kept(call, monkeypatch):
    seen = []
    stand_in = SimpleNamespace(main=lambda words: seen.append((called(), list(words))) or 7)
    monkeypatch.setitem(sys.modules, "stand_in", stand_in)
    monkeypatch.setitem(main.VERBS, "run", ("stand_in", ""))
    assert call(kjax, "run", "trot_velocity", "--duration", "3") == 7
    assert seen == [("kjax run", ["trot_velocity", "--duration", "3"])]


def test_a_study_of_ones_own_is_found_by_its_name(call, monkeypatch):
    seen = []

    def study(words):
        seen.append((called(), list(words)))
        return 5

    monkeypatch.setitem(sys.modules, "mine", SimpleNamespace(main=study))
    assert call(kjax, "study", "mine:main", "--seeds", "3") == 5
    assert seen == [("kjax study mine:main", ["--seeds", "3"])]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["rnu"], "did you mean kjax run?"),
        (["run", "trot_velocty"], "did you mean trot_velocity?"),
        (["run", "trot_velocity", "--lmpc.horizn", "3"], "did you mean --lmpc.horizon?"),
        (["sweep"], "CONFIG"),
        (["sweep", "trot_velocity"], "trot_velocity"),
        (["study", "invarience"], "wanted one of invariance"),
        (["study", "no_module:main"], "cannot be loaded: No module named 'no_module'; is its"),
        (["study", "kjax.types:GRAVITY"], "is a float, wanted a function"),
        (["configs", "trot"], "no such config"),
        (["bench", "speed"], "which benchmark?"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(call, capsys, words, said):
    assert call(kjax, *words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1, err
    assert said in err


def test_what_is_not_installed_is_named_with_the_extra_that_brings_it(call, capsys, monkeypatch):
    def missing(name):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setattr(main.importlib, "import_module", missing)
    assert call(kjax, "run", "trot_velocity") == 2
    assert capsys.readouterr().err == (
        "error: kjax run needs mujoco; install it with: pip install 'kjax[all]' "
        "(or the extra 'sim' alone)\n"
    )


def test_what_a_verb_needs_at_its_end_is_asked_for_at_its_beginning(call, capsys, monkeypatch):
    find = main.importlib.util.find_spec
    monkeypatch.setattr(
        main.importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name)
    )
    assert call(kjax, "fit", "koopman_fit") == 2
    assert capsys.readouterr().err.startswith("error: kjax fit needs matplotlib; ")
    assert set(main.NEEDS) <= set(main.VERBS)


def test_a_module_of_our_own_that_is_missing_is_no_users_mistake(call, monkeypatch):
    monkeypatch.setitem(main.VERBS, "run", ("kjax.nowhere", ""))
    with pytest.raises(ModuleNotFoundError):
        kjax(["run"])


def test_the_extras_are_those_of_the_package(repository):
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    assert set(main.EXTRAS) <= set(project["optional-dependencies"])
    assert set(doctor.PACKAGES.values()) - {""} <= set(main.EXTRAS)


@pytest.mark.parametrize("name", study.STUDIES)
def test_every_study_is_there(name):
    module = importlib.import_module(study._PACKAGES.get(name, f"kjax.studies.{name}"))
    assert callable(module.main)


def test_version_and_configs(call, capsys, repository, tmp_path):
    assert call(kjax, "--version") == 0
    assert capsys.readouterr().out == f"kjax {__version__}\n"
    assert call(kjax, "configs") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(list((repository / "configs").rglob("*.toml")))
    assert call(kjax, "configs", "walk") == 0
    text = (repository / "configs" / "walk.toml").read_text()
    assert capsys.readouterr().out == text
    assert call(kjax, "configs", "walk", "--out", tmp_path / "mine.toml") == 0
    assert (tmp_path / "mine.toml").read_text() == text


@pytest.fixture
def quick(monkeypatch):
    """Leave out the part that starts renderers in processes of their own."""
    monkeypatch.setattr(doctor, "graphics", lambda: doctor.Finding("graphics", "not tried"))


def test_doctor_reports_a_whole_installation(call, capsys, quick, monkeypatch):
    monkeypatch.setenv("NPROC", "1")
    assert call(kjax, "doctor") == 0
    out = capsys.readouterr().out
    for what in ("kjax", "python", "packages", "configs", "threads", "compile cache", "devices"):
        assert f"{what:16} " in out
    assert f"jax {importlib.import_module('jax').__version__}" in out
    assert "NPROC = 1" in out


def test_doctor_says_what_is_missing_and_the_remedy(call, capsys, quick, monkeypatch):
    version = doctor.importlib.metadata.version

    def without(name):
        if name in ("mujoco", "optax"):
            raise doctor.importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(doctor.importlib.metadata, "version", without)
    monkeypatch.delenv("NPROC", raising=False)
    assert call(kjax, "doctor") == 1
    out = capsys.readouterr().out
    assert "missing          mujoco\n" + " " * 17 + "-> pip install 'kjax[sim]'" in out
    assert "-> pip install 'kjax[learn]'" in out
    assert "set NPROC=1" in out


def test_a_renderer_that_fails_is_passed_over(monkeypatch):
    tried = []

    def run(command, *, env, **_):
        tried.append(env["MUJOCO_GL"])
        return SimpleNamespace(returncode=0, stdout="drawn" if env["MUJOCO_GL"] == "osmesa" else "")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(doctor.subprocess, "run", run)
    assert doctor.graphics().found == "MUJOCO_GL=osmesa draws"
    assert tried == ["egl", "osmesa"]
    monkeypatch.setattr(
        doctor.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1, stdout="")
    )
    assert doctor.graphics().remedy.startswith("install a renderer")
