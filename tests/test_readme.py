"""What the README and the pages in docs/ show is run as written."""

import importlib.util
import inspect
import re
import shlex

import jax
import mujoco
import numpy as np
import pytest

from kjax.bench import main as bench
from kjax.commands import main, study
from kjax.config import ConfigError, RunConfig, SimConfig
from kjax.config.shipped import find_config
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.sim.observe import find_addresses
from kjax.sim.resolve import build_scene

PAGES = ("README.md", *(f"docs/{name}.md" for name in (
    "index", "install", "first_walk", "your_own_loop", "your_robot", "gaits", "three_dimensions",
    "models", "qp", "sweeps", "tuning", "threads", "results", "reproduction", "benchmarks",
    "notebooks", "conventions", "faq", "changelog", "contributing",
)))  # fmt: skip


@pytest.fixture(scope="module")
def refresh(repository):
    spec = importlib.util.spec_from_file_location("refresh", repository / "docs" / "refresh.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", PAGES)
def test_tables_and_quoted_numbers_are_those_of_the_recorded_results(repository, refresh, page):
    text = (repository / page).read_text(encoding="utf-8")
    assert refresh.refreshed(text, page) == text, "run: python docs/refresh.py"


def test_a_number_that_is_not_recorded_is_found(repository, refresh):
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert "**0.0128**" in text
    assert refresh.refreshed(text.replace("**0.0128**", "**0.0100**")) == text
    text = (repository / "docs" / "models.md").read_text(encoding="utf-8")
    wrong = re.sub(r"stream\s+through \d+ MB", "stream through 7 MB", text)
    assert wrong != text
    assert refresh.refreshed(wrong, "docs/models.md").split() == text.split()


def test_a_sentence_that_quotes_results_must_stand_on_its_page_once(repository, refresh):
    text = (repository / "docs" / "models.md").read_text(encoding="utf-8")
    with pytest.raises(ValueError, match=r"docs/models.md: 2 times, wanted once: stream through"):
        refresh.refreshed(f"{text}\nstream through 7 MB.", "docs/models.md")
    with pytest.raises(ValueError, match=r"docs/models.md: 0 times, wanted once"):
        refresh.refreshed("nothing", "docs/models.md")


def test_every_page_is_on_the_site(repository):
    toc = (repository / "docs" / "index.md").read_text(encoding="utf-8")
    assert all(re.search(rf"^{page[5:-3]}$", toc, re.MULTILINE) for page in PAGES[2:])


