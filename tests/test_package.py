"""The wheel that users install."""

import subprocess
import sys
import zipfile

import pytest


@pytest.mark.slow
def test_the_wheel_holds_every_subpackage_and_the_mjcf(repository, tmp_path):
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
        if path.suffix in {".py", ".xml"} or path.name == "py.typed"
    }
    assert sources <= inside
    assert "kjax/robots/go1.xml" in inside
