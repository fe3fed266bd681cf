import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import mujoco
import pytest

from kjax.sim.mjx_import import mjx, mjx_step, pass_on

SENSES = """<mujoco><worldbody><body><freejoint/><geom size=".1"/><site name="s"/></body>
</worldbody><sensor><gyro site="s"/><accelerometer site="s"/></sensor></mujoco>"""


def test_only_the_note_that_warp_is_not_installed_is_kept_back():
    absent = "Failed to import warp: No module named 'warp'\n"
    assert pass_on(absent + absent.replace("warp:", "mujoco_warp:")) == ""
    other = "Failed to import warp: CUDA driver version is insufficient\nmore\n"
    assert pass_on(other) == other
    assert pass_on(f"before\n{absent}after") == "before\nafter"


def test_importing_what_uses_mjx_prints_nothing():
    code = "import kjax.sim.engines.mjx, kjax.sim.sensitivity; from mujoco import mjx; mjx.step"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_a_step_in_float32_says_nothing_where_mjx_itself_warns():
    def single(tree):
        return jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == float else a, tree)

    model = mujoco.MjModel.from_xml_string(SENSES)
    own = single(jax.tree.map(jnp.asarray, mjx.put_model(model)))
    data = single(jax.tree.map(jnp.asarray, mjx.make_data(model)))
    with pytest.warns(FutureWarning, match="scatter inputs"):
        wanted = jax.eval_shape(mjx.step, own, data)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        got = jax.eval_shape(mjx_step, own, data)
    assert said == []
    assert jax.tree.map(lambda a: (a.shape, a.dtype), got) == jax.tree.map(
        lambda a: (a.shape, a.dtype), wanted
    )
