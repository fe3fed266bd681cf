import subprocess
import sys

from kjax.sim.mjx_import import pass_on


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
