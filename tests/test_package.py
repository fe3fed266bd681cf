"""The wheel that users install."""

import importlib
import re
import subprocess
import sys
import zipfile

import pytest

import kjax
from kjax.moved import MOVED, NAMES


@pytest.mark.slow
def test_the_wheel_holds_every_subpackage_the_mjcf_the_configs_and_the_command(
    repository, tmp_path
):
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", tmp_path, repository],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    inside = set(zipfile.ZipFile(wheel).namelist())
    sources = {
        str(path.relative_to(repository))
        for path in (repository / "kjax").rglob("*")
        if path.suffix in {".py", ".xml", ".jinja"} or path.name == "py.typed"
    }
    assert sources <= inside
    assert "kjax/robots/go1.xml" in inside
    shipped = {
        f"kjax/{path.relative_to(repository)}" for path in (repository / "configs").rglob("*.toml")
    }
    assert len(shipped) > 20
    assert shipped <= inside
    scripts = next(name for name in inside if name.endswith("entry_points.txt"))
    assert "kjax = kjax.commands.main:start" in zipfile.ZipFile(wheel).read(scripts).decode()


def test_a_public_name_that_has_gone_gives_the_new_one():
    with pytest.raises(ImportError, match=r"kjax\.build_params has gone: use resolve\(config"):
        from kjax import build_params  # noqa: F401
    assert not hasattr(kjax, "nothing_of_that_name")


def test_every_equation_of_the_paper_is_found_by_its_number(repository):
    sources = "".join(path.read_text("utf-8") for path in (repository / "kjax").rglob("*.py"))
    missing = [n for n in range(1, 19) if not re.search(rf"Eq\. {n}\b", sources)]
    assert missing == []


def test_modules_and_names_that_have_moved_give_the_new_ones():
    for old, new in MOVED.items():
        with pytest.raises(ImportError, match=rf"^{old} has moved: import {new}$"):
            importlib.import_module(old)
        assert importlib.util.find_spec(new) is not None
    with pytest.raises(ImportError, match=r"kjax\.sweep has moved: import kjax\.runs\.sweeps"):
        importlib.import_module("kjax.sweep.runner")
    for module, names in NAMES.items():
        for old, new in names.items():
            with pytest.raises(ImportError) as error:
                getattr(importlib.import_module(module), old)
            assert str(error.value) == f"{module}.{old} has gone: use {new}"
        assert not hasattr(importlib.import_module(module), "nothing_of_that_name")
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("kjax.nothing_of_that_name")
