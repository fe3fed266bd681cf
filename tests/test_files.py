"""A result depends on modules of one's own: robots, kinds of models, engines."""

import importlib
import sys

import pytest

from kjax.config import AxisConfig, RunConfig, SweepConfig, load_config
from kjax.files import file_hashes, own_module_hash
from kjax.runs.cache import Cache
from kjax.runs.sweeps.runner import _keys

KIND = """
from kjax.prediction.kinds.rigid_body import SRB
HEAVY = SRB  # {}
"""


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write the module ``of_my_own`` with some text."""
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("of_my_own", None)

    def write(text):
        (tmp_path / "of_my_own.py").write_text(text)
        importlib.invalidate_caches()

    yield write
    sys.modules.pop("of_my_own", None)


def test_a_kind_of_model_that_was_edited_is_another_input(write):
    config = load_config(RunConfig, None, {"koopman.model": "of_my_own:HEAVY"})
    write(KIND.format("first"))
    first = file_hashes(config)
    assert set(first) == {"koopman.model"}
    assert file_hashes(config) == first
    write(KIND.format("second"))
    assert file_hashes(config) != first
    assert file_hashes(RunConfig()) == {}


def test_an_engine_that_was_edited_computes_a_sweep_again(write, tmp_path):
    write("class ENGINE: ...")
    axes = {"speed": AxisConfig(values=(0.1, 0.3))}
    sweep = SweepConfig(base="base.toml", axes=axes, engine="of_my_own:ENGINE")
    cache, cases = Cache(tmp_path / "out"), [RunConfig()]
    first = _keys(cache, sweep, cases)
    assert _keys(cache, sweep, cases) == first
    write("class ENGINE: 'torques forgotten'")
    assert _keys(cache, sweep, cases) != first
    assert own_module_hash("mujoco_batch") == "kjax"
