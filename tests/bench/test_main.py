"""The benchmark's entry: verbs, their options, what each leaves."""

import json
import re
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from kjax.bench import controller, main
from kjax.bench.main import main as entry
from kjax.bench.options import BenchOptions


@pytest.fixture
def stand_in(monkeypatch):
    """Stand in for the module of every verb; its ``seen`` are the options that it got."""
    module = SimpleNamespace(seen=[])

    def run(folder, args):
        module.seen.append(args)
        (folder / "table.md").write_text("| a table |\n")
        return {"speed": 2.0, "nothing": None}

    @dataclass(kw_only=True)
    class More(BenchOptions):
        more: int = 1

    module.run, module.OPTIONS = run, More
    monkeypatch.setitem(sys.modules, "stand_in", module)
    for name in main.MODULES:
        monkeypatch.setitem(main.MODULES, name, "stand_in")
    return module


@pytest.mark.parametrize("verb", ["qp", "simulation", "edmd", "gradient", "device"])
def test_a_verb_gets_its_options_and_leaves_its_results(stand_in, call, capsys, tmp_path, verb):
    assert call(entry, verb, "--quick", "--more", 3, "--out", tmp_path) == 0
    (args,) = stand_in.seen
    assert (args.quick, args.more) == (True, 3)
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert (found["speed"], found["nothing"]) == (2.0, None)
    assert "git_revision" in found["provenance"]
    assert "| a table |" in capsys.readouterr().out


def test_the_verbs_are_those_of_the_help(call, capsys):
    assert call(entry, "-h") == 0
    text = capsys.readouterr().out
    assert "{controller,qp,simulation,edmd,gradient,device}" in text
    for verb in main.BENCHMARKS:
        assert f"\n{verb}: " in text


@pytest.mark.parametrize("verb", main.BENCHMARKS)
def test_each_verb_has_help_of_its_own(call, capsys, verb):
    assert call(entry, verb, "--help") == 0
    text = capsys.readouterr().out
    assert re.match(rf"usage: \S+ {verb} ", text)
    option = {"controller": "--no-startup", "edmd": "--peers NAME", "qp": "--problems PATH",
              "gradient": "--through-flight"}.get(verb, "--quick")  # fmt: skip
    assert option in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "which benchmark? one of: controller, qp, simulation, edmd, gradient, device"),
        (["speed"], "which benchmark?"),
        (["qp", "--quik"], "--quik"),
        (["controller", "nowhere.toml"], "nowhere.toml: no such file"),
        (["controller", "--lmpc.horizn", "3"], "did you mean --lmpc.horizon"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(stand_in, call, capsys, words, said):
    assert call(entry, *words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert said in err
    assert stand_in.seen == []


@pytest.mark.parametrize("startup", [True, False])
def test_the_controller_s_latency_and_unless_left_out_its_start(
    call, capsys, monkeypatch, tmp_path, repository, startup
):
    seen = []
    monkeypatch.setattr(
        controller, "controller_latency", lambda config: {"plan_ms_median": config.duration}
    )
    monkeypatch.setattr(
        controller, "start_up", lambda config: seen.append(config) or {"first_run_s": 9.0}
    )
    config = str(repository / "configs" / "trot_velocity.toml")
    words = [config, "--duration", 3, "--out", tmp_path]
    assert call(entry, "controller", *words, *([] if startup else ["--no-startup"])) == 0
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["config"] == config
    assert found["plan_ms_median"] == 3.0
    assert ("first_run_s" in found) is startup
    assert seen == ([config] if startup else [])
    assert "plan_ms_median" in capsys.readouterr().out


def test_a_start_is_timed_with_an_empty_and_then_a_filled_compile_cache(monkeypatch):
    commands, caches = [], []

    def run(command, *, env, check, capture_output):
        commands.append(command[1:])
        cache = controller.Path(env["JAX_COMPILATION_CACHE_DIR"])
        caches.append((cache, sorted(cache.parent.glob("cache/*"))))
        cache.mkdir(exist_ok=True)
        (cache / "program").touch()
        if "--out" in command:
            folder = controller.Path(command[command.index("--out") + 1])
            folder.mkdir(exist_ok=True)
            (folder / "metrics.json").write_text('{"realtime_factor": 4.0}')

    monkeypatch.setattr(controller.subprocess, "run", run)
    found = controller.start_up("trot.toml")
    walk = ["-m", "kjax.studies.closed_loop", "trot.toml"]
    assert [command[:3] for command in commands[:2]] == [walk] * 2
    assert [len(programs) for _, programs in caches] == [0] + [1] * (len(commands) - 1)
    assert len({cache for cache, _ in caches}) == 1
    assert commands[2][0] == "-c", "the README's lines"
    assert commands[2] == commands[3]
    assert ["-m", "kjax", "doctor"] in commands
    assert found["second_run_realtime_factor"] == 4.0
    assert min(found.values()) > 0.0
    assert {"doctor_s", "own_loop_first_s", "own_loop_second_s", "switch_video_run_s"} <= set(found)