def blocks(repository, page, language):
    text = (repository / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def test_every_page_of_the_docs_is_looked_at(repository):
    found = {path.relative_to(repository).as_posix() for path in (repository / "docs").glob("*.md")}
    assert found == set(PAGES[1:])


def test_the_readme_fits_on_a_few_screens(repository):
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert len(text.encode()) <= 8000


def test_the_controller_examples_walk_somebody_elses_robot(repository):
    """The reader's loop: raw MuJoCo on a free trunk here, none of kjax's simulation but the scene.

    The ground is not at zero, and the robot looks the other way.
    """
    with_loop, command, bare = blocks(repository, "docs/your_own_loop.md", "python")
    assert blocks(repository, "README.md", "python") == [with_loop]
    floor = -0.27
    model = build_scene(RunConfig(sim=SimConfig(floor=floor)))
    at = find_addresses(go1.ROBOT, model)
    data = mujoco.MjData(model)
    height, joints = stand_pose(go1.PARAMS, 0.27)
    heights, calls = [], []

    def put_robot_back():
        mujoco.mj_resetData(model, data)
        data.qpos[:3] = [40.0, -7.0, height + floor]
        data.qpos[3:7] = [np.cos(1.2), 0.0, 0.0, np.sin(1.2)]
        data.qpos[7:] = joints.reshape(-1)
        mujoco.mj_forward(model, data)
        heights.clear()

    def read_robot():
        trunk = data.body("trunk")
        return {
            "base_pos": trunk.xpos.copy(),
            "base_quat": trunk.xquat.copy(),
            "base_vel": data.qvel[:3].copy(),
            "base_ang_vel": data.qvel[3:6].copy(),
            "joint_pos": data.qpos[at.qpos],
            "joint_vel": data.qvel[at.qvel],
            "contact": data.sensordata[at.foot_force] > 5.0,
        }

    def send_torque(torque):
        assert isinstance(torque, np.ndarray | jax.Array)
        data.ctrl[at.actuator] = torque
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        heights.append(data.qpos[2] - floor)
        calls.append(np.array(torque))

    scope = {"read_robot": read_robot, "send_torque": send_torque}
    with jax.enable_x64(False):  # the precision that a reader gets without asking
        for code in (with_loop, bare):
            put_robot_back()
            exec(code, scope)
            assert len(heights) == 1000
            assert 0.25 < min(heights) < max(heights) < 0.31
        exec(command, scope)
    np.testing.assert_array_equal(scope["loop"].params.command.values[:, 0], 0.3)
    assert int(scope["info"].status) == 0
    assert int(scope["loop"].info.status) == 0
    # Both are the same controller.
    np.testing.assert_allclose(calls[:1000], calls[1000:], rtol=0, atol=1e-3)


def test_the_qp_example_runs_in_the_precision_that_a_reader_has(repository):
    (code,) = blocks(repository, "docs/qp.md", "python")
    scope = {}
    with jax.enable_x64(False):
        exec(code, scope)
    # By hand: the second variable is at its bound 1, the first solves 4 x + 1 + 1.01 = 0.
    np.testing.assert_allclose(scope["x"], [-0.5025, 1.0], rtol=1e-5)
    np.testing.assert_allclose(scope["slope"], [-0.25, 0.0], rtol=1e-5)
    # Without the factor 1.01 the first is -0.5, and the row x_1 + x_2 <= 0.5 holds just so.
    np.testing.assert_allclose(scope["rows"].x, [-0.5, 1.0], rtol=1e-5)


def test_the_models_example_runs(repository):
    (code,) = blocks(repository, "docs/models.md", "python")
    scope = {}
    exec(code, scope)
    assert scope["predicted"].shape == (41, 6)
    assert scope["A"].shape == (9, 9)
    assert scope["B"].shape == (9, 4)
    assert np.isfinite(scope["predicted"]).all()


def commands(text):
    """The words of each line that starts kjax, without its comment."""
    whole = text.replace("\\\n", " ")
    return [shlex.split(line, comments=True) for line in whole.splitlines() if "kjax " in line]


def require_command(words):
    """Fail where a verb, study, config or option of a command is not there."""
    if "kjax" not in words:  # a comment, or pip
        return
    verb, *rest = words[words.index("kjax") + 1 :]
    if verb == "study":
        verb, *rest = rest
        assert verb in study.STUDIES
        module = study._PACKAGES.get(verb, f"kjax.studies.{verb}")
    elif verb.startswith("--") or verb == "COMMAND":
        return
    else:
        module = main.VERBS[verb][0]
    if verb in ("run", "tune", "sweep") and rest and not rest[0].startswith("-"):
        own = (rest[0].endswith(".toml") and "results/" in rest[0]) or rest[0] in (
            "my.toml",
            "S.toml",
        )
        assert own or find_config(rest[0]).is_file(), rest[0]
    modules = [module, "kjax.options"]
    if verb == "bench":
        modules += ["kjax.bench.options", *bench.MODULES.values()]
    if verb == "tune":
        modules += ["kjax.studies.tune.options"]
    source = "".join(inspect.getsource(importlib.import_module(name)) for name in modules)
    for option in rest:
        name = option.partition("=")[0].removeprefix("--")
        if option.startswith("--") and "." not in name and name not in ("help", "help-config"):
            field = name.replace("-", "_")
            known = re.search(rf"^    {field}: ", source, re.MULTILINE)
            assert known or field in RunConfig.__dataclass_fields__, option


def test_a_command_that_does_not_exist_is_found():
    for line in ("kjax rnu", "kjax run trot_velocty", "kjax run trot_velocity --viedo",
                 "kjax study nothing"):  # fmt: skip
        (words,) = commands(line + "  # a comment")
        with pytest.raises((AssertionError, KeyError, ConfigError)):
            require_command(words)


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_name_files_and_keys_that_exist(page, repository):
    text = "\n".join(blocks(repository, page, "bash"))
    for path in re.findall(r"(?:experiments|configs)/\w+\.\w+", text):
        assert (repository / path).is_file(), path
    for line in commands(text):
        require_command(line)
    targets = (repository / "Makefile").read_text()
    for target in re.findall(r"make ([\w-]+)", text):
        assert f"\n{target}: " in targets, target


def test_there_are_commands_pictures_and_targets_to_look_for(repository):
    """The checks beside this one pass on a page that has none of them."""
    text = "\n".join(one for page in PAGES for one in blocks(repository, page, "bash"))
    assert len(commands(text)) > 30
    assert "make setup" in text
    links = re.findall(r"\]\(([^)#:]+)\)", (repository / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 5


@pytest.mark.parametrize("page", PAGES)
def test_nothing_is_left_to_be_filled_in(page, repository):
    assert not re.search(r"@@|TODO|TBD", (repository / page).read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", PAGES)
def test_pictures_and_pages_that_are_linked_are_in_the_repository(page, repository):
    text = (repository / page).read_text(encoding="utf-8")
    for path in re.findall(r"\]\(([^)#:]+)\)", text):
        assert ((repository / page).parent / path).is_file(), path
